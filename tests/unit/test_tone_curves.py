"""Tone curves of cameras: monotone, and undone to what was exposed."""

import numpy as np
import pytest

from envedit.core.tone_curves import TONE_CURVES


@pytest.mark.parametrize("name", TONE_CURVES)
def test_a_curve_rises_from_black_to_white_keeps_grey_and_is_undone(name, rng):
    grey = np.repeat(np.append(0, np.geomspace(1e-4, 200, 300))[:, None], 3, axis=1)
    shown = TONE_CURVES[name].shown(grey)
    assert (np.diff(shown, axis=0) >= -1e-6).all() and shown[0].max() < 0.01 and shown[-1].min() > 0.97
    assert np.ptp(shown, axis=1).max() < 5e-3
    curve = TONE_CURVES[name]
    radiance = np.exp(rng.normal(-1.5, 1, (500, 3)))
    shown = curve.shown(radiance)
    kept = ((shown > 0.02) & (shown < 0.98)).all(axis=1)
    assert kept.mean() > 0.6
    np.testing.assert_allclose(curve.exposed(shown)[kept], radiance[kept], rtol=1e-3)


def test_mid_grey_is_where_the_authors_of_the_curves_have_it():
    """0.18 under sRGB by IEC 61966-2-1; under AgX near Sobotka's middle grey, 0.18^(1 / 2.2) = 0.459."""
    grey = np.full((1, 3), 0.18)
    assert TONE_CURVES["srgb"].shown(grey)[0, 0] == pytest.approx(0.4614, abs=1e-4)
    assert TONE_CURVES["agx"].shown(grey)[0, 0] == pytest.approx(0.48, abs=0.025)
