"""Three spheres of light estimation: the pictures, their ground truth, and measures worked out by hand."""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envedit.core import latlong
from experiments.light_estimation import experiment, port, protocol

TRUTH = Path(os.environ.get("ENVEDIT_DATA", ".")) / "evaluation" / "ground_truth" / "stylelight"


def picture(left, right=(0, 0, 0), alpha=1.0):
    """A picture of which the left half is the sphere: colours of its left and right half."""
    made = np.zeros((20, 40, 4))
    made[:, :10] = [*left, alpha]
    made[:, 10:20] = [*(right if any(right) else left), alpha]
    return made


def constant(value=1.0, height=9, width=16):
    return np.full((height, width, 3), value, np.float32)


def lights(*azimuths):
    return [{"azimuth": azimuth, "elevation": 0.0} for azimuth in azimuths]


# ---- Measures of pictures ----------------------------------------------------------------------------------


def test_errors_are_summed_over_channels_and_divided_by_pixels():
    """Squared errors 1 and 1 + 4, whose mean is 3; the best factor is 1; angles 0 and 90 degrees."""
    found = protocol.compared(picture((1, 0, 0), (0, 1, 0)), picture((2, 0, 0), (0, 0, 2)))
    assert found["rmse"] == pytest.approx(math.sqrt(3)) and found["si_rmse"] == pytest.approx(math.sqrt(3))
    assert found["angle"] == pytest.approx(45)


def test_one_factor_for_all_pixels():
    """(1, 1, 1) and (1, 1, 1) against 1 and 3 of gray: factor 2, errors 3 and 3 in both pixels."""
    found = protocol.compared(picture((1, 1, 1)), picture((1, 1, 1), (3, 3, 3)))
    assert found["rmse"] == pytest.approx(math.sqrt(6)) and found["si_rmse"] == pytest.approx(math.sqrt(3))
    assert found["angle"] == pytest.approx(0, abs=1e-5)


def test_each_picture_is_normalised_by_itself():
    """1 everywhere is 1; 2 and 4 are 1/2 and 1: an error of 3/4 in half of the pixels."""
    found = protocol.compared(picture((1, 1, 1)), picture((2, 2, 2), (4, 4, 4)))
    assert found["normalised"] == pytest.approx(math.sqrt(0.375))
    assert protocol.compared(picture((1, 2, 3)), picture((5, 10, 15)))["normalised"] == pytest.approx(0)


def test_one_colour_differs_by_its_factor_alone():
    found = protocol.compared(picture((1, 2, 3)), picture((3, 6, 9)))
    assert found["rmse"] == pytest.approx(math.sqrt(56))
    assert found["si_rmse"] == pytest.approx(0, abs=1e-6) and found["angle"] == pytest.approx(0, abs=1e-5)


def test_a_black_picture_has_the_error_of_the_true_one_and_no_angle():
    black = picture((0, 0, 0))
    found = protocol.compared(black, picture((1, 1, 1)))
    assert [found[key] for key in ("rmse", "si_rmse", "normalised")] == pytest.approx([math.sqrt(3)] * 3)
    assert math.isnan(found["angle"])
    assert protocol.compared(black, black)["rmse"] == 0


# ---- Measures of maps --------------------------------------------------------------------------------------


def test_angle_between_brightest_directions():
    found, true = constant(), constant()
    found[4, 0], true[4, 4] = 2, 3  # a quarter of the horizon
    assert protocol.peak_error(found, true) == pytest.approx(90)
    true[0, 7] = 9  # the zenith
    assert protocol.peak_error(found, true) == pytest.approx(90) and protocol.peak_error(true, true) == 0
    assert math.isnan(protocol.peak_error(constant(), true))
    assert math.isnan(protocol.peak_error(true, constant(0)))


def test_lights_are_compared_both_ways_and_at_most_five():
    assert protocol.lights_error(lights(0), lights(0, 90)) == pytest.approx(22.5)
    assert protocol.lights_error(lights(0, 90), lights(0)) == pytest.approx(22.5)
    assert protocol.lights_error(lights(0), lights(0, 90, 180)) == pytest.approx(22.5)
    six = lights(0, 10, 20, 30, 40, 50)
    assert protocol.lights_error(six, lights(0, 10, 20, 30, 40, 180)) == pytest.approx(0, abs=1e-5)
    assert math.isnan(protocol.lights_error([], six)) and math.isnan(protocol.lights_error(six, []))


def test_irradiance_in_stops_on_six_planes():
    assert protocol.irradiance_error(constant(2), constant()) == pytest.approx([1] * 6)
    sky = constant(1, 129, 64)
    sky[:64] = 3  # the upper half, without the horizon: a vertical plane receives 2 of 1
    expected = [1, 1, math.log2(3), 0, 1, 1]
    assert protocol.irradiance_error(sky, constant(1, 129, 64)) == pytest.approx(expected, abs=0.02)
    black = constant(0)
    assert (protocol.irradiance_error(black, black) == 0).all()
    assert (protocol.irradiance_error(black, constant()) == -math.inf).all()


# ---- Pictures ----------------------------------------------------------------------------------------------


def test_the_median_of_positive_values_becomes_a_half():
    envmap = np.zeros((128, 256, 3), np.float32)
    envmap[:64] = [1, 2**2.4, 3**2.4]
    assert protocol.tonemapped(envmap)[0, 0] == pytest.approx([0.25, 0.5, 0.75])
    assert protocol.tonemapped(constant(7)).shape == (128, 256, 3)
    assert protocol.tonemapped(constant(7)) == pytest.approx(np.full((128, 256, 3), 0.5))
    assert not protocol.tonemapped(constant(0)).any()


@pytest.fixture
def mirror():
    return protocol.SPHERES["mirror"]


@pytest.mark.slow
def test_a_constant_map_gives_the_reflectance(mirror):
    for sphere in (mirror, protocol.SPHERES["matte silver"]):
        found = protocol.render(replace(sphere, samples=8), constant(0.5))
        height, width = len(found) // 2, found.shape[1] // 2
        assert found.shape == (540 // sphere.reduction, 960 // sphere.reduction, 4)
        assert found[height, width] == pytest.approx([0.4, 0.4, 0.4, 1], rel=0.02)
        assert not found[0, 0].any()
    area = math.pi * (85 / 36 * 960 * math.tan(math.asin(protocol.RADIUS / math.sqrt(260)))) ** 2
    assert protocol.render(mirror, constant())[..., 3].sum() == pytest.approx(area, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "direction, side",
    [((0, -1, 0), (0, 0)), ((1, 0, 0), (1, 0)), ((-1, 0, 0), (-1, 0)), ((0, 0, 1), (0, 1))],
    ids=["towards the camera", "right", "left", "above"],
)
def test_directions_of_blender_are_where_its_camera_sees_them(direction, side, mirror):
    """Blender: +z is up, u = 1/2 - atan2(y, x) / 2 pi, v = 1/2 - asin(z) / pi; the camera looks along +y."""
    x, y, z = direction
    column = (0.5 - math.atan2(y, x) / (2 * math.pi)) % 1 * 64
    lit = constant(0, 33, 64)
    lit[round((0.5 - math.asin(z) / math.pi) * 32), [int(column) - 1, int(column)]] = 1
    if z:
        lit[0] = 1
    found = protocol.render(mirror, lit)[..., 0]
    down, right = (np.argwhere(found > found.max() / 2) - [269.5, 479.5]).mean(axis=0) / 140
    # A mirror that faces halfway between the camera and a direction at 90 degrees is at sin(45 degrees).
    assert (right, -down) == pytest.approx(np.multiply(side, math.sqrt(0.5)), abs=0.13)


@pytest.mark.slow
def test_a_map_is_read_off_its_mirror(mirror):
    height, width = port.HEIGHT, port.WIDTH
    expected = 1 + 0.5 * latlong.directions(height, width).astype(np.float32)
    found = port.read_off(protocol.render(mirror, expected))
    behind = latlong.directions(height, width) @ (-protocol.CAMERA / np.linalg.norm(protocol.CAMERA)) > 0.9
    assert np.abs(found - expected)[~behind].mean() < 0.002


@pytest.mark.skipif(not TRUTH.is_dir(), reason="ENVEDIT_DATA has no evaluation/ground_truth/stylelight")
def test_spheres_are_those_of_the_ground_truth(monkeypatch):
    """RMSE .042, .060 and .231 of the page, at a sixteenth of its samples."""
    few = {name: replace(s, samples=max(1, s.samples // 16)) for name, s in protocol.SPHERES.items()}
    monkeypatch.setattr(protocol, "SPHERES", few)
    monkeypatch.setattr(port, "BLEND", {})
    found = port.compare(None, Path())
    assert [values["ratio"] for values in found.values()] == pytest.approx([1, 1, 1], abs=0.012)
    for name, most in {"diffuse": 0.15, "matte silver": 0.13, "mirror": 0.25}.items():
        assert found[name]["rmse"] < most and found[name]["angle"] < 0.75


# ---- Tables ------------------------------------------------------------------------------------------------


def test_our_rows_stand_beside_the_published_ones():
    keys = [f"{name} {key}" for name in protocol.SPHERES for key in experiment.PICTURES]
    row = {f"{kind} {key}": 0.125 for kind in ("edited", "unedited") for key in [*keys, *experiment.MAPS]}
    rows = [row | {"edited peak": 4.0}, row | {"edited peak": float("nan"), "unedited peak": float("nan")}]
    rows[0]["unedited peak"] = None
    text = experiment.summary(rows).splitlines()
    assert text[2].startswith("| edited, 2 maps | 0.125 / 0.125 / 0.125 |")
    assert "| - | 0.14 / 0.45 / 0.66 | - | 2.14 / 3.60 / 4.29 |" in text[4]
    assert text[-2].startswith("| edited | 4.00 (4.00), of 1 | 0.12 (0.12) |")
    assert text[-1].startswith("| unedited | - | 0.12 (0.12) |")
