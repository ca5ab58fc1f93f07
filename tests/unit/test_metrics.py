"""Metrics against closed forms."""

import math

import numpy as np
import pytest

from envedit.core.color import LUMINANCE, inverse_tonemap, tonemap
from envedit.core.errors import ConfigError, InputError
from envedit.losses import metrics
from tests.oracles.plain import IDENTICAL

PAIRS = ["mse", "psnr", "ssim", "compare", "log_psnr", "log_rmse", "sun_offset", "peak_ratio"]
PAIRS += ["mean_luminance_ratio"]


def sky(rng, height=32, width=64):
    return (0.2 + rng.random((height, width, 3))).astype(np.float32)


def test_psnr_and_mse_of_a_known_error_under_the_tonemap_that_is_stated():
    a = np.zeros((4, 5, 3))
    assert metrics.mse(a + 0.1, a) == pytest.approx(0.01)
    assert metrics.psnr(a + 0.1, a) == pytest.approx(20)
    assert metrics.psnr(a + 0.1, a, data_range=10) == pytest.approx(40)
    assert metrics.psnr(a + 1e6, a) == pytest.approx(-120)
    a, b = np.full((16, 16, 3), 0.25, np.float32), np.full((16, 16, 3), 3.0, np.float32)
    result = metrics.compare(a, b)
    error = (1 - 0.25 ** (1 / 2.2)) ** 2
    assert result["mse"] == pytest.approx(error) and result["psnr"] == pytest.approx(-10 * math.log10(error))
    assert result["lpips"] is None and list(result) == list(IDENTICAL)
    assert metrics.compare(a, b, tonemap="linear")["mse"] == pytest.approx(0.75**2)
    with pytest.raises(ConfigError, match="tonemap"):
        metrics.compare(a, b, tonemap="gama")


def test_log_psnr_is_normalised_by_the_reference(rng):
    b = sky(rng)
    span = math.log((b.max() + 0.01) / (b.min() + 0.01))
    a = (b + 0.01) * math.exp(0.1 * span) - 0.01  # a tenth of the range brighter everywhere
    assert metrics.log_psnr(a, b) == pytest.approx(20, abs=1e-4)
    assert metrics.log_psnr(b, b) == metrics.PSNR_CAP
    flat = np.ones((2, 2, 3))
    assert metrics.log_psnr(flat, flat) == metrics.PSNR_CAP and metrics.log_psnr(2 * flat, flat) is None


def test_log_rmse_is_the_same_at_every_exposure(rng):
    b = sky(rng).astype(np.float64)
    offset = metrics.RELATIVE_EPS * np.median(b)
    a = (b + offset) * 2**0.5 - offset  # half a stop brighter everywhere
    for exposure in (1e-30, 1.0, 1e30):
        assert metrics.log_rmse(exposure * a, exposure * b) == pytest.approx(0.5, abs=1e-9)
    black = np.zeros((2, 2, 3))
    assert metrics.log_rmse(black, black) == 0 and metrics.log_rmse(black + 1, black) is None


@pytest.mark.parametrize("exposure, beyond", [(1e-12, 1), (0.1, 0), (1e3, 1), (1e30, 1)])
@pytest.mark.parametrize("tonemap", ["gamma", "linear", "srgb", "log"])
def test_where_a_display_shows_nothing_the_logarithm_judges(rng, tonemap, exposure, beyond):
    """Even where the PSNR of both is 200 dB, and where the farther one has the better PSNR."""
    wanted = exposure * sky(rng).astype(np.float64)
    near, far = (metrics.compare(wanted * factor, wanted, tonemap) for factor in (1.1, 2.0))
    assert near["beyond_display"] == beyond
    assert metrics.saturated([near, far]) == bool(beyond)
    assert metrics.gained(far, near) < 0 < metrics.gained(near, far) and metrics.gained(near, near) == 0
    assert metrics.score(far, [near]).endswith(" stops" if beyond else " dB")


def test_the_share_beyond_the_display_is_of_what_differs(rng):
    """A black ground that is equal in both does not hide that the rest is clipped."""
    a = np.zeros((10, 10, 3))
    a[:4] = 50 + rng.random((4, 10, 3))
    b = a.copy()
    b[:4] *= 2
    b[0] = 0.5
    assert metrics.compare(b, a)["beyond_display"] == pytest.approx(0.75)
    seen = np.zeros((10, 10), bool)
    seen[:1] = True
    assert metrics.compare(b, a, seen=seen)["beyond_display"] == 0


def test_ratios_and_the_offset_of_the_sun(rng):
    a, b = sky(rng), sky(rng)
    a[5, 1], b[8, 61] = 1e4, 2e4
    assert metrics.peak_position(a) == (5, 1)
    assert metrics.sun_offset(a, b) == metrics.sun_offset(b, a) == 5  # 3 rows, 4 columns
    assert metrics.peak_ratio(a, b) == pytest.approx(0.5)
    a = np.zeros((4, 8, 3))
    b = a + 0.5
    assert metrics.mean_luminance_ratio(b, 2 * b) == pytest.approx(0.5)
    assert metrics.peak_ratio(b, a) is None and metrics.mean_luminance_ratio(b, a) is None
    assert metrics.peak_ratio(a, b) == 0


@pytest.mark.parametrize("name", PAIRS)
def test_unsuitable_images_are_refused(name):
    function = getattr(metrics, name)
    a = np.ones((12, 12, 3), np.float32)
    for bad in (np.nan, np.inf):
        b = a.copy()
        b[7, 2, 1] = bad
        with pytest.raises(InputError, match="second image: 1 texel.* not finite, .* row 7, column 2"):
            function(a, b)


def test_painted_tells_how_far_the_paint_was_followed_and_how_still_the_rest_was_held():
    initial = np.full((4, 6, 3), 0.25)
    coverage = np.zeros((4, 6, 1))
    coverage[:, :2], coverage[:, 2] = 1, 0.5
    wanted = np.where(coverage > 0, 0.64, initial)
    edited = initial.copy()
    edited[:, :3] = 0.49
    edited[:, 5] = 0.36
    found = metrics.painted(edited, wanted, initial, coverage, "linear")
    assert found["towards"] == pytest.approx(1 - 0.15 / 0.39)
    assert found["elsewhere"] == pytest.approx((0.5 * 0.24 + 0.11) / 3.5)
    assert metrics.painted(wanted, wanted, initial, coverage)["towards"] == 1
    assert metrics.painted(initial, wanted, initial, coverage) == {"towards": 0, "elsewhere": 0}


def test_paint_below_the_noise_is_unknown(rng):
    """A result that follows the paint exactly, with other samples, seems to have gone the other way."""
    initial = np.full((64, 64, 3), 0.3)
    noise = np.full((64, 64), 0.01)
    coverage = np.zeros((64, 64, 1))
    coverage[:32] = 1

    def noisy(image):
        return inverse_tonemap(tonemap(image) + noise[..., None] * rng.standard_normal(image.shape))

    before, other = noisy(initial), noisy(initial)
    for change, measured in ((0.005, False), (0.05, True)):
        wanted = inverse_tonemap(tonemap(before) + change * coverage)
        edited = inverse_tonemap(tonemap(other) + change * coverage)
        blind = metrics.painted(edited, wanted, before, coverage)["towards"]
        found = metrics.painted(edited, wanted, before, coverage, noise=noise)["towards"]
        assert blind == pytest.approx(1 - 2 / np.sqrt(np.pi) * 0.01 / change, abs=0.05)
        assert found == (blind if measured else None)


def test_of_paint_only_pixels_that_count_are_measured(rng):
    edited, wanted, initial = (rng.random((4, 6, 3)) for _ in range(3))
    coverage, seen = rng.random((4, 6, 1)), np.ones((4, 6), bool)
    whole = metrics.painted(edited, wanted, initial, coverage)
    assert metrics.painted(edited, wanted, initial, coverage, seen=seen) == whole
    seen[:, 3:] = False
    left = metrics.painted(*(a[:, :3] for a in (edited, wanted, initial, coverage)))
    assert metrics.painted(edited, wanted, initial, coverage, seen=seen) == pytest.approx(left)
    nothing = metrics.painted(edited, wanted, initial, coverage, seen=np.zeros((4, 6), bool))
    assert nothing == {"towards": None, "elsewhere": None}


def high_pass(a):
    y = np.log(a @ LUMINANCE + 0.01)
    taps, out = np.array([1, 4, 6, 4, 1]) / 16, np.zeros_like(y)
    for i in range(5):
        for j in range(5):
            rows = np.clip(np.arange(y.shape[0]) + i - 2, 0, y.shape[0] - 1)
            out += taps[i] * taps[j] * np.roll(y[rows], 2 - j, axis=1)
    return math.fsum(((y - out) ** 2).ravel()) / y.size


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e5])
def test_high_frequency_energy_is_what_a_binomial_blur_leaves_out(scale, rng):
    for image in (scale * rng.random((16, 32, 3)), 10 ** rng.uniform(-5, 5, (16, 32, 3))):
        assert metrics.high_frequency_energy(image) == pytest.approx(high_pass(image), rel=1e-12)
