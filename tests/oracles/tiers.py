"""Which cases of a test are in the quick tier."""

import pytest


def slow_but(cases, *quick):
    """Return the cases of a parametrised test, all of them slow but some.

    Parameters
    ----------
    cases : iterable
        Values, or tuples of them.
    quick
        Those that stay in the quick tier: a value, or the first one of a tuple.
    """
    cases = [case if isinstance(case, tuple) else (case,) for case in cases]
    assert all(value in [case[0] for case in cases] for value in quick)
    return [pytest.param(*case, marks=() if case[0] in quick else pytest.mark.slow) for case in cases]
