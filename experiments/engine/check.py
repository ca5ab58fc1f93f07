"""What must hold of any measurement: the self-check of ``--quick``, and of every other run."""

from collections import Counter

from . import network

ADJOINT = 1e-5
"""|<T E, I> - <E, T' I>| over <T E, I>: sums of float32 in two orders, taken in double at the end."""
PICTURE = 0.05
"""RMSE of T's picture under a one-texel sun, 24x24 pixels; a lost or doubled tier is off by 0.5 or more."""


def _kernels(calls, launched, compiled):
    return {
        f"only {launched} kernels in the history": launched >= calls,
        f"{compiled} of {launched} kernels compiled after warm-up": compiled == 0,
    }


def _rate(row):
    return {f"a rate of {row['rate']}": row["rate"] > 0}


def _siren(row):
    return _kernels(**row["kernels"]) | {
        f"unknown layout {row['layout']}": row["layout"] in network.LAYOUTS,
        "a reverse pass that takes no time": row["step"]["median_s"] > row["forward"]["min_s"],
    }


def _transport(row):
    return _kernels(**row["kernels"]) | {
        f"adjoint off by {row['adjointness']:.2g}": row["adjointness"] < ADJOINT,
        "no exact column under a clear sky": row["columns"] > 0,
        "nothing is read": row["bytes"]["apply"] > 0 and row["floor_s"] > 0,
        "T was not found on disk after it was kept there": row["load_s"] is not None,
    }


def _quality(row):
    holds = {"16 samples of prb are better than T": row["prb_rmse"] > row["rmse"]}
    if row["quick"]:  # a mirror's caustic, at full size, is off by more than the picture's mean
        holds[f"T's picture is off by {100 * row['corrected']:.2g} %"] = row["corrected"] < PICTURE
        holds[f"the reference is off by {100 * row['noise']:.2g} %"] = row["noise"] < PICTURE
    return holds


def _fits(row):
    worst, mean, log_psnr = (row[key] for key in ("noisy_worst", "noisy_mean", "log_psnr"))
    known = None not in (worst, mean, log_psnr)
    return {"noise makes the fit better": not known or worst <= mean <= log_psnr + 1}


CHECKS = {
    "bandwidth": _rate,
    "rays": _rate,
    "siren": _siren,
    "transport": _transport,
    "quality": _quality,
    "fits": _fits,
}
"""For each table: row -> what is wrong unless it holds."""
TABLES = {
    "floors": ("bandwidth", "matmul", "rays"),
    "siren": ("siren",),
    "transport": ("transport", "transport-time"),
    "quality": ("quality", "equal-error"),
    "curve": ("error-time",),
    "scaling": ("scaling",),
    "fits": ("fits",),
}
"""For each section: what its cases must have rows of."""
ROWS = {"matmul": len(network.LAYOUTS), "rays": 3, "error-time": 3}
"""How many at least, where it is not one."""


def failures(rows: list[dict]) -> list[str]:
    """Return a sentence for each thing that does not hold."""
    infinite = {f"{row['case']}: {place} is not finite": None for row in rows for place in row["not_finite"]}
    if infinite:
        return list(infinite)
    there = Counter((row["case"], row["table"]) for row in rows)
    needed = {(row["case"], table): ROWS.get(table, 1) for row in rows for table in TABLES[row["section"]]}
    wrong = [
        f"{case}: {there[case, table]} rows of table {table}, expected {least} or more"
        for (case, table), least in needed.items()
        if there[case, table] < least
    ]
    found = [(row["case"], CHECKS[row["table"]](row)) for row in rows if row["table"] in CHECKS]
    return wrong + [f"{case}: {text}" for case, holds in found for text, right in holds.items() if not right]
