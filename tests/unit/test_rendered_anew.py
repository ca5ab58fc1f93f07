"""Whether a picture was painted or rendered anew, by its noise; and how large that is."""

import numpy as np
import pytest

from envedit.core.color import inverse_tonemap
from envedit.scene import scene
from envedit.targets import rendered_anew
from tests.oracles.builders import sky

FILM = (64, 64)
SPP = 16


@pytest.fixture(scope="module")
def sphere():
    """The scene, a map, and two renderings of it: A and B."""
    lit = scene.load("sphere", *FILM)
    envmap = sky(np.random.default_rng(3)) + 0.05
    return lit, envmap, lit.render(envmap, spp=SPP, seed=1), lit.render(envmap, spp=SPP, seed=2)


def tell(sphere, picture):
    """Return whether a picture is rendered anew, and how often another rendering was asked for."""
    _, _, on, other = sphere
    coverage = (np.abs(picture - on) > 1e-6).any(axis=2, keepdims=True)
    asked = []

    def another():
        asked.append(1)
        return other

    return rendered_anew.is_rendered_anew(picture, on, coverage, another), len(asked)


def eight_bit(picture):
    shown = np.round(np.clip(picture, 0, 1) ** (1 / 2.2) * 255) / 255
    return inverse_tonemap(shown, "gamma").astype(np.float32)


PAINTED = {
    "darker": lambda a: 0.6 * a,
    "warmer": lambda a: a * np.array([1.3, 1.0, 0.7], np.float32),
    "lifted": lambda a: 0.05 + 0.9 * a,
    "a gradient": lambda a: a * np.linspace(0.5, 2, FILM[1], dtype=np.float32)[:, None],
    "more contrast": lambda a: a**1.3,
}


@pytest.mark.slow
@pytest.mark.parametrize("how", PAINTED)
def test_what_keeps_the_noise_of_the_rendering_is_painted(how, sphere):
    """All over it: there is no part that equals the rendering."""
    assert tell(sphere, PAINTED[how](sphere[2]).astype(np.float32)) == (False, 1)
    assert tell(sphere, eight_bit(PAINTED[how](sphere[2]))) == (False, 1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5])
def test_what_was_rendered_under_other_light_is_not(seed, sphere):
    """With another seed, and with the same, whose paths go elsewhere."""
    lit, envmap, _, _ = sphere
    turned = np.roll(envmap, 5, axis=1) * np.array([1.2, 1, 0.8], np.float32)
    picture = lit.render(turned, spp=SPP, seed=seed)
    assert tell(sphere, picture)[0]
    assert tell(sphere, eight_bit(picture))[0]


@pytest.mark.slow
def test_without_noise_it_was_not_painted_on_the_rendering(sphere):
    """A denoised picture of another light, or one of many samples."""
    lit, envmap, _, _ = sphere
    assert tell(sphere, lit.render(np.roll(envmap, 5, axis=1), spp=529, seed=7))[0]


def test_what_is_the_rendering_in_part_or_black_was_painted(sphere):
    """No other rendering is asked for."""
    picture = np.roll(sphere[3], 3, axis=0)
    picture[:16] = sphere[2][:16]
    assert tell(sphere, picture) == (False, 0)
    assert tell(sphere, sphere[2]) == (False, 0)
    black = np.zeros((*FILM, 3), np.float32)
    assert not rendered_anew.is_rendered_anew(black + 1, black, np.ones((*FILM, 1)), lambda: black)


def noisy(rng, sigma, shape=(64, 96), views=1):
    """Return linear radiance whose display values are a gradient with white noise."""
    high, wide = shape
    shown = np.add.outer(np.linspace(0.2, 0.4, high), np.linspace(0, 0.2, wide))[..., None]
    shown = np.concatenate([shown + 0.1 * k for k in range(views)])
    shown = shown + rng.normal(0, sigma, (*shown.shape[:2], 3))
    return inverse_tonemap(shown, "gamma").astype(np.float32)


@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.03])
def test_noise_over_a_gradient_is_found(sigma, rng):
    found = rendered_anew.noise(noisy(rng, sigma))
    assert found.shape == (64, 96) and np.ptp(found) == 0 and found[0, 0] == pytest.approx(sigma, rel=0.1)


def test_edges_are_little_of_it_and_views_are_apart(rng):
    picture = noisy(rng, 0.01, views=3)
    views = [slice(64 * k, 64 * (k + 1)) for k in range(3)]
    assert rendered_anew.noise(picture, views)[0, 0] == pytest.approx(0.01, rel=0.1)
    apart = np.concatenate([rendered_anew.high_pass(picture[rows]) for rows in views])
    np.testing.assert_array_equal(rendered_anew.high_pass(picture, views), apart)
    picture[20:40, 30:50] *= 0.5
    assert rendered_anew.noise(picture, views)[0, 0] == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("factor", [0.25, 1.0, 4.0])
def test_samples_are_those_whose_variance_is_that_of_the_noise(factor, rng):
    initial, picture = noisy(rng, 0.02), noisy(rng, 0.02 / np.sqrt(factor))
    known = rendered_anew.noise(picture)
    assert rendered_anew.samples(known, initial, 64) == pytest.approx(64 * factor, rel=0.2)


def test_samples_have_ends(rng):
    smooth, initial = noisy(rng, 0.0), noisy(rng, 0.02)
    few = rendered_anew.samples(rendered_anew.noise(initial), smooth, 64)
    many = rendered_anew.samples(rendered_anew.noise(smooth), initial, 64)
    assert few == 1 and many == rendered_anew.MOST_SAMPLES


@pytest.mark.slow
def test_samples_of_a_rendering_are_nearly_those_it_was_made_with(sphere):
    """Where noise is uneven, up to twice as little of it is found, and four times the samples."""
    lit, envmap, on, _ = sphere
    for spp in (4, 64):
        picture = lit.render(np.roll(envmap, 5, axis=1), spp=spp, seed=9)
        found = rendered_anew.samples(rendered_anew.noise(picture), on, SPP)
        assert spp / 3 < found < 4 * spp
