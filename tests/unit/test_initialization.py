"""Where an edit with layers starts: what it looks through, and what its pixels count."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from envedit import config
from envedit.solve import initialization
from envedit.targets.target import Target
from envedit.transport import sampling_plan

SHAPE = (24, 32, 3)
MAP = np.ones((8, 16, 3), np.float32)


class Recording:
    """A picture that stands for T E."""

    scene = SimpleNamespace(rows=())

    def __init__(self, picture, spp):
        self.picture, self.spp = picture.astype(np.float32), spp

    def resolved(self, envmap):
        assert envmap is MAP
        return self

    def apply(self, envmap):
        return mi.TensorXf(self.picture)


def seen(rng, spp=(256, 32)):
    base = 0.4 + 0.2 * rng.random(SHAPE)
    first, second = (base + 0.003 * rng.normal(size=SHAPE) for _ in range(2))
    first[10:13, 20:23] += 3
    base[10:13, 20:23] += 3
    pair = (Recording(picture, n) for picture, n in zip((first, second), spp, strict=True))
    return initialization.Recordings(*pair), base


def target(picture, weight=None):
    everywhere = np.ones((*picture.shape[:2], 1), np.float32)
    return Target(picture.astype(np.float32), everywhere if weight is None else weight, None, "")


def test_weights_have_a_mean_of_one_and_are_told(rng):
    recordings, base = seen(rng)
    trusted, (said,) = initialization.trusted(MAP, recordings, target(base))
    weight = trusted.weight
    assert weight.shape == (24, 32, 1) and float(weight.mean()) == pytest.approx(1, abs=1e-5)
    assert weight[11, 21] == 0 and "% of the pixels are dominated by Monte Carlo noise" in said


def test_a_mask_counts_too_and_is_kept_around_nothing_but_noise(rng):
    recordings, base = seen(rng)
    mask = np.ones((24, 32, 1), np.float32)
    mask[:, :8] = 0
    weight = initialization.trusted(MAP, recordings, target(base, mask))[0].weight
    assert not weight[:, :8].any() and weight[0, 31] > 1
    recordings, base = seen(rng)
    mask = np.zeros((24, 32, 1), np.float32)
    mask[10:13, 20:23] = 1
    asked = target(base, mask)
    assert initialization.trusted(MAP, recordings, asked) == (asked, [])


@pytest.mark.parametrize("cycles, coverage, spp, wanted", [
    ("auto", None, 256, (256, 32)), ("auto", None, 16, (16, 16)), (12, None, 256, (256, None)),
    ("auto", MAP, 256, (256, None)),
])  # fmt: skip
def test_a_second_recording_is_made_where_detail_is_asked_about(cycles, coverage, spp, wanted, monkeypatch):
    asked = tracing(monkeypatch, [])
    found = recorded({"representation": {"cycles": cycles}}, Traced(spp), coverage)
    second = found.second and found.second.spp
    assert (found.transport.spp, second) == wanted and len(asked) == (second is not None)
    assert all(0 <= seed < 2**32 and seed != 2**32 - 1 for seed, _ in asked)
    assert bool(found.notes) == (second is not None)


@pytest.mark.parametrize("octaves, renderer, spp, size, wanted", [
    (["one"], {}, 64, 256, 256),  # 0.8 of the 2 GB
    (["one"], {"memory_gb": "auto"}, 64, 256, 256),
    (["one"], {"memory_gb": 1.0}, 64, 256, 128),
    (["one"], {}, 16, 1024, None),  # more do not fit
    (["one"], {}, 256, 128, None),
    (["one"], {"spp": 64}, 64, 256, None),  # what was asked for is taken
    ([], {}, 64, 256, None),
])  # fmt: skip
def test_where_detail_is_told_a_large_picture_gets_more_samples(
    octaves, renderer, spp, size, wanted, monkeypatch
):
    asked, first = tracing(monkeypatch, octaves), Traced(spp)
    found = recorded({"renderer": renderer}, first, size=size)
    assert found.octaves == octaves and asked[0][1] == min(spp, 32)
    if wanted is None:
        assert found.transport is first and len(asked) == 1
        return
    assert found.transport.spp == wanted and asked[1:] == [(2**32 - 1, wanted)]  # the run's own seed
    assert not first.held, "there is no memory for both"
    assert found.second.paths == (8 * 32 // wanted, 48 * 32 // wanted, 48 * 32 // wanted)
    assert str(wanted) in found.notes[-1] and str(spp) in found.notes[-1]


def test_small_maps_and_path_tracers_keep_their_recording(monkeypatch):
    asked = tracing(monkeypatch, ["one"])
    assert recorded({}, first := Traced(256), width=46) == initialization.Recordings(first) and not asked
    found = recorded({"renderer": {"kind": "path", "spp": 16}}, None, size=256)
    assert [spp for _, spp in asked] == ["auto", 32] and found.transport.spp == 64


class Traced:
    paths, bounces, capacity, held = (8, 48, 48), 3, 256, True

    def __init__(self, spp):
        self.spp = spp

    def release(self):
        self.held = False


def tracing(monkeypatch, octaves):
    """Let no path be traced, and the picture tell what it is to tell; returns seeds and samples asked for."""
    asked = []

    def trace(settings, lit, shape, progress):
        asked.append((settings.seed, settings.renderer.spp))
        if settings.seed != 2**32 - 1:  # the second: as deep as T, and no larger than it must be
            few = sampling_plan.gigabytes(lit.width * lit.height, settings.renderer.spp, 65)
            assert settings.renderer.max_depth == 4 and settings.renderer.memory_gb == few
        return Traced(64 if settings.renderer.spp == "auto" else settings.renderer.spp)

    monkeypatch.setattr(initialization.renderers, "trace", trace)
    monkeypatch.setattr(initialization.gain_bandwidth, "octaves", lambda *asked: [Told(o) for o in octaves])
    return asked


class Told(str):
    cycles, share = 24, 0.9


def recorded(tables, traced, coverage=None, size=24, width=48):
    settings = config.from_dict({**tables, "seed": 2**32 - 1})
    layers = SimpleNamespace(separation=SimpleNamespace(background=MAP), rows=(0, 8))
    wished = Target(np.zeros(SHAPE, np.float32), None, None, "", coverage=coverage)
    lit = SimpleNamespace(width=size, height=size, rows=())
    return initialization.recordings(settings, lit, (24, width), layers, wished, traced)
