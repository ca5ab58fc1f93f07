"""The paper's renderer: unbiased picture and gradient, fresh samples at every step."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import ConfigError
from envedit.scene import scene
from envedit.scene.path_tracer import PathTracer
from envedit.transport.light_transport import LightTransport
from tests.oracles.statistics import disagreement

HEIGHT, WIDTH, DEPTH, STEPS = 6, 12, 3, 8


@pytest.fixture(scope="module")
def matte():
    return scene.load("matte", 24, 24)


@pytest.fixture(scope="module")
def sky():
    return np.random.default_rng(0).random((HEIGHT, WIDTH, 3), dtype=np.float32) + 0.1


@pytest.fixture(scope="module")
def weights(matte):
    return np.random.default_rng(1).random((matte.height, matte.width, 3), dtype=np.float32)


@pytest.fixture(scope="module")
def gradients(matte, sky, weights):
    """Gradients of <I, weights> with respect to the map, one for every step."""
    tracer = PathTracer(matte, spp=64, max_depth=DEPTH, seed=5)
    result = []
    for step in range(STEPS):
        image = mi.TensorXf(sky)
        dr.enable_grad(image)
        dr.backward(dr.sum(tracer.render(image, step) * mi.TensorXf(weights), axis=None))
        result.append(dr.grad(image).numpy())
    return np.stack(result)


@pytest.fixture(scope="module")
def adjoints(matte, weights):
    y = mi.TensorXf(weights)
    options = {"spp": 64, "max_depth": DEPTH, "memory_gb": 0.5}
    transports = [LightTransport.build(matte, HEIGHT, WIDTH, seed=k, **options) for k in range(STEPS)]
    return np.stack([t.adjoint(y).numpy() for t in transports])


@pytest.mark.slow
def test_gradient_is_the_adjoint_of_light_transport(gradients, adjoints):
    # A texel's gradient sums over all pixels, so that its noise is normal.
    assert disagreement(gradients, adjoints, sizes=(1, 2, 0)) == ""
    assert disagreement(np.roll(gradients, 1, axis=2), adjoints, sizes=(1,)) != ""  # one column further
    assert disagreement(1.02 * gradients, adjoints, sizes=(1, 2, 0)) != ""


def test_picture_is_that_of_the_reference_renderer(matte, sky):
    tracer = PathTracer(matte, spp=64, max_depth=DEPTH, seed=1)
    ours = np.stack([tracer.render(mi.TensorXf(sky), step).numpy() for step in range(STEPS)])
    theirs = np.stack([matte.render(sky, spp=64, seed=k, max_depth=DEPTH) for k in range(STEPS)])
    assert ours.shape == (STEPS, 24, 24, 3)
    assert disagreement(ours, theirs) == ""


@pytest.mark.slow
def test_every_step_has_its_own_samples_and_the_same_ones_again(matte, sky):
    image = mi.TensorXf(sky)

    def render(seed, step):
        return PathTracer(matte, spp=4, max_depth=DEPTH, seed=seed).render(image, step).numpy()

    first = render(0, 0)
    np.testing.assert_array_equal(render(0, 0), first)
    others = [render(0, 1), render(0, 2), render(1, 0), render(0, 100_000)]
    for other in others:
        assert (other != first).any(axis=2).mean() > 0.9
    # Not the same samples in another order either: neighbouring steps of neighbouring seeds differ.
    assert (others[0] != others[2]).any(axis=2).mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("spp, taken", [(1, 1), (2, 2), (3, 3), (7, 8), (16, 16), (128, 132), (1000, 1023)])
def test_samples_fill_the_sampler_s_grid_and_are_told(spp, taken, matte, capfd):
    tracer = PathTracer(matte, spp=spp, max_depth=1)
    assert tracer.spp == taken and f"{taken} samples" in tracer.choices[0]
    if spp <= 128:
        dr.eval(tracer.render(mi.TensorXf(np.ones((HEIGHT, WIDTH, 3), np.float32)), 0))
        dr.sync_thread()
    assert capfd.readouterr() == ("", ""), "Mitsuba takes them as they are"


def test_more_samples_than_mitsuba_holds_are_refused(matte):
    most = (2**32 - 1) // (24 * 24)
    assert PathTracer(matte, spp=2**16).spp == 2**16
    with pytest.raises(ConfigError, match="more than one rendering can hold"):
        PathTracer(matte, spp=most + 1)
