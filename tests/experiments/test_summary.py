"""Statistics over rows: what counts, what is left out, and how it is written."""

from experiments.summary import Numbers, Summary, Value, values

ROWS = [
    {"scene": "b", "psnr": 10.0, "seam": None},
    {"scene": "a", "psnr": 30.0, "seam": 2.0},
    {"scene": "b", "psnr": float("nan"), "seam": 3.0},
    {"scene": "b", "psnr": 20.0, "seam": 5.0},
]


def test_a_row_for_each_group_in_the_order_in_which_they_come():
    columns = {"runs": "{runs}", "PSNR": "{psnr.mean:.1f} ({psnr.min:.0f}), {psnr.count}"}
    lines = Summary({"scene": "{scene}"}, columns)(ROWS).splitlines()
    assert lines[0] == "| scene | runs | PSNR |"
    assert lines[2:] == ["| b | 3 | 15.0 (10), 2 |", "| a | 1 | 30.0 (30), 1 |"]


def test_numbers_are_counted_and_what_is_not_known_is_a_dash():
    text = Summary({}, {"": "{seam.above[2.5]} {seam.above[3]} {seam.below[3]} {seam.median:.1f}"})(ROWS)
    assert text.endswith("| 2 1 1 3.0 |")
    assert f"{Value('nan'):.1f} {Value(0.125):+.1%} {Value(2):.1f}" == "- +12.5 % 2.0"
    assert f"{Numbers([0.5, 8.0, None]).geometric:.1f}" == "2.0"
    assert f"{Numbers([None]).max:.1f}" == "-" and Numbers([]).above[0] == 0
    row = values({"a": None, "b": 0.5, "c": "text", "d": [1.0], "e": 3})
    assert "{a:.1f} {b:.0%} {c} {e}".format_map(row) == "- 50 % text 3"
    assert Summary({}, {"": "{other.mean:.1f}"})(ROWS).endswith("| - |")
    rows = [values({"map": one}) for one in ({"psnr": 10.0}, {"psnr": None}, {"psnr": 20.0}, None)]
    assert ["{map[psnr]:.1f}".format_map(row) for row in rows] == ["10.0", "-", "20.0", "-"]
    assert Summary({}, {"": "{map[psnr].mean:.1f}, {map[psnr].count}"})(rows).endswith("| 15.0, 2 |")


def test_numbers_have_three_digits():
    found = values({"a": [], "b": {"n": None, "some": 999, "much": 1.234e9, "few": 0.0, "share": 0.01234}})
    line = "{b[n]:si B}, {b[some]:si B}, {b[much]:si B}, {b[few]:si B}, {b[share]:.3g%}".format_map(found)
    assert line == "-, 999 B, 1.23 GB, 0.00 B, 1.23 %"
    assert [f"{Value(v):si s}" for v in (0.0123, 1200, 99.9)] == ["12.3 ms", "1200 s", "99.9 s"]
