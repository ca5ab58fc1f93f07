"""Strokes: where they are, what they do, what is refused, and the six edits that come ready."""

import math

import numpy as np
import pytest

from envedit import config as cfg
from envedit.config.list_schema import STROKES, StrokeList
from envedit.core.color import TONEMAPS, inverse_tonemap, luminance, tonemap
from envedit.targets import stroke_shapes, strokes
from tests.oracles import ROOT
from tests.oracles.builders import grey, refused

EDITS = ROOT / "scenes" / "edits"
BOX = [0.25, 0.25, 0.75, 0.75]
ALL = [
    {"type": "shadow", "ellipse": [0.5, 0.5, 0.2, 0.1], "softness": 0.05},
    {"type": "light", "points": [[0.1, 0.1], [0.9, 0.2]], "width": 0.03, "color": [1, 0.8, 0.6]},
    {"type": "erase-shadow", "polygon": [[0.2, 0.2], [0.8, 0.3], [0.5, 0.9]], "softness": 0.02},
    {"type": "temperature", "kelvin": 4000, "rectangle": BOX, "opacity": 0.7},
    {"type": "contrast", "rectangle": [0.1, 0.1, 0.9, 0.9]},
    {"type": "blur", "radius": 0.02, "ellipse": [0.5, 0.5, 0.3, 0.3, 30]},
    {"type": "hold", "ellipse": [0.2, 0.8, 0.1, 0.1]},
]


def covered(height, across=None, **stroke):
    """Coverage (height, across) of one stroke; of a square without ``across``."""
    (full,) = StrokeList()([{"type": "shadow"} | stroke])
    return stroke_shapes.coverage(full, height, across or height)[..., 0]


def painted(picture, tonemap="gamma", **stroke):
    found = strokes.paint(picture, [stroke], tonemap)
    assert not found.warnings
    return found.picture


# ---- where -------------------------------------------------------------------------------------------------

TRIANGLE = [[0.1, 0.1], [0.83, 0.2], [0.4, 0.77]]
BAR = {"points": [[0.2, 0.2], [0.7, 0.63]], "width": 0.05}
ELBOW = {"points": [[0.2, 0.2], [0.8, 0.2], [0.8, 0.8]], "width": 0.1}
AREAS = [
    ({"ellipse": [0.5, 0.5, 0.3, 0.11]}, math.pi * 0.3 * 0.11),
    ({"ellipse": [0.5, 0.5, 0.11, 0.3, 30]}, math.pi * 0.3 * 0.11),
    ({"polygon": TRIANGLE}, 0.5 * (0.73 * 0.67 - 0.3 * 0.1)),
    ({"rectangle": [0.213, 0.317, 0.651, 0.777]}, 0.438 * 0.46),
    ({"points": [[0.4, 0.4]], "width": 0.3}, math.pi * 0.15**2),
    (BAR, 0.05 * math.hypot(0.5, 0.43) + math.pi * 0.025**2),
    # An elbow of a right angle: two bars and round ends, less the square that the bars share, and with the
    # joint's quarter of a disc.
    (ELBOW, 2 * 0.6 * 0.1 + math.pi * 0.05**2 + (math.pi / 4 - 1) * 0.05**2),
]


@pytest.mark.parametrize("shape, area", AREAS)
@pytest.mark.parametrize("size", [128, 512])
def test_the_area_covered_is_that_of_the_shape_at_any_resolution(shape, area, size):
    assert covered(size, **shape).mean() == pytest.approx(area, rel=5e-4)


def test_a_picture_made_small_is_the_small_picture_and_hairlines_keep_their_share():
    for shape, _ in AREAS:
        fine = covered(512, softness=0.03, **shape).reshape(128, 4, 128, 4).mean(axis=(1, 3))
        assert np.abs(fine - covered(128, softness=0.03, **shape)).max() < 0.01
    line = {"points": [[0.2, 0.2], [0.7, 0.63]], "width": 0.002}
    assert covered(64, **line).mean() == pytest.approx(0.002 * math.hypot(0.5, 0.43), rel=0.01)
    dot = {"ellipse": [0.502, 0.49, 0.004, 0.003]}
    assert covered(64, **dot).mean() == pytest.approx(math.pi * 0.004 * 0.003, rel=0.05)


def test_pixels_have_their_centres_at_one_half_and_fractions_follow_width_and_height():
    exact = covered(10, 20, rectangle=[3, 2, 7, 5], units="pixels")
    assert exact[2:5, 3:7].min() > 0.9 and exact.sum() == pytest.approx(12, abs=0.1)
    assert exact[:1].max() == exact[6:].max() == exact[:, :2].max() == exact[:, 8:].max() == 0
    fraction = covered(10, 20, rectangle=[3 / 20, 2 / 10, 7 / 20, 5 / 10])
    np.testing.assert_allclose(exact, fraction, atol=1e-9)
    # Widths are shares of the width, so that a dot is round in a picture of any aspect.
    dot = covered(100, 200, points=[[0.5, 0.5]], width=0.2)
    assert dot.sum() == pytest.approx(math.pi * 20**2, rel=1e-3)
    assert np.count_nonzero(dot[50] > 0.5) == np.count_nonzero(dot[:, 100] > 0.5) == 40


def test_an_ellipse_turns_from_x_towards_y_and_a_crossed_polygon_has_a_hole():
    turned = covered(128, ellipse=[0.5, 0.5, 0.4, 0.05, 45])
    assert turned[90, 90] == 1 and turned[90, 37] == 0 and turned[37, 37] == 1
    # The turn is one of the picture's pixels, whatever its aspect: a quarter turn changes the two radii over.
    wide, tall = [0.5, 0.5, 0.2, 0.2, 90], [0.5, 0.5, 0.1, 0.4]
    np.testing.assert_allclose(covered(64, 128, ellipse=wide), covered(64, 128, ellipse=tall), atol=1e-6)
    star = [[0.5 + 0.4 * math.sin(a), 0.5 - 0.4 * math.cos(a)] for a in np.arange(5) * 0.8 * math.pi]
    c = covered(128, polygon=star)
    assert c[64, 64] == 0 and c[24, 64] == 1


def test_a_soft_edge_is_a_smooth_step_half_inside_and_half_outside():
    c = covered(101, rectangle=[20.5, -200, 400, 400], softness=20, units="pixels")[50]
    assert c[20] == pytest.approx(0.5) and c[9] == 0 and c[31] == 1
    u = 0.5 + 5 / 20
    assert c[25] == pytest.approx(u * u * (3 - 2 * u)) and c[25] + c[15] == pytest.approx(1)
    hard = covered(101, rectangle=[20.5, -200, 400, 400], units="pixels")[50]
    assert hard[19] == 0 and hard[20] == pytest.approx(0.5) and hard[21] == 1
    faint = covered(101, rectangle=[20.498, -200, 400, 400], softness=20, units="pixels")[50]
    assert faint[10] == 0 < faint[11]  # 3e-8, less than a pixel's float32 tells apart


def test_coverage_is_the_union_of_the_strokes():
    left, right = {"rectangle": [0, 0, 0.5, 1]}, {"rectangle": [0.25, 0, 0.75, 1], "softness": 0.1}
    found = strokes.paint(grey(1.0, 32, 32), [{"type": "shadow"} | left, {"type": "light"} | right])
    a, b = covered(32, **left), covered(32, **right)
    np.testing.assert_allclose(found.coverage[..., 0], 1 - (1 - a) * (1 - b), atol=1e-6)
    assert found.coverage.dtype == found.picture.dtype == np.float32
    assert found.coverage.shape == (32, 32, 1) and found.coverage[:, 30:].max() == 0


# ---- what --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", TONEMAPS)
@pytest.mark.parametrize("stroke", ALL, ids=[s["type"] for s in ALL])
def test_what_no_stroke_covers_is_the_same_bit_for_bit(stroke, name, rng):
    picture = (10 ** rng.uniform(-30, 6, (48, 64, 3))).astype(np.float32)
    picture[:4], picture[5, 5], picture[1, 60], picture[2, 60] = 0, 65504, -0.25, -0.0
    found = strokes.paint(picture, [stroke], name)
    bare = found.coverage[..., 0] == 0
    assert 0.1 < bare.mean() < 0.99 and found.picture[bare].tobytes() == picture[bare].tobytes()
    changed = found.picture[found.coverage[..., 0] == 1] != picture[found.coverage[..., 0] == 1]
    assert changed.mean() > 0.2 if stroke["type"] != "hold" else not changed.any()


def test_a_colour_is_given_as_numbers_or_as_on_a_display():
    (stroke,) = StrokeList()([{"type": "light", "points": [[0.5, 0.5]], "width": 0.1, "color": "#FFd9a6"}])
    assert stroke["color"] == [1.0, 0.6939, 0.3813]  # the sRGB curve of 255, 217, 166
    assert StrokeList()([stroke]) == (stroke,)


def test_a_shadow_on_a_highlight_far_above_white_leaves_it_white():
    """A factor on radiance, which a display clips: as docs/painting.md says of the stroke."""
    found = painted(grey(30.0, 16, 16), type="shadow", amount=0.95, rectangle=BOX, softness=0.0)
    assert found[8, 8, 0] == pytest.approx(1.5) and (tonemap(found) == 1).all()


def test_a_shadow_is_a_factor_on_radiance_and_light_adds_to_it():
    picture = grey(2.0, 64, 64)  # above display white: a factor all the same
    soft = {"type": "shadow", "ellipse": [0.5, 0.5, 0.3, 0.3], "softness": 0.2, "amount": 0.75}
    c = covered(64, **soft)[..., None]
    for opacity in (1.0, 0.5):
        expected = 2 * (1 - opacity * 0.75 * c) + np.zeros(3)
        np.testing.assert_allclose(painted(picture, opacity=opacity, **soft), expected, rtol=1e-6)
    tinted = painted(picture, color=[0.5, 1, 2], **soft)
    np.testing.assert_allclose(tinted[32, 32], [0.25, 0.5, 1.0], rtol=1e-6)
    picture = grey(0.0, 32, 32)
    picture[16:] = 3
    lit = painted(picture, type="light", rectangle=BOX, amount=2, color=[1, 0.5, 0])
    np.testing.assert_allclose(lit[10, 16], [2, 1, 0], rtol=1e-6)
    np.testing.assert_allclose(lit[20, 16], [5, 4, 3], rtol=1e-6)


@pytest.mark.parametrize("softness", [0, 0.05])
def test_erasing_a_dark_disc_from_a_gradient_brings_back_the_gradient(softness):
    y, x = np.mgrid[:96, :96] / 96
    clean = np.stack([0.2 + 0.6 * x, 0.5 - 0.3 * y, 0.3 + 0.2 * x + 0.2 * y], axis=-1).astype(np.float32)
    dark = clean.copy()
    dark[np.hypot(x - 0.5, y - 0.5) < 0.2] *= 0.1
    brush = {"ellipse": [0.5, 0.5, 0.24, 0.24], "softness": softness}
    found = painted(dark, type="erase-shadow", **brush)
    assert np.abs(found / clean - 1).max() < 0.02 < np.abs(dark / clean - 1).max()
    # A gradient in display values is one that a membrane in display values passes through.
    shown = inverse_tonemap(clean)
    dark = np.where(dark < clean, 0, shown).astype(np.float32)
    np.testing.assert_allclose(tonemap(painted(dark, type="erase-shadow", **brush)), clean, atol=1e-5)


def test_erasing_at_the_picture_s_border_and_beside_a_highlight():
    picture = grey(0.4, 32, 48)
    picture[:, :10] = 0.01
    found = painted(picture, type="erase-shadow", rectangle=[-1, -1, 0.25, 2])
    np.testing.assert_allclose(found, 0.4, rtol=1e-5)
    picture[:, 20] = 1e6
    beside = painted(picture, type="erase-shadow", rectangle=BOX)
    np.testing.assert_array_equal(beside[:, 40:], picture[:, 40:])


def test_the_membrane_solves_laplace_s_equation(rng):
    values = rng.random((20, 30, 3))
    unknown = np.zeros((20, 30), bool)
    unknown[3:15, 8:30], unknown[0:5, 2:4] = True, True
    found = strokes.membrane(values, unknown)
    around = np.pad(found, ((1, 1), (1, 1), (0, 0)), mode="edge")
    mean = (around[2:, 1:-1] + around[:-2, 1:-1] + around[1:-1, 2:] + around[1:-1, :-2]) / 4
    np.testing.assert_allclose(found[unknown], mean[unknown], atol=1e-6)
    np.testing.assert_array_equal(found[~unknown], values[~unknown])


@pytest.mark.parametrize("kelvin", [2000, 3200, 4500, 10000, 25000])
def test_temperature_keeps_luminance(kelvin, rng):
    picture = rng.random((24, 24, 3)).astype(np.float32) ** 2
    picture[3, 3] = 500
    for where in ({}, {"ellipse": [0.5, 0.5, 0.4, 0.4], "softness": 0.2}):
        found = painted(picture, type="temperature", kelvin=kelvin, **where)
        assert luminance(found).mean() == pytest.approx(luminance(picture).mean(), rel=1e-6)
        assert abs(found - picture).max() > 0.01
    same = painted(picture, type="temperature", kelvin=6500)
    np.testing.assert_allclose(same, picture, rtol=1e-6)
    flat = painted(grey(0.3), type="temperature", kelvin=kelvin)
    np.testing.assert_allclose(luminance(flat), 0.3, rtol=1e-6)
    assert (flat[0, 0, 0] > flat[0, 0, 2]) == (kelvin < 6500)


def test_black_bodies_have_the_colours_of_the_literature():
    """Planck's law over the CIE 1931 observer; 2856 K is standard illuminant A."""
    for kelvin, x, y in ((2000, 0.5267, 0.4133), (2856, 0.4476, 0.4074), (6500, 0.3135, 0.3237)):
        np.testing.assert_allclose(strokes.chromaticity(kelvin), (x, y), atol=6e-4)
    assert (strokes.gains(2000) > 0).all()


def test_contrast_is_a_factor_about_the_mean_of_display_values_and_spares_highlights(rng):
    shown = 0.3 + 0.3 * rng.random((32, 32, 3))
    picture = inverse_tonemap(shown).astype(np.float32)
    found = tonemap(painted(picture, type="contrast", amount=1.5))
    mean = shown.mean(axis=(0, 1))
    np.testing.assert_allclose(found, mean + 1.5 * (shown - mean), atol=1e-5)
    flat = tonemap(painted(picture, type="contrast", amount=0, rectangle=BOX))[12:20, 12:20]
    np.testing.assert_allclose(flat, np.broadcast_to(flat[0, 0], flat.shape), atol=1e-6)
    picture = grey(0.2, 16, 16)
    picture[4, 4], picture[8, 8] = 1e6, 1e-4
    found = painted(picture, type="contrast", amount=4)
    np.testing.assert_allclose(found[4, 4], 1e6, rtol=1e-5)
    np.testing.assert_array_equal(found[8, 8], 0)


def test_blur_sees_what_lies_outside_and_keeps_the_mean():
    picture = grey(inverse_tonemap(0.5), 64, 64)
    np.testing.assert_allclose(painted(picture, type="blur", radius=0.1), picture, rtol=1e-6)
    picture[28:36, 28:36] = inverse_tonemap(0.9)
    found = painted(picture, type="blur", radius=0.03)
    assert tonemap(found).mean() == pytest.approx(tonemap(picture).mean(), rel=1e-6)
    half = {"rectangle": [0, 0, 0.43, 1]}  # up to the square, which it does not touch
    found = tonemap(painted(picture, type="blur", radius=0.03, **half))
    assert found[32, 26, 0] > 0.55 and found[2, 26, 0] == pytest.approx(0.5)
    np.testing.assert_array_equal(found[:, 29:], tonemap(picture)[:, 29:])


def test_blur_is_a_gaussian_of_that_many_pixels_at_any_resolution():
    for size in (64, 128):
        picture = grey(0.0, size, size)
        picture[:, size // 2 :] = 1
        shown = tonemap(painted(picture, type="blur", radius=0.05))[size // 2, :, 0]
        x = (np.arange(size) + 0.5 - size / 2) / (0.05 * size)
        normal = np.array([0.5 + 0.5 * math.erf(v / math.sqrt(2)) for v in x])
        middle = slice(size // 4, -size // 4)
        np.testing.assert_allclose(shown[middle], normal[middle], atol=3e-3)
    in_pixels = painted(picture, type="blur", radius=0.05 * 128, units="pixels")
    np.testing.assert_allclose(tonemap(in_pixels)[size // 2, :, 0], shown, atol=1e-6)


def test_strokes_work_on_the_result_of_those_before_them():
    dark = {"type": "shadow", "rectangle": BOX, "amount": 1}
    bright = {"type": "light", "rectangle": BOX, "amount": 1}
    assert strokes.paint(grey(0.5), [dark, bright]).picture[4, 8, 0] == 1
    assert strokes.paint(grey(0.5), [bright, dark]).picture[4, 8, 0] == 0
    assert strokes.paint(grey(0.5), []).coverage.max() == 0


@pytest.mark.parametrize("name", TONEMAPS)
def test_display_values_go_on_above_white_and_come_back(name):
    display = strokes.Display(name)
    radiance = np.array([0, 1e-30, 1e-3, 0.5, 1, 1.001, 99.9, 100.1, 65504, 1e6, 3e38])
    values = display.show(radiance)
    assert (np.diff(values) > 0).all()
    np.testing.assert_allclose(display.radiance(values), radiance, rtol=1e-11)  # a slope of 5e-5: reinhard
    below = radiance[radiance < display.white]
    np.testing.assert_array_equal(display.show(below), tonemap(below, name))
    near = display.white * np.exp([-1e-3, 0, 1e-3])
    below, above = np.diff(display.show(near))
    assert below == pytest.approx(above, rel=2e-3)


# ---- extremes ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", TONEMAPS)
@pytest.mark.parametrize("value", [0, 1e-38, 1e6, 3.4e38])
@pytest.mark.parametrize("size", [(40, 40), (1, 1), (1, 30), (30, 2)])
def test_extreme_pictures_stay_finite(name, value, size, rng):
    picture = (value * rng.random((*size, 3))).astype(np.float32)
    blurs = [{"type": "blur", "radius": radius} for radius in (1e6, 1e-6)]
    found = strokes.paint(picture, [*ALL, *blurs], name)
    assert np.isfinite(found.picture).all() and found.picture.min() >= 0
    assert found.picture.shape == picture.shape and found.coverage.max() <= 1
    if not value:
        assert found.picture.max() > 0 or min(size) < 40  # the light


def test_strokes_that_paint_nothing_say_so():
    picture = grey(0.5)
    nothing = [
        {"type": "shadow", "rectangle": [2, 2, 3, 3]},
        {"type": "light", "points": [[-4, 0.5]], "width": 0.1},
        {"type": "light", "rectangle": BOX, "opacity": 0},
        {"type": "erase-shadow", "rectangle": [-1, -1, 2, 2]},
        {"type": "shadow", "polygon": [[1e6, 1e6], [1e6, -1e6], [9e5, 0]]},
    ]
    found = strokes.paint(picture, nothing)
    assert found.coverage.max() == 0 and found.picture.tobytes() == picture.tobytes()
    outside, also, unseen, all_of_it, far = found.warnings
    assert "target.strokes[0] (shadow)" in outside and "outside the 16x8 picture" in outside
    assert "target.strokes[1] (light)" in also and "target.strokes[4]" in far
    assert "opacity 0" in unseen and "target.strokes[3] (erase-shadow): covers the whole picture" in all_of_it


# ---- configuration -----------------------------------------------------------------------------------------

DOT = "points = [[0.5, 0.5]], width = 0.1"


@pytest.mark.parametrize("stroke, says", [
    ("amount = 1", "target.strokes[1].type: got none, expected one of shadow, light, erase-shadow"),
    ("type = 'shade'", "did you mean shadow?"),
    (f"type = 'shadow', {DOT}, widht = 1", "target.strokes[1]: has no key 'widht'; did you mean width?"),
    ("type = 'shadow'", "target.strokes[1]: got no shape, expected one of points, polygon"),
    ("type = 'blur', radius = 1, width = 1", "strokes[1].width: got 1.0, expected none but with points"),
    ("type = 'light', width = 1, points = [[0, 0], [1]]", "expected a list of 2 numbers at entry 1"),
    ("type = 'light', polygon = [[0, 0], [1, 1]]", "at least 3"),
    ("type = 'light', ellipse = [0, 0, 1]", "ellipse: got [0, 0, 1], expected [cx, cy, rx, ry] or"),
    (
        "type = 'light', rectangle = [1, 0, 0, 1]",
        "rectangle: got [1, 0, 0, 1], expected [x0, y0, x1, y1] with",
    ),
    (f"type = 'light', {DOT}, color = [1, -1, 1]", "target.strokes[1].color: got [1, -1, 1], expected"),
    (f"type = 'light', {DOT}, color = '#ffd9a'", "[r, g, b], or a colour such as"),
    (f"type = 'shadow', {DOT}, opacity = 2", "target.strokes[1].opacity: got 2, expected"),
    (f"type = 'shadow', {DOT}, units = 'pixel'", "units: got 'pixel', expected one of fraction, pixels; did"),
    ("type = 'temperature'", "target.strokes[1].kelvin: got none, expected a number"),
])  # fmt: skip
def test_a_stroke_that_cannot_be_understood_is_refused_by_name(stroke, says):
    both = f"[{{type = 'contrast', amount = 1.2}}, {{{stroke}}}]"
    message = refused(f"[target]\nkind = 'strokes'\nstrokes = {both}")
    assert says in message and message.startswith("a.toml: target.strokes[1]")


def test_strokes_and_the_kind_of_target_go_together():
    assert "target.strokes: got none, expected at least one" in refused("[target]\nkind = 'strokes'")
    contrast = "strokes = [{type = 'contrast'}]"
    for kind, more in (("envmap", ""), ("image", "file = 'a.png'")):
        message = refused(f"[target]\nkind = '{kind}'\n{more}\n{contrast}")
        assert "target.strokes: got 1, expected none" in message and 'target.kind = "strokes"' in message
    assert "target.file" in refused(f"[target]\nkind = 'strokes'\nfile = 'a.exr'\n{contrast}")
    assert "--set" in refused("", "target.strokes=[{type = 'blur'}]")


def test_an_override_replaces_strokes_of_the_file_that_are_refused():
    text = "[target]\nkind = 'strokes'\nstrokes = [{type = 'blurr'}]"
    found = cfg.loads(text, overrides=["target.strokes=[{type = 'contrast'}]"])
    assert found.target.strokes[0]["type"] == "contrast"
    assert "target.strokes[0].type" in refused(text, "target.kind=strokes")


def test_strokes_come_back_from_toml_equal_and_paint_the_same(rng):
    config = cfg.from_dict({"target": {"kind": "strokes", "strokes": ALL, "tonemap": "srgb"}})
    again = cfg.loads(cfg.to_toml(config), base_dir="/elsewhere", name="other.toml")
    assert again.target == config.target and StrokeList()(config.target.strokes) == config.target.strokes
    assert {s["type"] for s in config.target.strokes} == STROKES.keys()
    picture = rng.random((32, 32, 3)).astype(np.float32)
    one, other = (strokes.paint(picture, them, "srgb").picture for them in (ALL, again.target.strokes))
    np.testing.assert_array_equal(one, other)


def test_what_is_held_still_counts_as_painted_and_keeps_its_bits(rng):
    picture = rng.random((16, 16, 3)).astype(np.float32)
    done = strokes.paint(picture, [{"type": "hold", "rectangle": [0.25, 0.25, 0.75, 0.5]}])
    np.testing.assert_array_equal(done.picture, picture)
    assert done.coverage[4:8, 4:12].min() == 1 and done.coverage.sum() == 32


# ---- the edits that come ready -----------------------------------------------------------------------------
@pytest.mark.parametrize("name", sorted(file.stem for file in EDITS.iterdir()))
def test_the_edits_that_come_ready_paint_something(name, rng):
    config = cfg.load(EDITS / f"{name}.toml")
    assert config.target.kind == "strokes" and config.input.envmap == "auto" and config.preset == "standard"
    assert cfg.loads(cfg.to_toml(config), base_dir="/elsewhere", name="b.toml") == config
    picture = (0.2 + 0.1 * rng.random((128, 128, 3))).astype(np.float32)
    found = strokes.paint(picture, config.target.strokes, config.target.display_tonemap)
    assert not found.warnings
    change = np.abs(tonemap(found.picture) - tonemap(picture)).max(axis=2)
    assert found.coverage.mean() > 0.003 and (found.coverage.mean() == 1) == (name == "warmer")
    assert change[found.coverage[..., 0] > 0].mean() > 0.01
    assert (EDITS / f"{name}.toml").read_text().startswith("# ")
