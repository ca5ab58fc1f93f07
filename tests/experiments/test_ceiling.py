"""What the true map itself scores: the noise of two renderings of it."""

import numpy as np
import pytest

from envedit import config
from envedit.images import images
from experiments.ceiling import experiment as ceiling


@pytest.mark.slow
def test_the_ceiling_is_the_noise_of_two_renderings(tmp_path):
    sun = np.full((8, 16, 3), 0.2, np.float32)
    sun[2, 5] = 2000.0
    found = {}
    for name, content in {"clear": sun, "grey": np.full_like(sun, 0.4), "night": 0 * sun}.items():
        images.write_exr(tmp_path / f"{name}.exr", content)
        tables = {
            "input": {"envmap": str(tmp_path / f"{name}.exr")},
            "scene": {"file": "statue", "width": 16, "parameters": {"roughness": 0.0}},
            "target": {"rotate_degrees": 60},
        }
        found[name] = ceiling.twice(config.from_dict(tables), tmp_path)
    assert 20 < found["clear"]["psnr"] < found["grey"]["psnr"] < 80  # caustics of the sun
    assert (found["night"]["psnr"], found["night"]["ssim"]) == (200.0, 1.0)


def test_edits_are_counted_that_are_under_the_true_map():
    rows = [
        {"scene": "sphere", "psnr": 40.0, "ssim": 0.9, "edit": 40.0 + over, "over": over}
        for over in (-1.0, 1.0)
    ]
    line = ceiling.EXPERIMENT.summary(rows).splitlines()[-1]
    assert line == "| sphere | 2 | 40.00 | 0.900 | 40.00 | +0.00 | -1.00 | 1 |"
    unknown = rows[0] | {"edit": None, "over": None}
    assert ceiling.EXPERIMENT.summary([unknown]).endswith("| sphere | 1 | 40.00 | 0.900 | - | - | - | 0 |")
