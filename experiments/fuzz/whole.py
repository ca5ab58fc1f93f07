"""Whole files of every kind that the readers take, small, from which damaged ones are made.

Those of ``files`` are by ``whole.py`` of commit d86377dc: OpenEXR of every compression of OpenEXR 3.5.3
(floats, halves, tiles), with parts, layers, windows, deep data; Radiance with run lengths new, old and none;
PNG of every colour type; JPEG, also progressive (Pillow 13); meshes of every format, a volume, weights, a
scene.
"""

import functools
import itertools
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR

from envedit import config
from envedit.config import presets
from envedit.core import shipped
from envedit.images import images
from envedit.scene import scene
from envedit.solve import checkpoint
from envedit.solve.adam_loop import State
from envedit.transport.light_transport import LightTransport

FILES = Path(__file__).parent / "files"
SIZE = 16, 32
"""Rows and columns of every picture: a lat-long map, two chunks of most compressions."""
COMPRESSED = "half", "float", "tiles"
"""Ends of the names of OpenEXR files that begin with their compression."""


def stored(kind: str) -> dict[str, bytes]:
    """Return the files of a kind that lie in ``files``; no OpenEXR whose compression this version lacks."""
    files = {}
    for file in (FILES / kind).iterdir():
        compression, _, form = file.stem.partition("-")
        if form not in COMPRESSED or hasattr(OpenEXR, f"{compression.upper()}_COMPRESSION"):
            files[file.name] = file.read_bytes()
    return files


def radiance() -> np.ndarray:
    """Return the sky of the pictures (16, 32, 3) float32: smooth, a bright sun, flat ground."""
    return images.read(str(FILES / "map" / "ours.exr"))[0]


def toml_files() -> dict[str, bytes]:
    """Return whole configurations: the shipped edits, and presets and kinds with every key spelled out."""
    files = {file.name: file.read_bytes() for file in (shipped.folder() / "edits").glob("*.toml")}
    files["image.toml"] = '[target]\nkind = "image"\nfile = "é/paint.png"\n'.encode()
    for preset, kind in itertools.product(presets.PRESETS, ("layers", "siren", "pixels")):
        chosen = config.loads(f'representation.kind = "{kind}"', "/maps", "a.toml", preset)
        files[f"{preset}-{kind}.toml"] = config.to_toml(chosen).encode()
    return files


# ---- caches and checkpoints --------------------------------------------------------------------------------


@functools.cache
def transport():
    """Return a function that takes a light transport from its cache or traces it anew, and one of it."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    lit = scene.load(FILES / "scene" / "written.xml")
    folder = Path(tempfile.mkdtemp())
    build = functools.partial(LightTransport.build, lit, 8, 16, spp=16, max_depth=3, folder=folder)
    return build, build()


def recording() -> Path:
    """Return the file of the light transport's recording in its cache."""
    cache, key = transport()[1]._stored
    return cache._path(key | {"part": "recording"})


def checkpoint_files() -> dict[str, bytes]:
    """Return the checkpoint of a run through a light transport."""
    state = State(step=2, history=[{"iteration": i, "loss": 1.0, "step_ms": 3.0} for i in range(2)])
    parts = ("params", "before", "m", "v")
    optimiser = {"step": np.int64(2)} | {f"{part}/a": np.ones((4, 3), np.float32) for part in parts}
    renderer = {
        "columns": np.array([3, 9]),
        "paths": np.array([8, 48]),
        "looks": np.zeros(8 * 16, np.uint8),
        "epoch": np.int64(0),
    }
    with tempfile.TemporaryDirectory() as folder:
        target = np.ones((6, 8, 3), np.float32)
        checkpoint.save(Path(folder), "what", state, optimiser, renderer, target)
        return {checkpoint.NAME: (Path(folder) / checkpoint.NAME).read_bytes()}
