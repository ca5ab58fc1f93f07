"""SSIM against scikit-image's recorded numbers and its formula window by window."""

import numpy as np
import pytest

from envedit.losses.ssim import Ssim, StackedSsim
from tests.oracles.plain import double, gradient, plain_ssim, single, waves


def loss_of(x, y, *weight):
    return Ssim(y, *weight)(x)


def index_of(x, y):
    return (1 - loss_of(x, y))[0]


def test_ssim_matches_scikit_image():
    """Check against scikit-image 0.26.0 on `waves`.

    ``structural_similarity(x, y, data_range=1.0, gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, channel_axis=2)``, and the same of 1000 + x, 1000 + y.
    """
    x, y = waves()
    assert index_of(double(x), double(y)) == pytest.approx(0.7613521445087875, rel=1e-12)
    # There scikit-image loses digits to E[x^2] - E[x]^2; the formula window by window does not.
    offset = index_of(double(1e3 + x), double(1e3 + y))
    assert offset == pytest.approx(0.7613521433473772, abs=1e-8)
    assert offset == pytest.approx(plain_ssim(1e3 + x, 1e3 + y).mean(), rel=1e-11)
    assert index_of(single(x), single(y)) == pytest.approx(0.7613521445, rel=1e-6)


def test_ssim_survives_an_offset_in_single_precision():
    """E[x^2] - E[x]^2 at an offset of 100 is off by 1e-3 in float32, as much as C2 itself."""
    x, y = (np.float32(100) + a.astype(np.float32) for a in waves())
    exact = index_of(double(x), double(y))
    assert index_of(single(x), single(y)) == pytest.approx(exact, abs=2e-5)


def test_ssim_of_near_images_keeps_its_digits():
    _, y = waves()
    y = y.astype(np.float32)
    x = y + np.float32(2.0**-13) * (np.indices(y.shape).sum(0) % 2).astype(np.float32)
    exact = loss_of(double(x), double(y))[0]
    assert 0 < exact < 1e-5
    assert loss_of(single(x), single(y))[0] == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 3), (3, 30, 3), (12, 10, 1), (11, 11, 3)])
def test_ssim_of_small_images(shape, rng):
    x, y = rng.random(shape), rng.random(shape)
    assert index_of(double(x), double(y)) == pytest.approx(plain_ssim(x, y).mean(), rel=1e-11)


def test_ssim_can_be_reused(rng):
    x, z, y = (rng.random((20, 24, 3)) for _ in range(3))
    w = single(rng.random((20, 24, 1)))
    ssim = Ssim(single(y), w)
    for image in (x, z, x):
        (a, g), (b, h) = gradient(ssim, single(image)), gradient(Ssim(single(y), w), single(image))
        assert a == b and np.array_equal(g, h)
        assert ssim(single(image))[0] == a  # without gradients asked for


@pytest.mark.slow
def test_ssim_of_pictures_below_each_other_is_that_of_each(rng):
    """Value and gradient; each counts by its weight."""
    x, y, w = rng.random((30, 14, 3)), rng.random((30, 14, 3)), rng.random((30, 14, 1)) + 0.1
    rows = slice(0, 12), slice(12, 30)
    w[rows[1]] *= 3
    shares = [w[some].sum() / w.sum() for some in rows]
    stacked = StackedSsim(double(y), double(w), rows)
    value, found = gradient(stacked, double(x))
    each = [gradient(Ssim(double(y[some]), double(w[some])), double(x[some])) for some in rows]
    assert value == pytest.approx(sum(s * v for s, (v, _) in zip(shares, each, strict=True)), rel=1e-12)
    expected = np.concatenate([s * g for s, (_, g) in zip(shares, each, strict=True)])
    np.testing.assert_allclose(found, expected, rtol=1e-12)
