"""What is run: cells (a map in a scene), and settings (what differs from the standard preset)."""

from __future__ import annotations

from dataclasses import dataclass

from experiments import puresky

MAPS = ("overcast_soil", "wasteland_clouds", "kloofendal_48d_partly_cloudy")
"""Overcast, in between, and sunny: peaks of 4.5, 309 and 8,963 at 256 texels across."""
SCENES = {
    "matte": {"file": "matte"},
    "glossy": {"file": "sphere", "parameters": {"roughness": 0.05}},
}


def base(file: str, scene: str) -> dict:
    """Return the configuration of the standard preset with a map's file, in one of :data:`SCENES`.

    Fits and transports are not kept on disk, so that every run pays for its own.
    """
    return {
        "input": {"envmap": file},
        "scene": SCENES[scene],
        "target": {"rotate_degrees": 60},
        # Where the sky turned, every setting would find the same map.
        "representation": {"turn": False},
        "renderer": {"cache": False},
        "fit": {"cache": False},
    }


def cells() -> dict[tuple[str, str], dict]:
    """Return the configuration of the standard preset in every cell, by the names of map and scene."""
    return {(name, scene): base(puresky.file(name), scene) for name in MAPS for scene in SCENES}


@dataclass(frozen=True)
class Setting:
    """What is changed in the standard preset.

    Attributes
    ----------
    name : str
        What tables call it; "KNOB: LEVEL" for a knob.
    group : str
        "standard", "preset", "knob", "siren" or "joint".
    tables : dict
        Tables and keys as in a configuration.
    """

    name: str
    group: str
    tables: dict


def knob(name: str, table: str, key: str, *levels) -> list[Setting]:
    """List a key at several levels, without that of the standard preset."""
    return [Setting(f"{name}: {level}", "knob", {table: {key: level}}) for level in levels]


def samples(count: int) -> dict:
    """Return the change to as many samples a pixel of target and result."""
    return {"target": {"spp": count}, "output": {"spp": count}}


def sizes(texels: int, pixels: int) -> dict:
    """Return the change to a map and a picture of as many texels and pixels across."""
    return {"input": {"width": texels}, "scene": {"width": pixels}}


STANDARD = [Setting(f"standard, seed {n}", "standard", {"seed": n}) for n in range(3)]
"""Before, amid and after the others; the seeds show how far results differ by chance."""
PAPER = Setting("paper", "preset", {"preset": "paper"})
"""A run takes about twenty minutes."""
JOINT = ((64, 256, 64, 16), (256, 128, 128, 1024), (128, 64, 96, 64), (16, 96, 32, 64), (32, 384, 48, 256))
"""Samples of T, width of map and of film, samples of target and result: drawn by Latin hypercube sampling
(McKay, Beckman and Conover 1979), so that the levels of a knob are met about equally often."""
SETTINGS = [
    Setting("draft", "preset", {"preset": "draft"}),
    *knob("samples of T", "renderer", "spp", 16, 64, 512),
    *knob("path depth", "renderer", "max_depth", 2),
    *knob("map width", "input", "width", 64, 128, 512),
    # Larger pictures are solved on a film of 128 pixels: experiments/solver.
    *knob("film width", "scene", "width", 64),
    # Gauss-Newton makes at most 16, Adam, where detail is identifiable, all of them.
    *knob("steps at most", "optimizer", "iterations", 4, 30, 200),
    # A number means those cycles and no finer grids, wherever the picture may tell them.
    *knob("gain without detail, cycles", "representation", "cycles", 4, 12),
    *knob("optimizer", "optimizer", "kind", "adam"),
    *(Setting(f"samples of target and result: {n}", "knob", samples(n)) for n in (16, 64)),
    # The standard robust SIREN: at 256 texels across it takes ten times as long.
    Setting("siren, map 128", "siren", {"representation": {"kind": "siren"}, "input": {"width": 128}}),
    *(
        Setting(
            f"joint {i}: T {spp}, map {texels}, film {pixels}, samples {count}",
            "joint",
            {"renderer": {"spp": spp}} | sizes(texels, pixels) | samples(count),
        )
        for i, (spp, texels, pixels, count) in enumerate(JOINT, 1)
    ),
    # The two knobs that are the cheapest alone.
    Setting("map 96, film 32, samples 64", "joint", sizes(96, 32) | samples(64)),
    Setting("map 96, film 48, samples 64", "joint", sizes(96, 48) | samples(64)),
    Setting("map 128, film 64", "joint", sizes(128, 64)),
    Setting("map 128, film 96", "joint", sizes(128, 96)),
]


def settings(part: str, scene: str) -> list[Setting]:
    """List what is run in a cell, with the standard preset before, amid and after it.

    Parameters
    ----------
    part : str
        "settings", or "paper": that preset alone.
    scene : str
        A SIREN, which takes longer than all others, is run in "glossy".
    """
    some = [one for one in SETTINGS if one.group != "siren" or scene == "glossy"]
    some = [PAPER] if part == "paper" else some
    half, (before, amid, after) = len(some) // 2, STANDARD
    return [before, *some[:half], amid, *some[half:], after]
