"""SIREN: a multi-layer perceptron with sine activations, natively in Dr.Jit.

The network of Sec. 3 and 6.1 of the paper, after Sitzmann et al. 2020: a first sine layer, ``depth`` hidden
sine layers, a linear layer and a sigmoid::

    h_0 = sin(omega (W_0 x + b_0)),   h_i = sin(omega (W_i h_{i-1} + b_i)),   y = sigmoid(W h_depth + b)

Parameters are a flat dict of tensors, ``"0.weight"`` (out, in) and ``"0.bias"`` (out,) upwards. Activations
are (N, width), a point a row. The reverse pass is written by hand: it keeps sine and cosine of each layer,
and needs two matrix products a layer beside the forward one. A bias gradient is a sum over points, of which
every lane takes a stretch (``docs/decisions/network_layout.md``).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.types import Params

SPHERE_SCALE = 1.5
"""Radius of the sphere on which directions lie: the higher, the finer the detail that is found first."""


def init(seed: int, hidden: int = 256, depth: int = 6, omega: float = 30.0, inputs: int = 2) -> Params:
    """Draw the initial weights of a SIREN.

    First layer U(-1/in, 1/in), later ones U(-sqrt(6/in)/omega, sqrt(6/in)/omega) (Sitzmann et al. 2020,
    Sec. 3.2), biases U(-1/sqrt(in), 1/sqrt(in)) as in the authors' code.

    ``hidden`` is the width, ``depth`` the number of hidden sine layers after the first, ``omega`` the angular
    frequency of the sine layers, and ``inputs`` the size of a coordinate; a value is a colour. The same seed
    gives the same weights on every machine.
    """
    rng = np.random.default_rng(seed)
    sizes = [inputs] + [hidden] * (depth + 1) + [3]
    params: Params = {}
    for i, (fan_in, fan_out) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        bound = 1.0 / fan_in if i == 0 else np.sqrt(6.0 / fan_in) / omega
        bias = 1.0 / np.sqrt(fan_in)
        weight = rng.uniform(-bound, bound, (fan_out, fan_in)).astype(np.float32)
        params[f"{i}.weight"] = tensor(weight)
        params[f"{i}.bias"] = tensor(rng.uniform(-bias, bias, fan_out))
    return params


def coordinates(height: int, width: int) -> mi.TensorXf:
    """Return texel centres as network coordinates (H * W, 2): (y, x) in (-1, 1), row after row."""
    y = (2 * np.arange(height) + 1) / height - 1
    x = (2 * np.arange(width) + 1) / width - 1
    grid = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    return tensor(grid)


def directions(height: int, width: int, first: int = 0, total: int | None = None) -> mi.TensorXf:
    """Directions through texel centres as network coordinates (H * W, 3), scaled by :data:`SPHERE_SCALE`.

    On the sphere a map has no seam, its zenith is a point, and a step of a texel is as long across as down.
    The rows are ``first`` ... ``first + height - 1`` of a map of ``total`` rows; all of them by default.
    """
    d = latlong.directions(total or height, width, slice(first, first + height))
    return tensor((SPHERE_SCALE * d).reshape(-1, 3))


def forward(params: Params, x: mi.TensorXf, omega: float) -> tuple[mi.TensorXf, list]:
    """Evaluate the network at coordinates ``x`` (N, inputs).

    Returns values (N, 3) in (0, 1), and a tape: per layer its input and omega * cos, and the output,
    which is what :func:`backward` needs.
    """
    last = len(params) // 2 - 1
    tape = []
    h = x
    for i in range(last):
        z = dr.matmul(h, params[f"{i}.weight"], Bt=True) + params[f"{i}.bias"]
        sine, cosine = dr.sincos(omega * z)
        slope = omega * cosine
        dr.eval(sine, slope)
        tape.append((h, slope))
        h = sine
    y = _sigmoid(dr.matmul(h, params[f"{last}.weight"], Bt=True) + params[f"{last}.bias"])
    tape.append((h, y))
    return y, tape


def backward(params: Params, tape: list, grad: mi.TensorXf) -> Params:
    """Pull ``grad`` (N, 3), of a scalar by y, back to the parameters that made the ``tape``.

    Returns the gradient of every parameter, same names and shapes.
    """
    last = len(params) // 2 - 1
    grads: Params = {}
    h, y = tape[last]
    delta = grad * y * (1 - y)
    for i in range(last, -1, -1):
        dr.eval(delta)
        grads[f"{i}.weight"] = dr.matmul(delta, h, At=True)
        grads[f"{i}.bias"] = _sum_of_rows(delta)
        if i > 0:
            slope = tape[i - 1][1]
            delta = dr.matmul(delta, params[f"{i}.weight"]) * slope
            h = tape[i - 1][0]
    # In the order of the parameters: dr.CustomOp.set_grad_in drops, silently, a dict whose keys come in
    # another order.
    return {name: grads[name] for name in params}


def evaluate(params: Params, x: mi.TensorXf, omega: float) -> mi.TensorXf:
    """Evaluate the network as one differentiable operation: :func:`forward`, reversed by :func:`backward`."""
    return dr.custom(_Siren, params, x, omega)


_STRETCHES = 32


def _sum_of_rows(x):
    """Sum a tensor (N, width) over N: stretches of rows first, then the stretches."""
    n, width = x.shape
    parts = _sum_of_stretches(x.array, n, width)
    dr.eval(parts)
    lane = dr.arange(mi.UInt32, width)
    total = dr.zeros(type(x.array), width)
    for stretch in range(_STRETCHES):
        total += dr.gather(type(x.array), parts, lane + stretch * width)
    return type(x)(total, (width,))


@dr.syntax
def _sum_of_stretches(x, n, width):
    lane = dr.arange(mi.UInt32, width * _STRETCHES)
    rows = dr.opaque(mi.UInt32, -(-n // _STRETCHES))
    i = (lane // width) * rows * width + lane % width
    stop = dr.minimum((lane // width + 1) * rows, dr.opaque(mi.UInt32, n)) * width
    total = dr.zeros(type(x), width * _STRETCHES)
    while i < stop:
        total += dr.gather(type(x), x, i)
        i += width
    return total


class _Siren(dr.CustomOp):
    """Glue between the hand-written reverse pass and Dr.Jit's AD graph."""

    def eval(self, params, x, omega):
        self.params = dict(params)
        y, self.tape = forward(self.params, x, omega)
        return y

    def backward(self):
        self.set_grad_in("params", backward(self.params, self.tape, self.grad_out()))
        self.tape = None  # activations are the largest memory of a step: let go of them at once

    def name(self):
        return "siren"


def _sigmoid(z):
    # exp(-|z|) cannot overflow; the two branches meet at 1/2.
    e = dr.exp(-dr.abs(z))
    return dr.select(z >= 0, 1, e) / (1 + e)
