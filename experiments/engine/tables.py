"""The results as Markdown, a table for each marker of docs/engine.md."""

import math
import statistics

from experiments.harness import markdown


def table(head: str, rows) -> str:
    """Return a Markdown table; ``head`` has its columns separated by |."""
    return markdown([cell.strip() for cell in head.split("|")], ([str(cell) for cell in row] for row in rows))


def si(value: float | None, unit: str = "") -> str:
    """Write a number with three digits and a prefix: 0.0123 s is 12.3 ms."""
    if value is None or not math.isfinite(value):
        return "-" if value is None else str(value)
    if value == 0:
        return f"0 {unit}".rstrip()
    scales = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1, ""), (1e-3, "m"), (1e-6, "u"))
    factor, prefix = next((scale for scale in scales if abs(value) >= scale[0]), scales[-1])
    digits = max(0, 2 - len(str(int(abs(value) / factor))) + 1)
    return f"{value / factor:.{digits}f} {prefix}{unit}".rstrip()


def seconds(value: float | None) -> str:
    """Write a duration: 1200 s, 12.3 ms."""
    return "-" if value is None else f"{value:.0f} s" if value >= 100 else si(value, "s")


def percent(value: float | None) -> str:
    """Write a share in percent with three digits."""
    return "-" if value is None else f"{100 * value:.3g} %"


def times(value: float | None) -> str:
    """Write a ratio with three digits."""
    return "-" if value is None else f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


# ---------------------------------------------------------------------- a table each


def floors(found: dict) -> dict[str, str]:
    """Tables ``bandwidth``, ``matmul`` and ``rays``."""
    memory = found["bandwidth"]
    cache = si(memory["cache_bytes"], "B") if memory["cache_bytes"] else "of unknown size"
    note = f"Arrays of {si(memory['array_bytes'], 'B')}, largest cache {cache}; best of the repeats."
    rates = table("streaming | bytes a second", [(k, si(v, "B/s")) for k, v in memory["rates"].items()])
    by_key = {(r["width"], r["layout"], r["product"]): r for r in found["matmul"]}
    products = list(dict.fromkeys(r["product"] for r in found["matmul"]))
    kinds = list(dict.fromkeys((r["width"], r["points"], r["layout"]) for r in found["matmul"]))
    matmul = table(
        "width | points | a point is a | " + " | ".join(products),
        [
            (
                width,
                f"{points:,}",
                layout.removesuffix("s"),
                *(
                    f"{cell['gflops']:.0f} ({cell['gflops_best']:.0f})"
                    for cell in (by_key[width, layout, product] for product in products)
                ),
            )
            for width, points, layout in kinds
        ],
    )
    rays = found["rays"]
    traced = table(
        "rays | rays a second",
        [
            ("from the camera, nearest hit", si(rays["camera"])),
            ("from anywhere, nearest hit", si(rays["random"])),
            ("from anywhere, any hit", si(rays["shadow"])),
        ],
    )
    return {
        "bandwidth": f"{note}\n\n{rates}",
        "matmul": f"GFLOP/s, float32: median (best).\n\n{matmul}",
        "rays": f"Scene `sphere`, {rays['rays']:,} rays at once.\n\n{traced}",
    }


def siren(found: dict) -> dict[str, str]:
    """Table ``siren``."""
    torch = found["torch"]
    rows = []
    for r in found["networks"]:
        own, step = r["products"][r["layout"]], r["step"]
        peer = torch["networks"].get(r["name"]) if torch else None
        kernels, memory = r["kernels"], r["memory"]
        rows.append(
            (
                f"{r['hidden']}x{r['depth']} ({r['name']})",
                seconds(r["forward"]["median_s"]),
                f"{seconds(step['median_s'])} ({seconds(step['min_s'])})",
                f"{seconds(own['median_s'])} ({seconds(own['min_s'])})",
                f"{r['ratio']:.2f}",
                f"{r['ratio_best']:.2f}",
                seconds(peer["median_s"]) if peer else "-",
                f"{r['gflop'] / step['median_s']:.0f}",
                f"{kernels['compiled']} of {kernels['launched']}",
                f"{si(memory['bytes'], 'B')} in {memory['calls']} steps",
            )
        )
    text = table(
        "network | forward | forward + backward | its products alone | ratio | to the quicker layout | "
        "PyTorch | GFLOP/s | compiled after warm-up | growth of memory",
        rows,
    )
    against = (
        f"PyTorch {torch['version']}, {torch['threads']} threads, in a process of its own before and after."
        if torch
        else f"Not compared with: {found['not_compared']}."
    )
    return {"siren": f"{found['points']:,} points; median (best). {against}\n\n{text}"}


def transport(found: dict) -> dict[str, str]:
    """Tables ``transport`` and ``transport-time``."""
    held, spent = [], []
    for r in found["scenes"]:
        size, map_ = f"{r['scene']}, {r['pixels']}x{r['pixels']}", f"{r['texels'][1]}x{r['texels'][0]}"
        held.append(
            (
                size,
                map_,
                r["map"],
                r["spp"],
                r["depth"],
                r["columns"],
                si(r["bytes"]["held"], "B"),
                f"{seconds(r['trace']['again_s'])} ({seconds(r['trace']['first_s'])})",
                seconds(r["resolve_s"]),
                seconds(r["disk"]["load_s"]) if r["disk"] else "-",
                times(r["trace_in_prb_steps"]),
            )
        )
        coarse, t = r["coarse"], r["times"]
        read = si(r["bytes"]["apply"] + r["bytes"]["adjoint"], "B")
        lines = [
            ("T E, coarse tier", *_both(coarse["apply"])),
            ("T' I, coarse tier", *_both(coarse["adjoint"])),
            ("T E", *_both(t["apply"])),
            ("T' I", *_both(t["adjoint"])),
            (
                f"floor of both: {read} at {si(found['read'], 'B/s')}",
                seconds(r["floor_s"]),
                f"they take {r['above_floor']:.2f} times that",
            ),
            ("a step through T", seconds(r["step_s"]), ""),
            ("of it: looking for bright texels", seconds(r["look_s"]), f"every {r['look_every']} steps"),
            (f"prb, {r['prb_spp']} spp, forward", *_both(t["prb forward"])),
            (f"prb, {r['prb_spp']} spp, a step", seconds(r["prb_step_s"]), _over(r["ratio"])),
            ("the same, the map never set", seconds(r["prb_bare_step_s"]), _over(r["ratio_bare"])),
        ]
        spent += [(size, *line) for line in lines]
    first = table(
        "scene, pixels | texels | map | spp | path depth | exact columns | held | "
        "traced in (first time) | columns in | loaded in | traced in, prb steps",
        held,
    )
    second = table("scene, pixels | what | median | best, or ratio", spent)
    choices = _bullets(f"{r['scene']}: {c}" for r in found["scenes"] for c in r["choices"])
    return {
        "transport": "\n\n".join(filter(None, [first, choices, _skipped(found)])),
        "transport-time": second,
    }


def quality(found: dict) -> dict[str, str]:
    """Tables ``quality``, ``quality-parts``, ``equal-error`` and ``error-time``."""
    rows = [
        (
            r["scene"],
            r["sun"],
            r["columns"],
            percent(r["rmse"]),
            percent(r["noise"]),
            percent(r["corrected"]),
        )
        for r in found["rows"]
    ]
    size = f"{found['pixels']}x{found['pixels']} pixels, {found['texels'][1]}x{found['texels'][0]} texels."
    main = table("scene | sun at | exact columns | RMSE | of it the reference's noise | without it", rows)
    choices = _bullets(f"{name}: {c}" for name, lines in found["choices"].items() for c in lines)
    parts = table(
        "scene | sun at | path depth 2: region | pixels | RMSE | of it the reference's noise | without it",
        [
            (
                r["scene"],
                r["sun"],
                r["part"],
                r["pixels"],
                percent(r["rmse"]),
                percent(r["noise"]),
                percent(r["corrected"]),
            )
            for r in found["parts"]
        ],
    )
    equal = table(
        "scene | sun at | T: error | step | prb, 16 spp: error | step | prb needs, spp | "
        "times a step through T",
        [
            (
                r["scene"],
                r["sun"],
                percent(r["rmse"]),
                seconds(r["t_step_s"]),
                percent(r["prb_rmse"]),
                seconds(r["prb_step_s"]),
                si(r["prb_spp"]),
                times(r["equal_error"]),
            )
            for r in found["rows"]
        ],
    )
    against = table(
        "renderer | samples a pixel | step | RMSE | without the reference's noise",
        [
            (r["kind"], r["samples"], seconds(r["step_s"]), percent(r["rmse"]), percent(r["corrected"]))
            for r in found["curve"]
        ],
    )
    return {
        "quality": "\n\n".join(filter(None, [size, main, choices, _skipped(found)])),
        "quality-parts": parts if found["parts"] else "No scene with a mirror was measured.",
        "equal-error": equal,
        "error-time": against,
    }


def scaling(found: dict) -> dict[str, str]:
    """Table ``scaling``."""
    text = table(
        "varied | pixels | texels | spp | exact columns | traced in | read by both | held | T E | T' I",
        [
            (
                r["variable"].replace("width", "texels"),
                f"{r['pixels']}x{r['pixels']}",
                f"{r['texels'][1]}x{r['texels'][0]}",
                r["spp"],
                r["columns"],
                seconds(r["trace_s"]) + (" with compiling" if r["cold"] else ""),
                si(r["bytes"], "B"),
                si(r["held"], "B"),
                seconds(r["apply"]["median_s"]),
                seconds(r["adjoint"]["median_s"]),
            )
            for r in found["rows"]
        ],
    )
    choices = _bullets(
        f"{r['pixels']}x{r['pixels']} pixels, {r['texels'][1]}x{r['texels'][0]} texels: {c}"
        for r in found["rows"]
        for c in r["choices"]
    )
    return {"scaling": f"{text}\n\n{choices}"}


def fits(found: dict) -> dict[str, str]:
    """Table ``fits``: the maps, and the medians over them."""
    rows = [_fit_cells(r) for r in found["rows"]]
    if len(rows) > 1:
        keys = ("peak", "log_psnr", "peak_ratio", "mean_ratio", "noisy_mean", "noisy_worst", "seconds")
        known = {key: [r[key] for r in found["rows"] if r[key] is not None] for key in keys}
        rows.append(
            _fit_cells(
                {"map": "**median**"} | {k: statistics.median(v) if v else None for k, v in known.items()}
            )
        )
    head = "map | peak | log-PSNR | peak ratio | mean ratio | with noise: mean | worst of 5 | fitted in"
    overrides = f", {' '.join(found['overrides'])}" if found["overrides"] else ""
    text = table(head, rows) if rows else ""
    about = f"Preset {found['preset']}{overrides}."
    return {"fits": "\n\n".join(filter(None, [about, text, _skipped(found)]))}


def fit_line(row: dict) -> str:
    """Return one fit as a line of text."""
    return f"{row['map']}: " + ", ".join(_fit_cells(row)[2:])


def _fit_cells(r):
    def number(value, digits, unit=""):
        return "-" if value is None else f"{value:,.{digits}f}{unit}"

    return (
        r["map"],
        number(r["peak"], 1 if r["peak"] < 100 else 0),
        number(r["log_psnr"], 1, " dB"),
        number(r["peak_ratio"], 2),
        number(r["mean_ratio"], 2),
        number(r["noisy_mean"], 1, " dB"),
        number(r["noisy_worst"], 1, " dB"),
        seconds(r["seconds"]),
    )


def _both(taken):
    return seconds(taken["median_s"]), seconds(taken["min_s"])


def _over(ratio):
    return f"{times(ratio)} times a step through T"


def _bullets(lines):
    return "\n".join(f"- {line}" for line in dict.fromkeys(lines))


def _skipped(found):
    return _bullets(f"skipped: {line}" for line in found["skipped"])


def machine(results: dict) -> str:
    """Return what the sections were measured on, how long that took, and how busy the machine was before."""
    groups = {}
    for section, entry in results.items():
        about = entry["about"]
        versions = ", ".join(f"{k} {v}" for k, v in about["versions"].items() if v)
        where = (
            f"{about['cpu'] or 'Unknown processor'}, {about['threads']} threads, "
            f"{si(about['memory_bytes'], 'B')} of memory; {versions}, "
            f"LLVM {(about['llvm'] or {}).get('version')}; commit {about['commit']}"
        )
        load = "unknown" if about["load"] is None else f"{about['load']:.2f}"
        when = about["time_utc"].removesuffix("+00:00")
        groups.setdefault(where, []).append((section, when, f"{entry['seconds']:.0f} s", load))
    head = "section | begun, UTC | took | load before"
    return "\n\n".join(f"{where}.\n\n{table(head, rows)}" for where, rows in groups.items())
