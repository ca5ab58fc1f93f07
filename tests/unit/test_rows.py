"""A range of rows under its several names."""

import pytest

from envedit.core.rows import Rows


def test_rows_by_every_name():
    rows = Rows(2, 3, 8)
    assert (rows.last, rows.stop, rows.slice, rows.place, rows.all) == (4, 5, slice(2, 5), (2, 8), False)
    assert Rows.of(8, 2, 4) == Rows.of(8, 2, -4) == rows
    assert Rows.of(8) == Rows(0, 8, 8) and Rows.of(8).all
    assert list(range(8))[rows.slice] == [2, 3, 4]


@pytest.mark.parametrize("rows", [(-1, 3, 8), (2, 0, 8), (2, 7, 8), (8, 1, 8)])
def test_rows_that_the_map_lacks_are_refused(rows):
    with pytest.raises(ValueError, match="are no rows of a map of 8"):
        Rows(*rows)
    with pytest.raises(ValueError, match="are no rows of a map of 8"):
        Rows.of(8, 2, 8)
