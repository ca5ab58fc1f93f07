"""The results as tables, one for each name; what must hold of any of them; and two figures."""

from pathlib import Path

from experiments.harness import figure
from experiments.summary import Summary

ADJOINT = 1e-5
"""|<T E, I> - <E, T' I>| over <T E, I>: sums of float32 in two orders, taken in double at the end."""
PICTURE = 0.05
"""RMSE of T's picture under a one-texel sun, 24x24 pixels; a lost or doubled tier is off by 0.5 or more."""


# ---- tables ------------------------------------------------------------------------------------------------

SIZE = {"scene": "{scene}", "pixels": "{pixels}x{pixels}", "texels": "{texels[1]}x{texels[0]}"}
SUN = {"scene": "{scene}", "sun at": "{sun}"}
ERROR = {
    "RMSE": "{rmse:.3g%}",
    "of it the reference's noise": "{noise:.3g%}",
    "without it": "{corrected:.3g%}",
}
COLUMNS = {
    "machine": {
        "case": "{case}",
        "begun, UTC": lambda r: r["machine"]["time_utc"].removesuffix("+00:00"),
        "took": "{seconds:.0f} s",
        "load before": "{load:.2f}",
        "sampling of T": "{sampling}",
    },
    "bandwidth": {
        "streaming": "{streaming}",
        "bytes a second": "{rate:si B/s}",
        "array": "{array_bytes:si B}",
        "largest cache": "{cache_bytes:si B}",
    },
    "matmul": {"width": "{width}", "points": "{points:,}", "a point is a": lambda r: r["layout"][:-1]}
    | {
        f"{product}, GFLOP/s": f"{{{product}:.0f}}"
        for product in ("forward", "gradient of the weights", "gradient of the input")
    },
    "rays": {"rays": "{rays}", "at once": "{count:,}", "rays a second": "{rate:si}"},
    "siren": {
        "network": "{hidden}x{depth} ({preset})",
        "points": "{points:,}",
        "forward": "{forward[median_s]:si s}",
        "forward + backward": "{step[median_s]:si s} ({step[min_s]:si s})",
        "its products alone": "{own[median_s]:si s} ({own[min_s]:si s})",
        "ratio": "{ratio:.2f}",
        "PyTorch": "{torch[median_s]:si s}",
        "GFLOP/s": "{gflops:.0f}",
        "compiled after warm-up": "{kernels[compiled]} of {kernels[launched]}",
    },
    "transport": SIZE
    | {
        "map": "{map}",
        "spp": "{spp}",
        "path depth": "{depth}",
        "exact columns": "{columns}",
        "held": "{held:si B}",
        "traced in (first time)": "{again_s:si s} ({first_s:si s})",
        "columns in": "{resolve_s:si s}",
        "loaded in": "{load_s:si s}",
        "traced in, prb steps": "{trace_in_prb_steps:.3g}",
    },
    "transport-time": SIZE
    | {
        "T E": "{apply_s:si s}",
        "T' I": "{adjoint_s:si s}",
        "read by both": "{read:si B}",
        "bandwidth": "{bandwidth:si B/s}",
        "both over the floor": "{above_floor:.2f}",
        "a step through T": "{step_s:si s}",
        "prb, 16 spp, a step": "{prb_step_s:si s}",
        "over a step through T": "{prb_ratio:.3g}",
    },
    "quality": SUN | {"exact columns": "{columns}"} | ERROR,
    "quality-parts": SUN | {"path depth 2: region": "{part}", "pixels": "{seen}"} | ERROR,
    "equal-error": SUN
    | {
        "T: error": "{rmse:.3g%}",
        "a step through T": "{step_s:si s}",
        "prb, 16 spp: error": "{prb_rmse:.3g%}",
        "a step of prb": "{prb_step_s:si s}",
        "prb needs, spp": "{prb_needs:si}",
        "times a step through T": "{equal_error:.0f}",
    },
    "error-time": {
        "samples a pixel": "{prb_samples}",
        "T: a step": "{step_s:si s}",
        "RMSE": "{rmse:.3g%}",
        "without the reference's noise": "{corrected:.3g%}",
        "prb: a step": "{prb_step_s:si s}",
        "its RMSE without the noise": "{prb_rmse:.3g%}",
    },
    "scaling": {"varied": "{variable}"}
    | SIZE
    | {
        "spp": "{spp}",
        "exact columns": "{columns}",
        "traced in": "{again_s:si s}",
        "read by both": "{read:si B}",
        "held": "{held:si B}",
        "T E": "{apply_s:si s}",
        "T' I": "{adjoint_s:si s}",
    },
    "fits": {
        "map": "{map}",
        "preset": "{preset}",
        "peak": lambda r: f"{r['peak']:,.{1 if r['peak'] < 100 else 0}f}",
        "log-PSNR, dB": "{log_psnr:.1f}",
        "peak ratio": "{peak_ratio:.2f}",
        "mean ratio": "{mean_ratio:.2f}",
        "with noise: mean, dB": "{noisy_mean:.1f}",
        "worst of 5, dB": "{noisy_worst:.1f}",
        "fitted in": "{fitted_s:si s}",
    },
}
"""Columns of each table: a table's name is that of its marker in docs/engine.md."""
FITS = Summary(
    {"fits, medians": "{preset}"},
    {
        "maps": "{runs}",
        "log-PSNR, dB": "{log_psnr.median:.1f}",
        "peak ratio": "{peak_ratio.median:.2f}",
        "mean ratio": "{mean_ratio.median:.2f}",
        "with noise: mean, dB": "{noisy_mean.median:.1f}",
        "worst of 5, dB": "{noisy_worst.median:.1f}",
        "fitted in, s": "{fitted_s.median:.1f}",
    },
)


SHOWN = {
    "transport": ("transport", "transport-time"),
    "quality": ("quality", "equal-error"),
    "curve": ("error-time",),
    "scaling": ("scaling",),
}
"""For each section: the tables that show what :func:`.transport.measure` returns as ``transport``."""


def measure(done) -> list[dict]:
    """Return the rows of all tables that a case has numbers for, and its own of ``machine``."""
    found = done.metrics
    common = {key: found[key] for key in ("machine", "seconds", "not_finite")}
    choices = {line for rows in found["tables"].values() for row in rows for line in row.get("choices", [])}
    about = {"sampling": "; ".join(sorted(choices)), "load": found["machine"]["load"]}
    rows = [common | {"table": "machine"} | about]
    for name, some in found["tables"].items():
        shown = SHOWN[done.case.about["section"]] if name == "transport" else (name,)
        rows += [common | {"table": one} | row for one in shown for row in some]
    return rows


def summary(rows: list[dict]) -> str:
    """Return what was measured on, and the medians of the fits."""
    machines = {}
    for about in (row["machine"] for row in rows):
        versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
        where = f"{about['cpu']}, {about['threads']} threads, {about['memory_bytes']:si B} of memory"
        llvm = f"LLVM {about['llvm']['version']}"
        machines[f"{where}; {versions}, {llvm}; commit {about['commit']}."] = None
    fits = [row for row in rows if row["table"] == "fits"]
    return "\n\n".join([*machines, *([FITS(fits)] if len(fits) > 1 else [])])


# ---- what must hold ----------------------------------------------------------------------------------------

KERNELS = {
    "only {kernels[launched]} kernels in the history": (
        lambda row: row["kernels"]["launched"] >= row["kernels"]["calls"]
    ),
    "{kernels[compiled]} of {kernels[launched]} kernels compiled after warm-up": (
        lambda row: row["kernels"]["compiled"] == 0
    ),
}
CHECKS = {
    "siren": KERNELS,
    "transport": KERNELS
    | {
        "adjoint off by {adjointness:.2g}": lambda row: row["adjointness"] < ADJOINT,
        "no exact column under a clear sky": lambda row: row["columns"] > 0,
        "T was not found on disk after it was kept there": lambda row: row["load_s"] > 0,  # not of NaN
    },
    "quality": {
        "16 samples of prb are better than T": lambda row: row["prb_rmse"] > row["rmse"],
        # A mirror's caustic, at full size, is off by more than the picture's mean.
        "T's picture is off by {corrected:.1%}": lambda row: row["corrected"] < PICTURE or not row["quick"],
        "the reference is off by {noise:.1%}": lambda row: row["noise"] < PICTURE or not row["quick"],
    },
}
"""For each table: what is wrong with a row, and what holds of it otherwise."""


def failures(rows: list[dict]) -> list[str]:
    """Return a sentence for each thing that does not hold; of numbers that are not finite, these alone."""
    infinite = {f"{row['case']}: {place} is not finite": None for row in rows for place in row["not_finite"]}
    wrong = []
    for row in rows:
        for sentence, holds in CHECKS.get(row["table"], {}).items():
            if not holds(row):
                wrong.append(f"{row['case']}: {sentence.format_map(row)}")
    return list(infinite) or wrong


# ---- figures -----------------------------------------------------------------------------------------------

GROWTH = {
    "pixels": ("pixels", lambda row: row["pixels"] ** 2),
    "texels": ("texels", lambda row: row["texels"][0] * row["texels"][1]),
    "spp": ("paths a pixel", lambda row: row["spp"]),
}
"""Label and value of what is varied."""
CURVES = {
    "tracing, s": ("s-", lambda row: row["again_s"]),
    "T E, s": ("o-", lambda row: row["apply_s"]),
    "T' I, s": ("^-", lambda row: row["adjoint_s"]),
    "read by both, GB": ("x--", lambda row: row["read"] / 1e9),
}


def growth(rows: list[dict], file: Path) -> None:
    """Draw seconds and bytes of T against pixels, texels and samples, one panel each."""
    with figure(file, 1, 3, (12, 3.6), sharey=True) as panels:
        for panel, (variable, (label, value)) in zip(panels, GROWTH.items(), strict=True):
            some = [row for row in rows if row["variable"] == variable]
            across = [value(row) for row in some]
            for name, (style, height) in CURVES.items():
                panel.loglog(across, [height(row) for row in some], style, label=name)
            panel.set_xticks(across, [f"{tick:,}" for tick in across], fontsize="small")
            panel.minorticks_off()
            panel.set_xlabel(label)
        panels[0].legend(fontsize="small")


def error_time(rows: list[dict], file: Path) -> None:
    """Draw error against the seconds of a step, T and prb."""
    with figure(file, 1, 1, (5.5, 4)) as panel:
        for name, style, step, error in (
            ("prb", "s-", "prb_step_s", "prb_rmse"),
            ("T", "o-", "step_s", "corrected"),
        ):
            points = [(row[step], 100 * row[error]) for row in rows]
            panel.loglog(*zip(*points, strict=True), style, label=name)
            for row, point in zip(rows, points, strict=True):
                panel.annotate(f" {row['prb_samples']} spp", point, fontsize="x-small")
        panel.margins(x=0.1)
        panel.axhline(100 * rows[0]["noise"], color="grey", ls=":", label="noise of the reference")
        panel.set_xlabel("seconds of a step: rendering and gradient")
        panel.set_ylabel("RMSE, % of the mean, without that noise")
        panel.legend(fontsize="small")


def draw(rows: list[dict], folder: Path) -> list[Path]:
    """Draw what there are rows for; returns the files."""
    files = []
    for table, plot in (("scaling", growth), ("error-time", error_time)):
        if some := [row for row in rows if row["table"] == table]:
            files.append(folder / f"engine_{table.replace('-', '_')}.png")
            plot(some, files[-1])
    return files
