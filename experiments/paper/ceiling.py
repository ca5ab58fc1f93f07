r"""What the true map itself scores in Table 3: two renderings of it, as target and result are rendered.

    python -m experiments.paper.ceiling [--folder DIR] [--maps NAME ...] [--scene statue] [--width 128] \
        [--angle 60] [--roughness 0 0.5 1]

No edit can be expected to score more than the noise of its judge allows: one that does shows a picture that
is smoother than the truth.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import mitsuba as mi
import numpy as np

from envedit import config, inputs
from envedit.cli import doctor
from envedit.core import latlong
from envedit.core.errors import EnveditError, unwrapped
from envedit.core.seeds import Seeds
from envedit.losses import metrics
from envedit.scene import scene
from experiments import puresky

from .kinds import ROUGHNESS


def twice(lit: scene.Scene, true: np.ndarray) -> dict:
    """Render a map with the target's and with the result's samples, and compare: ``metrics.compare``."""
    seeds = Seeds.of(0)
    target, result = (lit.sampled(true, "auto", seed)[0] for seed in (seeds.target, seeds.judged))
    return metrics.compare(result, target)


def main(argv: list[str] | None = None) -> int:
    """Render and print; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.paper.ceiling", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--folder", metavar="DIR", help="of NAME_puresky_1k.hdr ($ENVEDIT_DATA/puresky)")
    parser.add_argument("--maps", nargs="+", metavar="MAP", help="some maps")
    parser.add_argument("--scene", default="statue")
    parser.add_argument("--width", type=int, default=128, help="pixels across")
    parser.add_argument("--angle", type=float, default=60.0, help="turn of the true map to the left, degrees")
    parser.add_argument(
        "--roughness",
        type=float,
        nargs="*",
        default=ROUGHNESS,
        help="none: that of the scene's own materials",
    )
    given = parser.parse_args(argv)
    try:
        with unwrapped():
            for line in table(given):
                print(line, flush=True)
    except EnveditError as error:
        print(f"envedit: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def table(given: argparse.Namespace) -> Iterator[str]:
    """Yield PSNR and SSIM as Markdown: a line a map, a column a roughness, the averages last."""
    found = puresky.find(given.folder, "--folder")
    files = puresky.pick(found, given.maps, "--maps") if given.maps else found
    variant = config.Config().variant
    doctor.ensure(variant)
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    kinds = {f"roughness {r:g}": {"roughness": r} for r in given.roughness} or {"own materials": {}}
    lit = [scene.load(given.scene, given.width, 0, parameters, None) for parameters in kinds.values()]
    yield f"| map | {' | '.join(kinds)} |"
    yield "|---" * (1 + len(lit)) + "|"
    scores = []
    for name, file in files.items():
        original, _ = inputs.load_map(config.Input(envmap=str(file)))
        true = np.ascontiguousarray(latlong.rotate(original, given.angle), np.float32)
        row = [twice(one, inputs.scaled(true, one.own.scale, str(file))) for one in lit]
        scores.append([(score["psnr"], score["ssim"]) for score in row])
        yield _line(name, scores[-1])
    yield _line(f"**mean of {len(scores)}**", np.mean(scores, axis=0))


def _line(name, scores):
    return f"| {name} | " + " | ".join(f"{psnr:.2f} / {ssim:.3f}" for psnr, ssim in scores) + " |"


if __name__ == "__main__":
    sys.exit(main())
