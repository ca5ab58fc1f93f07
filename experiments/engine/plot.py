"""Draw how T grows, and error against time: the figures of docs/engine.md."""

from pathlib import Path

from experiments.harness import figure

GROWTH = {
    "pixels": ("pixels", lambda row: row["pixels"] ** 2),
    "texels": ("texels", lambda row: row["texels"][0] * row["texels"][1]),
    "spp": ("paths a pixel", lambda row: row["spp"]),
}
"""Label and value of what is varied."""
CURVES = {
    "tracing, s": ("s-", lambda row: row["trace_s"]),
    "T E, s": ("o-", lambda row: row["apply_s"]),
    "T' I, s": ("^-", lambda row: row["adjoint_s"]),
    "read by both, GB": ("x--", lambda row: row["bytes"] / 1e9),
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
        for kind, style in (("prb", "s-"), ("T", "o-")):
            some = [row for row in rows if row["kind"] == kind]
            points = [(row["step_s"], 100 * row["rmse"]) for row in some]
            panel.loglog(*zip(*points, strict=True), style, label=kind)
            for row, point in zip(some, points, strict=True):
                panel.annotate(f" {row['samples']} spp", point, fontsize="x-small")
        panel.margins(x=0.1)
        panel.axhline(100 * rows[0]["noise"], color="grey", ls=":", label="noise of the reference")
        panel.set_xlabel("seconds of a step: rendering and gradient")
        panel.set_ylabel("RMSE, % of the mean")
        panel.legend(fontsize="small")


def draw(rows: list[dict], folder: Path) -> list[Path]:
    """Draw what there are rows for; returns the files."""
    files = []
    for table, plot in (("scaling", growth), ("error-time", error_time)):
        if some := [row for row in rows if row["table"] == table]:
            files.append(folder / f"engine_{table.replace('-', '_')}.png")
            plot(some, files[-1])
    return files
