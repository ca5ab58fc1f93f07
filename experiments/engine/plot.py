"""Draw what was measured: ``python -m experiments.engine.plot [--out DIR]``; needs envedit[report]."""

import argparse
import json
from pathlib import Path


def scaling(found: dict, file: Path) -> None:
    """Draw seconds and bytes of T against pixels, texels and samples, one panel each."""
    import matplotlib.pyplot as plt

    variables = {"pixels": "pixels", "width": "texels", "spp": "paths a pixel"}
    figure, panels = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained", sharey=True)
    for panel, (variable, label) in zip(panels, variables.items(), strict=True):
        rows = [r for r in found["rows"] if r["variable"] == variable]
        across = [
            {"pixels": r["pixels"] ** 2, "width": r["texels"][0] * r["texels"][1], "spp": r["spp"]}[variable]
            for r in rows
        ]
        panel.loglog(across, [r["trace_s"] for r in rows], "s-", label="tracing, s")
        panel.loglog(across, [r["apply"]["median_s"] for r in rows], "o-", label="T E, s")
        panel.loglog(across, [r["adjoint"]["median_s"] for r in rows], "^-", label="T' I, s")
        panel.loglog(across, [r["bytes"] / 1e9 for r in rows], "x--", color="grey", label="read by both, GB")
        ticks = sorted(set(across))
        panel.set_xticks(ticks, [f"{tick:,}" for tick in ticks], fontsize="small")
        panel.minorticks_off()
        panel.set_xlabel(label)
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize="small")
    figure.savefig(file, dpi=120)
    plt.close(figure)


def error_time(found: dict, file: Path) -> None:
    """Draw error against the seconds of a step, T and prb."""
    import matplotlib.pyplot as plt

    figure, panel = plt.subplots(figsize=(5.5, 4), layout="constrained")
    for kind, style in (("prb", "s-"), ("T", "o-")):
        rows = [r for r in found["curve"] if r["kind"] == kind]
        panel.loglog([r["step_s"] for r in rows], [100 * r["rmse"] for r in rows], style, label=kind)
        for r in rows:
            panel.annotate(f" {r['samples']} spp", (r["step_s"], 100 * r["rmse"]), fontsize="x-small")
    panel.margins(x=0.1)
    panel.axhline(100 * found["curve"][0]["noise"], color="grey", ls=":", label="noise of the reference")
    panel.set_xlabel("seconds of a step: rendering and gradient")
    panel.set_ylabel("RMSE, % of the mean")
    panel.grid(alpha=0.3)
    panel.legend(fontsize="small")
    figure.savefig(file, dpi=120)
    plt.close(figure)


def draw(results: dict, folder: Path) -> list[Path]:
    """Draw what there is; returns the files, none without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return []
    matplotlib.use("agg")
    files = []
    for section, name, plot in (("scaling", "scaling", scaling), ("quality", "error_time", error_time)):
        if section in results:
            files.append(folder / f"{name}.png")
            plot(results[section]["found"], files[-1])
    return files


def main():
    """Draw the results of an earlier run."""
    parser = argparse.ArgumentParser(prog="python -m experiments.engine.plot", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/engine"))
    folder = parser.parse_args().out
    for file in draw(json.loads((folder / "results.json").read_text()), folder):
        print(file)


if __name__ == "__main__":
    main()
