"""Scenes, the files that they name, and what lies in caches and checkpoints under right digests."""

import functools
import io
import json
import re
import struct
import tempfile
import zlib
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit.core import array_cache
from envedit.scene import scene
from envedit.solve.adam_loop import State
from envedit.transport.light_transport import LightTransport

from . import documents, pictures
from .mutate import one_of

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
    head = b"VOL\3" + struct.pack("<5i6f", 1, 2, 2, 2, 1, 0, 0, 0, 1, 1, 1)
    files["a.vol"] = head + values
    return files


@functools.cache
def world():
    """Return a function that takes a light transport from its cache or traces it anew, and one of it."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    folder = Path(tempfile.mkdtemp())
    (folder / "scene.xml").write_text(WRITTEN)
    lit = scene.load(folder / "scene.xml")
    build = functools.partial(LightTransport.build, lit, 8, 16, spp=16, max_depth=3, folder=folder / "cache")
    return build, build()


def recording() -> Path:
    """Return the file of the light transport's recording in its cache."""
    cache, key = world()[1]._stored
    return cache._path(key | {"part": "recording"})


def entry_files() -> dict[str, bytes]:
    """Return the entry of a light transport."""
    return {"recording.arrays": recording().read_bytes()}


def state_files() -> dict[str, bytes]:
    """Return the checkpoint of a run through a light transport."""
    state = State(step=2, history=[{"iteration": 0, "loss": 1.0, "step_ms": 3.0}])
    parts = ("params", "before", "m", "v")
    optimiser = {"step": np.int64(2)} | {f"{part}/a": np.ones((4, 3), np.float32) for part in parts}
    looks = np.zeros(8 * 16, np.uint8)
    renderer = {"columns": np.array([3, 9]), "paths": np.array([8, 48]), "looks": looks}
    renderer |= {"bright": np.array([3]), "epoch": np.int64(0)}
    return pictures.saved(state, optimiser, renderer, np.ones((6, 8, 3), np.float32))


# ---- damage ------------------------------------------------------------------------------------------------


def mutated_scene(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the structure of a scene: values, names, elements removed, doubled, moved and nested."""
    tags = re.split(r"(<[^>]*>)", data.decode())
    for _ in range(int(rng.integers(1, 5))):
        i, j = (int(k) for k in rng.integers(len(tags), size=2))
        word = str((NAMES, VALUES)[rng.integers(2)][rng.integers(min(len(NAMES), len(VALUES)))])
        match rng.integers(8):
            case 0:
                tags[i] = re.sub(r'"[^"]*"', lambda _, w=word: f'"{w}"', tags[i], count=1)
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
            case 7:  # defaults that double
                names = [f'<default name="a{k + 1}" value="$a{k}$a{k}"/>' for k in range(rng.integers(40))]
                first, include = f'<default name="a0" value="{word}"/>', f'<include filename="{word}"/>'
                tags.insert(i, first + "".join(names) + include)
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
        words[rng.integers(words.size)] = one_of(bits, rng) % 2 ** (8 * words.itemsize)
    return raw.reshape(array.shape)


def mutated_entry(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the arrays of a cache entry, and make the digests right again."""
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
        meta["state"][str(rng.choice(list(meta["state"])))] = one_of(values, rng)
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
