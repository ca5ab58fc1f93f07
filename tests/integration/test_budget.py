"""A budget: the finest level that ends in time, or a refusal that says what would do."""

import dataclasses

import numpy as np
import pytest

from envedit import config
from envedit.cli import budget, run, run_options
from envedit.cli.budget import LEVELS, Calibration
from envedit.core.errors import ConfigError
from envedit.images import images
from envedit.scene import scene
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene

HERE = Calibration(budget.REFERENCE_RENDER, 1.0, 0.0, 512)
"""The reference machine."""
LARGE = dataclasses.replace(HERE, texels=2**25)


@pytest.mark.parametrize("elapsed", [0.0, 2.0])
def test_the_finest_level_in_time_is_taken(elapsed):
    for i, level in enumerate(LEVELS):
        wanted = elapsed + budget.expect(level, HERE)
        taken, expected = budget.choose(HERE, wanted + 0.01, elapsed)
        assert taken == level and expected == pytest.approx(wanted)
        if i:
            assert budget.choose(HERE, wanted - 0.01, elapsed)[0] == LEVELS[i - 1]


def test_a_little_late_is_allowed_and_more_is_refused():
    least = budget.expect(LEVELS[0], HERE)
    assert budget.choose(HERE, least / budget.LATE + 0.01, 0)[0] == LEVELS[0]
    with pytest.raises(ConfigError, match=rf"cannot be kept.* about {least:.0f} s here: give at least"):
        budget.choose(HERE, least / budget.LATE - 0.1, 0)
    with pytest.raises(ConfigError, match="or set output.full=false"):
        budget.choose(LARGE, 1.0, 0)


@pytest.mark.parametrize(
    "more", [{"render": 4 * HERE.render}, {"machine": 4.0}, {"compile_s": 20.0}, {"quiet_spp": 768},
             {"painted": True}]
)  # fmt: skip
def test_a_slower_machine_or_a_larger_task_is_expected_to_take_longer(more):
    standard = next(level for level in LEVELS if level.name == "standard")
    assert budget.expect(standard, dataclasses.replace(HERE, **more)) > 1.05 * budget.expect(standard, HERE)
    assert budget.expect(standard, LARGE) > budget.expect(standard, HERE) + 5


@pytest.mark.parametrize(
    "text, value", [("30", 30), (" 30s ", 30), ("1.5m", 90), ("2 min", 120), (".5s", 0.5)]
)
def test_times_are_read(text, value):
    assert run_options.seconds(text) == value


@pytest.mark.parametrize("text", ["", "0", "-3", "s", "1h", "1e9", "nan", "30 40", "2ms"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ConfigError, match="--budget: got .*, expected seconds or minutes"):
        run_options.seconds(text)


STROKE = {"type": "light", "ellipse": [9, 9, 4, 4], "units": "pixels"}


@pytest.mark.parametrize(
    "table, says",
    [
        ({"representation": {"kind": "pixels"}}, "got .*expected .*layers.*transport"),
        ({"renderer": {"kind": "path"}}, "got .*expected .*layers.*transport"),
        ({"target": {"kind": "image", "file": "a.png"}}, "target.* is in pixels of the rendering"),
        ({"target": {"mask": "a.png"}}, "target.* is in pixels of the rendering"),
        ({"target": {"kind": "strokes", "strokes": [STROKE]}}, "target.* is in pixels of the rendering"),
    ],
)
def test_what_times_are_not_known_of_or_is_in_pixels_is_not_budgeted(table, says):
    with pytest.raises(ConfigError, match=f"--budget: {says}"):
        budget.apply(config.from_dict(table), 60)


@pytest.mark.parametrize("rows, wanted", [([0, 20], (0, 5)), ([0, 127], (0, 31)), ([127, 127], (31, 31))])
def test_active_rows_stay_the_same_part_of_the_sky(rows, wanted):
    given = config.Input(envmap="sunsky", width=256, rows=tuple(rows))
    assert budget._at_width(given, 64).rows == wanted
    assert budget._at_width(config.Input(envmap="sunsky"), 64).rows == "all"


def test_a_picture_keeps_its_shape():
    assert budget._film_at(config.Scene(width=256, height=64), 128) == config.Scene(width=128, height=32)
    assert budget._film_at(config.Scene(width=256, height=4), 32).height == 1


@pytest.fixture
def small(tmp_path, rng, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    images.write_exr(tmp_path / "map.exr", (0.5 + rng.random((32, 64, 3))).astype(np.float32))
    write_scene(tmp_path, SENSOR, BALL, LIGHT, name="scene.xml")
    path = tmp_path / "c.toml"
    path.write_text('[input]\nenvmap = "map.exr"\n[scene]\nfile = "scene.xml"\n[optimizer]\nlr = 0.01\n')
    return path


@pytest.mark.slow
def test_calibration_measures_this_scene(small):
    settings = config.load(small)
    found = budget.calibrate(settings, small.parent)
    assert found.texels == 32 * 64 and 0.5 < found.aspect < 2 and not found.painted
    assert 0 < found.render < 1e-3 and 0 < found.machine < 1e3 and found.compile_s >= 0
    assert scene.QUIET_LEAST <= found.quiet_spp <= scene.QUIET_MOST


@pytest.mark.slow
def test_a_run_within_a_budget_takes_the_level_and_says_so(small, monkeypatch, capsys):
    tiny = LEVELS[0]._replace(name="tiny", map=32, film=24, spp=16)
    monkeypatch.setattr(budget, "LEVELS", (tiny,))
    out = small.parent / "out"
    assert run.main([str(small), "--budget", "10m", "--out", str(out)]) == 0
    done = config.load(out / "config.toml")
    assert (done.input.width, done.scene.width) == (32, 24)
    assert done.target.spp == done.output.spp == 16 and done.optimizer.lr == 0.01
    assert "level 'tiny'" in capsys.readouterr().out and "level 'tiny'" in (out / "metrics.json").read_text()


@pytest.mark.slow
def test_a_budget_that_cannot_be_kept_ends_before_anything_is_made(small, capsys):
    out = small.parent / "out"
    assert run.main([str(small), "--budget", "0.1s", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "cannot be kept" in error and not list(out.glob("*.exr"))
