"""Renderings: Mitsuba's own values, and the same bits with any number of threads."""

import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import NumericalError
from envedit.scene import film, scene
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene

pytestmark = pytest.mark.usefixtures("own_core")

BOX = '<rfilter type="box"/>'
WIDE = '<rfilter type="gaussian"/><boolean name="sample_border" value="true"/>'
CROP = "".join(
    f'<integer name="crop_{key}" value="{value}"/>'
    for key, value in {"offset_x": 3, "offset_y": 2, "width": 9, "height": 7}.items()
)
SIGNED = f'<rfilter type="lanczos"/>{CROP}'


def lit_by_a_sun(folder, rng, part, sampler="multijitter", size=None):
    sensor = SENSOR.replace(BOX, part)
    loaded = scene.load(write_scene(folder, sensor, BALL, LIGHT), size, sampler=sampler)
    sky = rng.random((16, 32, 3), dtype=np.float32)
    sky[3, 5] = 3000
    loaded.set_envmap(sky)
    return loaded, sky


@pytest.mark.parametrize("part", [BOX, WIDE, SIGNED], ids=["box", "wide", "signed"])
@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
def test_pixels_are_those_of_mitsuba_with_the_same_seed(part, sampler, tmp_path, rng):
    loaded, _ = lit_by_a_sun(tmp_path, rng, part, sampler)
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    for spp in (7, 36):
        ours = film.render(loaded.mi, integrator, spp, 5)
        theirs = np.array(mi.render(loaded.mi, integrator=integrator, spp=spp, seed=5))
        assert ours.shape == (loaded.height, loaded.width, 4) and theirs.shape == ours[..., :3].shape
        # Mitsuba's weights and sums are single precision: 1e-7 of the brightest sample near a pixel.
        np.testing.assert_allclose(ours[..., :3], theirs, rtol=1e-5, atol=3e-5 * theirs.mean())


@pytest.mark.slow
@pytest.mark.parametrize("part", [BOX, WIDE], ids=["box", "wide"])
def test_any_number_of_samples_gives_the_same_bits_on_any_number_of_threads(part, tmp_path, rng, threads):
    loaded, sky = lit_by_a_sun(tmp_path, rng, part, size=48)
    for spp in (1, 7, 64, 100, 144):
        found = []
        for count in (1, 2, 2, 3):
            threads(count)
            found.append(loaded.render(sky, spp, seed=2).tobytes())
        assert len(set(found)) == 1, spp
    assert loaded.render(sky, 7, seed=3).tobytes() != loaded.render(sky, 7, seed=2).tobytes()


def test_a_sample_that_is_not_finite_is_not_dropped(tmp_path, rng):
    loaded, sky = lit_by_a_sun(tmp_path, rng, BOX)
    loaded.params[_albedo(loaded)] = mi.Color3f(np.nan)
    loaded.params.update()
    with pytest.raises(NumericalError, match=r"pixels are not finite, the first at row \d+, column \d+"):
        loaded.render(sky, 16)


def _albedo(loaded):
    return next(key for key, _ in loaded.params if key.endswith("reflectance.value"))
