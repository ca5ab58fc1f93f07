"""The readers under test: each reads one damaged file, and finds fault with what it returns."""

from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.losses.perceptual import weights
from envedit.scene import scene
from envedit.solve import checkpoint
from envedit.targets import painted_image

from . import pictures, scenes


class WrongError(Exception):
    """A reader returned something that it must not."""


def _demand(true, text):
    if not true:
        raise WrongError(text)


def _plain(lines):
    return all(line.isprintable() and len(line) < 1000 for line in lines)


def _each(*calls):
    """Call all, and raise the first error that a user may see."""
    errors = []
    for call in calls:
        try:
            call()
        except EnveditError as error:
            errors.append(error)
    if errors:
        raise errors[0]


# ---- pictures, configurations, weights ---------------------------------------------------------------------


def environment(path: Path, index: int) -> None:
    """Read as a picture with alpha and as the map to edit: exr, hdr."""

    def stored():
        pixels, info = images.read_stored(path)
        _demand(pixels.ndim == 3 and pixels.shape[1::-1] == info["size"], f"shape {pixels.shape}")

    def to_edit():
        found, info = images.load_envmap(path, 16, repair=bool(index % 2))
        _demand(found.shape == (8, 16, 3) and found.dtype == np.float32, f"shape {found.shape}")
        # A file may hold values whose mean float32 cannot; then the map must be refused, not infinite.
        _demand(np.isfinite(found).all() and (found >= 0).all(), "a map that is not finite, or negative")
        _demand(_plain(info["warnings"]), f"warnings {info['warnings']!r:.200}")

    _each(stored, to_edit)


def picture(path: Path, index: int) -> None:
    """Read as a painted picture, with and without the rendering it was painted on, and as a mask."""
    initial = np.clip(pictures.radiance(), 0, 1) if index % 2 else None

    def look(*values):
        _demand(all(v.shape[:2] == pictures.SIZE and np.isfinite(v).all() for v in values), "not finite")
        _demand(all(v.dtype == np.float32 and (v >= 0).all() for v in values), "negative")

    def painted():
        found = painted_image.read(path, pictures.SIZE, "gamma", initial)
        look(found.picture, found.coverage)
        _demand(_plain(found.warnings), f"warnings {found!r:.200}")

    _each(painted, lambda: look(painted_image.read_mask(path, pictures.SIZE)))


def configuration(path: Path, index: int) -> None:
    """Read as a configuration; what is understood must come back equal."""
    found = config.load(path)
    again = config.loads(config.to_toml(found), "/elsewhere", str(path))
    _demand(again == found, "it does not come back equal")


def tensors(path: Path, index: int) -> None:
    """Read as weights of a network."""
    found = weights.read(path, pictures.WANTED, "the test", "nowhere")
    shapes = {name: values.shape for name, values in found.items()}
    finite = all(np.isfinite(values).all() for values in found.values())
    _demand(shapes == pictures.WANTED and finite, f"shapes {shapes}")


# ---- scenes ------------------------------------------------------------------------------------------------


def scene_file(path: Path, index: int) -> None:
    """Load a scene."""
    _load(path, path)


def mesh(path: Path, index: int) -> None:
    """Load a scene with a mesh or a volume."""
    file = f'<string name="filename" value="{path}"/>'
    shape = f'<shape type="{path.suffix[1:]}">{file}</shape>'
    if path.suffix == ".vol":
        volume = f'<volume type="gridvolume" name="sigma_t">{file}</volume>'
        shape = f'<shape type="cube"><medium type="heterogeneous" name="interior">{volume}</medium></shape>'
    _load(path, _around(path, shape))


def texture(path: Path, index: int) -> None:
    """Load a scene with a texture."""
    file = f'<string name="filename" value="{path}"/>'
    bitmap = f'<texture type="bitmap" name="reflectance">{file}</texture>'
    _load(path, _around(path, f'<shape type="sphere"><bsdf type="diffuse">{bitmap}</bsdf></shape>'))


def _around(path, shape):
    """Write a scene with a shape beside a file."""
    outer = path.with_name("outer.xml")
    outer.write_text(f'<scene version="3.0.0">{scenes.SENSOR}<emitter type="constant"/>{shape}</scene>')
    return outer


def _load(path, file):
    """Load a scene; an error may name it or the damaged file by the name alone, as those of parameters do."""
    try:
        scene.load(file)
    except EnveditError as error:
        if str(path) not in str(error) and (path.name in str(error) or file.name in str(error)):
            raise type(error)(f"{path}: {error}") from None
        raise


# ---- caches and checkpoints --------------------------------------------------------------------------------


def transport(path: Path, index: int) -> None:
    """Take a light transport from disk, or trace it anew, and use it."""
    scenes.recording().write_bytes(path.read_bytes())
    found = scenes.world()[0]()
    picture = found.apply(mi.TensorXf(np.ones((8, 16, 3), np.float32))).numpy()
    back = found.adjoint(mi.TensorXf(np.ones((6, 8, 3), np.float32))).numpy()
    _demand(np.isfinite(picture).all() and np.isfinite(back).all(), "a transport that is not finite")


def checkpointed(path: Path, index: int) -> None:
    """Read as the checkpoint of a run; the file has its name already."""
    found = checkpoint.load(path.parent, "what")
    _demand(found is not None and found[0].step == 2 and found[3].shape == (8, 32, 3), f"{found!r:.200}")


def continued(path: Path, index: int) -> None:
    """Continue from a checkpoint, with the columns of its transport."""
    renderer = checkpoint.load(path.parent, "what")[2]
    try:
        scenes.world()[1].restore(renderer)
    except EnveditError as error:
        raise type(error)(f"{path}: {error}") from None
