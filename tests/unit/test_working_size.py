"""The size at which an edit is solved, and the target at that size."""

from dataclasses import replace

import numpy as np
import pytest

import envedit
from envedit import config
from envedit.images import images
from envedit.scene import scene
from envedit.targets import pixel_weights, target, working_size
from tests.oracles.builders import LIGHT, write_scene

pytestmark = pytest.mark.usefixtures("own_core")

SKY = envedit.sunsky(32)
SQUARE = {"type": "shadow", "amount": 0.6, "rectangle": [0.25, 0.5, 0.75, 1.0], "softness": 0.0}


def settings(**tables):
    return config.from_dict({"scene": {"file": "sphere", "width": 24}, "renderer": {"pixels": 150}} | tables)


@pytest.mark.parametrize(("tables", "most"), [
    ({}, working_size.PIXELS),
    ({"target": {"kind": "image", "file": "a.exr"}}, working_size.PAINTED_PIXELS),
    ({"target": {"kind": "image", "file": "a.exr"}, "renderer": {"pixels": 100}}, 100),
    ({"renderer": {"pixels": 100}, "representation": {"kind": "pixels"}}, 100),
    ({"representation": {"kind": "siren"}}, None),
    ({"optimizer": {"kind": "adam"}}, None),
    ({"renderer": {"kind": "path"}}, None),
    ({"representation": {"cycles": 12}}, working_size.PIXELS),
    ({"representation": {"cycles": 48}}, None),
])  # fmt: skip
def test_only_gauss_newton_is_solved_on_fewer_pixels_unless_they_are_asked_for(tables, most):
    made = config.from_dict(tables)
    assert working_size.most_pixels(made, made.target.painted) == most


def test_a_large_film_is_made_smaller_and_keeps_its_aspect():
    lit = scene.load("sphere", 48, 24)
    for pixels, size in ((1 << 20, (48, 24)), (700, (48, 24)), (288, (24, 12)), (70, (12, 6))):
        small = working_size.smaller(settings(renderer={"pixels": pixels}), lit)
        assert (small.width, small.height) == size and (small is lit) == (size == (48, 24))


def test_a_crop_is_made_smaller_and_what_takes_no_other_size_stays_as_it_is(tmp_path):
    crop = '<film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="48"/>'
    crop += '<integer name="crop_width" value="40"/><integer name="crop_height" value="40"/></film>'
    sensor = f'<sensor type="perspective"><float name="fov" value="40"/>{crop}</sensor>'
    cropped = scene.load(write_scene(tmp_path, sensor, '<shape type="sphere"/>', LIGHT, name="crop.xml"))
    loaded = scene.load("sphere", 48)
    built = envedit.load_scene(loaded.mi)
    small = settings(renderer={"pixels": 100})
    assert working_size.smaller(small, cropped).width == 10
    assert working_size.smaller(small, built) is built


def test_views_are_scaled_each_by_itself(rng):
    lit = scene.load("sphere", 8)
    of = replace(lit, views=(scene.View("a", slice(0, 4)), scene.View("b", slice(4, 12))))
    to = replace(of, width=4, views=(scene.View("a", slice(0, 2)), scene.View("b", slice(2, 6))))
    image = rng.random((12, 8, 3)).astype(np.float32)
    blocks = image.reshape(6, 2, 4, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(working_size.at_size(image, of, to), blocks, rtol=1e-6)
    assert np.array_equal(working_size.at_size(blocks, to, of), blocks.repeat(2, axis=0).repeat(2, axis=1))


def targets(asked, lit):
    wanted = target.make(asked, lit, SKY)
    return wanted, working_size.worked_on(asked, lit, working_size.smaller(asked, lit), SKY, wanted)


@pytest.mark.slow
def test_a_rendered_target_is_rendered_on_the_smaller_film():
    asked = settings(target={"rotate_degrees": 90.0, "spp": 64})
    wanted, found = targets(asked, scene.load("sphere", 24))
    assert found.picture.shape == (12, 12, 3) and found.envmap is wanted.envmap and (found.weight == 1).all()
    blocks = wanted.picture.reshape(12, 2, 12, 2, 3).mean(axis=(1, 3))
    assert np.abs(found.picture - blocks).mean() < 0.1 * blocks.mean()


@pytest.mark.slow
def test_a_picture_of_the_scene_is_made_smaller_and_less_noisy(tmp_path):
    """Its samples are those of its pixels, four times as many a pixel; a mask stays beside it."""
    lit = scene.load("sphere", 48)
    picture = lit.render(np.roll(SKY, 9, axis=1), spp=16, seed=5)
    images.write_exr(tmp_path / "a.exr", picture, panorama=False)
    asked = settings(scene={"file": "sphere", "width": 48}, renderer={"pixels": 600})
    asked = replace(asked, target=config.Target(kind="rendering", file=str(tmp_path / "a.exr"), spp=16))
    wanted, found = targets(asked, lit)
    blocks = picture.reshape(24, 2, 24, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(found.picture, blocks, rtol=1e-5)
    assert (found.weight == 1).all() and found.coverage is None and found.noise.shape == (24, 24)
    assert 2 * wanted.spp < found.spp < 8 * wanted.spp and found.noise.max() < 0.8 * wanted.noise.max()


@pytest.mark.slow
def test_paint_keeps_its_change_and_its_weight():
    asked = settings(target={"kind": "strokes", "strokes": [SQUARE], "spp": 64})
    wanted, found = targets(asked, scene.load("sphere", 24))
    averaged, before = (
        one.reshape(12, 2, 12, 2, 3).mean(axis=(1, 3)) for one in (wanted.picture, wanted.initial)
    )
    np.testing.assert_allclose(found.picture, found.initial * averaged / before, rtol=1e-5)  # a shadow
    assert found.coverage.mean() == pytest.approx(wanted.coverage.mean(), rel=1e-5)
    for one in (wanted, found):
        paint = float((one.weight * (one.coverage > 0.5)).sum() / one.weight.sum())
        assert paint == pytest.approx(1 / (1 + pixel_weights.FOLLOWING), abs=0.02)


@pytest.mark.slow
def test_an_edit_on_fewer_pixels_is_judged_at_full_size():
    """Nearly as good as one on all of them; what is shown has the size of the film."""
    tables = {"input": {"width": 32}, "scene": {"file": "sphere", "width": 48}, "output": {"spp": 64}}
    tables |= {"target": {"rotate_degrees": 60.0, "spp": 64}, "representation": {"turn": False}}
    sizes = [{"renderer": {"pixels": pixels}} for pixels in (24 * 24, 48 * 48)]
    fewer, all_of_them = (envedit.edit(tables | size, envmap=envedit.sunsky(32)) for size in sizes)
    assert "solved on a picture of 24x24 pixels" in fewer.notes
    assert not any("solved on" in note for note in all_of_them.notes)
    assert {picture.shape for picture in fewer.renders.values()} == {(48, 48, 3)}
    psnr = [one.metrics["render"]["psnr"] for one in (fewer, all_of_them)]
    assert psnr[0] > psnr[1] - 3, psnr
    # Of the map fewer pixels tell less: where in its texel the sun is.
    assert fewer.metrics["envmap"]["psnr"] > fewer.metrics["initial_envmap"]["psnr"] + 3
    assert fewer.metrics["render"]["psnr"] > fewer.metrics["initial"]["psnr"] + 10
