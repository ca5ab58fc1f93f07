"""Losses against plain numpy, scikit-image's recorded numbers, and finite differences in double precision."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.errors import ConfigError, InputError
from envedit.losses import LOSSES, LUMINANCE, Ssim, luminance, ssim_index, ssim_loss, ssim_map, tv

REC709 = np.array([0.2126, 0.7152, 0.0722])


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


def numpy_tv(x, w):
    across = np.abs(np.roll(x, -1, axis=1) - x)
    down = np.zeros_like(x)
    down[:-1] = np.abs(x[1:] - x[:-1])
    return np.sum(w * (across + down)) / np.sum(w)


PLAIN = {
    "luminance": lambda x, y, w: abs(np.sum(w * x * REC709) - np.sum(w * y * REC709)),
    "l1": lambda x, y, w: np.sum(w * np.abs(x)),
    "tv": lambda x, y, w: numpy_tv(x, w),
    "image_l1": lambda x, y, w: np.sum(w * np.abs(x - y)) / np.sum(w),
    "hdr": lambda x, y, w: np.sum(w * np.abs(x - y)) / np.sum(w),
    "image_l2": lambda x, y, w: np.sum(w * (x - y) ** 2) / np.sum(w),
    "log_mse": lambda x, y, w: np.sum(w * (x - y) ** 2) / np.sum(w),
    "ssim": lambda x, y, w: plain_ssim_loss(x, y, w),
    "log_ssim": lambda x, y, w: plain_ssim_loss(x, y, w),
}


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


# --------------------------------------------------------------------------------------------------------
# Values and gradients of all losses
# --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("weighted", ["no", "texel", "channel"])
def test_value_is_the_plain_formula(name, weighted, rng):
    x, y = rng.random((14, 19, 3)), rng.random((14, 19, 3))
    w = rng.random((14, 19, 1 if weighted == "texel" else 3))
    w[3, 4] = 0
    given = None if weighted == "no" else double(w)
    w = np.ones((14, 19, 3)) if weighted == "no" else np.broadcast_to(w, x.shape)
    value = LOSSES[name](double(x), double(y), given)
    assert len(value) == 1 and type(value) is mi.Float64
    np.testing.assert_allclose(value[0], PLAIN[name](x, y, w), rtol=1e-12)
    narrow = LOSSES[name](single(x), single(y), None if given is None else single(given))
    assert type(narrow) is mi.Float
    np.testing.assert_allclose(narrow[0], value[0], rtol=3e-6)


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("weighted", [False, True])
def test_gradient_is_the_finite_difference(name, weighted, rng):
    x, y, d = (rng.random((13, 16, 3)) for _ in range(3))
    w = double(rng.random((13, 16, 1))) if weighted else None
    _, g = gradient(LOSSES[name], double(x), double(y), w)
    # Small enough that no absolute value changes sign, fourth order for the smooth ones.
    h = 1e-5
    v = {k: LOSSES[name](double(x + k * h * d), double(y), w)[0] for k in (-2, -1, 1, 2)}
    slope = (8 * (v[1] - v[-1]) - (v[2] - v[-2])) / (12 * h)
    np.testing.assert_allclose(np.sum(g * d), slope, rtol=1e-6)


@pytest.mark.parametrize("name", LOSSES)
def test_equal_images_are_a_stationary_point(name, rng):
    x = single(rng.random((12, 12, 3)) * (name != "l1"))
    if name == "tv":
        x = dr.full(mi.TensorXf, 0.7, (12, 12, 3))
    value, g = gradient(LOSSES[name], x, type(x)(x))
    assert value == 0 and not g.any()


@pytest.mark.parametrize("name", LOSSES)
def test_weights_that_are_all_zero_give_zero_not_nan(name, rng):
    x, y = rng.random((12, 12, 3)), rng.random((12, 12, 3))
    w = dr.opaque(mi.TensorXf, 0, (12, 12, 1))
    value, g = gradient(LOSSES[name], single(x), single(y), w)
    assert value == 0 and not g.any()


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (12, 2, 3), (13, 1, 1)])
@pytest.mark.parametrize("level", [0.0, 1e-30, 65504.0, 1e6])
def test_any_shape_and_level_is_finite(name, shape, level, rng):
    if name == "luminance" and shape[2] != 3:
        pytest.skip("luminance is of RGB images")
    x = single(level * rng.random(shape))
    value, g = gradient(LOSSES[name], x, single(rng.random(shape)))
    assert np.isfinite(value) and np.isfinite(g).all() and g.shape == shape


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_texel_is_not_hidden(name, bad, rng):
    x, y = rng.random((12, 15, 3)), rng.random((12, 15, 3))
    x[5, 8, 1] = bad
    assert not np.isfinite(LOSSES[name](single(x), single(y))[0])
    w = np.ones((12, 15, 1))
    w[:, 8] = 0
    assert not np.isfinite(LOSSES[name](single(x), single(y), single(w))[0])


@pytest.mark.parametrize("name", set(LOSSES) - {"l1", "tv"})
def test_shapes_must_agree(name):
    x = dr.zeros(mi.TensorXf, (12, 15, 3))
    with pytest.raises(InputError, match=r"image \(12, 15, 3\) and reference \(15, 12, 3\) differ in shape"):
        LOSSES[name](x, dr.zeros(mi.TensorXf, (15, 12, 3)))
    with pytest.raises(InputError, match=r"expected an image of shape \(H, W, C\), got \(12, 15\)"):
        LOSSES[name](x[..., 0], x[..., 0])


@pytest.mark.parametrize("name", LOSSES)
def test_weight_must_fit(name):
    x = dr.zeros(mi.TensorXf, (12, 15, 3))
    with pytest.raises(InputError, match=r"weight \(12, 14, 1\) fits neither"):
        LOSSES[name](x, x, dr.zeros(mi.TensorXf, (12, 14, 1)))


def test_luminance_needs_rgb():
    x = dr.zeros(mi.TensorXf, (4, 4, 1))
    with pytest.raises(InputError, match="luminance needs RGB"):
        luminance(x, x)


def test_luminance_weights_are_those_of_images():
    image = pytest.importorskip("envedit.image")
    np.testing.assert_allclose(image.luminance(np.eye(3)), LUMINANCE)


@pytest.mark.parametrize("sun", [(0, 0), (100, 200), (511, 511)])
def test_a_sun_does_not_swallow_the_sky(sun):
    """Float32 sums in blocks lose 5e-5 here; with the sun in both images the difference is all sky."""
    sky = np.full((512, 512, 3), 0.1, np.float32)
    sky[sun] = 1e6
    value = LOSSES["l1"](single(sky))[0]
    np.testing.assert_allclose(value, sky.astype(np.float64).sum(), rtol=1e-7)
    brighter = sky + np.float32(1e-3) * (sky < 1)
    expected = np.sum((brighter.astype(np.float64) - sky) * REC709)
    np.testing.assert_allclose(luminance(single(brighter), single(sky))[0], expected, rtol=1e-6)


def test_tv_wraps_columns_and_not_rows():
    x = np.zeros((4, 5, 1))
    x[:, 0] = 1
    assert tv(double(x))[0] * 20 == pytest.approx(8)  # both sides of the column, one of them through the seam
    assert tv(double(np.swapaxes(x, 0, 1)))[0] * 20 == pytest.approx(4)  # the row below only


def test_losses_compose_in_the_graph(rng):
    """A loss is a node like any other: scaled, added to the others, and reached through another operation."""
    x, y = rng.random((16, 16, 3)), rng.random((16, 16, 3))
    factor = {name: 1 + k for k, name in enumerate(LOSSES)}
    alone = sum(f * gradient(LOSSES[n], double(x**2), double(y))[1] for n, f in factor.items())

    def together(t):
        return sum(f * LOSSES[n](t * t, double(y)) for n, f in factor.items())

    np.testing.assert_allclose(gradient(together, double(x))[1], 2 * x * alone, rtol=1e-10, atol=1e-12)


# --------------------------------------------------------------------------------------------------------
# SSIM
# --------------------------------------------------------------------------------------------------------


def test_ssim_matches_scikit_image():
    """Check against scikit-image 0.26.0 on `waves`.

    ``structural_similarity(x, y, data_range=1.0, gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, channel_axis=2)``, and the same of 1000 + x, 1000 + y.
    """
    x, y = waves()
    assert ssim_index(double(x), double(y))[0] == pytest.approx(0.7613521445087875, rel=1e-12)
    scaled = ssim_index(double(20 * x), double(20 * y), data_range=20.0)[0]
    assert scaled == pytest.approx(0.7613521445087875, rel=1e-12)
    # There scikit-image loses digits to E[x^2] - E[x]^2; the formula window by window does not.
    offset = ssim_index(double(1e3 + x), double(1e3 + y))[0]
    assert offset == pytest.approx(0.7613521433473772, abs=1e-8)
    assert offset == pytest.approx(plain_ssim(1e3 + x, 1e3 + y).mean(), rel=1e-11)
    assert ssim_index(single(x), single(y))[0] == pytest.approx(0.7613521445, rel=1e-6)


def test_ssim_survives_an_offset_in_single_precision():
    """E[x^2] - E[x]^2 at an offset of 100 is off by 1e-3 in float32, as much as C2 itself."""
    x, y = (np.float32(100) + a.astype(np.float32) for a in waves())
    exact = ssim_index(double(x), double(y))[0]
    assert ssim_index(single(x), single(y))[0] == pytest.approx(exact, abs=2e-5)


def test_ssim_of_near_images_keeps_its_digits():
    _, y = waves()
    y = y.astype(np.float32)
    x = y + np.float32(2.0**-13) * (np.indices(y.shape).sum(0) % 2).astype(np.float32)
    exact = ssim_loss(double(x), double(y))[0]
    assert 0 < exact < 1e-5
    assert ssim_loss(single(x), single(y))[0] == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 5, 3), (3, 30, 3), (12, 10, 1), (11, 11, 3)])
def test_ssim_map_in_small_images(shape, rng):
    x, y = rng.random(shape), rng.random(shape)
    expected = plain_ssim(x, y)
    got = ssim_map(double(x), double(y))
    assert got.shape == expected.shape
    np.testing.assert_allclose(np.array(got), expected, rtol=1e-11)


def test_ssim_class_agrees_with_the_function_and_can_be_reused(rng):
    x, z, y = (rng.random((20, 24, 3)) for _ in range(3))
    w = single(rng.random((20, 24, 1)))
    ssim = Ssim(single(y), w)
    for image in (x, z, x):
        (a, g), (b, h) = gradient(ssim, single(image)), gradient(ssim_loss, single(image), single(y), w)
        assert a == b and np.array_equal(g, h)
        assert ssim(single(image))[0] == a  # without gradients asked for


def test_ssim_forward_mode(rng):
    x, y, d = (rng.random((14, 14, 3)) for _ in range(3))
    _, g = gradient(ssim_loss, double(x), double(y))
    t = double(x)
    dr.enable_grad(t)
    loss = ssim_loss(t, double(y))
    dr.set_grad(t, double(d))
    assert dr.forward_to(loss)[0] == pytest.approx(np.sum(g * d), rel=1e-12)


def test_ssim_is_symmetric_and_orders_damage(rng):
    _, y = waves()
    n = rng.normal(size=y.shape)
    values = [ssim_index(double(y + s * n), double(y))[0] for s in (0, 0.01, 0.05, 0.2)]
    assert values == sorted(values, reverse=True) and values[0] == 1
    swapped = [ssim_index(double(a), double(b))[0] for a, b in ((y, y + n), (y + n, y))]
    assert swapped[0] == pytest.approx(swapped[1], rel=1e-12)


def test_ssim_refuses(rng):
    x = single(rng.random((12, 12, 3)))
    with pytest.raises(ConfigError, match="data_range must be a positive number, got 0"):
        ssim_loss(x, x, data_range=0)
    with pytest.raises(InputError, match="negative or non-finite"):
        ssim_loss(x, x, -dr.ones(mi.TensorXf, (12, 12, 1)))
    with pytest.raises(InputError, match=r"SSIM: image \(12, 11, 3\) and reference \(12, 12, 3\)"):
        Ssim(x)(x[:, :11])
    y = mi.TensorXf(x)
    dr.enable_grad(y)
    with pytest.raises(InputError, match="gradients of the reference"):
        ssim_loss(x, y)
