"""What is raised inside Dr.Jit's operations comes out as it is; places are named."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from envedit.core.errors import InputError, NumericalError, place_of, unwrapped


class Raising(dr.CustomOp):
    def eval(self, x, error):
        raise error

    def name(self):
        return "raising"


class Outer(Raising):
    def eval(self, x, error):
        return dr.custom(Raising, x, error)


@pytest.mark.parametrize("operation", [Raising, Outer])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), InputError("gone"), NumericalError("not finite")])
def test_ctrl_c_and_what_a_user_is_told_come_through_operations(operation, error):
    def call():
        dr.custom(operation, mi.Float(1), error)

    with pytest.raises(RuntimeError):  # what Dr.Jit makes of it
        call()
    with pytest.raises(type(error)) as raised, unwrapped():
        call()
    assert raised.value is error
    with pytest.raises(type(error)):
        unwrapped()(call)()


def test_other_errors_stay_what_they_are():
    for error in (ValueError("a bug"), RuntimeError("another")):
        with pytest.raises(RuntimeError) as raised, unwrapped():
            dr.custom(Raising, mi.Float(1), error)
        assert raised.value.__cause__ is error
    with pytest.raises(ZeroDivisionError), unwrapped():
        raise ZeroDivisionError


def test_a_place_is_the_first_in_reading_order():
    bad = np.zeros((4, 5, 3), bool)
    bad[2, 1, 0] = bad[1, 3, 2] = bad[3, 0] = True
    assert place_of(bad) == place_of(bad.any(axis=2)) == "row 1, column 3"
    assert place_of(bad[2:], first_row=2) == "row 2, column 1"
