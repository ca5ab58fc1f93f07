"""Maps of the matrix through its stages; the page in docs/ says the same."""

import numpy as np
import pytest

from envedit import pipeline
from envedit.core import latlong
from envedit.core.errors import InputError
from envedit.images import images
from envedit.inputs import Replacements
from envedit.representations import LogPixels, Pixels
from envedit.representations.layers.layers import Layers
from envedit.scene import scene
from envedit.targets import initial_rendering, target
from tests.oracles import ROOT, extremes
from tests.oracles.extremes_stages import transport
from tests.oracles.runs import settings_of

pytestmark = pytest.mark.usefixtures("own_cache", "own_core")


@pytest.mark.parametrize(("name", "stage"), extremes.CELLS)
def test_cell(name, stage, tmp_path):
    """A stage returns where all is right; wrong numbers fail an assertion of its own."""
    if (name, stage) not in extremes.REFUSALS:
        extremes.STAGES[stage](extremes.MAPS[name], tmp_path)
        return
    error, words = extremes.REFUSALS[name, stage]
    with pytest.raises(error) as refusal:
        extremes.STAGES[stage](extremes.MAPS[name], tmp_path)
    message = str(refusal.value)
    assert words in message and len(message.splitlines()) <= 2


def test_the_page_says_what_is_refused():
    text = (ROOT / "docs" / "extremes.md").read_text(encoding="utf-8")
    head, _, *rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    said = {
        (name, stage): mark.startswith("refused")
        for names, *marks in rows
        for name in names.split(", ")
        for stage, mark in zip(head, marks, strict=True)
    }
    assert said == {cell: cell in extremes.REFUSALS for cell in extremes.CELLS}


# ---- refusals ----------------------------------------------------------------------------------------------


def test_rows_of_a_refusal_are_those_of_the_map():
    m = extremes.texel(np.nan)
    with pytest.raises(InputError, match="row 12, column 9"):
        Layers.of(m, rows=(7, 32))
    for made in (Pixels(), LogPixels()):
        with pytest.raises(InputError, match="row 5, column 9"):
            made.encode(m)


def test_pixels_hold_what_logarithms_cannot():
    m = extremes.texel(3e38)
    np.testing.assert_array_equal(Pixels().decode(Pixels().encode(m)).numpy(), m)
    with pytest.raises(InputError, match="log-pixels: 1 texel is brighter"):
        LogPixels().encode(m)


@pytest.mark.slow
def test_whole_runs_end_finite_or_with_a_reason(tmp_path):
    m = extremes.sky(8, 16)
    asked = {"target": {"rotate_degrees": 90.0}, "input": {"rows": "all"}}
    m[2, 5] = 3e38
    with pytest.raises(InputError, match="layers: 1 texel is brighter than 1.27e[+]30, .* row 2, column 5"):
        pipeline.run(settings_of(tmp_path, m, **asked))
    m[2, 5] = 1e30
    result = pipeline.run(settings_of(tmp_path, m, **asked))
    assert np.isfinite(result.envmap).all() and result.metrics["non_finite_steps"] == 0


@pytest.mark.slow
def test_a_picture_beyond_all_light_counts_as_bright_as_can_be(tmp_path):
    m = extremes.sky(8, 16)
    settings = settings_of(tmp_path, m)
    lit = scene.load(settings.scene.file, settings.scene.width)
    picture = initial_rendering.initial(lit, m, settings)
    picture[3, 4] = 3e38
    made = target.make(settings, lit, m, Replacements(target=picture))
    assert any("target: 1 pixel is brighter than 1.27e+30" in line for line in made.warnings)
    assert (made.picture[3, 4] == np.float32(2.0**100)).all()
    picture[3, 4] = 1e30
    made = target.make(settings, lit, m, Replacements(target=picture))
    np.testing.assert_array_equal(made.picture, picture)
    assert not made.warnings


def test_another_map_beyond_all_light_is_refused_as_a_target(tmp_path):
    images.write_exr(tmp_path / "other.exr", extremes.texel(3e38))
    settings = settings_of(tmp_path, extremes.sky(8, 16), target={"file": "other.exr"}, input={"width": 16})
    with pytest.raises(InputError, match=r"other.exr: \d+ texels are brighter than 1.27e[+]30"):
        pipeline.run(settings)


# ---- what the matrix found ---------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1e6, 1e30, 2.0**100])
def test_a_light_of_any_radiance_comes_back(value):
    m = extremes.texel(value)
    made = Layers.of(m)
    got = made.decode(made.start()).numpy()
    assert len(made.separation.lights) == 1
    np.testing.assert_allclose(got[5, 9], value, rtol=1e-6)
    assert np.abs(got - m)[m < 1].max() <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize("value", [np.nan, np.inf, -5.0])
def test_no_error_is_told_of_a_map_that_is_no_radiance(value):
    with pytest.raises(InputError, match="light transport: 1 texel is .* row 5, column 9"):
        transport(16, 32).coarse_error(extremes.texel(value))


@pytest.mark.parametrize("size", [(1, 2), (2, 4), (3, 1)])
def test_a_grid_that_mitsuba_does_not_take_is_refused(size):
    with pytest.raises(InputError, match=f"map of {size[1]} x {size[0]} texels is too small"):
        latlong.check_envmap_size(*size)
    latlong.check_envmap_size(3, 2)
