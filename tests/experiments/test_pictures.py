"""The picture of plain Mitsuba that experiments/pictures gives as a target."""

import mitsuba as mi
import numpy as np
import pytest

import envedit
from envedit import config
from experiments.pictures.experiment import write_png


@pytest.mark.slow
def test_the_png_of_plain_mitsuba_is_the_rendering_of_envedit(tmp_path):
    envmap = envedit.sunsky(64, azimuth=200, elevation=35)
    settings = config.from_dict({"scene": {"file": "sphere", "width": 32, "scale": 0.5}})
    write_png(settings, tmp_path, envmap, tmp_path / "a.png")
    picture = np.array(mi.Bitmap(str(tmp_path / "a.png"))) / 255
    linear = mi.Bitmap(envedit.load_scene("sphere", width=32).render(envmap, spp=256, seed=1))
    expected = np.array(linear.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True)) / 255
    assert picture.shape == (32, 32, 3)
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), rtol=0.01)
    assert np.abs(picture - expected).mean() < 0.02
