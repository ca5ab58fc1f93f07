"""The results as tables, one for each marker of docs/engine.md, and what precedes them."""

import math
import statistics

from experiments.harness import markdown, number


def si(value: float | None, unit: str = "") -> str:
    """Write a number with three digits and a prefix: 0.0123 s is 12.3 ms."""
    if not value or not math.isfinite(value):
        return "-" if value is None else f"{value:g} {unit}".rstrip()
    scales = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1, ""), (1e-3, "m"), (1e-6, "u"))
    factor, prefix = next((scale for scale in scales if abs(value) >= scale[0]), scales[-1])
    digits = max(0, 2 - len(str(int(abs(value) / factor))) + 1)
    return f"{value / factor:.{digits}f} {prefix}{unit}".rstrip()


def seconds(value: float | None) -> str:
    """Write a duration: 1200 s, 12.3 ms."""
    return "-" if value is None else f"{value:.0f} s" if value >= 100 else si(value, "s")


def percent(value: float) -> str:
    """Write a share in percent with three digits."""
    return f"{100 * value:.3g} %"


def times(value: float) -> str:
    """Write a ratio with three digits."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def of(key: str, write, *arguments):
    """Return a column: what ``write`` makes of a row's number."""
    return lambda row: write(row[key], *arguments)


def median_and_best(key: str):
    """Return a column of times."""
    return lambda row: f"{seconds(row[key]['median_s'])} ({seconds(row[key]['min_s'])})"


def _note(row):
    """Write what a time of the transport is held against; the shortest one if there is no such thing."""
    if "ratio" in row:
        return f"{times(row['ratio'])} times a step through T"
    if "above_floor" in row:
        return f"they take {row['above_floor']:.2f} times that"
    return f"every {row['every']} steps" if "every" in row else seconds(row.get("min_s"))


def _rates(product):
    return lambda row: f"{row[product]['gflops']:.0f} ({row[product]['gflops_best']:.0f})"


SIZE = {"pixels": "{pixels}x{pixels}", "texels": "{texels[1]}x{texels[0]}"}
SUN = {"scene": "{scene}", "sun at": "{sun}"}
ERROR = {
    "RMSE": of("rmse", percent),
    "of it the reference's noise": of("noise", percent),
    "without it": of("corrected", percent),
}
COLUMNS = {
    "machine": {
        "case": "{case}",
        "begun, UTC": lambda r: r["machine"]["time_utc"].removesuffix("+00:00"),
        "took": lambda r: f"{r['seconds']:.0f} s",
        "load before": lambda r: number(r["machine"]["load"], ".2f"),
        "sampling of T": "{sampling}",
    },
    "bandwidth": {
        "streaming": "{streaming}",
        "bytes a second": of("rate", si, "B/s"),
        "array": of("array_bytes", si, "B"),
        "largest cache": of("cache_bytes", si, "B"),
    },
    "matmul": {"width": "{width}", "points": "{points:,}", "a point is a": lambda r: r["layout"][:-1]}
    | {
        f"{product}, GFLOP/s": _rates(product)
        for product in ("forward", "gradient of the weights", "gradient of the input")
    },
    "rays": {"rays": "{rays}", "at once": "{count:,}", "rays a second": of("rate", si)},
    "siren": {
        "network": "{hidden}x{depth} ({preset})",
        "points": "{points:,}",
        "forward": lambda r: seconds(r["forward"]["median_s"]),
        "forward + backward": median_and_best("step"),
        "its products alone": median_and_best("own"),
        "ratio": "{ratio:.2f}",
        "to the quicker layout": "{ratio_best:.2f}",
        "PyTorch": lambda r: seconds(r["torch"] and r["torch"]["median_s"]),
        "GFLOP/s": "{gflops:.0f}",
        "compiled after warm-up": "{kernels[compiled]} of {kernels[launched]}",
        "growth of memory": lambda r: f"{si(r['memory']['bytes'], 'B')} in {r['memory']['calls']} steps",
    },
    "transport": {
        "scene, pixels": "{scene}, {pixels}x{pixels}",
        "texels": SIZE["texels"],
        "map": "{map}",
        "spp": "{spp}",
        "path depth": "{depth}",
        "exact columns": "{columns}",
        "held": lambda r: si(r["bytes"]["held"], "B"),
        "traced in (first time)": lambda r: f"{seconds(r['again_s'])} ({seconds(r['first_s'])})",
        "columns in": of("resolve_s", seconds),
        "loaded in": of("load_s", seconds),
        "traced in, prb steps": of("trace_in_prb_steps", times),
    },
    "transport-time": {
        "scene, pixels": "{scene}, {pixels}x{pixels}",
        "what": "{what}",
        "median": of("median_s", seconds),
        "best, or ratio": _note,
    },
    "quality": SUN | {"exact columns": "{columns}"} | ERROR,
    "quality-parts": SUN | {"path depth 2: region": "{part}", "pixels": "{pixels}"} | ERROR,
    "equal-error": SUN
    | {
        "T: error": of("rmse", percent),
        "a step through T": of("t_step_s", seconds),
        "prb, 16 spp: error": of("prb_rmse", percent),
        "a step of prb": of("prb_step_s", seconds),
        "prb needs, spp": of("prb_spp", si),
        "times a step through T": of("equal_error", times),
    },
    "error-time": {
        "renderer": "{kind}",
        "samples a pixel": "{samples}",
        "step": of("step_s", seconds),
        "RMSE": of("rmse", percent),
        "without the reference's noise": of("corrected", percent),
    },
    "scaling": {"varied": "{variable}"}
    | SIZE
    | {
        "spp": "{spp}",
        "exact columns": "{columns}",
        "traced in": of("trace_s", seconds),
        "read by both": of("bytes", si, "B"),
        "held": of("held", si, "B"),
        "T E": of("apply_s", seconds),
        "T' I": of("adjoint_s", seconds),
    },
    "fits": {
        "map": "{map}",
        "preset": "{preset}",
        "peak": lambda r: f"{r['peak']:,.{1 if r['peak'] < 100 else 0}f}",
        "log-PSNR, dB": of("log_psnr", number),
        "peak ratio": of("peak_ratio", number, ".2f"),
        "mean ratio": of("mean_ratio", number, ".2f"),
        "with noise: mean, dB": of("noisy_mean", number),
        "worst of 5, dB": of("noisy_worst", number),
        "fitted in": of("fitted_s", seconds),
    },
}
"""Columns of each table: a table's name is that of its marker."""


def measure(done) -> list[dict]:
    """Return the rows of all tables that a case has numbers for, and its own of ``machine``."""
    found = done.metrics
    common = {key: found[key] for key in ("machine", "seconds", "not_finite")}
    choices = {line for rows in found["tables"].values() for row in rows for line in row.get("choices", [])}
    tables = {"machine": [{"sampling": "; ".join(sorted(choices))}]} | found["tables"]
    return [common | {"table": name} | row for name, rows in tables.items() for row in rows]


def summary(rows: list[dict]) -> str:
    """Return what was measured on, and the medians of the fits."""
    machines = {}
    for about in (row["machine"] for row in rows):
        versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
        where = f"{about['cpu']}, {about['threads']} threads, {si(about['memory_bytes'], 'B')} of memory"
        llvm = f"LLVM {(about['llvm'] or {}).get('version')}"
        machines[f"{where}; {versions}, {llvm}; commit {about['commit']}."] = None
    fits = [row for row in rows if row["table"] == "fits"]
    return "\n\n".join([*machines, *([_medians(fits)] if len(fits) > 1 else [])])


def _medians(fits):
    """Return a table of one row, the medians over all maps."""
    columns, middle = COLUMNS["fits"], {"map": f"median of {len(fits)}", "preset": fits[0]["preset"]}
    for key in ("peak", "log_psnr", "peak_ratio", "mean_ratio", "noisy_mean", "noisy_worst", "fitted_s"):
        known = [row[key] for row in fits if row[key] is not None]
        middle[key] = statistics.median(known) if known else math.nan
    cells = [form.format_map(middle) if isinstance(form, str) else form(middle) for form in columns.values()]
    return markdown(list(columns), [cells])
