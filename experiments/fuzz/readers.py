"""The readers under test, by name: each reads one damaged file, and finds fault with what it returns."""

import functools
from pathlib import Path

import numpy as np

from . import pictures, scenes


class WrongError(Exception):
    """A reader returned something that it must not."""


def _demand(true, text):
    if not true:
        raise WrongError(text)


def environment(path: Path, index: int) -> None:
    """Read as the map to edit and as a picture with alpha: exr, hdr."""
    from envedit.core.errors import EnveditError
    from envedit.images import images

    first = None
    try:
        found, info = images.load_envmap(path, 16, repair=bool(index % 2))
        _demand(found.shape == (8, 16, 3) and found.dtype == np.float32, f"shape {found.shape}")
        # A file may hold values whose mean float32 cannot; then the map must be refused, not infinite.
        _demand(np.isfinite(found).all() and (found >= 0).all(), "a map that is not finite, or negative")
        _demand(_plain(info["warnings"]), f"warnings {info['warnings']!r:.200}")
    except EnveditError as error:
        first = error
    pixels, info = images.read_stored(path)
    _demand(pixels.ndim == 3 and pixels.shape[1::-1] == info["size"], f"shape {pixels.shape}")
    if first:
        raise first


def picture(path: Path, index: int) -> None:
    """Read as a painted picture, with and without the rendering it was painted on, and as a mask."""
    from envedit.core.errors import EnveditError
    from envedit.targets import painted_image

    first = None
    for call in (
        lambda: painted_image.read(path, pictures.SIZE, "gamma", _initial() if index % 2 else None),
        lambda: painted_image.read_mask(path, pictures.SIZE),
    ):
        try:
            found = call()
            values = [found] if isinstance(found, np.ndarray) else [found.picture, found.coverage]
            _demand(all(v.shape[:2] == pictures.SIZE and np.isfinite(v).all() for v in values), "not finite")
            _demand(all(v.dtype == np.float32 and (v >= 0).all() for v in values), "negative")
            _demand(_plain(getattr(found, "warnings", ())), f"warnings {found!r:.200}")
        except EnveditError as error:
            first = first or error
    if first:
        raise first


@functools.cache
def _initial():
    return (np.clip(pictures.radiance(), 0, 1)).astype(np.float32)


def _plain(lines):
    return all(line.isprintable() and len(line) < 1000 for line in lines)


def configuration(path: Path, index: int) -> None:
    """Read as a configuration; what is understood must come back equal."""
    from envedit import config

    found = config.load(path)
    _demand(
        config.loads(config.to_toml(found), "/elsewhere", str(path)) == found, "it does not come back equal"
    )


def tensors(path: Path, index: int) -> None:
    """Read as weights of a network."""
    from envedit.losses.perceptual import weights

    found = weights.read(path, pictures.WANTED, "the test", "nowhere")
    shapes = {name: values.shape for name, values in found.items()}
    _demand(
        shapes == pictures.WANTED and all(np.isfinite(v).all() for v in found.values()), f"shapes {shapes}"
    )


def state(path: Path, index: int) -> None:
    """Read as the checkpoint of a run; the file has its name already."""
    from envedit.solve import checkpoint

    found = checkpoint.load(path.parent, "what")
    _demand(found is not None and found[0].step == 2 and found[3].shape == (8, 32, 3), f"{found!r:.200}")


READERS = {
    "exr": environment, "hdr": environment, "toml": configuration, "painted": picture, "weights": tensors,
    "checkpoint": state, "scene": scenes.read_scene, "mesh": scenes.read_mesh,
    "texture": scenes.read_texture, "entry": scenes.read_entry, "state": scenes.read_state,
}  # fmt: skip
