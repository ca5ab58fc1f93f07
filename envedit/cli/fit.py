"""``envedit fit MAP``: fit a SIREN to a map, without an edit."""

from __future__ import annotations

from pathlib import Path

from envedit import config
from envedit.cli import doctor
from envedit.cli.console import Console, add_overrides, exit_code, make_parser
from envedit.config import presets
from envedit.core.array_cache import cache_folder
from envedit.core.atomic_files import write_atomically
from envedit.report import output_folder

RESULTS = ("fit.json", "fitted.exr", "preview.png")
"""What the command leaves in its folder."""


def main(argv: list[str] | None = None) -> int:
    """Fit a map, write what the network makes of it, and say how good it is; returns the exit code."""
    parser = make_parser(
        "fit",
        "Fit a SIREN to an HDR map, and say how well it reproduces the map.\n"
        "Leaves fitted.exr, preview.png and fit.json.",
        [
            "envedit fit sky.hdr --preset draft",
            "envedit fit sunsky --set input.elevation=10 --set fit.epochs=500",
        ],
    )
    parser.add_argument(
        "map", metavar="MAP", help="an EXR or Radiance HDR file, or sunsky, Mitsuba's analytic sky"
    )
    parser.add_argument(
        "--out", metavar="DIR", help="folder for the results (default: MAP_fit in the working folder)"
    )
    parser.add_argument("--preset", choices=tuple(presets.PRESETS), help="named set of defaults")
    add_overrides(parser, "fit.epochs=500")
    arguments = parser.parse_args(argv)
    goes_on = "running it again goes on where the fit was last kept"
    interrupted = f"interrupted; no results were written ({goes_on})"
    console = Console()
    return exit_code(console, lambda: _run(arguments, console), interrupted)


def _run(arguments, console):
    overrides = [*arguments.overrides, f"input.envmap={config.quote(arguments.map)}"]
    settings = config.loads("", Path.cwd(), "command line", arguments.preset, overrides)
    doctor.select(settings.variant)
    from envedit import inputs

    original, warnings = inputs.load_map(settings.input)
    folder = Path(arguments.out or f"{Path(arguments.map).stem}_fit")
    with output_folder.results_in(folder, RESULTS, [arguments.map]):
        console.warn(*warnings)
        _fit(arguments, settings, original, folder, console)
    return 0


def _fit(arguments, settings, original, folder, console):
    """Fit, and leave the results in a folder."""
    import mitsuba as mi

    from envedit import inputs
    from envedit.images import images
    from envedit.losses import metrics
    from envedit.report import plain_files, preview
    from envedit.representations.siren import fit

    rows = inputs.active_rows(settings.input.rows, original.shape[0])
    active = original[rows.slice]
    network = settings.representation

    # ---- Fit
    with console.progress() as progress:
        progress.stage(f"fitting {arguments.map}")
        fitted = fit.fit(
            active,
            network,
            settings.fit,
            settings.seed,
            rows.place,
            folder=cache_folder("fits"),
            progress=lambda done, total, loss: progress.update(done, total, f"loss {loss:.4g}"),
        )

    # ---- The map that the network reproduces
    params = {name: mi.TensorXf(value) for name, value in fitted.params.items()}
    shape = active.shape[:2]
    points = fit.points(network, shape, rows.place)
    reproduced = fit.evaluate(params, fitted.normalisation, points, shape, network.omega).numpy()
    marks = {"source": arguments.map, "rows": f"{rows.first} to {rows.last}"}
    whole = len(reproduced) == len(original)
    images.write_exr(folder / "fitted.exr", reproduced, marks, panorama=whole)
    write_atomically(folder / "preview.png", preview.sheet({"map": active, "fit": reproduced}, {}))

    # ---- How good it is
    numbers = {
        "log_psnr": fitted.log_psnr,
        "peak_ratio": fitted.peak_ratio,
        "mean_luminance_ratio": metrics.mean_luminance_ratio(reproduced, active),
        "epochs": fitted.epochs,
        "seconds": round(fitted.seconds, 2),
        "cached": fitted.cached,
    }
    plain_files.write_json(folder / "fit.json", numbers)
    log_psnr = "undefined" if fitted.log_psnr is None else f"{fitted.log_psnr:.1f}"
    peak_ratio = "undefined" if fitted.peak_ratio is None else f"{fitted.peak_ratio:.2f}"
    seconds = f"{fitted.seconds:.1f} s{' (kept from an earlier run)' if fitted.cached else ''}"
    console.say(f"log-PSNR {log_psnr} dB, peak ratio {peak_ratio}, {seconds}; results in {folder}")
