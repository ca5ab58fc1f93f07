"""The last layer of a fitted SIREN, solved for.

Gradient descent comes near the sun of a map last: one texel of 16,384 that holds half of the light. With the
hidden layers as they are the output is sigmoid(W h + b), and W and b are the solution of a small weighted
least-squares problem: 3 systems of hidden + 1 unknowns, a few milliseconds, no step size.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from envedit.core.arrays import tensor
from envedit.core.types import Params
from envedit.representations.siren import network as siren

RIDGE = 5e-6
"""Damping of the solution, per point."""
NEWTON_STEPS = 2


def last_layer(
    params: Params, x: mi.TensorXf, omega: float, target: np.ndarray, light: np.ndarray, share: float
) -> Params:
    """Solve for the last layer that reproduces ``target`` best.

    Gauss-Newton on sum_i w_i (sigmoid(W h_i + b) - y_i)^2 + ridge |step|^2, channel by channel, in float64.
    The weight of a point is 1 + share * E_i / mean(E): points count by themselves, and by the light that they
    hold, so that the sum of light comes out right.

    ``params`` are of a fitted network (:mod:`.network`) of angular frequency ``omega``, ``x`` (N, inputs) its
    points, ``target`` (N, 3) is in [0, 1], and ``light`` (N, 3) is E, at least 0. Returns the
    parameters with another last layer; a channel whose solution is not finite or worse stays.
    """
    # ---- Features, their weights, and the layer as it is
    last = len(params) // 2 - 1
    _, tape = siren.forward(params, x, omega)
    features = tape[-1][0].numpy().astype(np.float64)
    features = np.concatenate([features, np.ones((len(features), 1))], axis=1)
    before = np.concatenate(
        [params[f"{last}.weight"].numpy(), params[f"{last}.bias"].numpy()[:, None]], axis=1
    ).astype(np.float64)
    light = light.astype(np.float64)
    mean = light.mean(axis=0)
    weight = 1 + share * light / np.where(mean > 0, mean, 1)

    # ---- Gauss-Newton steps of each channel
    after = before.copy()
    damping = RIDGE * len(features) * np.eye(features.shape[1])
    for channel, row in enumerate(after):
        for _ in range(NEWTON_STEPS):
            y = _sigmoid(features @ row)
            root = np.sqrt(weight[:, channel] / weight[:, channel].mean())
            jacobian = features * (y * (1 - y) * root)[:, None]
            residual = (target[:, channel] - y) * root
            row += np.linalg.solve(jacobian.T @ jacobian + damping, jacobian.T @ residual)

    def errors(rows):
        return (weight * (_sigmoid(features @ rows.T) - target) ** 2).sum(axis=0)

    # ---- A channel whose solution is not finite, or beyond the reach of two steps, stays as it was
    after = np.where((errors(after) < errors(before))[:, None], after, before)
    solved = {f"{last}.weight": after[:, :-1], f"{last}.bias": after[:, -1]}
    solved = {name: tensor(v) for name, v in solved.items()}
    return {name: solved.get(name, value) for name, value in params.items()}


def _sigmoid(z):
    e = np.exp(-np.abs(z))
    return np.where(z >= 0, 1, e) / (1 + e)
