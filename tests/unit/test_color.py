"""Luminance and tonemaps against their formulas and inverses."""

import numpy as np
import pytest

from envedit.core import color


def test_luminance_and_tonemap_values():
    np.testing.assert_allclose(color.luminance(np.eye(3)), [0.2126, 0.7152, 0.0722])
    assert color.luminance(np.full((2, 2, 3), 3e38, np.float32)).max() == pytest.approx(3e38)
    assert color.tonemap(0.5) == pytest.approx(0.5 ** (1 / 2.2))
    assert color.tonemap(0.5, "srgb") == pytest.approx(0.7353569831, rel=1e-9)
    assert color.tonemap(1.0, "log") == pytest.approx(np.log(101) / np.log(10001))
    assert color.tonemap(1.0, "reinhard") == pytest.approx((1.0001 / 2) ** (1 / 2.2))


@pytest.mark.parametrize("name", list(color.TONEMAPS))
def test_tonemaps(name):
    top = {"log": 100.0, "reinhard": 1e4}.get(name, 1.0)
    e = np.concatenate([[0, 1e-30, 1e-6], np.linspace(0, top, 1001)])
    t = color.tonemap(e, name)
    assert t.min() == 0 and t.max() == pytest.approx(1)
    assert (np.diff(color.tonemap(np.sort(e), name)) >= 0).all()
    np.testing.assert_allclose(color.inverse_tonemap(t, name), e, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(color.tonemap([-1, 65504, np.inf], name), [0, 1, 1])
    assert np.isnan(color.tonemap(np.nan, name))
    assert color.tonemap(np.ones(3, np.float32), name).dtype == np.float32
    assert color.inverse_tonemap(np.ones(3, np.float32), name).dtype == np.float32
