"""Numpy arrays to Dr.Jit's, as inputs of kernels: never as literals, each of which is a kernel of its own.

Always copied, for numpy's own memory is aligned now and then only, and either makes another kernel.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.types import ArrayLike, DrArray

ROUNDING = 1e-6
"""What differs by less is the same: a formula is rounded otherwise in every kernel of a GPU, where products
and sums are fused: a factor of 1 is up to 1.6e-7 off, a logarithm of 0 8e-8."""


def tensor(values: ArrayLike) -> mi.TensorXf:
    """Copy numbers of any shape to a float32 tensor."""
    return dr.opaque(mi.TensorXf(np.ascontiguousarray(values, np.float32)))


def flat(kind: type[DrArray], values: ArrayLike) -> DrArray:
    """Copy numbers to an array of a Dr.Jit type; done when this returns, so that ``values`` may change.

    ``values`` have the dtype of ``kind``, such as ``mi.Float``, and any shape.
    """
    array = dr.opaque(kind(np.ascontiguousarray(values).ravel()))
    dr.eval(array)
    dr.sync_thread()
    return array


def vectors(kind: type[DrArray], values: ArrayLike) -> DrArray:
    """Copy numbers (..., 3) to vectors or colours of a Dr.Jit type, such as ``mi.Color3f``."""
    values = np.asarray(values)
    return dr.opaque(kind(np.ascontiguousarray(values.reshape(-1, values.shape[-1]).T, np.float32)))


def settled(x: DrArray, value: float) -> DrArray:
    """Return ``x``, exactly ``value`` where it is that but for :data:`ROUNDING`; its derivative stays."""
    short = value - dr.detach(x)
    return x + dr.select(dr.abs(short) < ROUNDING, short, 0)
