"""Losses and the network in plain NumPy, and the way of their arguments to Dr.Jit and back."""

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong


def waves(height=40, width=56):
    """Two images by formula, so that another program can make the same ones."""
    r, c = np.mgrid[:height, :width]
    y = np.stack([0.5 + 0.4 * np.sin(0.3 * r + 0.11 * c * k) * np.cos(0.07 * k * c) for k in (1, 2, 3)], -1)
    return y + 0.1 * np.cos(1.7 * r + 2.3 * c)[..., None], y


def single(a):
    return dr.opaque(mi.TensorXf(np.asarray(a, np.float32)))  # aligned: the same kernels for all


def double(a):
    return dr.opaque(mi.TensorXd(np.asarray(a, np.float64)))


def gradient(loss, x, *args, **kwargs):
    x = type(x)(x)
    dr.enable_grad(x)
    value = loss(x, *args, **kwargs)
    dr.backward(value)
    return value[0], np.array(dr.grad(x))


def plain_ssim(x, y):
    """Wang et al. 2004, Eq. 13, window by window, the window not factored."""

    def taps(length):
        radius = (min(11, length) - 1) // 2
        return np.exp(-0.5 * (np.arange(-radius, radius + 1) / 1.5) ** 2)

    g = np.outer(taps(x.shape[0]), taps(x.shape[1]))
    g = (g / g.sum())[..., None]
    (n, m), (c1, c2) = g.shape[:2], (0.01**2, 0.03**2)
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


def plain_display(x):
    toe = 1e-3 ** (1 / 2.2)
    middle = np.clip(x, 1e-3, 1) ** (1 / 2.2)
    return np.where(x < 1e-3, x * toe / 1e-3, np.where(x > 1, 1 + np.log(np.maximum(x, 1)) / 2.2, middle))


def numpy_layers(params, x, omega):
    """Sitzmann et al. 2020, layer by layer, in float64: every sine layer and the output."""
    h, last, activations = np.float64(x), len(params) // 2 - 1, []
    for i in range(last + 1):
        z = h @ np.float64(params[f"{i}.weight"]).T + np.float64(params[f"{i}.bias"])
        h = np.sin(omega * z) if i < last else 1 / (1 + np.exp(-z))
        activations.append(h)
    return activations


def numpy_forward(params, x, omega):
    return numpy_layers(params, x, omega)[-1]


# ---- metrics ---------------------------------------------------------------------------------------------

IDENTICAL = {
    "psnr": 200.0, "ssim": 1.0, "mse": 0.0, "lpips": None, "log_rmse": 0.0, "beyond_display": 0.0,
}  # fmt: skip
"""What `metrics.compare` says of an image and itself."""


def lookup(image, d):
    """Interpolate a map (H, W, C) at directions (..., 3) as Mitsuba's ``envmap`` does, in float64."""
    image = np.asarray(image)
    height, width = image.shape[:2]
    row, column = latlong.texel_position(d, height, width)
    r0 = np.clip(np.floor(row).astype(np.int64), 0, max(height - 2, 0))
    c0 = np.floor(column).astype(np.int64)
    fr, fc = (row - r0)[..., None], (column - c0)[..., None]
    r1 = np.minimum(r0 + 1, height - 1)
    c0, c1 = c0 % width, (c0 + 1) % width
    upper = (1 - fc) * image[r0, c0] + fc * image[r0, c1]
    lower = (1 - fc) * image[r1, c0] + fc * image[r1, c1]
    return (1 - fr) * upper + fr * lower
