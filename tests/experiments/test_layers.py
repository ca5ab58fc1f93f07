"""The scripts beside ``experiments layers`` run against the representation as it is."""

import numpy as np
import pytest

from envedit.images import analytic_sky
from envedit.representations.layers.layers import Layers
from experiments.layers import gain, old_sun

WIDTH = 64


@pytest.fixture(scope="module")
def sky():
    """A sun over a lower half that mirrors the sky, (32, 64, 3)."""
    up = analytic_sky.sunsky(WIDTH, 90.0, 40.0)[: WIDTH // 4]
    return np.concatenate([up, up[::-1]])


@pytest.mark.slow
@pytest.mark.parametrize("way", old_sun.WAYS)
def test_every_way_to_fill_the_old_place_of_a_sun_gives_a_finite_map(sky, way):
    made = Layers((0, len(sky)), horizon="mirror")
    params = made.encode(sky)
    assert made.behind is not None
    old_sun.under(made, way)
    np.testing.assert_allclose(made.decode(params).numpy(), sky, rtol=1e-3)  # nothing has moved yet
    turned = made.decode(old_sun.turned(made, params, WIDTH // 3, WIDTH)).numpy()
    assert np.isfinite(turned).all()
    assert np.abs(turned - sky).max() > 1


@pytest.mark.parametrize("name", gain.VARIANTS)
def test_every_gain_that_is_compared_starts_from_no_change(sky, name):
    up = sky[: len(sky) // 2]
    made = type("Variant", (Layers,), {"Gain": gain.VARIANTS[name]})((0, len(sky)))
    params = made.encode(up)
    np.testing.assert_allclose(made.decode(params).numpy(), up, rtol=1e-3)
    # The last of the gain's parameters is a bias, or the nodes of the finest grid.
    last = max(key for key in params if key.startswith("gain."))
    last = last.replace("weight", "bias")
    changed = made.decode(params | {last: params[last] + 1}).numpy()
    assert (changed > 1.01 * up).mean() > 0.9  # all but the sun, which is no sky
