"""The matrix of extremes as data: maps, stages, and what happens where they meet.

``python -m tests.oracles.extremes > docs/extremes.md`` writes the table.
"""

import numpy as np

from envedit.core.errors import InputError, NumericalError
from tests.oracles.extremes_stages import DONE, STAGES, Outcome, refused, sky

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

# ---- what happens ----------------------------------------------------------------------------------------


AT = "the first at row 5, column 9"
NOT_FINITE, NEGATIVE = ("NaN", "+Inf", "-Inf"), ("-5", "all negative")


def _declare():
    """List the cells that end otherwise than in a finite and correct result."""
    cells = {}
    for name in NOT_FINITE:
        cells[name, "read"] = refused(
            InputError,
            f"1 texel is NaN or infinite, {AT}; repair the map",
            "`[input] repair = true` takes the mean of its neighbours instead, "
            "or the brightest light for +Inf.",
        )
        wrong = refused(InputError, f"1 texel is not finite, {AT}: repair the map")
        cells[name, "fit"] = cells[name, "edit loop"] = wrong
        cells[name, "write"] = refused(NumericalError, f"not written: 1 texel is not finite, {AT}")
        cells[name, "metrics"] = refused(InputError, f"1 texel is not finite, {AT}; repair the image first")
    first_of_all = "the first at row 0, column 0"
    for name, texels_are, first in (
        ("-5", "1 texel is", AT),
        ("all negative", "512 texels are", first_of_all),
    ):
        wrong = refused(InputError, f"{texels_are} negative, {first}: set them to 0")
        cells[name, "fit"] = cells[name, "edit loop"] = wrong
    cells["1e30", "edit loop"] = Outcome(
        "done",
        "Where a pixel is dark beside such a light, the gradient of the light's place has no square in "
        "single precision: an edit then stops after 20 steps that are refused, with a `NumericalError`.",
    )
    bright = refused(InputError, f"1 texel is brighter than 1.27e+30, {AT}: scale the map down")
    cells["3e38", "fit"] = cells["3e38", "edit loop"] = bright
    small = "an environment map of {} texels is too small for Mitsuba"
    for name, size in (("width 2", "2 x 1"), ("width 3", "3 x 2")):
        cells[name, "edit loop"] = refused(InputError, small.format(size))
    cells["width 2", "read"] = refused(InputError, "2 x 1 texels are too few for a map; use at least 6 x 3")
    cells["width 3", "read"] = refused(InputError, "3 x 2 texels are too few for a map; use at least 6 x 3")
    cells["width 5", "read"] = refused(InputError, "a lat-long map is 2:1, this is 5 x 4")
    return cells


EXCEPTIONS = _declare()
CELLS = [(name, stage) for name in MAPS for stage in STAGES]


def expected(name, stage):
    return EXCEPTIONS.get((name, stage), DONE)


# ---- the document ----------------------------------------------------------------------------------------

HEAD = """# Extremes

What happens with odd maps, written by the tests (`python -m tests.oracles.extremes > docs/extremes.md`).
*ok*: the result is finite and correct. Rows: a texel of that value in a smooth sky of 32 x 16 texels, or as
named. Columns:
"""


def document():
    """Return the page: maps that end alike in a row, with numbered notes."""
    notes, rows = [], {}
    for name in MAPS:
        marks = []
        for stage in STAGES:
            outcome = expected(name, stage)
            mark = "ok" if outcome.kind == "done" else outcome.kind
            if outcome.says:
                notes += [outcome.says] if outcome.says not in notes else []
                mark += f" [{notes.index(outcome.says) + 1}]"
            marks.append(mark)
        rows.setdefault(" | ".join(marks), []).append(name)
    lines = [HEAD, *(f"- **{stage}**: {' '.join(act.__doc__.split())}" for stage, act in STAGES.items())]
    lines += ["", f"| | {' | '.join(STAGES)} |", "|---" * (len(STAGES) + 1) + "|"]
    lines += [f"| {', '.join(alike)} | {marks} |" for marks, alike in rows.items()]
    return "\n".join([*lines, "", *(f"{i}. {note}" for i, note in enumerate(notes, 1)), ""])


if __name__ == "__main__":
    print(document(), end="")
