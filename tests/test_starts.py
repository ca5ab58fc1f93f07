"""Where an edit with layers starts: what it looks through, and what its pixels count."""

import mitsuba as mi
import numpy as np
import pytest

from envedit import config, starts
from envedit.target import Target

SHAPE = (24, 32, 3)
MAP = np.ones((8, 16, 3), np.float32)


class Recording:
    """A picture that stands for T E."""

    def __init__(self, picture, spp):
        self.picture, self.spp = picture.astype(np.float32), spp

    def resolve(self, envmap):
        assert envmap is MAP

    def apply(self, envmap):
        return mi.TensorXf(self.picture)


def seen(rng, spp=(256, 32)):
    base = 0.4 + 0.2 * rng.random(SHAPE)
    first, second = (base + 0.003 * rng.normal(size=SHAPE) for _ in range(2))
    first[10:13, 20:23] += 3
    base[10:13, 20:23] += 3
    return [Recording(picture, n) for picture, n in zip((first, second), spp, strict=True)], base


def target(picture, weight=None):
    return Target(picture.astype(np.float32), weight, None, "")


def test_weights_have_a_mean_of_one_and_are_told(rng):
    recordings, base = seen(rng)
    weight, said = starts._trusted(MAP, recordings, target(base))
    assert weight.shape == (24, 32, 1) and float(weight.mean()) == pytest.approx(1, abs=1e-5)
    assert weight[11, 21] == 0 and "% of the pixels are mostly noise" in said


def test_a_mask_counts_too(rng):
    recordings, base = seen(rng)
    mask = np.ones((24, 32, 1), np.float32)
    mask[:, :8] = 0
    weight, _ = starts._trusted(MAP, recordings, target(base, mask))
    assert not weight[:, :8].any() and weight[0, 31] > 1


def test_a_mask_around_nothing_but_noise_is_kept_as_it_is(rng):
    recordings, base = seen(rng)
    mask = np.zeros((24, 32, 1), np.float32)
    mask[10:13, 20:23] = 1
    assert starts._trusted(MAP, recordings, target(base, mask)) == (None, "")


@pytest.mark.parametrize(
    "cycles, coverage, spp, wanted",
    [
        ("auto", None, 256, [256, 32]),
        ("auto", None, 16, [16, 16]),
        (12, None, 256, [256]),
        ("auto", MAP, 256, [256]),
    ],
)
def test_a_second_recording_is_made_where_detail_is_asked_about(cycles, coverage, spp, wanted, monkeypatch):
    asked = []

    class Traced:
        paths = (8, 48, 48)

        def __init__(self, spp):
            self.spp = spp

    def trace(settings, lit, shape):
        asked.append(settings.seed)
        return Traced(settings.renderer.spp)

    monkeypatch.setattr(starts.renderers, "trace", trace)
    settings = config.from_dict({"representation": {"cycles": cycles}, "seed": 2**32 - 1})
    picture = np.zeros(SHAPE, np.float32)
    wished = Target(picture, None, None, "", coverage=coverage)
    found = starts.recordings(settings, None, (8, 16), wished, Traced(spp))
    assert [one.spp for one in found] == wanted and len(asked) == len(wanted) - 1
    assert all(0 <= seed < 2**32 and seed != settings.seed for seed in asked)
