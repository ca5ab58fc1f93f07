"""How fine a gain a picture can tell: a mirror's, a matte thing's, and one of noise alone."""

import numpy as np
import pytest

from envedit.core import latlong
from envedit.representations.layers.gain import grid_size
from envedit.solve import gain_bandwidth
from tests.oracles.dense_transport import DenseTransport

WIDTH, ROWS = 64, (0, 32)
FILM = 24
BACKGROUND = np.full((16, WIDTH, 3), 0.5)


def dense(matrix):
    return DenseTransport(matrix, (FILM, FILM), (32, WIDTH))


def mirror(share=1.0):
    """Pixels that see one texel each, of a share of the columns."""
    matrix = np.zeros((FILM * FILM, 32 * WIDTH))
    texels = np.arange(16 * WIDTH).reshape(16, WIDTH)[:, : int(share * WIDTH)].ravel()
    matrix[np.arange(FILM * FILM), np.resize(texels, FILM * FILM)] = 1
    return dense(matrix)


def matte():
    """Pixels of white plaster, each facing another way."""
    d = latlong.directions(32, WIDTH).reshape(-1, 3)
    normal = np.random.default_rng(1).normal(size=(FILM * FILM, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return dense(np.maximum(normal @ d.T, 0) * latlong.solid_angles(32, WIDTH).repeat(WIDTH) / np.pi)


def sampled(exact, seed, samples=64):
    rng, found = np.random.default_rng(seed), np.zeros_like(exact.weights[0])
    for row, weights in zip(found, exact.weights[0], strict=True):
        total = weights.sum()
        np.add.at(row, rng.choice(len(weights), samples, p=weights / total), total / samples)
    return dense(found)


def told(first, second=None, weight=None, value=0.5):
    picture = np.full((FILM, FILM, 3), value)
    weight = np.ones((FILM, FILM, 1)) if weight is None else weight
    return gain_bandwidth.octaves(first, second or first, BACKGROUND, ROWS, picture, weight, 4)


@pytest.mark.slow
def test_a_mirror_tells_every_octave_down_to_the_texel():
    found = told(mirror())
    assert [octave.cycles for octave in found] == [4, 8, 16, 32]
    assert [octave.size for octave in found] == [grid_size(c, 0.5) for c in (4, 8, 16, 32)]
    assert all(octave.share > 0.4 for octave in found)
    assert all(((octave.known >= 0) & (octave.known < 1)).all() for octave in found)


def test_detail_is_told_only_where_it_is_seen():
    octave = told(mirror(0.5))[2]
    columns = octave.size[1]
    # Splines and the patch that is summed over reach two and a half nodes across the border.
    seen, unseen = octave.known[:, 3 : columns // 2 - 3], octave.known[:, columns // 2 + 4 : -4]
    assert seen.mean() > 0.5 and unseen.max() == 0


@pytest.mark.slow
def test_a_matte_thing_tells_nothing_fine():
    shares = {octave.cycles: octave.share for octave in told(matte())}
    assert shares.get(16, 0) < 0.1 and 32 not in shares
    assert {octave.cycles: octave.share for octave in told(mirror())}[16] > 0.5


@pytest.mark.slow
def test_noise_of_samples_is_not_taken_for_detail():
    exact = matte()
    first, second = sampled(exact, 1), sampled(exact, 2)
    assert max((octave.cycles for octave in told(first)), default=0) == 32, "the same noise twice is detail"
    both = ((first, second), (exact,))
    independent, noiseless = ({octave.cycles: octave.share for octave in told(*them)} for them in both)
    assert independent.keys() == noiseless.keys()
    assert all(abs(independent[cycles] - noiseless[cycles]) < 0.05 for cycles in noiseless)


def test_pixels_that_do_not_count_tell_nothing():
    assert told(mirror(), weight=np.zeros((FILM, FILM, 1))) == []
    assert told(dense(np.zeros((FILM * FILM, 32 * WIDTH)))) == []


@pytest.mark.slow
def test_a_highlight_tells_less_than_the_dark():
    dark, bright = (told(mirror(), value=value) for value in (0.05, 50.0))
    assert len(bright) < len(dark) == 4
    assert all(few.known.mean() <= many.known.mean() for few, many in zip(bright, dark, strict=False))
