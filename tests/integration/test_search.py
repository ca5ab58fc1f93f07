"""Which lights explain paint, or a rendered target: they move, are added, become larger, or stay."""

import mitsuba as mi
import numpy as np
import pytest

from envedit.core import latlong
from envedit.core.rotations import rotation_vector
from envedit.losses.naturalness import white
from envedit.representations.layers.layers import Layers
from envedit.representations.layers.lights import DARK
from envedit.scene import scene
from envedit.solve import gauss_newton, painted_places, search
from envedit.solve.gauss_newton import Run
from envedit.solve.likelihood import VISIBLE, Likelihood, on_average_one
from envedit.solve.map_problem import Problem
from envedit.solve.prior import of_paint
from envedit.solve.unknowns import with_light
from envedit.targets.pixel_weights import FOLLOWING, pixel_weight
from envedit.transport.light_transport import LightTransport
from tests.oracles.maps import angle

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]

HEIGHT, WIDTH, ROWS, PIXELS = 32, 64, 16, 48
SUN = (6, 20)
DIRECTIONS = latlong.directions(HEIGHT, WIDTH)
OMEGA = latlong.lookup_solid_angles(HEIGHT, WIDTH)
FREEDOM = 0.25


@pytest.fixture(scope="module")
def traced(tmp_path_factory):
    """Return a function that builds the transport of a sphere on a plane, always without exact columns."""
    lit, folder = scene.load("sphere", PIXELS, PIXELS), tmp_path_factory.mktemp("transport")
    return lambda: LightTransport.build(lit, HEIGHT, WIDTH, max_depth=4, few=True, folder=folder)


@pytest.fixture
def transport(traced):
    return traced()


def sky(*suns, flux=1.5):
    """Return a sky with a gradient over a dark ground, and suns of one texel."""
    image = (0.3 + 0.2 * np.maximum(DIRECTIONS[..., 1:2], 0) + 0.1 * DIRECTIONS[..., :1]) * [0.8, 1.0, 1.3]
    image[ROWS:] = 0.1
    for row, column in suns:
        image[row, column] += flux / OMEGA[row] * np.array([1.2, 1, 0.8])
    return image.astype(np.float32)


def rendered(transport, image):
    return transport.resolved(image).apply(mi.TensorXf(image)).numpy()


def problem_of(transport, image, picture, coverage, prior=None):
    """Return the problem of a picture painted over the rendering, and the state of the map as it is."""
    layers = Layers.of(image[:ROWS], (0, HEIGHT), cycles=6)
    weight = pixel_weight(coverage, np.zeros(coverage.shape[:2], bool), 1.0, FOLLOWING)
    likelihood = Likelihood.of_paint(weight, coverage, rendered(transport, image), picture)
    problem = Problem(layers, transport, image, picture, likelihood, prior or of_paint(FREEDOM))
    return problem, problem.state(layers.start())


def painted(transport, image, other, share=1.0):
    """Paint what differs by a third between two maps' renderings, at most a share; picture and coverage."""
    before, after = (rendered(transport, one) for one in (image, other))
    change = np.abs(np.log(after.mean(axis=2, keepdims=True) / before.mean(axis=2, keepdims=True)))
    least = max(np.log(1.3), np.quantile(change, 1 - share))
    coverage = (change > least).astype(np.float32)
    return np.where(coverage > 0, after, before), coverage


def found_for(problem, start):
    """Return the likeliest explanation, its lights, and the score of the lights left where they are."""
    as_it_is = Run(start, start)
    before = search.score(problem, as_it_is, problem.evaluate(start))
    calls = []
    found = search.search(problem, start, after_step=lambda: calls.append(1))
    state = found.run.state
    assert found.point.residual is not None and np.isfinite(found.score)
    names = [found.name, *(one.name for one in found.others)]
    scores = [one.score for one in found.others]
    assert len(set(names)) == len(names) <= 1 + search.MOST_OTHERS and scores == sorted(scores)
    assert found.others or not calls
    return found, {k: problem.direction(state, k) for k in problem.shining(state)}, before, len(calls)


# ---- the sun moves -----------------------------------------------------------------------------------------

ELSEWHERE = (6, 40)


def moved(transport, place):
    """Return the problem of the shadow of a sun that is painted as of another place, and its start."""
    image = sky(SUN)
    return problem_of(transport, image, *painted(transport, image, sky(place)))


def test_a_shadow_that_was_painted_elsewhere_moves_the_sun(transport):
    """To within 5 degrees, less than a texel; one sun, with the flux that it had."""
    problem, start = moved(transport, ELSEWHERE)
    found, lights, before, tried = found_for(problem, start)
    assert [*lights] == [0] and angle(lights[0], DIRECTIONS[ELSEWHERE]) < 5
    assert found.name == "light 1 moved" and tried >= 1
    assert found.score < before - search.POSITIVE_EVIDENCE
    assert np.exp(found.run.state["flux"][0]) == pytest.approx(np.ones(3), rel=0.35)
    # The prior is around where it was put.
    assert angle(problem.direction(found.run.start, 0), DIRECTIONS[ELSEWHERE]) < 8


def test_a_light_is_looked_for_again_once_another_has_changed(transport, monkeypatch):
    """Not the one that was just placed: all else is as it was when its place was found."""
    problem, start = moved(transport, ELSEWHERE)
    places, lights = painted_places.best, []

    def best(problem, state, transport, k, away=None):
        lights.append(k)
        return places(problem, state, transport, k, away)

    monkeypatch.setattr(painted_places, "best", best)
    assert search.search(problem, start).name == "light 1 moved"
    own, spare = 0, problem.layers.lights.own
    assert lights == [own, spare, spare]


def test_what_was_tried_before_changes_nothing(transport):
    """F and an explanation are of the problem alone: columns of T that others have traced do not count."""
    problem, start = moved(transport, ELSEWHERE)
    point = problem.evaluate(start)
    first = search.search(problem, start)
    for row in range(4, 12):
        image = sky((row, 50))
        transport.resolved(image).apply(image)
    np.testing.assert_array_equal(problem.evaluate(start).rendering, point.rendering)
    again = search.search(problem, start)
    assert (again.name, again.score) == (first.name, first.score)
    np.testing.assert_array_equal(again.point.edited, first.point.edited)


def test_the_new_shadow_alone_says_so_too(transport):
    """Of the old one nothing was painted: the rest may follow."""
    image, place = sky(SUN), ELSEWHERE
    before, after = (rendered(transport, one) for one in (image, sky(place)))
    darker = (after.mean(axis=2, keepdims=True) < 0.75 * before.mean(axis=2, keepdims=True)).astype("f4")
    picture = np.where(darker > 0, after, before)
    problem, start = problem_of(transport, image, picture, darker)
    _, lights, _, _ = found_for(problem, start)
    assert [*lights] == [0] and angle(lights[0], DIRECTIONS[place]) < 10


@pytest.mark.parametrize("own", [True, False])
def test_a_light_is_tried_with_its_glow(transport, own):
    """What is promised of a place is what the composed map has there; not so of the core alone."""
    image = sky()
    image[:ROWS] *= 1 + 6 * np.exp(-angle(DIRECTIONS[:ROWS], DIRECTIONS[SUN]) / 15)[..., None]
    image += sky(SUN, flux=0.5) - sky()
    picture, coverage = painted(transport, image, image + sky((8, 44), flux=0.7) - sky(), share=0.2)
    problem, state = problem_of(transport, image, picture, coverage)
    lights, likelihood = problem.layers.lights, problem.likelihood
    assert lights.own == 1 and lights.glows[0] is not None
    k = 0 if own else 1
    if own:
        state = with_light(state, k, flux=DARK)
    before = problem.evaluate(state)
    away = lights.centres[0] if own else None
    for there in painted_places.best(problem, state, problem.transport, k, away):
        turn, size = rotation_vector(lights.centres[k], there.direction), 0.0
        if not own:
            size = lights.log_size(there.degrees)
        placed = problem.evaluate(with_light(state, k, turn=turn, flux=there.log_flux, size=size))
        composed = likelihood.misfit(placed.residual, likelihood.largest_noise)
        assert -there.promise == pytest.approx(composed, rel=0.05)
        core = problem.layers.cores_of(k, [(turn, there.log_flux, size)])
        of_core = placed.transport.pictures(core, problem.rows).reshape(before.rendering.shape)
        alone = problem.residual(state, before.rendering + of_core)
        assert likelihood.misfit(alone, likelihood.largest_noise) != pytest.approx(composed, rel=0.1)


# ---- a light is added --------------------------------------------------------------------------------------


def test_a_disc_painted_on_a_mirror_adds_a_light_as_large_as_its_image(tmp_path):
    mirror = scene.load("mirror", PIXELS, PIXELS)
    transport = LightTransport.build(mirror, HEIGHT, WIDTH, max_depth=4, few=True, folder=tmp_path)
    image, place = sky(), (10, 40)
    disc = image.copy()
    disc[:ROWS][DIRECTIONS[:ROWS] @ DIRECTIONS[place] > np.cos(np.radians(15))] = 2.0
    picture, coverage = painted(transport, image, disc, share=0.05)
    problem, start = problem_of(transport, image, picture, coverage)
    found, lights, _, _ = found_for(problem, start)
    added = problem.layers.lights.own
    assert found.name == "light added" and angle(lights[added], DIRECTIONS[place]) < 10
    radius = 0.5 * np.exp(found.run.state["size"][added, 0])
    assert 4 < radius < 20, "a standard deviation"
    left, asked = (
        (coverage * np.abs(one - picture)).sum()
        for one in (found.point.rendering, rendered(transport, image))
    )
    assert left < 0.6 * asked


def test_light_painted_beside_light_that_holds_adds_a_light(transport):
    """A tenth of the picture, as a second sun would light it; the first sun's light is painted as it is.

    Without what holds, the sun elsewhere is the simpler explanation.
    """
    place = (8, 44)
    image = sky(SUN)
    picture, coverage = painted(transport, image, image + sky(place) - sky(), share=0.1)
    of_sun = (rendered(transport, image) - rendered(transport, sky())).mean(axis=2, keepdims=True)
    held = (of_sun > np.quantile(of_sun, 0.9)) & (coverage == 0)
    problem, start = problem_of(transport, image, picture, np.maximum(coverage, held.astype(np.float32)))
    found, lights, before, _ = found_for(problem, start)
    assert found.name == "light added" and [*lights] == [0, problem.layers.lights.own]
    assert found.score < before - search.POSITIVE_EVIDENCE
    found = search.completed(problem, found)
    added, own = (problem.direction(found.run.state, k) for k in (problem.layers.lights.own, 0))
    assert angle(added, DIRECTIONS[place]) < 8 and angle(own, DIRECTIONS[SUN]) < 8
    off = problem.likelihood.mean(found.point.residual) * VISIBLE
    assert np.abs(off).max() < 2 * VISIBLE


def test_a_sun_that_is_painted_under_a_sky_without_one_is_added_although_it_lights_the_rest(transport):
    place, image = (8, 44), sky()
    lit = painted(transport, image, sky(place, flux=1.0), share=0.05)
    problem, start = problem_of(transport, image, *lit)
    found, lights, _, _ = found_for(problem, start)
    assert found.name == "light added" and [*lights] == [0]
    assert angle(lights[0], DIRECTIONS[place]) < 5
    off = problem.likelihood.mean(found.point.residual) * VISIBLE
    assert off.max() > VISIBLE


@pytest.mark.parametrize("blue", [1, 0])
def test_a_shadow_painted_softer_makes_the_sun_larger(transport, blue):
    """Also where a channel is black, without a division by zero; there beside a light that is added."""
    image, softer = sky(SUN), sky()
    near = (DIRECTIONS @ DIRECTIONS[SUN] > np.cos(np.radians(25)))[..., None]
    sun = (image - softer)[SUN] * OMEGA[SUN[0]]
    softer += sun * near / (near[..., 0] * OMEGA[:, None]).sum()
    image, softer = (one * np.float32([1, 1, blue]) for one in (image, softer))
    problem, start = problem_of(transport, image, *painted(transport, image, softer))
    found, *_ = found_for(problem, start)
    softened = [one.name for one in (found, *found.others) if search.SOFTENED in one.name]
    assert softened == ["light 1 softened" if blue else "light 1 softened, light added"]


# ---- lights stay -------------------------------------------------------------------------------------------


def test_of_paint_that_no_light_makes_other_answers_are_shown(transport, rng):
    """Stripes as bright as noon, and as dark as night: no move promises anything."""
    image = sky(SUN)
    before = rendered(transport, image)
    coverage = np.ones((PIXELS, PIXELS, 1), np.float32)
    stripes = np.where(np.arange(PIXELS) % 2, 4.0, 0.02).astype(np.float32)
    problem, start = problem_of(transport, image, before * stripes[:, None, None], coverage)
    found, _, _, tried = found_for(problem, start)
    assert found.others and tried >= len(found.others)
    # What could not become likelier was given up; its steps can go on.
    given_up = [one for one in found.others if not one.run.history]
    assert len(given_up) >= 2
    # "light 1 moved" is, but hardly likelier
    assert found.name == "lights left where they are"
    assert min(one.score for one in found.others) < found.score
    for one in given_up:
        further = search.completed(problem, one)
        assert further.score < one.score and len(further.run.history) > len(one.run.history)


def test_paint_that_is_there_already_leaves_lights(transport):
    """No move is promising: nothing else is descended to."""
    image = sky(SUN)
    before = rendered(transport, image)
    coverage = np.zeros((PIXELS, PIXELS, 1), np.float32)
    coverage[20:40, 20:40] = 1
    problem, start = problem_of(transport, image, before, coverage)
    found, lights, _, tried = found_for(problem, start)
    assert found.name == "lights left where they are" and tried == 0
    assert [*lights] == [0] and angle(lights[0], DIRECTIONS[SUN]) < 0.5
    assert np.abs(found.run.state["gain"]).max() < 0.02


def test_paint_that_one_factor_makes_leaves_lights(transport):
    factor = 0.6
    image = sky(SUN)
    before = rendered(transport, image)
    coverage = np.ones((PIXELS, PIXELS, 1), np.float32)
    problem, start = problem_of(transport, image, np.float32(factor * before), coverage)
    found, lights, _, _ = found_for(problem, start)
    assert [*lights] == [0] and angle(lights[0], DIRECTIONS[SUN]) < 3
    shown = found.point.rendering.mean() / before.mean()
    assert shown == pytest.approx(factor, rel=0.1)


def test_paint_that_grades_all_of_the_picture_leaves_lights_and_changes_their_colour(transport):
    """Bluer and darker: nothing says that the sun is elsewhere, and it is part of the map."""
    image = sky(SUN)
    before = rendered(transport, image)
    grade = np.float32([0.3, 0.55, 1.0])
    coverage = np.ones((PIXELS, PIXELS, 1), np.float32)
    problem, start = problem_of(transport, image, grade * before, coverage, of_paint(FREEDOM, coverage))
    found, lights, _, _ = found_for(problem, start)
    assert found.name == "lights left where they are" and angle(lights[0], DIRECTIONS[SUN]) < 3
    log_flux = found.run.state["flux"][0]
    assert log_flux[2] - log_flux[0] == pytest.approx(np.log(grade[2] / grade[0]), rel=0.3)


@pytest.mark.parametrize(("painted", "brightness"), [("part", 1.6), ("part", 2.3), ("all", 1.6)])
def test_a_sky_does_not_turn_white_for_paint_on_a_part_of_the_picture(transport, painted, brightness):
    """Brighter where the picture is in the shade, also under a sky that is nearly white.

    A brighter picture as a whole has a brighter sky.
    """
    image = sky(flux=0) * np.float32(brightness)
    before = rendered(transport, image)
    coverage = np.ones((PIXELS, PIXELS, 1), np.float32)
    if painted == "part":
        coverage[:24], coverage[:, :12], coverage[:, 36:] = 0, 0, 0
    problem, start = problem_of(transport, image, before * (1 + 0.7 * coverage), coverage, of_paint(1.0))

    def whiter():
        run = Run(start, start)
        point = gauss_newton.descended(problem, run, problem.evaluate(start), 8)
        assert len(run.history) > 3, "no step is made"
        return white(point.edited) - white(image)

    held = whiter()
    problem.white_sky = None
    free = whiter()
    assert free > 0.2
    assert held < 0.02 if painted == "part" else held == free


def test_a_map_that_is_not_finite_has_no_explanation(transport):
    """The search returns it as it is; the steps refuse it."""
    problem, start = moved(transport, ELSEWHERE)
    start["flux"][0] = np.nan
    found = search.search(problem, start)
    assert found.point.residual is None and found.score == np.inf


# ---- a rendered target -------------------------------------------------------------------------------------

FAR = (6, 52)
TEXEL = 360 / WIDTH
NEAR = 2 * TEXEL


class Found:
    """What a search, and the steps from what it found, make of a map and a picture."""

    def __init__(self, transport, image, wanted, weight=None):
        layers = Layers.of(image[:ROWS], (0, HEIGHT), cycles=6)
        encoded = layers.start()
        likelihood = None if weight is None else Likelihood(on_average_one(weight))
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
def followed(traced):
    wanted = rendered(traced(), sky(FAR))
    return wanted, Found(traced(), sky(SUN), wanted)


PLACES = {
    "the other side of the sphere": FAR,
    "across the seam": (5, 62),
    "the horizon": (15, 33),
}


@pytest.mark.parametrize("where", PLACES)
def test_a_sun_is_found_wherever_it_went(where, transport, followed):
    """To a fraction of a texel; it keeps its flux, and there is one."""
    place = PLACES[where]
    assert angle(DIRECTIONS[place], DIRECTIONS[SUN]) > NEAR  # staying would not do
    found = followed[1] if place == FAR else Found(transport, sky(SUN), rendered(transport, sky(place)))
    assert found.own == 1 and [*found.lit] == [0]
    assert angle(found.lit[0], DIRECTIONS[place]) < 0.5 * TEXEL
    if where != "the horizon":  # of what is there half lies below the rows that may change
        np.testing.assert_allclose(found.flux[0], 1, rtol=0.15)


def test_the_map_that_is_found_gives_the_picture(transport, followed):
    """Most of the way: a tenth of the error that there was."""
    wanted, found = followed
    composed = sky(SUN)
    composed[:ROWS] = found.decoded
    before, after = (rendered(transport, image) for image in (sky(SUN), composed))
    assert np.square(after - wanted).mean() < 0.1**2 * np.square(before - wanted).mean()


def test_a_mask_that_excludes_everything_leaves_the_sky(transport, followed):
    found = Found(transport, sky(SUN), followed[0], np.zeros((PIXELS, PIXELS, 1), np.float32))
    np.testing.assert_array_equal(found.state["gain"], 0)


def test_a_mask_tells_which_pixels_count(transport, followed):
    """What is left out may be anything: it has no say."""
    wanted = followed[0]
    mask = np.ones((PIXELS, PIXELS, 1), np.float32)
    mask[: PIXELS // 4] = 0
    spoilt = np.where(mask > 0, wanted, 0).astype(np.float32)
    found, unmasked = (Found(transport, sky(SUN), spoilt, weight) for weight in (mask, None))
    assert angle(found.lit[0], DIRECTIONS[FAR]) < NEAR
    assert unmasked.decoded.mean() < 0.95 * found.decoded.mean()  # without the mask the black pixels count


def test_a_black_picture_makes_a_dark_sky(transport):
    found = Found(transport, sky(SUN), np.zeros((PIXELS, PIXELS, 3), np.float32))
    assert found.decoded.mean() < 0.2 * sky()[:ROWS].mean()


def test_a_sun_below_the_rows_that_may_change_is_no_light_to_move(transport):
    assert Found(transport, sky((20, 7)), rendered(transport, sky())).own == 0
