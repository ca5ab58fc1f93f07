"""The kinds of files: where whole ones come from, how they are damaged, and what reads them.

A reader finds fault with what the package returns (:class:`WrongError`).
"""

import io
import json
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.losses.perceptual import weights
from envedit.renderers import StoredRenderer
from envedit.scene import scene
from envedit.solve import checkpoint
from envedit.targets import painted_image

from . import damage, whole

VALUES = (
    "0", "-1", "1", "2147483647", "-2147483648", "99999999999999999999", "0xff", "1e400", "-1e400", "1e-320",
    "nan", "-inf", "-0.0", "1e38", "1e39", "0.5", "1_0.0", "true", '""', '"auto"', '"sunsky"', '"layers"',
    "'a\\b'", '"\\u0000"', '"\\uD800"', '"\\U0001F600"', '"""\na\n"""', "'''", '"', "[]", "[1.0, 2.0]",
    "[1, [2]]", "{ a.b = [] }", "{", "[", "]", "=", "1979-05-27T07:32:00Z", "\0", "\x1b[31m", "\u2028",
    "\udcff", "\u202e", "[nan, inf]", '[{ type = "blur" }]', "'../../etc'", "a.b", "input.width", "preset",
    "[[input]]",
)  # fmt: skip
TOML = damage.Grammar(
    r"[\w.-]+|\"[^\"]*\"|[=\[\]{},]",
    VALUES,
    (("[", "", "]"), ("{a=", "1", "}"), ("a.", "a", ""), ("9", "", ""), ("[[a]]\n", "", "")),
)
XML = damage.Grammar(
    r"<[^>]*>|(?<=\")[^\"]*(?=\")",
    (
        *VALUES, "<scene>", "<shape>", "</bsdf>", '<ref id="metal"/>', '<include filename="/etc/passwd"/>',
        '<include filename="written.xml"/>', '<bsdf type="mask"/>', '<bsdf type="blendbsdf"/>',
        '<texture type="bitmap"/>', "sphere", "bitmap", "envmap", "$rough", "${rough}", "./evil", "..",
        "&#36;rough", "<!--", "-->", "<![CDATA[", "<?", "<!DOCTYPE a>", "1 2 3", "400:1 700:1", "0 0 0",
    ),
    (
        ('<bsdf type="twosided">', "", "</bsdf>"),
        ('<default name="rough" value="$rough$rough"/>', "", ""),
        ("x", "", ""),
    ),
)  # fmt: skip

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,1,6" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film></sensor>"""
SHAPES = {"features.0.weight": (4, 3, 3, 3), "features.0.bias": (4,), "alpha": (1, 8, 1, 1)}
"""Names and shapes that a file of weights is to have."""


class WrongError(Exception):
    """A reader returned something that it must not."""


def _demand(true, text):
    if not true:
        raise WrongError(text)


def _plain(lines):
    return all(line.isprintable() and len(line) < 1000 for line in lines)


# ---- readers -----------------------------------------------------------------------------------------------


def read_map(path: Path, index: int) -> None:
    """Read as a picture with alpha, and as the map to edit."""
    pixels, info = images.read_stored(path)
    _demand(pixels.ndim == 3 and pixels.shape[1::-1] == info["size"], f"shape {pixels.shape}")
    found, info = images.load_envmap(path, 16, repair=bool(index % 2))
    _demand(found.shape == (8, 16, 3) and found.dtype == np.float32, f"shape {found.shape}")
    # A file may hold values whose mean float32 cannot; then the map must be refused, not infinite.
    _demand(np.isfinite(found).all() and (found >= 0).all(), "a map that is not finite, or negative")
    _demand(_plain(info["warnings"]), f"warnings {info['warnings']!r:.200}")


def read_painted(path: Path, index: int) -> None:
    """Read as a painted picture, with or without the rendering it was painted on, and as a mask."""
    initial = np.clip(whole.radiance(), 0, 1) if index % 2 else None
    found = painted_image.read(path, whole.SIZE, "gamma", initial)
    _demand(_plain(found.warnings), f"warnings {found!r:.200}")
    for values in (found.picture, found.coverage, painted_image.read_mask(path, whole.SIZE)):
        _demand(values.shape[:2] == whole.SIZE and values.dtype == np.float32, f"shape {values.shape}")
        _demand(np.isfinite(values).all() and (values >= 0).all(), "not finite, or negative")


def read_configuration(path: Path, index: int) -> None:
    """Read as a configuration; what is understood must come back equal."""
    found = config.load(path)
    again = config.loads(config.to_toml(found), "/elsewhere", str(path))
    _demand(again == found, "it does not come back equal")


def read_weights(path: Path, index: int) -> None:
    """Read as weights of a network."""
    found = weights.read(path, SHAPES, "the test", "nowhere")
    shapes = {name: values.shape for name, values in found.items()}
    finite = all(np.isfinite(values).all() for values in found.values())
    _demand(shapes == SHAPES and finite, f"shapes {shapes}")


def read_scene(path: Path, index: int) -> None:
    """Load a scene."""
    _load(path, path)


def read_asset(path: Path, index: int) -> None:
    """Load a scene that names a mesh, a volume or a texture."""
    named = f'<string name="filename" value="{path}"/>'
    kind = path.suffix[1:]
    if kind in ("ply", "obj", "serialized"):
        shape = f'<shape type="{kind}">{named}</shape>'
    elif kind == "vol":
        volume = f'<volume type="gridvolume" name="sigma_t">{named}</volume>'
        shape = f'<shape type="cube"><medium type="heterogeneous" name="interior">{volume}</medium></shape>'
    else:
        bitmap = f'<texture type="bitmap" name="reflectance">{named}</texture>'
        shape = f'<shape type="sphere"><bsdf type="diffuse">{bitmap}</bsdf></shape>'
    outer = path.with_name("outer.xml")
    outer.write_text(f'<scene version="3.0.0">{SENSOR}<emitter type="constant"/>{shape}</scene>')
    _load(path, outer)


def _load(path, file):
    """Load a scene; an error may name it or the damaged file by the name alone, as those of parameters do."""
    try:
        scene.load(file)
    except EnveditError as error:
        if str(path) not in str(error) and (path.name in str(error) or file.name in str(error)):
            raise type(error)(f"{path}: {error}") from None
        raise


def read_entry(path: Path, index: int) -> None:
    """Take a light transport from disk, or trace it anew, and use it."""
    whole.recording().write_bytes(path.read_bytes())
    found = whole.transport()[0]()
    picture = found.apply(mi.TensorXf(np.ones((8, 16, 3), np.float32))).numpy()
    back = found.adjoint(mi.TensorXf(np.ones((6, 8, 3), np.float32))).numpy()
    _demand(np.isfinite(picture).all() and np.isfinite(back).all(), "a transport that is not finite")


def read_checkpoint(path: Path, index: int) -> None:
    """Read as the checkpoint of a run, and continue with the columns of its transport."""
    found = checkpoint.load(path.parent, "what")
    _demand(found is not None, "no checkpoint")
    try:
        StoredRenderer(whole.transport()[1]).restore(found[2])
    except EnveditError as error:
        raise type(error)(f"{path}: {error}") from None


# ---- damage ------------------------------------------------------------------------------------------------


damaged_configuration = partial(damage.of_text, grammar=TOML)
damaged_scene = partial(damage.of_text, grammar=XML)


def damaged_checkpoint(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage the bytes, or the arrays and the state of a checkpoint under right checksums."""
    if rng.random() < 0.5:
        return damage.of_bytes(data, rng)
    with np.load(io.BytesIO(data)) as stored:
        arrays = dict(stored)
    meta = json.loads(arrays.pop("meta").tobytes())
    if rng.random() < 0.3:
        values = (-1, 2**70, "2", None, [], {}, 0.5, 1e400, True, [5], [{}])
        meta["state"][str(rng.choice(list(meta["state"])))] = damage.one_of(values, rng)
    else:
        arrays = damage.of_arrays(arrays, rng)
    stream = io.BytesIO()
    np.savez(stream, meta=np.frombuffer(json.dumps(meta).encode(), np.uint8), **arrays)
    return stream.getvalue()


# ---- kinds -------------------------------------------------------------------------------------------------


class Kind(NamedTuple):
    """A kind of files: makes whole ones by name, reads one of a case, and damages the content of one.

    Of the files that are requested, one in ``one_in`` is made: to load a scene around each takes long.
    """

    files: Callable[[], dict[str, bytes]]
    read: Callable[[Path, int], None]
    damage: Callable[[bytes, np.random.Generator], bytes] = damage.of_bytes
    one_in: int = 1


KINDS = {
    "map": Kind(partial(whole.stored, "map"), read_map),
    "painted": Kind(partial(whole.stored, "painted"), read_painted),
    "toml": Kind(whole.toml_files, read_configuration, damaged_configuration),
    "weights": Kind(partial(whole.stored, "weights"), read_weights),
    "scene": Kind(partial(whole.stored, "scene"), read_scene, damaged_scene),
    "asset": Kind(partial(whole.stored, "asset"), read_asset, one_in=10),
    "entry": Kind(lambda: {"recording.arrays": whole.recording().read_bytes()}, read_entry),
    "checkpoint": Kind(whole.checkpoint_files, read_checkpoint, damaged_checkpoint),
}


def seeds(what: str) -> list[tuple[str, bytes]]:
    """Return the whole files of a kind, (name, content), in a fixed order."""
    return sorted(KINDS[what].files().items())


def case(what: str, files: list[tuple[str, bytes]], seed: int, index: int) -> tuple[str, bytes]:
    """Return name and content of a damaged file: the same for the same seeds, kind, seed and index."""
    rng = np.random.default_rng([seed, zlib.crc32(what.encode()), index])
    name, data = damage.one_of(files, rng)
    return name, KINDS[what].damage(data, rng)
