"""Scenes, the files that they name, and what lies in caches and checkpoints under right digests."""

import functools
import io
import json
import re
import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np

from . import documents

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,1,6" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/>
<rfilter type="box"/></film></sensor>"""
WRITTEN = f"""<?xml version="1.0"?>
<scene version="3.0.0">
<!-- a scene -->
<default name="rough" value="0.2"/>
<path value="."/>
<integrator type="path"><integer name="max_depth" value="4"/></integrator>
{SENSOR}
<emitter type="constant"><rgb name="radiance" value="1, 2, 3"/></emitter>
<bsdf type="roughconductor" id="metal"><float name="alpha" value="$rough"/></bsdf>
<bsdf type="twosided" id="both"><bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf></bsdf>
<shape type="sphere" id="ball"><point name="center" x="0" y="0" z="0"/><ref id="metal"/></shape>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="9"/>
<translate y="-1"/></transform><ref id="both"/></shape>
<shape type="cube"><bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse"/>
<bsdf type="plastic"/></bsdf></shape>
</scene>
"""  # noqa: E501
NAMES = (
    "scene", "shape", "bsdf", "include", "default", "path", "alias", "ref", "spectrum", "texture", "emitter",
    "medium", "transform", "matrix", "evil", "sphere", "twosided", "mask", "bitmap", "constant", "envmap",
    "metal", "both", "filename", "type", "value", "name", "id", "as", "$rough", "${rough}", "\\$",
    "/etc/passwd",
    "..", "./evil", "&#36;rough", "&amp;", "<", ">", '"', "'", "<!--", "-->", "<![CDATA[", "]]>", "<?", "?>",
    "<!DOCTYPE a>", "\0", "\x1b[2J", "é",
)  # fmt: skip
VALUES = (*documents.VALUES, "1 2 3", "400:1 700:1", "0 0 0", "1e38, 1e38, 1e38")
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
FACES = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3]], "<i4")


# ---- whole files -------------------------------------------------------------------------------------------


def scene_files() -> dict[str, bytes]:
    """Return whole scenes."""
    return {"written.xml": WRITTEN.encode()}


def mesh_files() -> dict[str, bytes]:
    """Return whole meshes of every format, and a volume."""
    head = (
        "ply\nformat {} 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = "\n".join(" ".join(map(str, row)) for row in POINTS.tolist())
    rows += "\n" + "\n".join("3 " + " ".join(map(str, row)) for row in FACES.tolist()) + "\n"
    files = {"text.ply": (head.format("ascii") + rows).encode()}
    for order, name in (("<", "little"), (">", "big")):
        raw = POINTS.astype(f"{order}f4").tobytes()
        raw += b"".join(b"\3" + row.astype(f"{order}i4").tobytes() for row in FACES)
        files[f"{name}.ply"] = head.format(f"binary_{name}_endian").encode() + raw
    body = struct.pack("<I", 0x1000) + b"x\0" + struct.pack("<QQ", 4, 3) + POINTS.tobytes() + FACES.tobytes()
    files["a.serialized"] = struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)
    lines = ["v {} {} {}".format(*p) for p in POINTS] + ["f {} {} {}".format(*f) for f in FACES + 1]
    files["a.obj"] = "\n".join([*lines, ""]).encode()
    values = np.linspace(0, 1, 8, dtype="<f4").tobytes()
    files["a.vol"] = (
        b"VOL\3" + struct.pack("<5i", 1, 2, 2, 2, 1) + struct.pack("<6f", 0, 0, 0, 1, 1, 1) + values
    )
    return files


@functools.cache
def _world():
    """Return a scene, a transport of it, and the folder of its cache."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    from envedit.scene import scene

    folder = Path(tempfile.mkdtemp())
    (folder / "scene.xml").write_text(WRITTEN)
    lit = scene.load(folder / "scene.xml")
    return lit, built(lit, folder), folder


def built(lit, folder):
    from envedit.transport.light_transport import LightTransport

    return LightTransport.build(lit, 8, 16, spp=16, max_depth=3, folder=folder / "cache")


def entry_files() -> dict[str, bytes]:
    """Return the entry of a light transport."""
    _, transport, _ = _world()
    cache, key = transport._stored
    return {"recording.arrays": cache._path(key | {"part": "recording"}).read_bytes()}


def state_files() -> dict[str, bytes]:
    """Return the checkpoint of a run through a light transport."""
    from envedit.solve import checkpoint
    from envedit.solve.adam_loop import State

    state = State(step=2, history=[{"iteration": 0, "loss": 1.0, "step_ms": 3.0}])
    optimiser = {"step": np.int64(2)} | {
        f"{part}/a": np.ones((4, 3), np.float32) for part in ("params", "before", "m", "v")
    }
    looks = np.zeros(8 * 16, np.uint8)
    renderer = {"columns": np.array([3, 9]), "paths": np.array([8, 48]), "looks": looks}
    renderer |= {"bright": np.array([3]), "epoch": np.int64(0)}
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.save(Path(folder), "what", state, optimiser, renderer, np.ones((6, 8, 3), np.float32))
        return {checkpoint.NAME: (Path(folder) / checkpoint.NAME).read_bytes()}


# ---- damage ------------------------------------------------------------------------------------------------


def mutated_scene(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the structure of a scene: values, names, elements removed, doubled, moved and nested."""
    tags = re.split(r"(<[^>]*>)", data.decode())
    for _ in range(int(rng.integers(1, 5))):
        i, j = (int(k) for k in rng.integers(len(tags), size=2))
        word = str((NAMES, VALUES)[rng.integers(2)][rng.integers(min(len(NAMES), len(VALUES)))])
        match rng.integers(8):
            case 0:
                quoted = re.sub(r'"[^"]*"', lambda _, w=word: f'"{w}"', tags[i], count=1)
                tags[i] = quoted
            case 1:
                tags[i] = re.sub(r"<\w+", lambda _, w=word: f"<{w}", tags[i])
            case 2:
                tags[i] = ""
            case 3:
                tags.insert(j, tags[i])
            case 4:
                tags[i], tags[j] = tags[j], tags[i]
            case 5:
                depth = int(2 ** rng.uniform(0, 14))
                tags.insert(i, '<bsdf type="twosided">' * depth + "</bsdf>" * depth)
            case 6:
                tags.insert(i, word * int(2 ** rng.uniform(0, 12)))
            case 7:
                values = "".join(
                    f'<default name="a{k + 1}" value="$a{k}$a{k}"/>' for k in range(rng.integers(40))
                )
                tags.insert(i, f'<default name="a0" value="{word}"/>{values}<include filename="{word}"/>')
    return "".join(tags).encode("utf-8", "replace")


def _odd(array, rng):
    """Return an array with odd numbers, or of another shape or type."""
    array = np.array(array)
    bits = (0, 1, 2**31 - 1, 2**31, 2**32 - 8, 0x7F800000, 0x7FC00000, 0xFF800000, int(rng.integers(2**32)))
    kind = rng.integers(10)
    if kind == 0:
        return array.astype(rng.choice(["f4", "f8", "i8", "u4", "u1", "?"]))
    if kind == 1:
        return array.reshape(-1)[: rng.integers(array.size + 1)]
    if kind == 2:
        return array[None] if rng.random() < 0.5 else array.ravel()
    raw = np.atleast_1d(array).copy()
    words = raw.reshape(-1).view(np.uint32) if raw.nbytes % 4 == 0 else raw.reshape(-1).view(np.uint8)
    for _ in range(int(rng.integers(1, 4)) if words.size else 0):
        words[rng.integers(words.size)] = bits[rng.integers(len(bits))] % 2 ** (8 * words.itemsize)
    return raw.reshape(array.shape)


def mutated_entry(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the arrays of a cache entry, and make the digests right again."""
    from envedit.core import array_cache

    length = int.from_bytes(data[8:16], "little")
    text = json.loads(data[array_cache._START : array_cache._START + length])["key"]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a").write_bytes(data)
        arrays = {k: np.array(v) for k, v in array_cache._read(Path(folder) / "a", text).items()}
    arrays = _some_odd(arrays, rng)
    out = array_cache._header(text, arrays)
    for array in arrays.values():
        out += array.tobytes().ljust(array_cache._padded(array.nbytes), b"\0")
    return out


def mutated_state(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the arrays and the state of a checkpoint whose digest stays right."""
    with np.load(io.BytesIO(data)) as stored:
        arrays = {name: stored[name] for name in stored.files}
    meta = json.loads(arrays.pop("meta").tobytes())
    if rng.random() < 0.3:
        values = (-1, 2**70, "2", None, [], {}, 0.5, 1e400, True, [5], [{}])
        meta["state"][str(rng.choice(list(meta["state"])))] = values[rng.integers(len(values))]
    else:
        arrays = _some_odd(arrays, rng)
    out = io.BytesIO()
    np.savez(out, meta=np.frombuffer(json.dumps(meta).encode(), np.uint8), **arrays)
    return out.getvalue()


def _some_odd(arrays, rng):
    for _ in range(int(rng.integers(1, 3))):
        name = str(rng.choice(list(arrays)))
        if rng.random() < 0.05:
            arrays.pop(name)
        else:
            arrays[name] = _odd(arrays[name], rng)
    return arrays or {"nothing": np.zeros(0)}


# ---- readers -----------------------------------------------------------------------------------------------


def read_scene(path: Path, index: int) -> None:
    """Load a scene."""
    from envedit.scene import scene

    _named(path, lambda: scene.load(path))


def read_mesh(path: Path, index: int) -> None:
    """Load a scene with a mesh or a volume."""
    from envedit.scene import scene

    kind = {".ply": "ply", ".obj": "obj", ".serialized": "serialized", ".vol": "gridvolume"}[path.suffix]
    file = f'<string name="filename" value="{path}"/>'
    shape = f'<shape type="{kind}">{file}</shape>'
    if kind == "gridvolume":
        volume = f'<volume type="gridvolume" name="sigma_t">{file}</volume>'
        shape = f'<shape type="cube"><medium type="heterogeneous" name="interior">{volume}</medium></shape>'
    outer = path.with_name("outer.xml")
    outer.write_text(f'<scene version="3.0.0">{SENSOR}<emitter type="constant"/>{shape}</scene>')
    _named(path, lambda: scene.load(outer))


def read_texture(path: Path, index: int) -> None:
    """Load a scene with a texture."""
    from envedit.scene import scene

    file = f'<string name="filename" value="{path}"/>'
    texture = f'<texture type="bitmap" name="reflectance">{file}</texture>'
    shape = f'<shape type="sphere"><bsdf type="diffuse">{texture}</bsdf></shape>'
    outer = path.with_name("outer.xml")
    outer.write_text(f'<scene version="3.0.0">{SENSOR}<emitter type="constant"/>{shape}</scene>')
    _named(path, lambda: scene.load(outer))


def _named(path, call):
    """Let an error name the scene by the file's name alone, as those of parameters do."""
    from envedit.core.errors import EnveditError

    try:
        call()
    except EnveditError as error:
        if path.name in str(error) or "outer.xml" in str(error):
            raise type(error)(f"{path}: {error}" if str(path) not in str(error) else str(error)) from None
        raise


def read_entry(path: Path, index: int) -> None:
    """Take a light transport from disk, or trace it anew, and use it."""
    import mitsuba as mi

    from .readers import WrongError

    lit, transport, folder = _world()
    cache, key = transport._stored
    cache._path(key | {"part": "recording"}).write_bytes(path.read_bytes())
    found = built(lit, folder)
    picture = found.apply(mi.TensorXf(np.ones((8, 16, 3), np.float32))).numpy()
    back = found.adjoint(mi.TensorXf(np.ones((6, 8, 3), np.float32))).numpy()
    if not (np.isfinite(picture).all() and np.isfinite(back).all()):
        raise WrongError("a transport that is not finite")


def read_state(path: Path, index: int) -> None:
    """Continue from a checkpoint."""
    from envedit.core.errors import EnveditError
    from envedit.solve import checkpoint

    _, optimiser, renderer, _ = checkpoint.load(path.parent, "what")
    try:
        _world()[1].restore(renderer)
    except EnveditError as error:
        raise type(error)(f"{path}: {error}") from None
