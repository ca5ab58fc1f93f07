"""A picture whose light differs is laid on the outlines of a rendering."""

import numpy as np
import pytest

from envedit.targets import alignment
from envedit.targets.alignment import Placement

HEIGHT, WIDTH = 72, 96
DISCS = ((30, 30, 14, 0.8), (48, 62, 18, 0.25), (22, 76, 9, 0.5), (58, 22, 7, 0.15))
"""Row, column, radius and albedo."""


def picture(placement, light, factor=2):
    """Return discs on a ground, lit unevenly, as a camera sees them whose film lies otherwise: (h, w)."""
    y, x = np.mgrid[: factor * HEIGHT, : factor * WIDTH] / factor + 0.5 / factor
    x, y = x - WIDTH / 2 - placement.right * WIDTH, y - HEIGHT / 2 - placement.down * WIDTH
    angle = np.radians(placement.degrees)
    x, y = (
        (np.cos(angle) * x + np.sin(angle) * y) / placement.scale + WIDTH / 2,
        (-np.sin(angle) * x + np.cos(angle) * y) / placement.scale + HEIGHT / 2,
    )
    albedo = np.full(x.shape, 0.4)
    for row, column, radius, value in DISCS:
        albedo = np.where(np.hypot(x - column, y - row) < radius, value, albedo)
    return albedo * np.exp(light[0] * x / WIDTH + light[1] * y / HEIGHT)


@pytest.mark.parametrize(
    "placement", [Placement(0.02, -0.015, 1.02, 1.0), Placement(-0.03, 0.01, 0.97, -0.5)]
)
def test_shift_scale_and_rotation_are_found_under_other_light(placement, rng):
    photo = picture(placement, (2, -1)) * np.exp(rng.normal(0, 0.05, (2 * HEIGHT, 2 * WIDTH)))
    found, clear = alignment.find(photo, picture(Placement(), (0, 0), factor=1))
    assert clear
    off = np.array([found.right - placement.right, found.down - placement.down]) * WIDTH
    assert np.abs(off).max() < 0.4  # pixels
    assert found.scale == pytest.approx(placement.scale, abs=0.008)
    assert found.degrees == pytest.approx(placement.degrees, abs=0.6)


def test_a_picture_that_lies_right_is_not_resampled_nor_one_that_is_another(rng):
    rendering = picture(Placement(), (0, 0), factor=1)
    found, clear = alignment.find(picture(Placement(), (1, 1)), rendering)
    assert clear and found == Placement() and found.summary == ""
    sampled, inside = found.sampled(rendering[..., None], HEIGHT, WIDTH)
    np.testing.assert_allclose(sampled[..., 0], rendering, rtol=1e-12)
    assert inside.all()
    found, clear = alignment.find(rng.random((HEIGHT, WIDTH)), picture(Placement(), (0, 0), factor=1))
    assert not clear and found == Placement()


def test_pixels_beside_the_photograph_are_known():
    values, inside = Placement(right=0.25).sampled(np.arange(8.0)[None, :, None].repeat(8, 0), 8, 8)
    np.testing.assert_allclose(values[3, :6, 0], np.arange(2.0, 8.0))
    assert inside[:, :6].all() and not inside[:, 6:].any()
