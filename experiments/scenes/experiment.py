"""Load, render and edit every Mitsuba scene of a folder: what is refused, and whether it is as Mitsuba's."""

import argparse
import re
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config, inputs, pipeline
from envedit.core import shipped
from envedit.core.errors import EnveditError, InputError
from envedit.scene import scene
from experiments.harness import Done, Experiment, calling
from experiments.plain_mitsuba import loaded
from experiments.summary import Summary, values

WIDTH, MAP = 64, 128
"""Pixels and texels across."""
RENDERINGS, SPP = 8, 64
"""Renderings by either program, and samples a pixel of each: what they differ by is the noise."""
NEAR, SIGMA = 0.005, 3.0
"""A rendering counts as Mitsuba's if the means differ by at most the first, or that many standard errors."""
_ROOT = re.compile(rb"\A(\xef\xbb\xbf)?\s*(<\?.*?\?>\s*|<!--.*?-->\s*)*<scene\b", re.DOTALL)


def options(parser: argparse.ArgumentParser) -> None:
    text = "of XML files, at any depth (default: the shipped scenes)"
    parser.add_argument("folder", nargs="?", type=Path, default=shipped.folder(), metavar="FOLDER", help=text)


def cases(given):
    files = sorted(given.folder.absolute().rglob("*.xml"))
    files = [file for file in files if _ROOT.match(file.read_bytes())]
    if not files:
        raise InputError(f"{given.folder}: no Mitsuba scene, NAME.xml, in this folder")
    tables = {
        "preset": "draft",
        "input": {"width": MAP},
        "scene": {"width": WIDTH},
        "target": {"rotate_degrees": 60},
    }
    found = []
    for file in files:
        name = str(file.relative_to(given.folder.absolute()))
        own = tables | {"scene": tables["scene"] | {"file": str(file)}}
        found.append(calling(name, tried, own, {"scene": name}))
    return found


def tried(settings: config.Config, folder: Path) -> dict:
    """Load a scene, compare its initial rendering with plain Mitsuba's, and edit it.

    A scene without an environment emitter, or that is made for any map, is lit by the analytic sky, in
    Mitsuba as well.
    """
    found = {"refused": "", "light": "its own", "plain": ""}
    file = settings.scene.file
    found |= dict.fromkeys(("ratio", "noise", "psnr", "initial", "map", "unedited"))
    try:
        lit = inputs.load_scene(settings.scene)
        if lit.own.added:
            settings = replace(settings, input=replace(settings.input, envmap=inputs.SUNSKY))
        if inputs.source_of(settings.input, lit) == inputs.SUNSKY:
            found["light"] = "analytic sky"
        given = inputs.read_map(settings.input, lit, settings.input.width)
    except EnveditError as error:
        return found | {"refused": str(error).replace(file, Path(file).name)}
    try:
        expected = plain(lit, settings, given, folder)
    except (EnveditError, RuntimeError) as error:
        found["plain"] = f"Mitsuba: {str(error).replace(file, Path(file).name)}"
    else:
        ours = [lit.render(given.radiance, SPP, k).mean(dtype=np.float64) for k in range(RENDERINGS)]
        found["ratio"] = float(np.mean(ours) / np.mean(expected))
        spread = [np.std(means, ddof=1) / np.mean(means) for means in (ours, expected)]
        found["noise"] = float(np.hypot(*spread) / RENDERINGS**0.5)
    try:
        edit = pipeline.run(settings)
    except EnveditError as error:
        return found | {"refused": str(error)}
    found |= {"psnr": edit.metrics["render"]["psnr"], "initial": edit.metrics["initial"]["psnr"]}
    return found | {"map": edit.metrics["envmap"]["psnr"], "unedited": edit.metrics["initial_envmap"]["psnr"]}


def plain(lit: scene.Scene, settings: config.Config, given: inputs.InputMap, folder: Path) -> list[float]:
    """Render the user's file by ``mi.render``, on a film of our size; the mean of each rendering.

    Without a light of its own, the file that a run would leave.
    """
    file = Path(settings.scene.file)
    filled = {key: str(value) for key, value in settings.scene.parameters.items()}
    if given.source == inputs.SUNSKY:
        text = scene.relit(settings.scene, "sky.exr")
        mi.Bitmap(given.stored).write(str(folder / "sky.exr"))
        filled = {}
        file = folder / "lit.xml"
        file.write_text(text)
    whole, _ = loaded(file, lit, **filled)
    pictures = (mi.render(whole, sensor=0, spp=SPP, seed=100 + k) for k in range(RENDERINGS))
    return [float(np.array(picture)[..., :3].mean(dtype=np.float64)) for picture in pictures]


def measure(done: Done) -> dict:
    """Return the numbers of a scene with how far it is off Mitsuba's, over what counts as the same."""
    row = values(done.metrics)
    off = abs(row["ratio"] - 1) / max(NEAR, SIGMA * row["noise"])
    return {**row, "off": off, "gain": row["psnr"] - row["initial"]}


def cell(text: str) -> str:
    return text.replace("\n", " ").replace("|", "\\|") or "-"


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "scene": "{scene}",
        "refused": lambda m: cell(m["refused"]),
        "light": "{light}",
        "mean over Mitsuba's, with standard error": lambda m: (
            cell(m["plain"]) if m["ratio"] != m["ratio"] else f"{m['ratio']:.4f} ± {m['noise']:.4f}"
        ),
        "rendering (unedited), dB": "{psnr:.1f} ({initial:.1f})",
        "map (unedited), dB": "{map:.1f} ({unedited:.1f})",
    },
    summary=Summary(
        {},
        {
            "scenes": "{runs}",
            "edited": "{gain.count}",
            "worse than unedited": "{gain.below[0]}",
            "initial renderings compared": "{off.count}",
            "with Mitsuba's mean": "{off.below[1]}",
        },
    ),
    options=options,
)
