"""DISTS and LPIPS against the authors' recorded numbers, and finite differences.

The weights are random and seeded, as the trained ones are not needed to tell whether the formulas are right;
one test has those, where they are.
"""

import functools
import importlib.util

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.losses.perceptual import convolution, installed
from envedit.losses.perceptual.backbones import KINDS, Backbone, Stack
from envedit.losses.perceptual.distances import Dists, Lpips
from tests.oracles import ROOT
from tests.oracles.plain import double, gradient, single


def _script():
    spec = importlib.util.spec_from_file_location(
        "perceptual_reference", ROOT / "experiments/references/perceptual.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


drawn = _script()
state_of = functools.cache(drawn.tensors)

# ---- what the tests share ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def backbones():
    return {kind: Backbone(kind, state_of(kind)) for kind in KINDS}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights")
    np.savez(path / "dists.npz", **drawn.alpha_beta())
    for kind in KINDS:
        np.savez(path / f"{kind}.npz", **drawn.heads(kind))
    return path


@pytest.fixture(scope="module")
def dists(backbones, folder):
    return Dists(backbones["vgg"], folder / "dists.npz")


@pytest.fixture(scope="module")
def lpips(backbones, folder):
    return {kind: Lpips(kind, backbones[kind], folder / f"{kind}.npz") for kind in KINDS}


# ---- features ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "pooling", "size"), [("vgg", "hanning", (9, 14)), ("alex", "max", (47, 36))]
)
def test_features_in_bands_are_the_same(kind, pooling, size, backbones, monkeypatch, rng):
    """Taps in double precision, and the gradient of the sum of taps times directions."""
    stack = Stack(backbones[kind], *size, pooling)
    x = double(rng.normal(size=(*size, 3))).array
    directions = [mi.Float64(rng.normal(size=n * c)) for _, n, c in stack.taps(stack.forward(x))]

    def found(most):
        monkeypatch.setattr(convolution, "MOST_PATCHES", most)
        stack = Stack(backbones[kind], *size, pooling)
        tape = stack.forward(x)
        back = [stack.backward(tape, directions)] if pooling == "hanning" else []
        return [np.array(one) for one in (*(tap for tap, _, _ in stack.taps(tape)), *back)]

    for bands, whole in zip(found(2**14), found(2**24), strict=True):  # of one to a few rows
        np.testing.assert_allclose(bands, whole, rtol=1e-10, atol=1e-11)


def test_max_pooling_does_not_lose_nan():
    pool = convolution.MaxPool(3, (5, 5, 1))
    x = np.zeros((5, 5))
    x[2, 2] = 1  # under all four windows
    np.testing.assert_array_equal(np.array(pool.forward(mi.Float64(x.ravel()))), 1)
    x[1, 3], x[1, 4] = np.nan, 5  # under one window, and before its largest
    np.testing.assert_array_equal(np.array(pool.forward(mi.Float64(x.ravel()))), [1, np.nan, 1, 1])


@pytest.mark.slow
def test_least_sizes(backbones):
    """torchvision says 32 and 63, which counts the last pooling."""
    for kind, n in (("vgg", 16), ("alex", 31)):
        stack = Stack(backbones[kind], n, n)
        last, pixels, _ = stack.taps(stack.forward(dr.ones(mi.Float, n * n * 3)))[-1]
        assert pixels >= 1 and np.isfinite(last).all()
        assert backbones[kind].least_size == n


# ---- recorded numbers --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded():
    with np.load(ROOT / "tests/data/perceptual/reference.npz") as file:
        found = dict(file)
    state = drawn.checksum(v for kind in sorted(drawn.CHANNELS) for v in state_of(kind).values())
    assert state == found["weights"], "numpy draws other random numbers now: record the reference again"
    return found


@pytest.mark.parametrize("measure, kind, size", drawn.CASES)
def test_measures_match_the_authors_code(recorded, dists, lpips, backbones, measure, kind, size):
    """PyTorch, torchvision, lpips and DISTS_pytorch; see experiments/references/perceptual.py."""
    case = f"{measure}_{kind}_{size[0]}x{size[1]}/"
    x, y, directions = drawn.images(*size)
    assert drawn.checksum((x, y, directions)) == recorded[case + "images"]
    if measure == "lpips":
        value = lpips[kind].distance(double(x), double(y))[0]
        assert value == pytest.approx(recorded[case + "score"], rel=1e-9)
        assert lpips[kind](x, y) == pytest.approx(recorded[case + "score"], rel=2e-5)
        return
    value, slope = gradient(dists.against(double(y)), double(x))
    assert value == pytest.approx(recorded[case + "score"], rel=1e-9)
    assert np.linalg.norm(slope) == pytest.approx(recorded[case + "length"], rel=1e-7)
    slopes, scale = np.tensordot(directions, slope, 3), recorded[case + "length"]
    np.testing.assert_allclose(slopes, recorded[case + "slopes"], atol=1e-7 * scale)
    value, slope = gradient(dists.against(single(y)), single(x))
    assert value == pytest.approx(recorded[case + "score"], rel=2e-5)
    np.testing.assert_allclose(
        np.tensordot(directions, slope, 3), recorded[case + "slopes"], atol=1e-3 * scale
    )


@pytest.mark.slow
def test_trained_networks_score_as_the_authors_programs(data):
    """Ten pairs, the weights that ``envedit weights`` fetches; see experiments/references/perceptual.py."""
    folder = data / "weights"
    if not (folder / installed.VGG).is_file():
        pytest.skip(f"no trained weights in {folder}")
    with np.load(ROOT / "tests/data/perceptual/trained.npz") as file:
        images, expected = file["images"], file["scores"]
    pairs = list(drawn.pairs())
    assert drawn.checksum(image for pair in pairs for image in pair) == images
    vgg, heads = Backbone.load("vgg", folder / installed.VGG), str(folder / installed.HEADS)
    alex = Lpips("alex", Backbone.load("alex", folder / installed.BACKBONES["alex"]), heads.format("alex"))
    dists = Dists(vgg, folder / installed.DISTS)
    measures = alex, Lpips("vgg", vgg, heads.format("vgg")), lambda a, b: dists.against(b)(a)
    found = [[np.ravel(measure(single(x), single(y)))[0] for measure in measures] for x, y in pairs]
    np.testing.assert_allclose(found, expected, atol=1e-6, rtol=1e-4)


# ---- the measures ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_measures_keep_the_digits_of_near_images(dists, lpips):
    """1 minus a sum near 1, as the formula is written, would leave nothing of a distance of 1e-9."""
    x, y, _ = drawn.images(33, 40)
    y = y.astype(np.float32)
    x = y + np.float32(2.0**-14) * np.sign(x - 0.5).astype(np.float32)
    for distance in (lambda a, b: dists.against(b)(a), lpips["alex"].distance):
        exact = distance(double(x), double(y))[0]
        assert 0 < exact < 1e-3
        assert distance(single(x), single(y))[0] == pytest.approx(exact, rel=2e-2)


# ---- extremes ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("value", [None, 0.0, 0.5, 1.0, -3.0, 65504.0, 1e-30])
def test_identical_images_are_at_distance_zero(dists, lpips, value):
    image = drawn.images(32, 31)[0] if value is None else np.full((32, 31, 3), value)
    found, slope = gradient(dists.against(single(image)), single(image))
    assert found == 0
    np.testing.assert_array_equal(slope, 0)
    assert all(measure(image, image) == 0 for measure in lpips.values())


@pytest.mark.slow
@pytest.mark.parametrize("a, b", [(0.0, 1.0), (0.5, 0.5001), (0.0, 1e-30), (0.0, 65504.0), (-1.0, 1e6)])
def test_constant_and_far_images_have_finite_distances_and_gradients(dists, lpips, a, b):
    x, y = (np.full((32, 32, 3), value) for value in (a, b))
    found, slope = gradient(dists.against(single(y)), single(x))
    assert np.isfinite(found) and found >= 0 and np.isfinite(slope).all()
    found = lpips["alex"](x, y)
    assert np.isfinite(found) and found >= 0


def test_pixels_without_any_feature(folder):
    """Biases below 0 and an image that is 0 once normalised: no ReLU of the first image is open."""
    state = {k: -np.abs(v) if k.endswith("bias") else v for k, v in state_of("alex").items()}
    backbone = Backbone("alex", state)
    x, y = np.tile([0.485, 0.456, 0.406], (40, 40, 1)), drawn.images(40, 40)[0]
    lpips = Lpips("alex", backbone, folder / "alex.npz")
    stack = Stack(backbone, 40, 40)
    normal = ((x - [0.485, 0.456, 0.406]) / 0.229).astype(np.float32)
    assert not any(np.any(tap) for tap, _, _ in stack.taps(stack.forward(mi.Float(normal.ravel()))))
    assert lpips.distance(double(x), double(y))[0] > 0.1
    assert lpips.distance(double(x), double(x))[0] == 0


def test_features_whose_squares_are_zero(folder):
    state = state_of("alex") | {"features.0.bias": np.zeros(64, np.float32)}
    state["features.0.weight"] = state["features.0.weight"] * np.float32(1e-26)
    x, y, _ = drawn.images(40, 40)
    assert np.isfinite(Lpips("alex", Backbone("alex", state), folder / "alex.npz")(x, y))


@pytest.mark.slow
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_not_hidden(dists, lpips, bad):
    x, y, _ = drawn.images(33, 36)
    x[20, 7, 1] = bad
    for measure in lpips.values():
        assert np.isnan(measure.distance(single(x), single(y))[0])
        assert np.isnan(measure.distance(single(y), single(x))[0])
    value, slope = gradient(dists.against(single(y)), single(x))
    assert np.isnan(value) and np.isnan(slope).any()


def test_weights_of_another_network_are_refused(backbones, folder):
    with pytest.raises(InputError, match="'lin0.model.1.weight'|'lin1.model.1.weight'"):
        Lpips("alex", backbones["alex"], folder / "vgg.npz")
    np.savez(folder / "zero.npz", **{k: 0 * v for k, v in drawn.alpha_beta().items()})
    with pytest.raises(InputError, match="alpha and beta of DISTS have the sum 0.0"):
        Dists(backbones["vgg"], folder / "zero.npz")


def test_a_backbone_is_loaded_from_a_file(backbones, folder):
    state = state_of("alex") | {"classifier.1.weight": np.zeros((2, 2), np.float32)}
    np.savez(folder / "alexnet.npz", **state)
    x, y, _ = drawn.images(40, 40)
    expected = Lpips("alex", backbones["alex"], folder / "alex.npz")(x, y)
    assert Lpips("alex", Backbone.load("alex", folder / "alexnet.npz"), folder / "alex.npz")(x, y) == expected
    with pytest.raises(InputError, match=r"'features.0.weight' has the shape \(64, 3, 3, 3\), in AlexNet"):
        np.savez(folder / "mixed.npz", **(state_of("alex") | {"features.0.weight": np.zeros((64, 3, 3, 3))}))
        Backbone.load("alex", folder / "mixed.npz")
