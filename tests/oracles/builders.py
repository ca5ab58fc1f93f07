"""Small files, pictures and scenes that several tests share, and losses in plain numpy."""

import struct
import zlib

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest

from envedit import config as cfg
from envedit.core.errors import ConfigError

# ---- images ------------------------------------------------------------------------------------------------

SCANLINE = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}


def exr(path, header=None, **channels):
    OpenEXR.File(SCANLINE | (header or {}), channels).write(str(path))
    return path


def planes(rng, dtype=np.float32, size=(4, 8)):
    return {c: (rng.random(size) * 100).astype(dtype) for c in "RGB"}


def stacked(p):
    return np.stack([p[c] for c in "RGB"], -1).astype(np.float32)


def floats(path, picture, dtype=np.float32, **more):
    """Write a picture (H, W, 3) as OpenEXR, past the package: also one that is not finite."""
    return exr(path, **{c: np.ascontiguousarray(picture[..., i], dtype) for i, c in enumerate("RGB")}, **more)


def png(path, values):
    mi.Bitmap(np.ascontiguousarray(values)).write(str(path))
    return path


def grey(value, height=8, width=16):
    return np.full((height, width, 3), value, np.float32)


def read_png(path):
    return np.array(mi.Bitmap(str(path)))


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunk(path, kind, data):
    """Put a chunk before the pixels of a PNG."""
    raw = path.read_bytes()
    at = raw.index(b"IDAT") - 4
    path.write_bytes(raw[:at] + chunk(kind, data) + raw[at:])
    return path


def turned(orientation):
    entry = struct.pack(">HHIHH", 274, 3, 1, orientation, 0)
    return b"MM\0*" + struct.pack(">IH", 8, 1) + entry + bytes(4)


# ---- scenes ------------------------------------------------------------------------------------------------

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,1,6" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/>
    <rfilter type="box"/></film></sensor>"""
ORIGIN, HALF = np.array([0.0, 1.0, 6.0]), np.tan(np.radians(20))
AHEAD = -ORIGIN / np.linalg.norm(ORIGIN)
RIGHT, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, -AHEAD[2], AHEAD[1]])
"""Where the camera of SENSOR is and looks, and half of its picture's width at a distance of 1."""
BALL = """<shape type="sphere"><bsdf type="diffuse">
    <rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf></shape>"""
LIGHT = '<emitter type="constant"/>'


def write_scene(folder, *parts, name="test.xml"):
    path = folder / name
    path.write_text('<scene version="3.0.0">' + "\n".join(parts) + "</scene>")
    return path


def sky(rng, height=8, width=16):
    return rng.random((height, width, 3), dtype=np.float32) ** 4 * 3


# ---- configurations ----------------------------------------------------------------------------------------


def refused(text, *overrides, **kwargs) -> str:
    """Return the message, on one line, with which a configuration is refused."""
    with pytest.raises(ConfigError) as info:
        cfg.loads(text, name="a.toml", overrides=overrides, **kwargs)
    message = str(info.value)
    assert info.value.exit_code == 2
    assert len(message.splitlines()) == 1 and len(message) < 400
    return message
