"""Whole image files of every kind that the readers take, small, from which damaged ones are made."""

import base64
import io
import itertools
import json
import struct
import tempfile
import zlib
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR

from envedit.images import images
from envedit.solve import checkpoint
from envedit.solve.adam_loop import State

SIZE = 16, 32
"""Rows and columns of every picture: a lat-long map, two chunks of most compressions."""

# Progressive and with restart markers, which no writer of ours makes: Pillow 13,
# Image.fromarray(codes()[..., :3]).save(file, quality=60, progressive=True, restart_marker_blocks=2).
_PROGRESSIVE = (
    "/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAA0JCgsKCA0LCgsODg0PEyAVExISEyccHhcgLikxMC4pLSwzOko+MzZGNywtQFdBRkxO"
    "UlNSMj5aYVpQYEpRUk//2wBDAQ4ODhMREyYVFSZPNS01T09PT09PT09PT09PT09PT09PT09PT09PT09PT09PT09PT09PT09PT09P"
    "T09PT09PT0//wgARCAAQACADASIAAhEBAxEB/8QAFgABAQEAAAAAAAAAAAAAAAAABAAC/8QAFQEBAQAAAAAAAAAAAAAAAAAAAAH/"
    "3QAEAAL/2gAMAwEAAhADEAAAAWnJJtI4/8QAGRAAAwEBAQAAAAAAAAAAAAAAAAECEAMS/9oACAEBAAEFAmipP//QtUjj6c//0c//"
    "0s//xAAVEQEBAAAAAAAAAAAAAAAAAAAAEv/aAAgBAwEBPwGEv//EABURAQEAAAAAAAAAAAAAAAAAAAAS/9oACAECAQE/AbW//8QA"
    "GBAAAgMAAAAAAAAAAAAAAAAAABABEiL/2gAIAQEABj8CX//Qipo//9Ff/9Jf/8QAGhAAAwADAQAAAAAAAAAAAAAAAAERECFBYf/a"
    "AAgBAQABPyEUXR//0NEv2KiMS7eqH//Rx//Sx//aAAwDAQACAAMAAAAQ/d//xAAVEQEBAAAAAAAAAAAAAAAAAAAQcf/aAAgBAwEB"
    "PxCj/8QAFREBAQAAAAAAAAAAAAAAAAAAAHH/2gAIAQIBAT8QhD//xAAbEAACAgMBAAAAAAAAAAAAAAABEQBBECExgf/aAAgBAQAB"
    "PxDXyWghWFuf/9Ay9b8JVDkAJgUEJ//Rx//Sx//Z"
)


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


# ---- OpenEXR -----------------------------------------------------------------------------------------------


def exr_files() -> dict[str, bytes]:
    """Write OpenEXR files: every compression, tiles, halves, parts, layers, grey, windows, deep data."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images.write_exr(folder / "ours.exr", radiance(), {"source": "sky.hdr", "seed": 3, "gamma": 0.5})
        for name, parts in _exr_parts().items():
            parts.write(str(folder / f"{name}.exr"))
        return {file.name: file.read_bytes() for file in folder.iterdir()}


def _exr_parts():
    full = {c: np.ascontiguousarray(radiance()[..., i]) for i, c in enumerate("RGB")}
    half = {c: v.astype(np.float16) for c, v in full.items()}
    scan, tiled, zips = OpenEXR.scanlineimage, OpenEXR.tiledimage, OpenEXR.ZIPS_COMPRESSION
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 16, 8

    def header(kind=scan, compression=OpenEXR.ZIP_COMPRESSION, **more):
        more |= {"tiles": tiles} if kind == tiled else {}
        return {"type": kind, "compression": compression, **more}

    made, forms = {}, {"lines-float": (scan, full), "lines-half": (scan, half), "tiles-half": (tiled, half)}
    for method in (name for name in dir(OpenEXR) if name.endswith("_COMPRESSION")):  # of this OpenEXR
        for form, (kind, planes) in forms.items():
            name = f"{method.removesuffix('_COMPRESSION').lower()}-{form}"
            made[name] = OpenEXR.File(header(kind, getattr(OpenEXR, method)), dict(planes))
    layers = {f"{layer}.{c}": v for layer in ("a", "beauty") for c, v in half.items()}
    uint = {c: v.astype(np.uint32) for c, v in full.items()}
    windows = {"dataWindow": ((2, 1), (33, 16)), "displayWindow": ((0, 0), (31, 15))}
    depth = OpenEXR.Part(header(), {"Z": full["R"]}, "depth")
    colour = OpenEXR.Part(header(), dict(half), "colour")
    parts = [OpenEXR.Part(header(kind), dict(half), name) for kind, name in ((tiled, "a"), (scan, "b"))]
    deep = np.empty(SIZE, object)
    for place in np.ndindex(*SIZE):
        deep[place] = np.full(sum(place) % 3, 0.5, np.float32)
    return made | {
        "alpha": OpenEXR.File(header(), half | {"A": half["R"]}),
        "grey": OpenEXR.File(header(), {"Y": full["G"]}),
        "layers": OpenEXR.File(header(), layers),
        "uint": OpenEXR.File(header(), uint),
        "window": OpenEXR.File(header(**windows), dict(half)),
        "parts": OpenEXR.File([depth, colour]),
        "parts-tiled": OpenEXR.File(parts),
        "deep": OpenEXR.File(header(OpenEXR.deepscanline, zips), {c: deep for c in "RGB"}),
    }


# ---- Radiance ----------------------------------------------------------------------------------------------


def shared_exponent() -> np.ndarray:
    """Return the sky as bytes (16, 32, 4): mantissas and exponent."""
    most = radiance().max(axis=2)
    exponent = np.frexp(most)[1]
    mantissas = radiance() / np.ldexp(1.0, exponent - 8)[..., None]
    return np.concatenate([mantissas, (exponent + 128)[..., None]], -1).astype(np.uint8)


def hdr_files() -> dict[str, bytes]:
    """Make Radiance files: run lengths new and old, flat pixels, other headers."""
    pixels = shared_exponent()
    rows, columns = SIZE
    new, old = bytearray(), bytearray()
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
    talkative = plain + "# made by hand\nSOFTWARE= a program\nEXPOSURE= 1.0\nCOLORCORR=1 1 1\nVIEW= -vta\n"
    size = f"\n-Y {rows} +X {columns}\n"
    return {
        "new.hdr": (plain + size).encode() + new,
        "old.hdr": (plain + size).encode() + old,
        "flat.hdr": (plain + size).encode() + pixels.tobytes(),
        "header.hdr": (talkative + size).encode() + new,
    }


# ---- PNG and JPEG ------------------------------------------------------------------------------------------


def chunk(kind: bytes, body: bytes) -> bytes:
    """Return a PNG chunk with its length and checksum."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(pixels, colour: int, extra: bytes = b"", palette: bytes = b"") -> bytes:
    """Return a PNG of pixels (H, W, C) uint8 or uint16, of a colour type, with further chunks."""
    depth = 8 * pixels.dtype.itemsize
    raw = pixels.astype(pixels.dtype.newbyteorder(">")).reshape(len(pixels), -1).view(np.uint8)
    lines = np.concatenate([np.zeros((len(raw), 1), np.uint8), raw], 1).tobytes()
    head = struct.pack(">2I5B", pixels.shape[1], pixels.shape[0], depth, colour, 0, 0, 0)
    body = chunk(b"IHDR", head) + palette + extra + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def painted_files() -> dict[str, bytes]:
    """Make painted pictures: PNG of every colour type with the chunks that are read, and others."""
    squeezed = zlib.compress("Ärger".encode() * 9)
    texts = chunk(b"tEXt", b"envedit.tonemap\0gamma") + chunk(b"zTXt", b"note\0\0" + squeezed)
    texts += chunk(b"iTXt", b"title\0\1\0de\0\0" + squeezed)
    exif = b"MM\0*\0\0\0\x08\0\1\x01\x12\0\3\0\0\0\1\0\1\0\0\0\0\0\0"  # upright
    marks = chunk(b"eXIf", exif) + chunk(b"iCCP", b"sRGB\0\0" + zlib.compress(b"sRGB" * 40))
    palette = chunk(b"PLTE", bytes(range(96)) * 8) + chunk(b"tRNS", b"\0\x80")
    files = {
        "rgb8.png": png(codes(), 2, texts),
        "rgb16.png": png(codes().astype(np.uint16) * 257 + 3, 2, marks),
        "rgba8.png": png(codes(4), 6, texts),
        "grey.png": png(codes(1), 0, texts + marks),
        "greya.png": png(codes(4)[..., 2:], 4),
        "palette.png": png(codes(1), 3, b"", palette),
    }
    for quality in (95, 40):
        stream = mi.MemoryStream()
        mi.Bitmap(codes()).write(stream, mi.Bitmap.FileFormat.JPEG, quality)
        stream.seek(0)
        raw = bytes(stream.raw_buffer())
        marked = b"\xff\xe1" + struct.pack(">H", len(exif) + 8) + b"Exif\0\0" + exif
        files[f"q{quality}.jpg"] = raw[:2] + (marked if quality == 95 else b"") + raw[2:]
    files["progressive.jpg"] = base64.b64decode(_PROGRESSIVE)
    float_files = exr_files() | hdr_files()
    return files | {name: float_files[name] for name in ("alpha.exr", "ours.exr", "new.hdr")}


# ---- tensors -----------------------------------------------------------------------------------------------

WANTED = {"features.0.weight": (4, 3, 3, 3), "features.0.bias": (4,), "alpha": (1, 8, 1, 1)}
"""Names and shapes that a file of weights is asked for."""


def tensors() -> dict[str, np.ndarray]:
    """Return tensors of those names: multiples of 1/8, exact in every format."""
    rng = np.random.default_rng(5)
    return {name: np.float32(rng.integers(-64, 64, shape) / 8) for name, shape in WANTED.items()}


def weight_files() -> dict[str, bytes]:
    """Make files of weights: npz stored and compressed, safetensors of three precisions."""
    files = {}
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, **tensors(), more=np.arange(3))
        files[f"{save.__name__}.npz"] = stream.getvalue()
    for kind, dtype in (("F16", "<f2"), ("F32", "<f4"), ("F64", "<f8")):
        entries, data = {"__metadata__": {"format": "pt"}}, b""
        for name, values in tensors().items():
            start = len(data)
            data += values.astype(dtype).tobytes()
            place = [start, len(data)]
            entries[name] = {"dtype": kind, "shape": list(values.shape), "data_offsets": place}
        text = json.dumps(entries).encode()
        files[f"{kind}.safetensors"] = struct.pack("<Q", len(text)) + text + data
    return files


def checkpoint_files() -> dict[str, bytes]:
    """Write a checkpoint as a run does."""
    state = State(2, history=[{"iteration": 0, "loss": 0.5}, {"iteration": 1, "loss": 0.25}])
    optimiser = {"step": np.int64(2), "params/gain": radiance()[:4, :8, 0]}
    return saved(state, optimiser, {"columns": np.arange(5)}, radiance()[:8])


def saved(state: State, optimiser: dict, renderer: dict, target: np.ndarray) -> dict[str, bytes]:
    """Return a checkpoint as a file of its name."""
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.save(Path(folder), "what", state, optimiser, renderer, target)
        return {checkpoint.NAME: (Path(folder) / checkpoint.NAME).read_bytes()}
