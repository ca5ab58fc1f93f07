"""What must hold of any measurement, at any size: the self-check of ``--quick``."""

import math
import re
from pathlib import Path

from . import network, scaling

DOCS = Path(__file__).resolve().parents[2] / "docs" / "engine.md"
ADJOINT = 1e-5
"""|<T E, I> - <E, T' I>| over <T E, I>: sums of float32 in two orders, taken in double at the end."""
PICTURE = 0.05
"""RMSE of T's picture under a one-texel sun, 24x24 pixels; a lost or doubled tier is off by 0.5 or more."""


def failures(results: dict, tables: dict[str, str], plots) -> list[str]:
    """Return a sentence for each thing that does not hold; ``results`` are those of all sections."""
    found = {section: entry["found"] for section, entry in results.items()}
    wrong = [f"{path} is {value}" for path, value in _numbers(found) if not math.isfinite(value)]

    def check(holds, text):
        if not holds:
            wrong.append(text)

    floors, siren, transport = found["floors"], found["siren"], found["transport"]
    for name, rate in {**floors["bandwidth"]["rates"], **floors["rays"]}.items():
        check(rate > 0, f"floors: {name} is {rate}")
    check(len(floors["matmul"]) == 3 * len(network.LAYOUTS), "floors: products are missing")

    check(len(siren["networks"]) == 1, "siren: no network was measured")
    for row in siren["networks"]:
        check(row["layout"] in network.LAYOUTS, f"siren: unknown layout {row['layout']}")
        check(row["step"]["median_s"] > row["forward"]["min_s"], "siren: a reverse pass that takes no time")
    measured = {"siren": siren["networks"], "transport": transport["scenes"]}
    for section, rows in measured.items():
        for row in rows:
            fresh, launched = row["kernels"]["compiled"], row["kernels"]["launched"]
            check(launched >= row["kernels"]["calls"], f"{section}: only {launched} kernels in the history")
            check(fresh == 0, f"{section}: {fresh} of {launched} kernels compiled after warm-up")

    check(len(transport["scenes"]) == 1, "transport: no scene was measured")
    for row in transport["scenes"]:
        check(row["adjointness"] < ADJOINT, f"transport: adjoint off by {row['adjointness']:.2g}")
        check(row["columns"] > 0, "transport: no exact column under a clear sky")
        check(row["bytes"]["apply"] > 0 and row["floor_s"] > 0, "transport: nothing is read")
        check(row["disk"] is not None, "transport: T was not found on disk after it was kept there")

    quality = found["quality"]
    check(len(quality["rows"]) == 1 and len(quality["curve"]) == 3, "quality: rows are missing")
    for row in quality["rows"]:
        check(row["corrected"] < PICTURE, f"quality: T's picture is off by {100 * row['corrected']:.2g} %")
        check(row["noise"] < PICTURE, f"quality: the reference is off by {100 * row['noise']:.2g} %")
        check(row["prb_rmse"] > row["rmse"], "quality: 16 samples of prb are better than T")

    variables = [row["variable"] for row in found["scaling"]["rows"]]
    for variable in scaling.RANGES:
        check(variables.count(variable) == 2, f"scaling: rows of {variable} are missing")
    check(len(found["fits"]["rows"]) == 1, "fits: no map was fitted")
    for row in found["fits"]["rows"]:
        check(row["noisy_worst"] <= row["noisy_mean"] <= row["log_psnr"] + 1, "fits: noise makes them better")

    wanted = set(re.findall(r"<!-- table: ([\w-]+) -->", DOCS.read_text()))
    odd = sorted(wanted ^ set(tables))
    check(not odd, f"tables and markers of docs/engine.md differ in {', '.join(odd)}")
    for name, text in tables.items():
        check(text.strip() and "nan" not in text, f"table {name} is empty or has no numbers")
    for file in plots:
        check(file.stat().st_size > 1000, f"{file.name} is empty")
    return wrong


def _numbers(value, path=""):
    """Yield (path, number) of everything in nested dicts and lists that is a float."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _numbers(item, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from _numbers(item, f"{path}[{i}]")
    elif isinstance(value, float):
        yield path, value
