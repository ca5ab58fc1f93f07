"""A recording on disk: the same bits as traced, for the same scene, grid and samples and no other."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError
from envedit.renderers import StoredRenderer
from envedit.scene import scene
from envedit.transport import recording, sampling_plan
from envedit.transport.light_transport import LightTransport
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene

LAMP = """<shape type="sphere"><point name="center" x="0" y="3" z="0"/><float name="radius" value="0.3"/>
    <emitter type="area"><rgb name="radiance" value="6, 3, 12"/></emitter></shape>"""
GROUND = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="9"/>
    <translate y="-1"/></transform></shape>"""


@pytest.fixture
def lit(tmp_path):
    return scene.load(write_scene(tmp_path, SENSOR, BALL, GROUND, LAMP, LIGHT))


def build(folder, lit, height=8, width=16, **options):
    return LightTransport.build(lit, height, width, folder=folder / "cache", **{"spp": 16, **options})


def pictures(t, rng):
    """Return what a transport makes of a map and of a picture, as bytes."""
    image = mi.TensorXf(rng.random((t.grid.height, t.grid.width, 3)).astype(np.float32))
    picture = mi.TensorXf(rng.random((*t.shape, 3)).astype(np.float32))
    return t.apply(image).numpy().tobytes(), t.adjoint(picture).numpy().tobytes()


def nothing_is_traced(monkeypatch):
    def refuse(*arguments, **keys):
        raise AssertionError("something was traced")

    monkeypatch.setattr(recording, "contributions", refuse)
    monkeypatch.setattr(scene.Scene, "render", refuse)


@pytest.mark.parametrize("lamp", [True, False])
def test_a_second_build_traces_nothing_and_gives_the_same_bits(lamp, tmp_path, rng, monkeypatch):
    """Under a lamp the light that is not the map's is kept as well."""
    s = scene.load(write_scene(tmp_path, SENSOR, BALL, *([LAMP] if lamp else []), LIGHT))
    first = build(tmp_path, s)
    with monkeypatch.context() as patch:
        nothing_is_traced(patch)
        second = build(tmp_path, s)
    assert not first.cached and second.cached
    state = rng.bit_generator.state
    made = pictures(first, rng)
    rng.bit_generator.state = state
    assert pictures(second, rng) == made
    assert second.influence.tobytes() == first.influence.tobytes() and second.influence.flags.writeable
    assert second.choices == first.choices and len(first.choices) == 2
    differing = {"cached"}
    told, told_again = first.summary(), second.summary()
    assert {k for k in told if told[k] != told_again[k]} == differing
    assert (np.abs(first.apply(dr.zeros(mi.TensorXf, (8, 16, 3))).numpy()).max() > 0) == lamp


CHANGES = ({"seed": 1}, {"spp": 8}, {"max_depth": 2}, {"height": 9, "width": 16})


@pytest.mark.slow
def test_another_recording_is_not_taken_for_this_one(lit, tmp_path):
    for change in ({}, *CHANGES):
        assert not build(tmp_path, lit, **change).cached, change
    red = BALL.replace("0.2, 0.4, 0.6", "0.6, 0.4, 0.2")
    other = scene.load(write_scene(tmp_path, SENSOR, red, GROUND, LAMP, LIGHT, name="other.xml"))
    assert not build(tmp_path, other).cached
    assert build(tmp_path, lit).cached and build(tmp_path, lit, **CHANGES[-1]).cached


@pytest.mark.slow
@pytest.mark.parametrize("lamp", [True, False])
def test_a_depth_that_was_chosen_is_the_same_as_one_that_was_asked_for(lamp, tmp_path):
    """But under a lamp, whose light is cut only where a depth is asked for."""
    lit = scene.load(write_scene(tmp_path, SENSOR, BALL, GROUND, *([LAMP] if lamp else []), LIGHT))
    depth = build(tmp_path, lit).bounces + 1
    asked = build(tmp_path, lit, max_depth=depth)
    assert asked.cached == (not lamp) and len(asked.choices) == 1
    short = build(tmp_path, lit, max_depth=2)
    assert 0 < asked.depth_error <= sampling_plan.DEPTH_TOLERANCE < short.depth_error


@pytest.mark.slow
def test_a_filter_with_negative_lobes_is_kept_too(tmp_path):
    sensor = SENSOR.replace('<rfilter type="box"/>', '<rfilter type="lanczos"/>')
    lit = scene.load(write_scene(tmp_path, sensor, BALL, GROUND, LIGHT))
    first = build(tmp_path, lit, 32, 64, spp=4)
    assert first.influence.min() < 0
    assert build(tmp_path, lit, 32, 64, spp=4).cached


@pytest.mark.slow
def test_other_recordings_are_not_kept(lit, tmp_path, rng):
    image = np.ones((8, 16, 3), np.float32)
    first = build(tmp_path, lit)
    kept = sorted(path.name for path in (tmp_path / "cache").iterdir())
    second = build(tmp_path, lit)
    made = [t.recorded_again(1).apply(image).numpy().tobytes() for t in (first, second)]
    assert made[0] == made[1] != first.apply(image).numpy().tobytes()
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == kept


@pytest.mark.slow
def test_columns_of_a_checkpoint_are_checked(lit, tmp_path):
    renderer = StoredRenderer(build(tmp_path, lit))
    parts = {"columns": np.array([3]), "paths": np.array([8]), "looks": np.zeros(8 * 16, np.uint8)}
    good = parts | {"epoch": np.int64(0)}
    renderer.restore(good)
    assert renderer.transport.columns.tolist() == [3]
    odd = [
        {"columns": np.array([8 * 16])},
        {"columns": np.array([-1])},
        {"columns": np.array([3, 3]), "paths": np.array([8, 8])},
        {"columns": np.array([3.0])},
        {"paths": np.array([2**31])},
        {"looks": np.zeros(5, np.uint8)},
        {"epoch": np.int64(-1)},
        {"epoch": np.int64(2**40)},
        {"more": np.zeros(1, int)},
    ]
    for state in (*(good | one for one in odd), parts, {"epoch": np.int64(0)}):
        with pytest.raises(InputError, match="the checkpoint is not of this light transport"):
            renderer.restore(state)
