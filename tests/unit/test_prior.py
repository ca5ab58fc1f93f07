"""How far a sky changes: node by node for a rendering, as photographed skies differ for paint."""

import numpy as np
import pytest

from envedit.representations.layers.gain import GridGain
from envedit.solve import prior
from envedit.solve.prior import AXES, DEGREES, LEAST_WHOLE_FREEDOM, PHOTOGRAPHED, Prior

UPPER = GridGain(12, 0.5)
FIRST = sum(rows * columns for rows, columns in UPPER.sizes[:-1])


def finest(freedom, gain=UPPER):
    """Return the precisions of the finest grid's nodes, (3, n, n)."""
    return prior.of_paint(freedom).gain_precisions(gain)[:, FIRST:, FIRST:]


def whole(skies, freedom):
    """The deviation of one factor for the whole sky."""
    return max(freedom, LEAST_WHOLE_FREEDOM) * skies.whole


def series(skies, cosine, freedom):
    """The covariance, with Legendre polynomials by their recurrence."""
    before, now, total = 1.0, cosine, whole(skies, freedom) ** 2
    for degree in range(1, DEGREES + 1):
        total += (2 * degree + 1) * (freedom * skies.gradient / degree**skies.falloff) ** 2 * now
        before, now = now, ((2 * degree + 1) * cosine * now - degree * before) / (degree + 1)
    return total


@pytest.mark.parametrize("skies", PHOTOGRAPHED)
@pytest.mark.parametrize("freedom", [0.25, 1.0])
def test_covariance_is_the_series_of_legendre_polynomials(skies, freedom):
    cosines = np.array([-1.0, -0.3, 0.0, 0.5, 0.99, 1.0])
    expected = [series(skies, cosine, freedom) for cosine in cosines]
    factor = max(freedom, LEAST_WHOLE_FREEDOM)
    np.testing.assert_allclose(skies.covariance(cosines, freedom, factor), expected, rtol=1e-10)
    assert skies.covariance(cosines, 0.0, LEAST_WHOLE_FREEDOM) == pytest.approx(whole(skies, 0.0) ** 2)


@pytest.mark.parametrize("freedom", [0.01, 0.25, 1.0])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_precision_is_the_inverse_of_a_positive_definite_covariance_at_the_nodes(freedom, share):
    gain = GridGain(6, share)
    first = sum(rows * columns for rows, columns in gain.sizes[:-1])
    found = prior.of_paint(freedom).gain_precisions(gain)[:, first:, first:]
    directions = gain.directions(2)
    cosine = np.clip(directions @ directions.T, -1, 1)
    for precision, skies in zip(found, PHOTOGRAPHED, strict=True):
        np.testing.assert_allclose(precision, precision.T, rtol=1e-6, atol=1e-6 * np.abs(precision).max())
        assert np.linalg.eigvalsh((precision + precision.T) / 2).min() > 0
        expected = [[series(skies, c, freedom) for c in row] for row in cosine[:: len(cosine) // 4]]
        got = np.linalg.inv(precision)[:: len(cosine) // 4]
        np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-4 * whole(skies, freedom) ** 2)


def test_without_freedom_the_sky_has_one_factor():
    """Nodes differ by a hundredth of what they do with all freedom, and by few per cent."""
    for none, full in zip(finest(0.0), finest(1.0), strict=True):
        apart = []
        for precision in (none, full):
            covariance = np.linalg.inv(precision)
            variance = np.diag(covariance)
            between = variance[:, None] + variance - 2 * covariance
            apart.append(np.sqrt(np.maximum(between, 0).max()))
        assert apart[0] < 0.02 * apart[1] and apart[0] < 0.03
    np.testing.assert_array_equal(finest(0.0), finest(np.sqrt(prior.LEAST_VARIANCE)))


def test_coarser_grids_stay_where_the_finest_has_all_and_ground_changes_as_a_sky():
    found = prior.of_paint(0.25).gain_precisions(UPPER, ground=True)
    assert found.shape == (3, *(2 * [FIRST + len(UPPER.directions(2)) + 1]))
    for precision, skies in zip(found, PHOTOGRAPHED, strict=True):
        np.testing.assert_array_equal(precision[:FIRST, :FIRST], np.eye(FIRST) / prior.LEAST_VARIANCE)
        assert not precision[:FIRST, FIRST:].any() and not precision[-1, :-1].any()
        assert precision[-1, -1] == pytest.approx(whole(skies, 0.25) ** -2)


def test_of_a_rendering_every_node_has_a_deviation_of_its_own():
    """Half as large from grid to grid; ground as a coarse node."""
    found = Prior(luminance=0.5, chroma=0.2, tint=0.1).gain_precisions(UPPER, ground=True)
    level = np.append(np.repeat([0, 1, 2], [rows * columns for rows, columns in UPPER.sizes]), 0)
    for precision, deviation in zip(found, (np.sqrt(3) * 0.5, 0.2, 0.1), strict=True):
        np.testing.assert_allclose(precision, np.diag((deviation / 2.0**level) ** -2), rtol=1e-12)


@pytest.mark.parametrize(("share", "factor"), [(0.0, 0.25), (0.1, 0.25), (0.6, 0.6), (1.0, 1.0)])
def test_paint_changes_the_colour_of_a_light_as_far_as_that_of_the_whole_sky(share, factor):
    coverage = np.full((4, 5, 1), share)
    painted, rendered = prior.of_paint(0.25, coverage), Prior()
    assert painted.freedom == 0.25 and rendered.freedom is None
    deviations = [np.diag(AXES @ one.flux_precision @ AXES.T) ** -0.5 for one in (painted, rendered)]
    _, chroma, tint = (factor * skies.whole for skies in PHOTOGRAPHED)
    np.testing.assert_allclose(deviations[0], [deviations[1][0], chroma, tint], rtol=1e-6)
    np.testing.assert_allclose(AXES @ AXES.T, np.eye(3), atol=1e-12)
