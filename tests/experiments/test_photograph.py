"""A ball that is put into a photograph: under its own light it is as rendered, under another it is not."""

import numpy as np
import pytest

import envedit
from envedit import config
from envedit.targets.photo import Camera
from experiments.photograph import insertion

pytestmark = pytest.mark.slow


def test_a_ball_under_the_photographs_own_light_is_exact(tmp_path, monkeypatch):
    monkeypatch.setattr(insertion, "SPP", 16)
    true, other = (envedit.sunsky(32, azimuth=azimuth, elevation=30) for azimuth in (150, 300))
    camera = Camera("filmic", np.log([1.5, 1.2, 0.8]))
    plate = insertion.Plate(config.Scene(file="sphere", width=24), true, camera, tmp_path)
    assert 0.005 < plate.outline.mean() < 0.1
    exposed_otherwise = 3 * true
    assert plate.inserted(exposed_otherwise, "filmic")["insertion RMSE"] < 1e-4
    worse = plate.inserted(other, "filmic")
    assert worse["insertion RMSE"] > 0.01 and worse["insertion SSIM"] < 0.98
