"""Small files, pictures and scenes that several tests share, and losses in plain numpy."""

import drjit as dr
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


def grey(value, height=8, width=16):
    return np.full((height, width, 3), value, np.float32)


def read_png(path):
    return np.array(mi.Bitmap(str(path)))


# ---- losses ------------------------------------------------------------------------------------------------


def waves(height=40, width=56):
    """Two images by formula, so that another program can make the same ones."""
    r, c = np.mgrid[:height, :width]
    y = np.stack([0.5 + 0.4 * np.sin(0.3 * r + 0.11 * c * k) * np.cos(0.07 * k * c) for k in (1, 2, 3)], -1)
    return y + 0.1 * np.cos(1.7 * r + 2.3 * c)[..., None], y


def single(a):
    return mi.TensorXf(np.asarray(a, np.float32))


def double(a):
    return mi.TensorXd(np.asarray(a, np.float64))


def gradient(loss, x, *args, **kwargs):
    """Return value and gradient of a loss."""
    x = type(x)(x)
    dr.enable_grad(x)
    value = loss(x, *args, **kwargs)
    dr.backward(value)
    return value[0], np.array(dr.grad(x))


def plain_ssim(x, y, data_range=1.0):
    """Wang et al. 2004, Eq. 13, window by window, the window not factored."""

    def taps(length):
        radius = (min(11, length) - 1) // 2
        return np.exp(-0.5 * (np.arange(-radius, radius + 1) / 1.5) ** 2)

    g = np.outer(taps(x.shape[0]), taps(x.shape[1]))
    g = (g / g.sum())[..., None]
    (n, m), (c1, c2) = g.shape[:2], ((0.01 * data_range) ** 2, (0.03 * data_range) ** 2)
    out = np.empty((x.shape[0] - n + 1, x.shape[1] - m + 1, x.shape[2]))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            a, b = x[i : i + n, j : j + m], y[i : i + n, j : j + m]
            ma, mb = (g * a).sum((0, 1)), (g * b).sum((0, 1))
            va, vb = (g * (a - ma) ** 2).sum((0, 1)), (g * (b - mb) ** 2).sum((0, 1))
            cov = (g * (a - ma) * (b - mb)).sum((0, 1))
            out[i, j] = (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    return out


def plain_ssim_loss(x, y, w):
    s = plain_ssim(x, y)
    r, c = (x.shape[0] - s.shape[0]) // 2, (x.shape[1] - s.shape[1]) // 2
    w = np.broadcast_to(w, x.shape)[r : r + s.shape[0], c : c + s.shape[1]]
    return 1 - np.sum(w * s) / np.sum(w)


# ---- scenes ------------------------------------------------------------------------------------------------

SENSOR = """<sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0,1,6" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/>
    <rfilter type="box"/></film></sensor>"""
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
