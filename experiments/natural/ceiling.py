r"""What the true map itself scores, beside the edit: of turned targets, with a turn of the sky allowed.

    ENVEDIT_DATA=... python -m experiments.natural.ceiling [--out runs/natural] [--only TEXT ...]

For every such case that is done. The true map is rendered with the samples that the edited map was judged
with, so that what differs is the map. An edit far above it shows a picture smoother than the truth.
"""

import argparse
import itertools
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from envedit import config, inputs
from envedit.cli import doctor
from envedit.core.seeds import Seeds
from envedit.losses import metrics
from experiments.harness import add_options, done_of, markdown

from .experiment import cases, options

BELOW = 0.5
"""Decibels under the true map's rendering, from which a case is named."""


def main(arguments=None):
    """Print a line a scene, and the cases that are farther below than :data:`BELOW`."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.natural.ceiling", description=__doc__.splitlines()[0]
    )
    add_options(parser, Path("runs") / "natural")
    options(parser)
    given = parser.parse_args(arguments)
    doctor.ensure(config.Config().variant)
    mi.set_variant(config.Config().variant)
    mi.set_log_level(mi.LogLevel.Error)
    some = [one for one in cases(given) if one.about["kind"] == "turned" and one.about["turn"] == "auto"]
    done = done_of([(one, one.job(given.sets)) for one in some], given.out.absolute())
    print(f"{len(done)} of {len(some)} cases are done", file=sys.stderr)
    lines, named = [], []
    seen = tqdm(done, disable=None)
    for scene, group in itertools.groupby(seen, lambda one: one.case.about["scene"]):
        rows = list(scored(group))
        edits, truths = np.array([row[1:] for row in rows]).T
        over = edits - truths
        lines.append(
            (scene, str(len(rows)), f"{edits.mean():.2f}", f"{truths.mean():.2f}", f"{over.mean():+.2f}",
             f"{over.min():+.2f}", str((over < -BELOW).sum()))
        )  # fmt: skip
        named += [(name, f"{edit:.1f}", f"{true:.1f}") for name, edit, true in rows if edit < true - BELOW]
    head = "scene", "runs", "edits, dB", "true maps, dB", "edits over them", "least", f"under -{BELOW}"
    print(markdown(head, lines))
    if named:
        print("\n" + markdown(("case", "edit, dB", "true map, dB"), named))


def scored(group):
    """Yield name, and PSNR of the edit's and of the true map's rendering, of cases in one scene."""
    lit = None
    for one in group:
        settings = config.load(one.folder / "config.toml")
        lit = lit or inputs.load_scene(settings.scene)
        true = inputs.scaled(one.maps[2], lit.own.scale, settings.input.envmap)
        picture = lit.sampled(true, settings.output.spp, Seeds.of(settings.seed).judged)[0]
        truth = metrics.compare(picture, one.picture("render_target"))
        yield one.case.name, one.metrics["render"]["psnr"], truth["psnr"]


if __name__ == "__main__":
    main()
