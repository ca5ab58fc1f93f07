"""A rendered target's lights, found by their picture alone, and left alone where they are."""

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.representations.layers.layers import Layers
from envedit.scene import scene
from envedit.solve import gauss_newton, search
from envedit.solve.likelihood import Likelihood, on_average_one
from envedit.solve.map_problem import Problem
from envedit.transport.light_transport import LightTransport
from tests.oracles.maps import angle

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]

HEIGHT, WIDTH, ROWS = 32, 64, 16
PIXELS = 40
SUN, ELSEWHERE = (6, 20), (6, 52)
TEXEL = 360 / WIDTH
NEAR = 2 * TEXEL
DIRECTIONS = latlong.directions(HEIGHT, WIDTH)
OMEGA = latlong.lookup_solid_angles(HEIGHT, WIDTH)


@pytest.fixture(scope="module")
def transport(tmp_path_factory):
    """Return a function that builds the transport of a shipped scene, always without exact columns."""
    folder, scenes = tmp_path_factory.mktemp("transport"), {}

    def build(name="sphere"):
        if name not in scenes:
            scenes[name] = scene.load(name, PIXELS, PIXELS)
        return LightTransport.build(scenes[name], HEIGHT, WIDTH, max_depth=4, few=True, folder=folder)

    return build


def sky(*suns, flux=3.0):
    """Return a sky with a gradient over a dark ground, and suns of one texel."""
    image = (0.5 + 0.5 * np.maximum(DIRECTIONS[..., 1:2], 0) + 0.2 * DIRECTIONS[..., :1]) * [0.8, 1.0, 1.3]
    image[ROWS:] = 0.2
    for row, column in suns:
        image[row, column] += flux / OMEGA[row] * np.array([1.2, 1, 0.8])
    return image.astype(np.float32)


def picture(transport, image):
    return transport.resolved(image).apply(mi.TensorXf(image)).numpy()


class Found:
    """What a search, and the steps from what it found, make of a map and a picture."""

    def __init__(self, transport, image, wanted, weight=None):
        layers = Layers.of(image[:ROWS], (0, HEIGHT), cycles=6)
        encoded = layers.start()
        likelihood = Likelihood(on_average_one(weight, wanted.shape[:2]))
        problem = Problem(layers, transport, image, wanted, likelihood, saturates=True)
        likeliest = search.search(problem, problem.state(encoded))
        solution = gauss_newton.solve(problem, encoded, run=likeliest.run)
        while (likelier := search.further(problem, solution.run)) is not None:
            solution = gauss_newton.solve(problem, encoded, run=likelier.run)
        self.state = state = problem.state(solution.params)
        self.name, self.own = likeliest.name, layers.lights.own
        self.lit = {k: problem.direction(state, k) for k in problem.shining(state)}
        self.flux = np.exp(state["flux"])
        self.decoded = layers.decode(solution.params).numpy()
        assert all(np.isfinite(value).all() for value in state.values())
        assert np.isfinite(self.decoded).all() and (self.decoded >= 0).all()


@pytest.fixture(scope="module")
def moved(transport):
    wanted = picture(transport(), sky(ELSEWHERE))
    return wanted, Found(transport(), sky(SUN), wanted)


# ---- a light that moves ----------------------------------------------------------------------------------

PLACES = {
    "the other side of the sphere": ELSEWHERE,
    "across the seam": (5, 62),
    "the horizon": (15, 33),
}


@pytest.mark.parametrize("where", PLACES)
def test_a_sun_is_found_wherever_it_went(where, transport, moved):
    """To a fraction of a texel; it keeps its flux, and there is one."""
    place = PLACES[where]
    assert angle(DIRECTIONS[place], DIRECTIONS[SUN]) > NEAR  # staying would not do
    found = moved[1] if place == ELSEWHERE else Found(transport(), sky(SUN), picture(transport(), sky(place)))
    assert found.own == 1 and [*found.lit] == [0]
    assert angle(found.lit[0], DIRECTIONS[place]) < 0.5 * TEXEL
    if where != "the horizon":  # of what is there half lies below the rows that may change
        np.testing.assert_allclose(found.flux[0], 1, rtol=0.15)


def test_the_map_that_is_found_gives_the_picture(transport, moved):
    """Most of the way: a tenth of the error that there was."""
    wanted, found = moved
    composed = sky(SUN)
    composed[:ROWS] = found.decoded
    before, after = (picture(transport(), image) for image in (sky(SUN), composed))
    assert np.square(after - wanted).mean() < 0.1**2 * np.square(before - wanted).mean()


# ---- pictures that say little ----------------------------------------------------------------------------


def test_a_mask_that_excludes_everything_leaves_the_sky(transport, moved):
    found = Found(transport(), sky(SUN), moved[0], np.zeros((PIXELS, PIXELS, 1), np.float32))
    np.testing.assert_array_equal(found.state["gain"], 0)


def test_a_mask_tells_which_pixels_count(transport, moved):
    """What is left out may be anything: it has no say."""
    wanted = moved[0]
    mask = np.ones((PIXELS, PIXELS, 1), np.float32)
    mask[: PIXELS // 4] = 0
    spoilt = np.where(mask > 0, wanted, 0).astype(np.float32)
    found, unmasked = (Found(transport(), sky(SUN), spoilt, weight) for weight in (mask, None))
    assert angle(found.lit[0], DIRECTIONS[ELSEWHERE]) < NEAR
    assert unmasked.decoded.mean() < 0.95 * found.decoded.mean()  # without the mask the black pixels count


def test_a_black_picture_makes_a_dark_sky(transport):
    found = Found(transport(), sky(SUN), np.zeros((PIXELS, PIXELS, 3), np.float32))
    assert found.decoded.mean() < 0.2 * sky()[:ROWS].mean()


def test_a_sun_below_the_rows_that_may_change_is_no_light_to_move(transport):
    assert Found(transport(), sky((20, 7)), picture(transport(), sky())).own == 0
