"""Sources of a configuration's values, nested dicts of its tables: presets, and what is laid over them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from envedit.config.tables import PAINTED_KINDS

# Presets are nested dicts of defaults. "paper" is Sec. 6 of the paper, every number of it spelled out even
# where it is a default today; the path tracer's samples a pixel and the rendering's size are not in it.
PRESETS: dict[str, dict[str, Any]] = {
    "draft": {
        "input": {"width": 128},
        "scene": {"width": 64},
        "representation": {"hidden": 64},
        "fit": {"epochs": 500},
    },
    "standard": {},
    "paper": {
        "input": {"width": 256, "rows": "upper"},
        "scene": {"width": 256},
        "representation": {"kind": "siren", "hidden": 256, "depth": 6, "omega": 30.0, "coordinates": "plane",
                           "turn": False},
        "fit": {
            "epochs": 1500, "lr": 5e-5, "schedule": "warm-restarts", "restart_period": 100,
            "log_mse": 0.85, "log_ssim": 0.25, "hdr": 1e-2, "awp_gamma": 0.01, "awp_lr": 1e-4, "awp_every": 1,
            "beta2": 0.999, "stride": 1, "headroom": 0.0, "polish": "never", "awp_until": 1.0, "light": 0.0,
        },
        "loss": {
            "ssim": (1.0, 1e4), "luminance": (1e-4, 1e-8), "l1": (1e-4, 1e-8), "dists": 0.6,
            "tv": 0.0, "change": 0.0, "image_l1": 0.0, "image_l2": 0.0,
        },
        "optimizer": {"kind": "adam", "iterations": 400, "lr": 5e-6, "beta2": 0.999, "schedule": "constant"},
        "renderer": {"kind": "path", "spp": 16, "refresh": 1},
        "perceptual": {"dists_every": 1},
    },
}  # fmt: skip

# Layers start near the end and have few parameters; a map of many parameters needs more steps, and the SSIM,
# to which noise matters, to hold its structure together.
MANY_PARAMETERS: dict[str, dict[str, Any]] = {
    "draft": {"loss": {"ssim": 1.0}, "optimizer": {"iterations": 150}},
    "standard": {"loss": {"ssim": 1.0}, "optimizer": {"iterations": 600}},
    "paper": {},
}

# DISTS keeps the sky of a network from being speckled, and needs half the steps. "auto": where weights are.
SIREN: dict[str, dict[str, Any]] = {
    "draft": {"loss": {"dists": "auto"}},
    "standard": {"loss": {"dists": "auto"}, "optimizer": {"iterations": "auto"}},
    "paper": {},
}

# Paint need not be what any sky does: the map is held where the paint leaves it free. For the paper's method,
# luminance weighs less, so that light may be added (Sec. 6.4; a tenth: the paper gives no number).
PAINTED: dict[str, dict[str, Any]] = {
    "draft": {"loss": {"change": 0.01}},
    "standard": {"loss": {"change": 0.01}},
    "paper": {"loss": {"luminance": (1e-5, 1e-9)}},
}

_PATHS = (
    ("input", "envmap"), ("scene", "file"), ("target", "file"), ("target", "mask"), ("output", "dir"),
    ("optimizer", "start"),
    *(("perceptual", key) for key in ("weights", "vgg", "dists", "backbone", "heads")),
)  # fmt: skip


MAP_WORDS = "auto", "scene", "sunsky"
"""What ``[input] envmap`` takes in place of a file."""


def overlaid(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Lay one nested dict over another: tables are merged key by key, anything else is replaced."""
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = overlaid(merged[key], value) if both else value
    return merged


def defaults(preset: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return a preset's defaults for the representation and the target that it, or what is given, names."""
    chosen = PRESETS[preset]
    asked = overlaid(chosen, given)
    kind = asked.get("representation", {}).get("kind", "layers")
    if kind != "layers":
        chosen = overlaid(chosen, MANY_PARAMETERS[preset])
    if kind == "siren":
        chosen = overlaid(chosen, SIREN[preset])
    if asked.get("target", {}).get("kind", "envmap") in PAINTED_KINDS:
        chosen = overlaid(chosen, PAINTED[preset])
    return chosen


def one_target(merged: dict[str, Any], sources: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the target of all sources; of ``file`` and ``rotate_degrees`` a later source replaces the other.

    Who overrides the other map by a turn, or a turn by another map, need not take the first one back. A turn
    of 0 is no turn, and takes nothing back.
    """
    if merged.get("target", {}).get("kind", "envmap") != "envmap":
        return dict(merged.get("target", {}))
    target: dict[str, Any] = {}
    for source in sources:
        given = source.get("target", {})
        if given.get("file"):
            target.pop("rotate_degrees", None)
        elif given.get("rotate_degrees", "auto") not in ("auto", 0):
            target.pop("file", None)
        target |= given
    return target


def resolve_paths(merged: dict[str, Any], base: Path, stem: str) -> None:
    """Make the paths absolute in place; words for maps and bare names of shipped scenes are no paths."""
    output = dict(merged.get("output", {}))
    output["dir"] = output.get("dir") or f"{stem}_out"
    merged["output"] = output
    for table, key in _PATHS:
        value = merged.get(table, {}).get(key, "")
        shipped = table == "scene" and Path(value).name == value and not Path(value).suffix
        if value and not shipped and not (key == "envmap" and value in MAP_WORDS):
            several = isinstance(value, tuple)
            found = tuple(v and str(base / v) for v in value) if several else str(base / value)
            merged[table] = merged[table] | {key: found}
    lights = merged.get("input", {}).get("lights", ())
    if any("image" in light for light in lights):
        with_paths = (
            light | {"image": str(base / light["image"])} if "image" in light else light for light in lights
        )
        merged["input"] = merged["input"] | {"lights": tuple(with_paths)}
