"""The same configuration and seed give the same bytes, whatever caches hold and however many threads work.

Every sum has a fixed order. Mitsuba's path tracer adds the gradients of a texel in the order in which threads
come to them: they are traced by one.
"""

import numpy as np
import pytest

from tests.oracles.runs import call, changed, differing, pixels, world

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("isolated", "own_core")]


@pytest.fixture
def carried_out(tmp_path, monkeypatch, threads):
    """Return what runs a configuration on so many threads, its caches empty; it returns the folder."""
    runs = []

    def run(path, count, *arguments, cache=None):
        runs.append(count)
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache or tmp_path / f"cache-{len(runs)}"))
        threads(count)
        out = tmp_path / f"out-{len(runs)}"
        assert call(path, "--quiet", "--out", out, *arguments) == 0
        return out

    return run


def configured(folder, rng, kind, renderer="transport"):
    tables = {"representation": {"kind": kind, "hidden": 16, "depth": 1}, "optimizer": {"iterations": 12}}
    tables["renderer"] = {"kind": renderer, "spp": 4 if renderer == "path" else 32, "max_depth": 3}
    return world(folder, rng, **tables)


CASES = [("transport", "layers"), ("transport", "siren"), ("path", "siren")]


@pytest.mark.parametrize(("renderer", "kind"), CASES)
def test_the_same_files_on_any_number_of_threads(kind, renderer, tmp_path, rng, carried_out):
    path = configured(tmp_path, rng, kind, renderer)
    one, two = (carried_out(path, count) for count in (1, 2))
    warm = carried_out(path, 2, cache=tmp_path / "cache-1")  # fit and recording come from disk
    assert differing(one, two) == set() == differing(one, warm)
    assert pixels(one / "edited.exr").tobytes() != pixels(tmp_path / "map.exr").tobytes()
    assert (one / "influence.exr").exists() == (renderer == "transport")


def test_a_wide_pixel_filter_and_odd_numbers_of_samples_give_the_same_files(tmp_path, rng, carried_out):
    path = configured(tmp_path, rng, "log-pixels")
    scene = tmp_path / "scene.xml"
    scene.write_text(scene.read_text().replace('type="box"', 'type="gaussian"'))
    odd = changed(target__spp=100, output__spp=144)
    one, two = (carried_out(path, count, *odd) for count in (1, 2))
    assert differing(one, two) == set()
    # What is compared depends on the samples, so that the same bytes mean something.
    a, b = (pixels(out / "edited.exr") for out in (one, carried_out(path, 2, *odd, *changed(seed=1))))
    assert (np.abs(a - b) / np.maximum(a, 1e-3)).max() > 1e-4
