r"""How well networks fit real maps, and what is left of a fit when its weights are moved.

    ENVEDIT_DATA=... python -m experiments.engine.fits [--preset draft|standard|paper] [--maps NAME ...] \
        [--set table.key=value ...] [--out runs/engine]

Every call is added to fits.json in the output folder, so that an ablation is a command.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import EnveditError
from envedit.inputs import active_rows, load_map
from envedit.losses import metrics
from envedit.report.manifest import manifest
from envedit.representations.siren import fit
from experiments import puresky

from . import maps, tables

NOISE, NOISE_SEEDS = 1e-3, 5
WIDTH = 256


def measure(
    preset: str = "standard", names=None, overrides=(), quick: bool = False, out: Path | None = None
) -> dict:
    """Fit maps by the recipe of a preset, none from disk.

    Parameters
    ----------
    preset : str
        The preset, at a width of 256 texels unless an override says otherwise.
    names : list of str, optional
        Maps of ENVEDIT_DATA/puresky; all by default.
    overrides : iterable of str
        ``table.key=value``, as on the package's own command lines.
    quick : bool
        A tiny analytic sky in their place.
    out : Path, optional
        Folder whose ``fits.json`` gets this record, written anew after every map.

    Returns
    -------
    dict
        ``preset``, ``overrides``, ``recipe``, ``about``; ``rows``: see :func:`one_map`; ``skipped``.
    """
    fixed = [f"input.width={WIDTH}", "representation.kind=siren"]
    overrides = [*fixed, *overrides]
    files = {"analytic sun and sky": "sunsky"} if quick else maps.skies(names)
    settings = config.loads("", preset=preset, overrides=overrides)
    record = {
        "preset": preset,
        "overrides": overrides[len(fixed) :],
        "recipe": asdict(settings.fit) | asdict(settings.representation),
        "about": manifest({"seed": settings.seed}, {}, settings.variant),
        "rows": [],
        "skipped": [] if files else ["fits: ENVEDIT_DATA names no folder with puresky maps"],
    }
    for name, file in files.items():
        there = f"input.envmap={config.quote(str(file))}"
        chosen = config.loads("", preset=preset, overrides=[*overrides, there])
        original, _ = load_map(chosen.input)
        rows = active_rows(chosen.input.rows, original.shape[0])
        record["rows"].append(row := one_map(name, original[rows.slice], rows.place, chosen))
        if not quick:
            print(tables.fit_line(row), flush=True)
        if out:
            _append(out / "fits.json", record)
    return record


def one_map(name: str, image: np.ndarray, rows: tuple[int, int], settings: config.Config) -> dict:
    """Fit one map, whose ``rows`` (first, total) the image is.

    Returns
    -------
    dict
        ``log_psnr`` (dB), ``peak_ratio``, ``mean_ratio`` of luminance, ``seconds``; ``noisy_mean`` and
        ``noisy_worst``: log-PSNR with N(0, 1e-3) added to all weights and biases, over five seeds.
    """
    network, shape = settings.representation, image.shape[:2]
    fitted = fit.fit(image, network, settings.fit, settings.seed, rows)
    x = fit.points(network, shape, rows)

    def picture(params):
        params = {key: mi.TensorXf(value) for key, value in params.items()}
        return fit.evaluate(params, fitted.normalisation, x, shape, network.omega).numpy()

    noisy = []
    for seed in range(NOISE_SEEDS):
        rng = np.random.default_rng(1000 + seed)
        moved = {
            key: (value + rng.normal(0, NOISE, value.shape)).astype(np.float32)
            for key, value in fitted.params.items()
        }
        noisy.append(metrics.log_psnr(picture(moved), image))
    return {
        "map": name,
        "texels": list(shape),
        "peak": float(metrics.luminance(image).max()),
        "log_psnr": fitted.log_psnr,
        "peak_ratio": fitted.peak_ratio,
        "mean_ratio": metrics.mean_luminance_ratio(picture(fitted.params), image),
        "noisy": noisy,
        "noisy_mean": None if None in noisy else float(np.mean(noisy)),
        "noisy_worst": None if None in noisy else float(min(noisy)),
        "seconds": fitted.seconds,
    }


def _append(path, record):
    """Put a record at the end of a list in a file, in place of its own earlier and shorter state."""
    try:
        known = json.loads(path.read_text())
    except FileNotFoundError:
        known = []
    known = [r for r in known if r["about"] != record["about"] or r["overrides"] != record["overrides"]]
    write_atomically(path, json.dumps([*known, record], indent=1).encode())


def main():
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--preset", choices=config.preset_names(), default="standard")
    parser.add_argument("--maps", nargs="+", metavar="NAME")
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="table.key=value")
    parser.add_argument("--out", type=Path, default=Path("runs/engine"))
    arguments = parser.parse_args()
    puresky.of_script(arguments.maps)  # says what is missing before anything is made
    arguments.out.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_rgb")
    try:
        record = measure(arguments.preset, arguments.maps, arguments.overrides, out=arguments.out)
    except EnveditError as error:
        sys.exit(f"envedit: {error}")
    print(tables.fits(record)["fits"])


if __name__ == "__main__":
    main()
