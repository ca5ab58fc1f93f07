"""What is run: cells (a map in a scene), and settings (what differs from the standard preset)."""

from __future__ import annotations

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


def knob(name: str, table: str, key: str, *levels) -> dict[str, dict]:
    """Return a key at several levels, without that of the standard preset, by the names of settings."""
    return {f"{name}: {level}": {table: {key: level}} for level in levels}


def samples(count: int) -> dict:
    """Return the change to as many samples a pixel of target and result."""
    return {"target": {"spp": count}, "output": {"spp": count}}


def sizes(texels: int, pixels: int) -> dict:
    """Return the change to a map and a picture of as many texels and pixels across."""
    return {"input": {"width": texels}, "scene": {"width": pixels}}


STANDARD = [f"standard, seed {n}" for n in range(3)]
"""Run before, amid and after the others; the seeds show how far results differ by chance."""
SETTINGS = {
    "draft": {"preset": "draft"},
    **knob("samples of T", "renderer", "spp", 16, 64, 512),
    **knob("path depth", "renderer", "max_depth", 2),
    **knob("map width", "input", "width", 64, 128, 512),
    # Larger pictures are solved on a film of 128 pixels: experiments/solver.
    **knob("film width", "scene", "width", 64),
    # Gauss-Newton makes at most 16, Adam, where detail is identifiable, all of them.
    **knob("steps at most", "optimizer", "iterations", 4, 30, 200),
    # A number means those cycles and no finer grids, wherever the picture may show them.
    **knob("gain without detail, cycles", "representation", "cycles", 4, 12),
    **knob("optimizer", "optimizer", "kind", "adam"),
    **{f"samples of target and result: {n}": samples(n) for n in (16, 64)},
    # The standard robust SIREN: at 256 texels across it takes ten times as long.
    "siren, map 128": {"representation": {"kind": "siren"}, "input": {"width": 128}},
    # Several at once; the second and "draft" are levels of --budget.
    "map 96, film 32, samples 64": sizes(96, 32) | samples(64),
    "map 96, film 48, samples 64": sizes(96, 48) | samples(64),
    "map 128, film 64": sizes(128, 64),
    "map 128, film 96": sizes(128, 96),
}
"""Tables and keys that are changed in the standard preset, as in a configuration, by the name in tables."""


def settings() -> dict[str, dict]:
    """Return what is run in a cell, in its order: all settings, and the standard preset three times."""
    before, amid, after = [(name, {"seed": seed}) for seed, name in enumerate(STANDARD)]
    others = list(SETTINGS.items())
    half = len(others) // 2
    return dict([before, *others[:half], amid, *others[half:], after])
