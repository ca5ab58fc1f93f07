"""Whole files of every kind that the readers take, small, from which damaged ones are made."""

import functools
import io
import itertools
import struct
import tempfile
import zlib
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

SIZE = 16, 32
"""Rows and columns of every picture: a lat-long map, two chunks of most compressions."""


def radiance() -> np.ndarray:
    """Return a small sky (16, 32, 3) float32: smooth, a bright sun, flat ground, so that it compresses."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    sky = np.stack([0.2 + 0.1 * k + 0.02 * rows + 0.1 * np.cos(columns * np.pi / 16) for k in range(3)], -1)
    sky[SIZE[0] // 2 :] = [0.2, 0.15, 0.1]
    sky[4, 9] = 9000.0
    return np.float32(np.round(sky * 256) / 256)


def codes(channels=3) -> np.ndarray:
    """Return the sky as display values (16, 32, channels) uint8, with a little paint on it."""
    shown = np.clip(radiance(), 0, 1) ** (1 / 2.2)
    shown[2:7, 20:27] *= 0.5
    alpha = np.ones((*SIZE, 1))
    alpha[:, :2], alpha[:, 2:4] = 0, 0.5
    return np.uint8(np.rint(255 * np.concatenate([shown, alpha], -1)[..., :channels]))


# ---- maps --------------------------------------------------------------------------------------------------


def maps() -> dict[str, bytes]:
    """Return OpenEXR and Radiance files."""
    return exr_files() | hdr_files()


def exr_files() -> dict[str, bytes]:
    """Write OpenEXR files: every compression, tiles, halves, parts, layers, grey, windows, deep data."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images.write_exr(folder / "ours.exr", radiance(), {"source": "sky.hdr", "seed": 3, "gamma": 0.5})
        for name, file in _exr_variants().items():
            file.write(str(folder / f"{name}.exr"))
        return {file.name: file.read_bytes() for file in folder.iterdir()}


def _exr_variants():
    full = {c: np.ascontiguousarray(radiance()[..., i]) for i, c in enumerate("RGB")}
    half = {c: v.astype(np.float16) for c, v in full.items()}
    scan, tiled = OpenEXR.scanlineimage, OpenEXR.tiledimage
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 16, 8

    def header(kind=scan, compression=OpenEXR.ZIP_COMPRESSION, **more):
        more |= {"tiles": tiles} if kind == tiled else {}
        return {"type": kind, "compression": compression, **more}

    made = {}
    for method in (name for name in dir(OpenEXR) if name.endswith("_COMPRESSION")):  # of this OpenEXR
        name = method.removesuffix("_COMPRESSION").lower()
        for form, kind, planes in (("float", scan, full), ("half", scan, half), ("tiles", tiled, half)):
            made[f"{name}-{form}"] = OpenEXR.File(header(kind, getattr(OpenEXR, method)), dict(planes))
    layers = {f"{layer}.{c}": v for layer in ("a", "beauty") for c, v in half.items()}
    windows = {"dataWindow": ((2, 1), (33, 16)), "displayWindow": ((0, 0), (31, 15))}
    depth = OpenEXR.Part(header(), {"Z": full["R"]}, "depth")
    colour = OpenEXR.Part(header(tiled), dict(half), "colour")
    deep = np.empty(SIZE, object)
    for place in np.ndindex(*SIZE):
        deep[place] = np.full(sum(place) % 3, 0.5, np.float32)
    return made | {
        "alpha": OpenEXR.File(header(), half | {"A": half["R"]}),
        "grey": OpenEXR.File(header(), {"Y": full["G"]}),
        "layers": OpenEXR.File(header(), layers),
        "uint": OpenEXR.File(header(), {c: v.astype(np.uint32) for c, v in full.items()}),
        "window": OpenEXR.File(header(**windows), dict(half)),
        "parts": OpenEXR.File([depth, colour]),
        "deep": OpenEXR.File(
            header(OpenEXR.deepscanline, OpenEXR.ZIPS_COMPRESSION), {c: deep for c in "RGB"}
        ),
    }


def shared_exponent() -> np.ndarray:
    """Return the sky as bytes (16, 32, 4): mantissas and exponent."""
    exponent = np.frexp(radiance().max(axis=2))[1]
    mantissas = radiance() / np.ldexp(1.0, exponent - 8)[..., None]
    return np.concatenate([mantissas, (exponent + 128)[..., None]], -1).astype(np.uint8)


def hdr_files() -> dict[str, bytes]:
    """Make Radiance files: run lengths new and old, flat pixels, a header with more lines."""
    pixels = shared_exponent()
    rows, columns = SIZE
    new = bytearray()
    old = bytearray()
    for row in pixels:
        new += bytes([2, 2, columns >> 8, columns & 255])
        for part in (part for band in row.T for part in (band[:20], band[20:])):
            same = (part == part[0]).all()
            new += bytes([128 + len(part), part[0]]) if same else bytes([len(part)]) + part.tobytes()
    for pixel, run in itertools.groupby(pixels.reshape(-1, 4).tolist()):
        old += bytes(pixel)
        repeats = len(list(run)) - 1
        while repeats:  # digits of base 256, the lowest first
            old += bytes([1, 1, 1, repeats & 255])
            repeats >>= 8
    plain = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"
    more = "# made by hand\nSOFTWARE= a program\nEXPOSURE= 1.0\nCOLORCORR=1 1 1\nVIEW= -vta\n"
    size = f"\n-Y {rows} +X {columns}\n"
    return {
        "new.hdr": (plain + size).encode() + new,
        "old.hdr": (plain + size).encode() + old,
        "flat.hdr": (plain + size).encode() + pixels.tobytes(),
        "header.hdr": (plain + more + size).encode() + new,
    }


# ---- painted pictures --------------------------------------------------------------------------------------


def png(pixels, colour: int, extra: bytes = b"", palette: bytes = b"") -> bytes:
    """Return a PNG of pixels (H, W, C) uint8 or uint16, of a colour type, with further chunks."""
    depth = 8 * pixels.dtype.itemsize
    raw = pixels.astype(pixels.dtype.newbyteorder(">")).reshape(len(pixels), -1).view(np.uint8)
    lines = np.concatenate([np.zeros((len(raw), 1), np.uint8), raw], 1).tobytes()
    head = struct.pack(">2I5B", pixels.shape[1], pixels.shape[0], depth, colour, 0, 0, 0)
    body = _chunk(b"IHDR", head) + palette + extra + _chunk(b"IDAT", zlib.compress(lines))
    return b"\x89PNG\r\n\x1a\n" + body + _chunk(b"IEND", b"")


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def painted_files() -> dict[str, bytes]:
    """Make painted pictures: PNG of every colour type with the chunks that are read, JPEG, and maps."""
    squeezed = zlib.compress("Ärger".encode() * 9)
    texts = _chunk(b"tEXt", b"envedit.tonemap\0gamma") + _chunk(b"zTXt", b"note\0\0" + squeezed)
    texts += _chunk(b"iTXt", b"title\0\1\0de\0\0" + squeezed)
    exif = b"MM\0*\0\0\0\x08\0\1\x01\x12\0\3\0\0\0\1\0\1\0\0\0\0\0\0"  # upright
    marks = _chunk(b"eXIf", exif) + _chunk(b"iCCP", b"sRGB\0\0" + zlib.compress(b"sRGB" * 40))
    palette = _chunk(b"PLTE", bytes(range(96)) * 8) + _chunk(b"tRNS", b"\0\x80")
    files = {
        "rgb8.png": png(codes(), 2, texts),
        "rgb16.png": png(codes().astype(np.uint16) * 257 + 3, 2, marks),
        "rgba8.png": png(codes(4), 6, texts),
        "grey.png": png(codes(1), 0, texts + marks),
        "greya.png": png(codes(4)[..., 2:], 4),
        "palette.png": png(codes(1), 3, b"", palette),
    }
    stream = mi.MemoryStream()
    mi.Bitmap(codes()).write(stream, mi.Bitmap.FileFormat.JPEG, 95)
    stream.seek(0)
    raw = bytes(stream.raw_buffer())
    files["q95.jpg"] = raw[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 8) + b"Exif\0\0" + exif + raw[2:]
    # Progressive and with restart markers, which no writer of ours makes: Pillow 13,
    # Image.fromarray(codes()).save(file, quality=60, progressive=True, restart_marker_blocks=2).
    files["progressive.jpg"] = Path(__file__).with_name("progressive.jpg").read_bytes()
    float_files = maps()
    return files | {name: float_files[name] for name in ("alpha.exr", "ours.exr", "new.hdr")}


# ---- configurations ----------------------------------------------------------------------------------------


def toml_files() -> dict[str, bytes]:
    """Return whole configurations: the shipped edits, and presets and kinds with every key spelled out."""
    files = {file.name: file.read_bytes() for file in (shipped.folder() / "edits").glob("*.toml")}
    files["image.toml"] = '[target]\nkind = "image"\nfile = "é/paint.png"\n'.encode()
    for preset, kind in itertools.product(presets.PRESETS, ("layers", "siren", "pixels")):
        chosen = config.loads(f'representation.kind = "{kind}"', "/maps", "a.toml", preset)
        files[f"{preset}-{kind}.toml"] = config.to_toml(chosen).encode()
    return files


# ---- tensors -----------------------------------------------------------------------------------------------

SHAPES = {"features.0.weight": (4, 3, 3, 3), "features.0.bias": (4,), "alpha": (1, 8, 1, 1)}
"""Names and shapes that a file of weights is to have."""


def tensors() -> dict[str, np.ndarray]:
    """Return tensors of those names: multiples of 1/8, exact in every format."""
    rng = np.random.default_rng(5)
    return {name: np.float32(rng.integers(-64, 64, shape) / 8) for name, shape in SHAPES.items()}


def weight_files() -> dict[str, bytes]:
    """Make files of weights: npz stored and compressed."""
    files = {}
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, **tensors(), more=np.arange(3))
        files[f"{save.__name__}.npz"] = stream.getvalue()
    return files


# ---- scenes ------------------------------------------------------------------------------------------------

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="0,1,6" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/>
<rfilter type="box"/></film></sensor>"""
SCENE = f"""<?xml version="1.0"?>
<scene version="3.0.0">
<!-- a scene -->
<default name="rough" value="0.2"/>
<path value="."/>
<integrator type="path"><integer name="max_depth" value="4"/></integrator>
{SENSOR}
<emitter type="constant"><rgb name="radiance" value="1, 2, 3"/></emitter>
<bsdf type="roughconductor" id="metal"><float name="alpha" value="$rough"/></bsdf>
<bsdf type="twosided" id="both"><bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf>
</bsdf>
<shape type="sphere" id="ball"><point name="center" x="0" y="0" z="0"/><ref id="metal"/></shape>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="9"/>
<translate y="-1"/></transform><ref id="both"/></shape>
<shape type="cube"><bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse"/>
<bsdf type="plastic"/></bsdf></shape>
</scene>
"""
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
FACES = np.array([[0, 1, 2], [0, 1, 3], [1, 2, 3]], "<i4")


def asset_files() -> dict[str, bytes]:
    """Return files that scenes name: meshes of every format, a volume, textures."""
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
    files["a.vol"] = b"VOL\3" + struct.pack("<5i6f", 1, 2, 2, 2, 1, 0, 0, 0, 1, 1, 1) + values
    return files


# ---- caches and checkpoints --------------------------------------------------------------------------------


@functools.cache
def transport():
    """Return a function that takes a light transport from its cache or traces it anew, and one of it."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    folder = Path(tempfile.mkdtemp())
    (folder / "scene.xml").write_text(SCENE)
    lit = scene.load(folder / "scene.xml")
    build = functools.partial(LightTransport.build, lit, 8, 16, spp=16, max_depth=3, folder=folder / "cache")
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
