"""Targets and scenes as odd as they can be: an edit follows them, and T renders them."""

import numpy as np
import pytest

from envedit import config, representations
from envedit.renderers import StoredRenderer
from envedit.scene import scene
from envedit.solve import adam_loop
from envedit.targets import painted_image
from envedit.transport.light_transport import LightTransport
from tests.oracles.extremes_stages import FILM, close, matte, single, sky, transport

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_cache", "own_core")]

SHAPE = (FILM[1], FILM[0])
STEPS = 10
"""After so many a transport looks for texels that have grown bright: until then T is the same."""


@pytest.fixture(scope="module")
def initial():
    return transport(16, 32).apply(single(sky())).numpy()


def follow(picture):
    """Edit the logarithms of the map towards a picture: the loss falls, and all stays finite."""
    made, before = representations.LogPixels(), sky()
    renderer = StoredRenderer(LightTransport.build(matte(), 16, 32, spp=16, max_depth=3))
    objective = adam_loop.Objective(
        config.Loss(image_l2=1.0), picture, np.ones_like(picture[..., :1]), before, STEPS
    )
    settings = config.Optimizer(iterations=STEPS, lr=0.02)
    start = made.encode(before)
    params, state = adam_loop.optimise(made, start, renderer, objective, before, 0, settings)
    found = made.decode(params).numpy()
    assert np.isfinite(found).all() and (found >= 0).all() and state.bad_steps == 0
    assert state.history[-1]["loss"] < state.history[0]["loss"]
    return found


@pytest.mark.parametrize("value", [0.0, 1.0, 65504.0, 3e38])
def test_one_value_in_every_pixel_is_followed(value, initial):
    """Display values go on as a logarithm above 1, so that the loss of 3e38 is 40 and not infinite."""
    picture = np.full((*SHAPE, 3), value, np.float32)
    found = painted_image.given(picture, SHAPE, initial)
    np.testing.assert_array_equal(found.picture, picture)
    assert (found.coverage == 1).all()
    light = follow(picture).sum(dtype=np.float64) - sky().sum(dtype=np.float64)
    assert light < 0 if value == 0 else light > 0


@pytest.mark.parametrize("value", [1e30, -5.0])
def test_one_pixel_is_followed_and_all_others_were_not_painted(value, initial):
    """Nothing is darker than black: -5 counts as 0."""
    picture = initial.copy()
    picture[2, 3] = value
    found = painted_image.given(picture, SHAPE, initial)
    assert found.coverage.sum() == 1 and found.coverage[2, 3] == 1
    assert (found.picture[2, 3] == np.float32(max(value, 0))).all()
    follow(found.picture)


@pytest.mark.parametrize("alpha", [0.0, 1e-4, 1.0])
def test_any_roughness_has_the_light_of_the_rendering(alpha):
    lit = scene.load("sphere", 12, 12, {"roughness": alpha})
    traced = LightTransport.build(lit, 16, 32, spp=64, max_depth=3)
    got = traced.apply(single(sky())).numpy()
    wanted = lit.render(sky(), spp=256, max_depth=3)
    assert np.isfinite(got).all() and (got >= 0).all() and traced.influence.min() >= 0
    # The sphere's own pixels, the middle of the film; both are means of 64 and more paths a pixel.
    for part in (np.s_[:], np.s_[4:9, 4:8]):
        np.testing.assert_allclose(got[part].mean(axis=(0, 1)), wanted[part].mean(axis=(0, 1)), rtol=0.02)
    pulled = traced.adjoint(single(got)).numpy().astype(np.float64)
    close((sky() * pulled).sum(), np.square(got.astype(np.float64)).sum(), 1e-5)
