"""The matrix of extremes as data: maps, and where a stage refuses one; ``docs/extremes.md`` has the same."""

import numpy as np

from envedit.core.errors import InputError, NumericalError
from tests.oracles.extremes_stages import STAGES, sky

# ---- maps ------------------------------------------------------------------------------------------------


def texel(value, place=(5, 9)):
    """Return the sky of the matrix with one texel of another value."""
    m = sky()
    m[place] = value
    return m


def ramp():
    """Return a map from 1e-6 to 1e6, evenly in its logarithm."""
    return np.geomspace(1e-6, 1e6, 16 * 32 * 3).astype(np.float32).reshape(32, 16, 3).swapaxes(0, 1).copy()


def sunny(height, width):
    """Return the sky at another size with a sun of 1e4."""
    m = sky(height, width)
    m[height // 2, width // 2] = 1e4
    return m


VALUES = ("0", "1e-30", "1e-6", "65504", "65505", "1.5e5", "1e6", "1e10", "1e30", "3e38")
VALUES += ("NaN", "+Inf", "-Inf", "-5")
MAPS = {
    **{name: texel(float(name)) for name in VALUES},
    "all zero": np.zeros((16, 32, 3), np.float32),
    "constant": np.full((16, 32, 3), 0.5, np.float32),
    "all negative": np.full((16, 32, 3), -5, np.float32),
    "sun in the pole": texel(1e4, (0, 7)),
    "sun at the seam": texel(1e4, (5, 0)),
    "sun at the horizon": texel(1e4, (7, 20)),
    "range of 1e12": ramp(),
    "width 2": sunny(1, 2),
    "width 3": sunny(2, 3),
    "width 5": sunny(4, 5),
    "width 4096": sunny(16, 4096),
}
"""A texel of that value in a smooth sky of 16 x 32 unless said otherwise; 4096 is 16 rows of such a map."""

# ---- what is refused --------------------------------------------------------------------------------------


AT = "the first at row 5, column 9"
NOT_FINITE, NEGATIVE = ("NaN", "+Inf", "-Inf"), ("-5", "all negative")


def _refusals():
    """Return the cells that do not end in a finite and correct result: error and words of its message."""
    cells = {}
    wrong = InputError, f"1 texel is not finite, {AT}: repair the map"
    for name in NOT_FINITE:
        cells[name, "read"] = InputError, f"1 texel is NaN or infinite, {AT}; repair the map"
        cells[name, "fit"] = cells[name, "edit loop"] = wrong
        cells[name, "write"] = NumericalError, f"not written: 1 texel is not finite, {AT}"
        cells[name, "metrics"] = InputError, f"1 texel is not finite, {AT}; repair the image first"
    counted = f"1 texel is negative, {AT}", "512 texels are negative, the first at row 0, column 0"
    for name, texels in zip(NEGATIVE, counted, strict=True):
        cells[name, "fit"] = cells[name, "edit loop"] = InputError, f"{texels}: set them to 0"
    bright = InputError, f"1 texel is brighter than 1.27e+30, {AT}: scale the map down"
    cells["3e38", "fit"] = cells["3e38", "edit loop"] = bright
    for name, size in (("width 2", "2 x 1"), ("width 3", "3 x 2")):
        cells[name, "edit loop"] = InputError, f"an environment map of {size} texels is too small for Mitsuba"
        cells[name, "read"] = InputError, f"{size} texels are too few for a map; use at least 6 x 3"
    cells["width 5", "read"] = InputError, "a lat-long map is 2:1, this is 5 x 4"
    return cells


REFUSALS = _refusals()
CELLS = [(name, stage) for name in MAPS for stage in STAGES]
