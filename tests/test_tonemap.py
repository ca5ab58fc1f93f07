"""Luminance and tonemaps against their formulas and inverses."""

import numpy as np
import pytest

from envedit import tonemap
from envedit.errors import ConfigError


def test_luminance():
    np.testing.assert_allclose(tonemap.luminance(np.eye(3)), [0.2126, 0.7152, 0.0722])
    assert tonemap.luminance(np.full((2, 2, 3), 3e38, np.float32)).max() == pytest.approx(3e38)


@pytest.mark.parametrize("name", list(tonemap.TONEMAPS))
def test_tonemaps(name):
    top = 100.0 if name == "log" else 1.0
    e = np.concatenate([[0, 1e-30, 1e-6], np.linspace(0, top, 1001)])
    t = tonemap.tonemap(e, name)
    assert (
        t.min() == 0
        and t.max() == pytest.approx(1)
        and (np.diff(tonemap.tonemap(np.sort(e), name)) >= 0).all()
    )
    np.testing.assert_allclose(tonemap.inverse_tonemap(t, name), e, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(tonemap.tonemap([-1, 65504, np.inf], name), [0, 1, 1])
    assert np.isnan(tonemap.tonemap(np.nan, name))
    assert tonemap.tonemap(np.ones(3, np.float32), name).dtype == np.float32
    assert tonemap.inverse_tonemap(np.ones(3, np.float32), name).dtype == np.float32


def test_tonemap_values():
    assert tonemap.tonemap(0.5) == pytest.approx(0.5 ** (1 / 2.2))
    assert tonemap.tonemap(0.5, "srgb") == pytest.approx(0.7353569831, rel=1e-9)
    assert tonemap.tonemap(1.0, "log") == pytest.approx(np.log(101) / np.log(10001))
    with pytest.raises(ConfigError, match="unknown tonemap 'filmic'; use one of gamma, srgb, log, linear"):
        tonemap.tonemap(0.5, "filmic")


def test_luminance_weights_are_those_of_images():
    np.testing.assert_array_equal(tonemap.luminance(np.eye(3)), tonemap.LUMINANCE)
