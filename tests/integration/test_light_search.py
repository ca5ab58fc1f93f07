"""Where the edit of layers starts: lights found by their picture alone, and left alone where they are."""

import itertools
import re

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.representations.layers.layers import Layers
from envedit.scene import scene
from envedit.solve import light_search, matching_pursuit
from envedit.transport import texel_sampling
from envedit.transport.block_transport import Overview
from envedit.transport.light_transport import LightTransport

HEIGHT, WIDTH, ROWS = 32, 64, 16
PIXELS = 96  # at half of it the recording is too coarse to tell where a sun near the zenith is
SUN = (6, 20)
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


def blob(place, flux, degrees):
    """Return the sky with a round light."""
    angle = np.degrees(np.arccos(np.clip(DIRECTIONS @ DIRECTIONS[place], -1, 1)))
    lobe = np.exp(-0.5 * (angle / degrees) ** 2)
    lobe *= flux / (lobe * OMEGA[:, None]).sum()
    return (sky() + lobe[..., None]).astype(np.float32)


def picture(transport, image):
    transport.resolve(image)
    return transport.apply(mi.TensorXf(image)).numpy()


class Start:
    """What a search finds for a map and a picture."""

    def __init__(self, transport, image, wanted, weight=None):
        layers = Layers((0, HEIGHT))
        encoded = layers.encode(image[:ROWS])
        asked = light_search.SearchProblem(layers, transport, wanted, weight, image)
        params, self.notes = light_search.start(asked, encoded)
        assert params.keys() == encoded.keys()
        assert all(params[name].shape == encoded[name].shape for name in params)
        self.count = len(layers.separation.lights)
        self.real = {name: np.float64(p.numpy()) * layers.scales[name] for name, p in params.items()}
        self.decoded = layers.decode(params).numpy()
        self.flux = np.exp(self.real["flux"])
        self.direction = [turned(v, d) for v, d in zip(self.real["turn"], layers.lights.centres, strict=True)]
        assert all(np.isfinite(value).all() for value in self.real.values())
        assert np.isfinite(self.decoded).all() and (self.decoded >= 0).all()


def turned(v, d):
    """Rotate a direction by axis times angle."""
    angle = np.linalg.norm(v)
    axis = v / max(angle, 1e-30)
    return d * np.cos(angle) + np.cross(axis, d) * np.sin(angle) + axis * (axis @ d) * (1 - np.cos(angle))


def degrees_apart(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


# ---- a light that moves ----------------------------------------------------------------------------------

PLACES = {
    "the other side of the sphere": (6, 52),
    "across the seam": (5, 62),
    "right at the seam": (9, 0),
    "high": (2, 10),
    "the zenith": (0, 3),
    "low": (13, 40),
    "the horizon": (15, 33),
    "four texels away": (6, 24),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", PLACES)
def test_a_sun_is_found_wherever_it_went(where, transport):
    place = PLACES[where]
    moved = degrees_apart(DIRECTIONS[place], DIRECTIONS[SUN])
    assert moved > NEAR  # staying would not do
    found = Start(transport(), sky(SUN), picture(transport(), sky(place)))
    assert found.count == 1 and len(found.notes) == 1
    assert degrees_apart(found.direction[0], DIRECTIONS[place]) < NEAR
    np.testing.assert_allclose(found.flux[0], 1, rtol=0.15)
    assert (found.flux[1:] < 1e-9).all()  # the spare lights stay dark
    told = [float(number) for number in re.findall(r"[\d.]+(?= degrees)", found.notes[0])]
    assert told[0] == pytest.approx(degrees_apart(found.direction[0], DIRECTIONS[SUN]), abs=0.2)


@pytest.mark.slow
def test_a_sun_is_found_to_a_fraction_of_a_texel(transport):
    """The columns around its cell are exact: better than the cells that the overview knows."""
    found = Start(transport(), sky(SUN), picture(transport(), sky((6, 52))))
    assert degrees_apart(found.direction[0], DIRECTIONS[6, 52]) < 0.25 * TEXEL


@pytest.mark.slow
def test_the_map_that_is_found_gives_the_picture(transport):
    """Most of the way: a tenth of the error that there was."""
    wanted = picture(transport(), sky((6, 52)))
    found = Start(transport(), sky(SUN), wanted)
    composed = sky(SUN)
    composed[:ROWS] = found.decoded
    before, after = (picture(transport(), image) for image in (sky(SUN), composed))
    assert np.square(after - wanted).mean() < 0.1**2 * np.square(before - wanted).mean()


# ---- lights that stay, go and come -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_picture_that_is_there_already_changes_nothing(transport):
    image = sky(SUN)
    found = Start(transport(), image, picture(transport(), image))
    assert (found.real["turn"] == 0).all()
    np.testing.assert_allclose(found.flux[0], 1, rtol=0.02)
    np.testing.assert_allclose(found.decoded, image[:ROWS], rtol=0.1)
    assert (found.flux[1:] < 1e-9).all() and len(found.notes) == 1


@pytest.mark.slow
def test_a_sun_that_the_picture_does_not_show_disappears(transport):
    found = Start(transport(), sky(SUN), picture(transport(), sky()))
    assert len(found.notes) == 1 and (found.flux < 1e-3).all()
    # At most the sky is left, not the sun of 100 times its radiance.
    assert found.decoded.max() < 3 * sky()[:ROWS].max() < 0.1 * sky(SUN).max()


@pytest.mark.slow
def test_a_light_that_the_map_does_not_have_is_added(transport):
    """A mirror sees where a light is; a matte ground leaves too much to the sky."""
    place, mirror = (8, 50), transport("mirror")
    image = blob(place, 10, degrees=3)
    found = Start(mirror, sky(), picture(transport("mirror"), image))
    assert found.count == 0 and any("added a light" in note for note in found.notes)
    lit = found.flux.max(axis=1) > 1e-3
    assert lit.any()
    for direction in np.array(found.direction)[lit]:
        assert degrees_apart(direction, DIRECTIONS[place]) < NEAR
    # What was added has the light that was wanted.
    extra = ((found.decoded - sky()[:ROWS]) * OMEGA[:ROWS, None, None]).sum(axis=(0, 1))
    np.testing.assert_allclose(extra, 10, rtol=0.3)


@pytest.mark.slow
def test_nothing_is_added_to_a_sky_that_is_right(transport):
    found = Start(transport("mirror"), sky(), picture(transport("mirror"), sky()))
    assert found.notes == [] and (found.flux < 1e-9).all()
    np.testing.assert_allclose(found.decoded, sky()[:ROWS], rtol=0.1)


# ---- pictures that say little ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_mask_that_excludes_everything_leaves_the_sky(transport):
    wanted = picture(transport(), sky((6, 52)))
    found = Start(transport(), sky(SUN), wanted, np.zeros((PIXELS, PIXELS, 1), np.float32))
    for level in range(3):
        np.testing.assert_array_equal(found.real[f"gain.{level}"], 0)


@pytest.mark.slow
def test_a_mask_tells_which_pixels_count(transport):
    """What is left out may be anything: it has no say."""
    wanted, mask = picture(transport(), sky((6, 52))), np.ones((PIXELS, PIXELS, 1), np.float32)
    mask[: PIXELS // 4] = 0
    spoilt = np.where(mask > 0, wanted, 0).astype(np.float32)
    found = Start(transport(), sky(SUN), spoilt, mask)
    assert degrees_apart(found.direction[0], DIRECTIONS[6, 52]) < NEAR
    unmasked = Start(transport(), sky(SUN), spoilt)
    gains = [abs(s.real["gain.0"]).max() for s in (found, unmasked)]
    assert gains[1] > 1.5 * gains[0]  # without the mask the black pixels count


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 1e-30, 1e6])
def test_a_picture_of_one_value_is_answered_with_finite_numbers(value, transport):
    found = Start(transport(), sky(SUN), np.full((PIXELS, PIXELS, 3), value, np.float32))
    if value < 1:
        assert found.decoded.mean() < 0.2 * sky()[:ROWS].mean()
    else:
        assert found.decoded.mean() > 5 * sky()[:ROWS].mean()


@pytest.mark.slow
@pytest.mark.parametrize("image", [np.zeros((HEIGHT, WIDTH, 3), np.float32), sky((20, 7))])
def test_maps_without_a_light_to_move_are_answered(image, transport):
    """A black one, and one whose sun lies below the rows that may change."""
    found = Start(transport(), image, picture(transport(), sky()))
    assert found.count == 0


@pytest.mark.slow
def test_the_same_question_has_the_same_answer_to_the_bit(transport):
    wanted = picture(transport(), sky((6, 52)))
    first, again = (Start(transport(), sky(SUN), wanted) for _ in range(2))
    assert first.notes == again.notes and first.decoded.tobytes() == again.decoded.tobytes()
    for name in first.real:
        assert first.real[name].tobytes() == again.real[name].tobytes(), name


# ---- its parts -------------------------------------------------------------------------------------------


def brute_force(a, b):
    """Return the least |a x - b| with x >= 0 over every choice of what is not 0."""
    best = np.linalg.norm(b)
    for size in range(1, a.shape[1] + 1):
        for chosen in itertools.combinations(range(a.shape[1]), size):
            x = np.linalg.lstsq(a[:, chosen], b, rcond=None)[0]
            if (x >= 0).all():
                best = min(best, np.linalg.norm(a[:, chosen] @ x - b))
    return best


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("columns", [1, 2, 3, 5, 7])
def test_least_squares_without_negative_numbers(columns, signed, rng):
    """Of positive columns, as pictures of lights are, and of any; many answers have zeros."""
    zeros = 0
    for _ in range(60):
        a, noise = rng.random((30, columns)) ** 3, rng.standard_normal(30)
        if signed:  # columns that go together: what was left out may have to come in again
            a = rng.standard_normal((30, 3)) @ rng.standard_normal((3, columns)) + 0.1 * a
        b = a @ np.maximum(rng.standard_normal(columns), 0) + 0.05 * noise
        x = matching_pursuit.not_negative(a, b)
        assert (x >= 0).all()
        zeros += (x == 0).any()
        assert np.linalg.norm(a @ x - b) <= brute_force(a, b) * (1 + 1e-9)
    assert zeros > 10


def test_least_squares_of_nothing():
    assert (matching_pursuit.not_negative(np.ones((4, 2)), -np.ones(4)) == 0).all()
    assert (matching_pursuit.not_negative(np.zeros((4, 2)), np.ones(4)) == 0).all()


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e6])
def test_least_squares_of_opposite_and_equal_columns(size):
    """A background that may become brighter or darker is given with both signs."""
    a = size * np.array([[1.0, -1, 1, 0], [1, -1, 1, 1], [1, -1, 1, 0]])
    for b in (np.array([1.0, 1, 1]), np.array([-1.0, 1, -1]), np.array([2.0, 1, 2])):
        x = matching_pursuit.not_negative(a, b)
        assert (x >= 0).all()
        assert np.linalg.norm(a @ x - b) <= brute_force(a, b) + 1e-9


def small_overview(rng, blocks=(6, 8), cells=20):
    """Return an overview of one pixel a block that mixes cells a little."""
    count = blocks[0] * blocks[1]
    matrix = rng.random((3, count, cells)) ** 4
    return Overview(
        matrix.astype(np.float32), np.arange(count), np.arange(cells), np.zeros((cells, 3)), np.ones(cells)
    )


def test_strengths_that_made_a_picture_are_found(rng):
    overview = small_overview(rng)
    hats = np.zeros((3, 20, 4))
    hats[:, np.arange(20), np.arange(20) // 5] = rng.random((3, 20)) + 0.5  # four parts of the sky
    lights = np.zeros((3, 48, 2))
    lights[:, 3:9, 0], lights[:, 30:34, 1] = 5, 8
    gain, strength = rng.uniform(0.5, 2, (4, 3)), rng.uniform(0.5, 2, (2, 3))
    wanted = np.stack(
        [overview.matrix[c] @ hats[c] @ gain[:, c] + lights[c] @ strength[:, c] for c in range(3)], axis=-1
    ).reshape(6, 8, 3)
    found = light_search.spread(overview, wanted, None, wanted, hats, lights)
    np.testing.assert_allclose(found[0], gain, rtol=0.1)
    np.testing.assert_allclose(found[1], strength, rtol=0.05)
    # From a start that is off by far more.
    assert abs(gain - 1).max() > 0.4

    # What is 1 already stays exactly, but for rounding.
    ones = np.stack([overview.matrix[c] @ hats[c].sum(1) + lights[c].sum(1) for c in range(3)], -1)
    for values in light_search.spread(
        overview, ones.reshape(6, 8, 3), None, ones.reshape(6, 8, 3), hats, lights
    ):
        np.testing.assert_allclose(values, 1, rtol=1e-6)


def test_strengths_that_no_counted_pixel_tells_stay_one(rng):
    overview = small_overview(rng)
    lights = np.zeros((3, 48, 2))
    lights[:, :5, 0], lights[:, 40:, 1] = 1, 1
    hats, weight = np.zeros((3, 20, 1)), np.ones((6, 8, 1))
    weight.reshape(-1)[40:] = 0
    wanted = np.full((6, 8, 3), 2.0)
    gain, strength = light_search.spread(overview, wanted, weight, wanted, hats, lights)
    assert (gain == 1).all() and (strength[1] == 1).all()
    np.testing.assert_allclose(strength[0], 2, rtol=1e-6)


@pytest.mark.parametrize(
    "values, place", [((0, 3, 0), 0), ((1, 2, 2), 0.5), ((2, 2, 1), -0.5), ((1, 4, 3), 0.25)]
)
def test_vertex_of_three_neighbours(values, place):
    assert light_search._vertex(np.array(values, float), 1) == pytest.approx(place)


def test_vertex_at_a_border_or_in_a_valley_is_the_point_itself():
    values = np.array([3.0, 1.0, 2.0])
    assert [light_search._vertex(values, i) for i in range(3)] == [0, 0, 0]


@pytest.mark.slow
def test_refinement_finds_a_light_from_three_texels_off(transport):
    """Without any background; the flux is told as a factor."""
    t = transport()
    light = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    light[7, 33] = 1 / OMEGA[7]
    t.resolve(light)
    wanted = 2.5 * t.linear(mi.TensorXf(light)).numpy().reshape(-1, 3)
    none = np.full((1, PIXELS**2, 3), 1e-12) * np.random.default_rng(0).random((1, PIXELS**2, 3))
    direction, factor = light_search.refine(
        t, wanted, wanted, None, none, DIRECTIONS[5, 36], np.ones(3), 0, ROWS - 1
    )
    assert degrees_apart(direction, DIRECTIONS[7, 33]) < 0.3 * TEXEL
    np.testing.assert_allclose(factor, 2.5, rtol=0.05)


@pytest.mark.parametrize("width", [2, 4, 8, 16])
def test_a_light_is_refined_on_a_map_of_few_texels(width, rng):
    """The exact columns of a map 8 wide are asked for once each: T would count one of two for ever."""
    height = max(width // 2, 2)

    class Few:
        grid = texel_sampling.Grid(height, width, np.eye(3), np.ones(height))

        def probe(self, texels):
            assert len(np.unique(texels)) == len(texels)
            return rng.random((len(texels), 30, 3))

    wanted, known, gains = (rng.random(shape) for shape in ((30, 3), (30, 3), (4, 30, 3)))
    asked = wanted, known, None, gains, np.array([0.6, 0.5, 0.6]), np.ones(3), 0, height - 1
    direction, factor = light_search.refine(Few(), *asked)
    assert abs(np.linalg.norm(direction) - 1) < 1e-6 and np.isfinite(factor).all() and factor.min() >= 0


@pytest.mark.parametrize("size", [1e-37, 1e-30, 1.0, 1e30])
def test_pixels_count_by_their_brightness_and_a_floor_at_every_scale(size):
    known = np.array([[1.0, 2, 3], [0, 0, 0], [2, 2, 2], [0, 0, 0]], np.float32) * np.float32(size)
    weight = np.array([[1.0], [1], [0.5], [0]], np.float32)
    mean = known[0, 1].astype(float) / 2
    found = matching_pursuit.relative(known, known, weight)
    floor = 0.2 * mean
    assert found == pytest.approx([1 / (2 * mean + floor), 1 / floor, 0.5 / (2 * mean + floor), 0], rel=1e-5)


def test_paint_on_black_counts_by_its_own_light_and_nothing_by_nothing():
    black, paint = np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32)
    paint[2] = -6
    assert matching_pursuit.relative(black, paint) == pytest.approx(1 / (0.2 * 1.5))
    assert (matching_pursuit.relative(black, black) == 1).all()
