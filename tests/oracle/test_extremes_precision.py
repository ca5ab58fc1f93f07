"""Single precision against double: every loss, metric and reduction, with the bound of its error.

A check returns its largest error over a range of at least ten orders of magnitude, relative to the largest
value.
"""

import functools
import math

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import color, latlong
from envedit.losses import losses, metrics, optimizer, ssim
from envedit.representations.layers import lights
from envedit.representations.siren import network as siren
from tests.oracles.extremes_stages import (
    LOSSES,
    LUMINANCE,
    dense,
    loss_and_gradient,
    plain,
    single,
    transport,
)
from tests.oracles.plain import plain_ssim

SCALES = [10.0**k for k in range(-5, 6)]


def error(got, wanted, beside=None) -> float:
    """Return the largest error relative to the largest reference value, or to what it stands ``beside``."""
    got, wanted = np.asarray(got, np.float64), np.asarray(wanted, np.float64)
    largest = np.abs(wanted).max() if beside is None else beside
    return float(np.abs(got - wanted).max() / largest) if largest else float(np.abs(got - wanted).max())


@functools.cache
def pair(scale, shape=(16, 32, 3)):
    rng = np.random.default_rng(7)
    return tuple((scale * rng.random(shape)).astype(np.float32) for _ in range(2))


@functools.cache
def wild(shape=(16, 32, 3)):
    """Return two images whose texels are spread evenly over 1e-5 to 1e5 by their logarithms."""
    rng = np.random.default_rng(8)
    return tuple((10 ** rng.uniform(-5, 5, shape)).astype(np.float32) for _ in range(2))


def sunny(sun=1e6, below=1e-3):
    m = np.full((512, 512, 3), below, np.float32)
    m[100, 200] = sun
    return m


def _cases(name):
    if name in ("log_mse", "log_ssim"):  # of what was normalised to [0, 1] only
        return [pair(scale) for scale in SCALES[:6]]
    return [*(pair(scale) for scale in SCALES), wild()]


def _loss(name, part):
    def measure():
        return max(
            error(loss_and_gradient(name, x, y)[part], plain(name, x, y)[part]) for x, y in _cases(name)
        )

    return measure


# ---- reductions ------------------------------------------------------------------------------------------


def _sun_luminance():
    m = sunny()
    wanted = (m.astype(np.float64) @ LUMINANCE).sum()
    lum = losses.luminance(single(m), single(np.zeros_like(m)))[0]
    return max(error(lum, wanted), error(color.luminance(m).sum(), wanted))


def _sky_under_sun():
    m = sunny()
    brighter = np.where(m < 1, np.float32(1.001e-3), m)
    wanted = ((brighter.astype(np.float64) - m) @ LUMINANCE).sum()
    return error(losses.luminance(single(brighter), single(m))[0], wanted)


def _sum_under_sun():
    return error(losses.l1(single(sunny()))[0], sunny().astype(np.float64).sum())


def _resize():
    def light(m):
        return (m.astype(np.float64) * latlong.solid_angles(*m.shape[:2])[:, None, None]).sum()

    maps = sunny(1e5, 1e-5)[:256], *wild((64, 128, 3))
    return max(error(light(latlong.resize(m, 32, 64)), light(m)) for m in maps)


def _transport(adjoint):
    def measure():
        traced, matrix, worst = transport(16, 32), dense(16, 32), 0.0
        rng = np.random.default_rng(9)
        for scale in SCALES:
            m = (scale * 10 ** rng.uniform(-5, 0, (16, 32, 3))).astype(np.float32)
            picture = traced.apply(single(m)).numpy()
            got = traced.adjoint(single(picture)).numpy() if adjoint else picture
            for c in range(3):
                x = (picture if adjoint else m).reshape(-1, 3)[:, c].astype(np.float64)
                wanted = (matrix[c].T if adjoint else matrix[c]) @ x
                worst = max(worst, error(got.reshape(-1, 3)[:, c], wanted))
        return worst

    return measure


def _rows():
    worst, n = 0.0, 65536
    rng = np.random.default_rng(10)
    for scale in SCALES:
        x = (scale * rng.random((n, 4))).astype(np.float32)
        x[n // 3] = scale * 1e6
        worst = max(worst, error(siren._sum_of_rows(mi.TensorXf(x)).numpy(), x.sum(axis=0, dtype=np.float64)))
    return worst


def _flux():
    worst = 0.0
    omega = latlong.lookup_solid_angles(16, 32)
    for scale in [1e-20, *SCALES, 1e20, 1e38]:
        row, column = mi.Float([3.3, 7.8]), mi.Float([9.2, 31.7])
        flux = mi.Color3f(scale * 0.02)
        got = lights.shared_out(
            row, column, mi.Float([1.0, 1.5]), flux + mi.Color3f(mi.Float(0, 0)), 1.0, (16, 32), (0, 16)
        )
        light = (got.numpy().astype(np.float64) * omega[:, None, None]).sum(axis=(0, 1))
        worst = max(worst, error(light, np.full(3, 2 * np.float64(np.float32(scale * 0.02)))))
    return worst


# ---- structural similarity -------------------------------------------------------------------------------


def _constant_ssim():
    worst, c1 = 0.0, 0.01**2
    for a in SCALES:
        for b in (a, 2 * a, 0.0):
            x, y = (np.full((16, 32, 3), v, np.float32) for v in (a, b))
            p, q = float(x[0, 0, 0]), float(y[0, 0, 0])
            got = ssim.Ssim(single(y))(single(x))[0]
            wanted = (p - q) ** 2 / (p * p + q * q + c1)
            if a == b and got:
                return math.inf  # equal images are equal
            worst = max(worst, error(got, wanted) if wanted else 0.0)
    return worst


# ---- Adam --------------------------------------------------------------------------------------------------


def _adam():
    rng, worst = np.random.default_rng(12), 0.0
    for scale in SCALES:
        p = start = rng.random((16, 32, 3)).astype(np.float32).astype(np.float64)
        one, m, v = optimizer.Adam({"x": single(start)}, 1e-3), 0.0, 0.0
        for t in range(1, 31):
            g = (scale * rng.normal(size=p.shape)).astype(np.float32)
            one.step({"x": single(g)})
            g = g.astype(np.float64)
            m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
            p = p - 1e-3 * m / (1 - 0.9**t) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        worst = max(worst, error(one.params["x"].numpy(), p))
    return worst


# ---- metrics ---------------------------------------------------------------------------------------------


def _judged(function, reference):
    def measure():
        return max(
            error(function(a, b), reference(a.astype(np.float64), b.astype(np.float64)))
            for a, b in _cases("")
        )

    return measure


def _mse(a, b):
    return math.fsum(((a - b) ** 2).ravel()) / a.size


def _log_psnr(a, b):
    a, b = np.log(a + 0.01), np.log(b + 0.01)
    return 10 * math.log10((b.max() - b.min()) ** 2 / _mse(a, b))


def _log_rmse(a, b):
    offset = 0.01 * np.median(b)
    return math.sqrt(math.fsum((np.log2((a + offset) / (b + offset)) ** 2).ravel()) / a.size)


def _ssim(a, b):
    return plain_ssim(a, b).mean()


def _high_pass(a):
    y = np.log(a @ LUMINANCE + 0.01)
    taps, out = np.array([1, 4, 6, 4, 1]) / 16, np.zeros_like(y)
    for i in range(5):
        for j in range(5):
            rows = np.clip(np.arange(y.shape[0]) + i - 2, 0, y.shape[0] - 1)
            out += taps[i] * taps[j] * np.roll(y[rows], 2 - j, axis=1)
    return math.fsum(((y - out) ** 2).ravel()) / y.size


# Relative to the largest value: a rounding (6e-8) a texel where the sum is double.
_VALUES = dict.fromkeys(("image_l1", "hdr", "luminance", "l1"), 2e-7)
_VALUES |= dict.fromkeys(("image_l2", "log_mse", "tv", "change", "ssim", "log_ssim"), 3e-7)
# SSIM: 1e-6 times level over local contrast; change: quotients and a root in single precision.
_GRADIENTS = dict.fromkeys(_VALUES, 3e-7) | {"ssim": 3e-6, "log_ssim": 3e-6, "change": 1e-5}

CHECKS = {f"loss `{name}`": (_loss(name, 0), _VALUES[name]) for name in LOSSES}
CHECKS |= {f"gradient of `{name}`": (_loss(name, 1), _GRADIENTS[name]) for name in LOSSES}
CHECKS |= {
    "luminance of a sun of 1e6 over a sky of 1e-3": (_sun_luminance, 1e-7),
    "its change when the sky alone grows by 0.1 %": (_sky_under_sun, 1e-6),
    "sum of the same map": (_sum_under_sun, 1e-7),
    "light kept by resizing": (_resize, 1e-6),
    # Sums of some 300 and 50 positive terms in single precision.
    "T E": (_transport(False), 3e-6),
    "T' y": (_transport(True), 3e-6),
    # 32 stretches in single precision: up to 2048 roundings each; half the sum is one point.
    "sum over 65536 points in the network's gradient": (_rows, 1e-4),
    # Integers of 40 bits, then rounded.
    "flux of a light that is shared out": (_flux, 1e-6),
    # 1 - SSIM = (a - b)^2 / (a^2 + b^2 + C1); exactly 0 where they are equal.
    "SSIM of constant images": (_constant_ssim, 3e-6),
    "30 steps of Adam": (_adam, 1e-6),
}
_METRICS = {
    "mse": (metrics.mse, _mse),
    "psnr": (metrics.psnr, lambda a, b: -10 * math.log10(_mse(a, b))),
    "ssim": (metrics.ssim, _ssim),
    "log_psnr": (metrics.log_psnr, _log_psnr),
    "log_rmse": (metrics.log_rmse, _log_rmse),
    "peak_ratio": (metrics.peak_ratio, lambda a, b: (a @ LUMINANCE).max() / (b @ LUMINANCE).max()),
    "mean_luminance_ratio": (
        metrics.mean_luminance_ratio, lambda a, b: (a @ LUMINANCE).mean() / (b @ LUMINANCE).mean()
    ),
    "high_frequency_energy": (
        lambda a, b: metrics.high_frequency_energy(a), lambda a, b: _high_pass(a)
    ),
}  # fmt: skip
CHECKS |= {f"metric `{name}`": (_judged(*both), 1e-12) for name, both in _METRICS.items()}
"""What is computed -> its check and its bound. References are plain float64; those of the losses of SSIM are
the same code in double precision, which the metric's check compares with the formula window by window."""


@pytest.mark.parametrize("name", CHECKS)
def test_error_is_within_its_bound(name):
    measure, bound = CHECKS[name]
    assert measure() <= bound
