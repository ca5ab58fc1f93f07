"""Targets: rendered under a known map, painted as a picture, or painted by strokes."""

from dataclasses import replace

import numpy as np
import pytest

from envedit import config
from envedit.core import latlong
from envedit.core.color import tonemap
from envedit.core.errors import ConfigError, InputError
from envedit.core.seeds import Seeds
from envedit.images import images
from envedit.inputs import Replacements
from envedit.scene import scene
from envedit.targets import initial_rendering, pixel_weights, target
from tests.oracles.builders import BALL, LIGHT, SENSOR, floats, png, sky, write_scene
from tests.oracles.users_scenes import HIDDEN

SIZE = (12, 16)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return scene.load(write_scene(tmp_path_factory.mktemp("scene"), SENSOR, BALL, LIGHT))


def asking(seed=0, repair=False, **kwargs):
    return config.Config(seed=seed, input=config.Input(repair=repair), target=config.Target(spp=4, **kwargs))


# ---- rendered under a known map --------------------------------------------------------------------------
def test_turned_target_is_the_rendering_of_the_turned_map(ball, rng):
    envmap = sky(rng)
    made = target.make(asking(5, rotate_degrees=40), ball, envmap)
    np.testing.assert_array_equal(made.envmap, latlong.rotate(envmap, 40).astype(np.float32))
    expected = ball.render(made.envmap, spp=4, seed=Seeds(5).target)
    np.testing.assert_array_equal(made.picture, expected)
    assert made.picture.shape == (12, 16, 3) and made.picture.dtype == made.envmap.dtype == np.float32
    assert (made.weight == 1).all() and made.warnings == () and "40 degrees" in made.source


def test_noise_is_that_of_as_many_samples_as_were_taken(ball, rng):
    """Against the difference from a rendering almost without noise; display values, mean over pixels."""
    envmap = sky(rng) + 0.1
    made = target.make(asking(rotate_degrees=0), ball, envmap)
    shown, true = (np.clip(p, 0, 1) ** (1 / 2.2) for p in (made.picture, ball.render(envmap, spp=1024)))
    assert made.spp == 4 and made.noise.shape == SIZE
    ratio = np.mean(made.noise**2) / np.mean((shown - true) ** 2)
    assert 0.5 < ratio < 2


def test_another_map_is_read_at_the_working_width(ball, tmp_path, rng):
    other = sky(rng, 16, 32)
    other[0, 0, 0] = -1
    file = floats(tmp_path / "other.exr", other)
    made = target.make(asking(1, file=str(file)), ball, sky(rng))
    expected, info = images.load_envmap(file, 16)
    np.testing.assert_array_equal(made.envmap, expected)
    np.testing.assert_array_equal(made.picture, ball.render(expected, spp=4, seed=Seeds(1).target))
    assert str(file) in made.source
    assert made.warnings == tuple(f"{file}: {line}" for line in info["warnings"])
    assert "negative" in made.warnings[0]


def test_a_map_that_is_not_finite_is_refused_or_repaired(ball, tmp_path, rng):
    other = sky(rng)
    other[3, 4] = np.nan
    file = str(floats(tmp_path / "other.exr", other))
    with pytest.raises(InputError, match=r"other\.exr.*row 3, column 4"):
        target.make(asking(file=file), ball, sky(rng))
    made = target.make(asking(file=file, repair=True), ball, sky(rng))
    assert np.isfinite(made.picture).all() and np.isfinite(made.envmap).all()


def test_a_target_that_is_largely_white_is_warned_of(ball, rng):
    """More than a tenth of the pixels of this film see the sky beside the ball."""
    for factor, curve, warned in ((1, "gamma", False), (100, "gamma", True), (100, "reinhard", False)):
        settings = asking(rotate_degrees=60)
        settings = replace(settings, output=replace(settings.output, tonemap=curve))
        made = target.make(settings, ball, factor * (sky(rng) + 0.2) / 4)
        assert bool(made.warnings) == warned
        white = (tonemap(made.picture, curve) >= 1).all(axis=2).mean()
        assert not warned or f"target: {100 * white:.3g} % of its pixels are white" in made.warnings[0]


def test_mask_counts_for_a_rendered_target_too(ball, tmp_path, rng):
    values = np.zeros((*SIZE, 3), np.uint8)
    values[:6] = 255
    settings = asking(rotate_degrees=30, mask=str(png(tmp_path / "m.png", values)))
    made = target.make(settings, ball, sky(rng))
    np.testing.assert_array_equal(made.weight[..., 0], values[..., 0] / 255)


# ---- painted ---------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def seen(ball):
    envmap = sky(np.random.default_rng(3))
    return envmap, initial_rendering.initial(ball, envmap, asking())


def a_stroke(**kwargs):
    return {"type": "shadow", "rectangle": [0.25, 0.25, 0.75, 0.75], "amount": 0.5, **kwargs}


def test_strokes_lie_on_the_initial_rendering_and_beside_it_are_refused(ball, seen):
    envmap, initial = seen
    made = target.make(asking(kind="strokes", strokes=(a_stroke(),)), ball, envmap)
    np.testing.assert_array_equal(made.initial, initial)
    np.testing.assert_allclose(made.picture[3:9, 4:12], 0.5 * initial[3:9, 4:12], rtol=1e-6)
    np.testing.assert_array_equal(made.picture[:3], initial[:3])
    assert made.envmap is None and made.asked == () and "1 stroke on" in made.source
    says = r"target\.strokes\[0\] \(shadow\): lies outside .*; target\.strokes\[1\] \(shadow\): opacity 0"
    with pytest.raises(ConfigError, match=says):
        nothing = a_stroke(rectangle=[3, 3, 4, 4]), a_stroke(opacity=0)
        target.make(asking(kind="strokes", strokes=nothing), ball, seen[0])


def test_an_array_asks_what_its_file_would(ball, seen, tmp_path):
    envmap, initial = seen
    picture = initial.copy()
    picture[2:5, 3:9] *= 2
    file = floats(tmp_path / "painted.exr", picture)
    from_file = target.make(asking(kind="image", file=str(file), rotate_degrees=0), ball, envmap)
    from_array = target.make(asking(), ball, envmap, Replacements(target=picture))
    np.testing.assert_array_equal(from_array.picture, from_file.picture)
    np.testing.assert_array_equal(from_array.weight, from_file.weight)
    assert from_array.coverage.sum() == 3 * 6


def test_a_painted_picture_is_read_as_it_was_exported(ball, seen, tmp_path):
    """Under Reinhard, as gamma would clip, though no file says so; another map width is refused."""
    envmap, initial = 40 * seen[0], 40 * seen[1]
    file, exported = tmp_path / "paint.png", asking(kind="image", file=str(tmp_path / "paint.png"))
    initial_rendering.export(file, initial, exported)
    display, _ = images.read_stored(file)
    display[3:9, 4:12] = display[3:9, 4:12] * 0.5
    png(file, display)
    narrow = replace(exported, input=config.Input(width=32))
    with pytest.raises(InputError, match="exported with input.width 256, where this run has 32"):
        target.make(narrow, ball, envmap)
    (tmp_path / "paint.png.envedit.json").unlink()
    for settings in (exported, narrow):
        made = target.make(settings, ball, envmap)
        shown = tonemap(made.picture, "reinhard")[3:9, 4:12] * 65535
        np.testing.assert_allclose(shown, display[3:9, 4:12], atol=1)
        assert made.coverage.sum() == 6 * 8
        assert all("are white under the tonemap" in line for line in made.warnings), made.warnings


def test_mask_of_an_array_overrides_what_is_seen(ball, seen):
    envmap, initial = seen
    mask = np.zeros(SIZE)
    mask[:2] = 0.5
    made = target.make(asking(), ball, envmap, Replacements(target=2 * initial, mask=mask))
    np.testing.assert_array_equal(made.coverage[..., 0], mask)
    np.testing.assert_array_equal(made.picture[2:], initial[2:])
    np.testing.assert_allclose(made.picture[:2], 2 * initial[:2], rtol=1e-6)


@pytest.mark.parametrize(("picture", "mask", "says"), [
    (np.ones((3, 4, 3)), None, "shape"),
    (np.full((*SIZE, 3), np.nan), None, "not finite"),
    (np.ones((*SIZE, 3)), np.ones((4, 4)), "mask"),
    (np.ones((*SIZE, 3)), np.full(SIZE, np.inf), "mask.*not finite"),
    (np.ones((*SIZE, 3)), np.zeros(SIZE), "nothing"),
])  # fmt: skip
def test_arrays_that_cannot_be_used(ball, seen, picture, mask, says):
    with pytest.raises(InputError, match=says):
        target.make(asking(), ball, seen[0], Replacements(target=picture, mask=mask))


# ---- a picture of the scene under other light -----------------------------------------------------------
@pytest.fixture(scope="module")
def pictured(ball):
    """A map, and the scene's picture under another one, within what a display shows."""
    rng = np.random.default_rng(4)
    envmap, other = sky(rng) + 0.2, sky(rng) + 0.2
    return 0.1 * envmap, np.minimum(ball.render(0.1 * other, spp=64, seed=11), 0.95)


def shown_as_srgb(picture):
    low = picture <= 0.0031308
    return np.round(255 * np.where(low, 12.92 * picture, 1.055 * picture ** (1 / 2.4) - 0.055)).astype("u1")


def of_a_picture(ball, pictured, **kwargs):
    made = target.make(asking(kind="rendering", **kwargs), ball, pictured[0])
    assert made.envmap is None and made.initial is None and made.coverage is None
    assert made.spp >= 1 and made.noise.shape == SIZE and made.noise.min() > 0
    assert made.source.startswith("a picture of the scene") and "samples a pixel" in made.source
    return made


def test_a_picture_of_the_scene_is_read_as_linear_radiance(ball, pictured, tmp_path):
    """From OpenEXR as it is, from a PNG that says nothing as sRGB, from an array likewise linear."""
    envmap, picture = pictured
    made = of_a_picture(ball, pictured, file=str(floats(tmp_path / "a.exr", picture)))
    np.testing.assert_array_equal(made.picture, picture)
    assert (made.weight == 1).all() and made.warnings == () and len(made.asked) == 1
    srgb = of_a_picture(ball, pictured, file=str(png(tmp_path / "a.png", shown_as_srgb(picture))))
    step = np.maximum(picture, 0.1) ** (1 - 1 / 2.4) / 255  # a step of 8 bits, and more
    assert (np.abs(srgb.picture - picture) < 1.5 * step).all() and (srgb.weight == 1).all()
    named = of_a_picture(ball, pictured, file=str(tmp_path / "a.png"), tonemap="gamma")
    np.testing.assert_allclose(named.picture, (shown_as_srgb(picture) / 255) ** 2.2, rtol=1e-4)
    with pytest.raises(ConfigError, match="expected the picture of the scene"):
        target.make(asking(kind="rendering"), ball, envmap)
    array = target.make(asking(kind="rendering"), ball, envmap, Replacements(target=picture))
    np.testing.assert_array_equal(array.picture, picture)
    assert "given as an array" in array.source and (array.weight == 1).all()


def test_pixels_of_a_picture_that_are_clipped_or_masked_do_not_count(ball, pictured, tmp_path):
    envmap, picture = pictured
    values, mask = shown_as_srgb(picture), np.zeros((*SIZE, 3), np.uint8)
    values[2, 3:5], mask[1:7] = 255, 255
    file, masked = (str(png(tmp_path / name, v)) for name, v in (("a.png", values), ("m.png", mask)))
    clipped = of_a_picture(ball, pictured, file=file)
    known = clipped.known_weight
    assert not known[2, 3:5].any() and known.sum() == SIZE[0] * SIZE[1] - 2
    # But as lower bounds.
    assert clipped.clipped[2, 3:5].all() and clipped.clipped.sum() == 6 and (clipped.weight == 1).all()
    both = of_a_picture(ball, pictured, file=file, mask=masked)
    assert both.known_weight.sum() == 6 * SIZE[1] - 2 and not both.known_weight[7:].any()
    assert both.weight[1:7].all() and not both.weight[7:].any()
    asked = asking(kind="rendering", file=images.ARRAY)
    array = target.make(asked, ball, envmap, Replacements(target=picture, mask=mask[..., 0] / 255))
    assert array.weight.sum() == 6 * SIZE[1] and len(array.asked) == 2
    mask[1:7], mask[2, 3:5] = 0, 255
    png(tmp_path / "m.png", mask)
    with pytest.raises(InputError, match=r"a\.png: all .* is clipped"):
        of_a_picture(ball, pictured, file=file, mask=masked)


def test_a_file_of_a_target_map_that_is_no_panorama_is_a_picture(ball, pictured, tmp_path):
    """A map is 2:1; the source says what the file was taken for."""
    file = str(floats(tmp_path / "a.exr", pictured[1]))
    made = target.make(asking(file=file), ball, pictured[0])
    assert made.envmap is None and "not 2:1" in made.source
    np.testing.assert_array_equal(made.picture, of_a_picture(ball, pictured, file=file).picture)
    with pytest.raises(InputError, match=r"b\.exr"):  # 4:3 as the film, of another aspect than it
        target.make(asking(file=str(floats(tmp_path / "b.exr", pictured[1][:, :10]))), ball, pictured[0])


def test_a_target_of_2_to_1_is_a_map_with_a_warning_where_it_has_the_size_of_the_rendering(tmp_path, rng):
    sensor = SENSOR.replace('"height" value="12"', '"height" value="8"')
    wide = scene.load(write_scene(tmp_path, sensor, BALL, LIGHT))
    maps = [floats(tmp_path / f"{width}.exr", rng.random((width // 2, width, 3))) for width in (16, 32)]
    made = [target.make(asking(file=str(file)), wide, sky(rng)) for file in maps]
    assert all(one.envmap is not None for one in made)
    assert not any("read as a map" in line for line in made[1].warnings)
    assert "16.exr: is 2:1 and read as a map" in made[0].warnings[-1]
    assert 'target.kind = "rendering"' in made[0].warnings[-1]


@pytest.mark.slow
def test_a_painted_image_that_was_rendered_anew_is_solved_as_a_rendering(tmp_path, rng):
    """And one that was painted all over the rendering is not; a mask says that it was painted."""
    lit = scene.load("sphere", 48)
    envmap = 0.2 * (sky(rng, 16, 32) + 0.05)
    asked = {"kind": "image", "file": str(tmp_path / "a.exr")}
    initial = initial_rendering.initial(lit, envmap, asking())
    floats(tmp_path / "a.exr", lit.render(np.roll(envmap, 9, axis=1), spp=16, seed=5))
    anew = target.make(asking(**asked), lit, envmap)
    assert anew.coverage is None and anew.noise is not None and "solved as a rendering" in anew.source
    white = np.full((48, 48, 3), 255, np.uint8)
    masked = target.make(asking(**asked, mask=str(png(tmp_path / "m.png", white))), lit, envmap)
    assert masked.coverage.all() and masked.noise is None
    floats(tmp_path / "a.exr", 0.7 * initial)
    painted = target.make(asking(**asked), lit, envmap)
    assert painted.coverage.mean() > 0.9 and painted.noise is None and "painted" in painted.source


def test_every_view_of_a_picture_of_the_scene_may_have_its_file(ball, pictured, tmp_path):
    """Views without one do not count."""
    views = (scene.View("left", slice(0, 6)), scene.View("right", slice(6, 12)))
    lit = replace(ball, views=views)
    file = str(floats(tmp_path / "right.exr", pictured[1][6:]))
    made = target.make(asking(kind="rendering", file=(file,), view=("right",)), lit, pictured[0])
    np.testing.assert_array_equal(made.picture[6:], pictured[1][6:])
    assert (made.weight[6:] == 1).all() and not made.weight[:6].any()


# ---- weights ---------------------------------------------------------------------------------------------
def test_paint_and_rest_have_their_weights_whatever_their_size():
    coverage = np.zeros((10, 10, 1))
    coverage[0, :2] = 1
    coverage[0, 2] = 0.5
    weight = pixel_weights.pixel_weight(coverage, np.zeros((10, 10), bool), paint=3, hold=1)
    assert weight.mean() == pytest.approx(1, rel=1e-6)
    shares = 3 * coverage / coverage.sum() + (1 - coverage) / (1 - coverage).sum()
    np.testing.assert_allclose(weight / weight.sum(), shares / 4, rtol=1e-5)


def test_what_tells_nothing_has_no_weight_and_a_target_without_any_is_refused():
    excluded = np.zeros((4, 5), bool)
    excluded[1] = True
    weight = pixel_weights.pixel_weight(np.ones((4, 5, 1)), excluded, paint=1, hold=1)
    assert not weight[1].any() and (weight[[0, 2, 3]] == weight[0, 0]).all()
    with pytest.raises(InputError, match="no pixel counts"):
        pixel_weights.pixel_weight(np.ones((4, 5, 1)), np.zeros((4, 5), bool), paint=0, hold=1)
    with pytest.raises(ConfigError, match=r"target\.paint"):
        asking(kind="strokes", strokes=(a_stroke(),), paint=0.0, hold=0.0)


# ---- pixels that see no surface ---------------------------------------------------------------------------
@pytest.mark.slow
def test_paint_beside_the_object_does_not_count(tmp_path, rng):
    """Of a scene that hides what lights it: weights are shared out among pixels that see a surface."""
    ball = scene.load(write_scene(tmp_path, HIDDEN, SENSOR, BALL, LIGHT))
    hidden = ball.alpha == 0
    assert 0.1 < hidden.mean() < 0.9
    stroke, envmap = {"type": "light", "amount": 2}, sky(rng)
    upper, corner = ({**stroke, "rectangle": [0, 0, *size]} for size in ((1, 0.5), (0.1, 0.1)))
    made = target.make(asking(kind="strokes", strokes=(upper,)), ball, envmap)
    assert not made.coverage[hidden].any() and made.coverage.any() and not made.weight[hidden].any()
    painted = made.coverage[..., 0] > 0
    wanted = pixel_weights.FOLLOWING * made.weight[painted].sum()
    assert made.weight[~painted].sum() == pytest.approx(wanted, rel=1e-5)
    held = made.held(1, 3)
    assert held.weight[~painted].sum() == pytest.approx(3 * held.weight[painted].sum(), rel=1e-5)
    with pytest.raises(InputError, match="no surface is seen"):
        target.make(asking(kind="strokes", strokes=(corner,)), ball, envmap)
    # A white backdrop is no lower bound of anything.
    file = str(png(tmp_path / "white.png", np.where(hidden[..., None], 255, 100).astype(np.uint8)))
    backed = target.make(asking(kind="rendering", file=file), ball, envmap)
    assert backed.clipped[hidden].all() and not backed.weight[hidden].any() and backed.weight[~hidden].all()


def test_what_is_asked_for_beside_a_rendering_is_asked_for_beside_that_of_the_transport():
    rendering = np.float32([[[0.5, 0.5, 0.5], [0.5, 0.0, 1e-30], [0.2, 0.2, 65504]]])
    picture = np.float32([[[0.1, 0.5, 0.75], [0.0, 0.3, 1e6], [0.2, 0.1, 65504]]])
    seen = np.float32([[[0.3, 0.4, 0.4], [0.2, 0.1, 0.0], [0.1, 0.4, 60000]]])
    asked = target.Target(picture, np.ones((1, 3, 1), np.float32), None, "")
    aim = asked.seen_as(seen, rendering).aim
    expected = [[[0.06, 0.4, 0.65], [0.0, 0.4, 1e6], [0.1, 0.2, 60000]]]
    assert np.allclose(aim, expected, rtol=1e-6), "less as a factor, more as a sum"
    assert np.array_equal(asked.seen_as(seen, picture).aim, seen), "nothing is asked for"
