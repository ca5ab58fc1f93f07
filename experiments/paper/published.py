"""The numbers that the paper printed, Tables 1 to 3."""

from __future__ import annotations

METRICS = ("psnr", "lpips", "mse", "ssim")
"""Columns of every table, of the map and then of the rendering; PSNR in dB."""

_TABLE1 = """
pixels        8.91931 0.63838 0.12825 0.31881   29.91687 0.17168 0.00102 0.94152
log-pixels    8.32278 0.76582 0.14714 0.02603   46.27205 0.06250 0.00002 0.99040
siren-no-hdr 14.89818 0.60814 0.03237 0.47149   38.95401 0.08466 0.00013 0.98292
siren        14.56471 0.62082 0.03496 0.34456   46.37604 0.05282 0.00002 0.99316
r-siren      14.58689 0.55724 0.03478 0.55372   39.95935 0.05812 0.00010 0.99125
r-siren-reg  14.85838 0.53229 0.03267 0.52657   41.23402 0.09429 0.00008 0.98908
"""

_TABLE2 = """
pixels       18.35015 0.48241 0.01462 0.54777   26.01747 0.25495 0.00250 0.88970
log-pixels   14.60996 0.63089 0.03459 0.28612   30.00922 0.05187 0.00100 0.97107
siren-reg    29.19136 0.32992 0.00120 0.85988   40.78696 0.09896 0.00008 0.98072
r-siren-reg  29.77839 0.29141 0.00105 0.91918   35.46278 0.17063 0.00028 0.95863
"""

_TABLE3 = {
    0.0: """
pixels       11.47963 0.63746 0.07877 0.33030   35.00420 0.18879 0.00465 0.94913
log-pixels   12.65512 0.66607 0.09697 0.36745   31.23284 0.32984 0.04663 0.79454
siren-reg    11.52815 0.48079 0.08656 0.35959   30.14610 0.24235 0.03281 0.93911
r-siren-reg  11.77427 0.47657 0.08324 0.37889   31.73236 0.20716 0.01330 0.95850
""",
    0.5: """
pixels        9.50746 0.68670 0.12130 0.23377   34.86679 0.20606 0.00507 0.95656
log-pixels    9.39572 0.72085 0.16545 0.28348   24.51719 0.54301 0.08933 0.69031
siren-reg    11.18299 0.51395 0.09276 0.29486   36.25536 0.21043 0.03165 0.95327
r-siren-reg  11.37157 0.50795 0.08931 0.31936   38.55692 0.16639 0.01403 0.97359
""",
    1.0: """
pixels        9.80608 0.66478 0.11211 0.28438   36.98002 0.20773 0.00337 0.95282
log-pixels   11.01039 0.69084 0.13392 0.33982   29.61368 0.45936 0.05712 0.74746
siren-reg    10.91892 0.52043 0.09769 0.28518   38.52983 0.21901 0.03354 0.95579
r-siren-reg  11.09265 0.51780 0.09469 0.30140   40.64959 0.17940 0.01541 0.97294
""",
}


def _read(text):
    rows = (line.split() for line in text.strip().splitlines())
    return {row: {"envmap": _metrics(numbers[:4]), "render": _metrics(numbers[4:])} for row, *numbers in rows}


def _metrics(numbers):
    return dict(zip(METRICS, map(float, numbers), strict=True))


PUBLISHED: dict[str, dict[float | None, dict[str, dict]]] = {
    "table1": {None: _read(_TABLE1)},
    "table2": {None: _read(_TABLE2)},
    "table3": {roughness: _read(text) for roughness, text in _TABLE3.items()},
}
"""Table -> roughness (None: not varied) -> row -> "envmap" or "render" -> metric -> number."""
