"""The network: a forward and a reverse pass, against its own matrix products, and against PyTorch.

Nothing can be quicker than the products that a step has to make: one forward and two backward a layer, but
for the first, whose input needs no gradient. What is above them is what the engine adds.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core.errors import ConfigError
from envedit.representations.siren import network as siren

from .timing import compiled, side_by_side

MAP = (64, 256)
"""Active texels of a 256x128 map: 16,384 points."""
LAYOUTS = ("columns", "rows")
"""A point a column of an activation, (width, N), or a point a row, (N, width), as in the network."""


def measure(settings, torch: str | None = None, quick: bool = False) -> dict:
    """Measure ``siren.forward`` and ``siren.backward``, in turns with their products alone.

    Returns ``siren``: a row with the times of ``forward``, ``step`` and ``own``, the products alone;
    ``ratio``: median of the step over that; ``kernels`` after warm-up; ``torch``: times of that
    interpreter's PyTorch, or None.
    """
    hidden, depth, omega = (getattr(settings.representation, key) for key in ("hidden", "depth", "omega"))
    shape = (8, 32) if quick else MAP
    points = shape[0] * shape[1]
    job = {"hidden": hidden, "depth": depth, "omega": omega, "shape": shape, "threads": dr.thread_count()}
    # Before and after: a subprocess cannot take turns with this one, and the machine may have slowed down.
    peers = [_peer(torch, job)] if torch else []
    params = siren.init(0, hidden, depth, omega)
    x = dr.opaque(siren.coordinates(*shape))
    ones = dr.opaque(mi.TensorXf, 1, siren.forward(params, x, omega)[0].shape)

    def forward():
        return siren.forward(params, x, omega)[0]

    def both():
        _, tape = siren.forward(params, x, omega)
        return siren.backward(params, tape, ones)

    sizes = [2] + [hidden] * (depth + 1) + [3]
    jobs = {"forward": forward, "step": both, "own": _products_alone(points, sizes)}
    taken = side_by_side(jobs, 3 if quick else 11)
    peers += [_peer(torch, job)] if torch else []
    weights = sum(a * b for a, b in zip(sizes[:-1], sizes[1:], strict=True))
    work = 2 * points * (3 * weights - sizes[0] * sizes[1])
    step = taken["step"]["median_s"]
    row = {
        "preset": settings.preset,
        "hidden": hidden,
        "depth": depth,
        "points": points,
        "ratio": step / taken["own"]["median_s"],
        "gflops": work / step / 1e9,
        "kernels": compiled(both),
        "torch": min(peers, key=lambda peer: peer["median_s"], default=None),
    }
    return {"siren": [row | taken]}


def products(layout: str, points: int, inputs: int, outputs: int) -> list[tuple]:
    """List the products of one layer: (name, shape of A, shape of B, transpose flags)."""
    weight = (outputs, inputs)
    if layout == "columns":
        return [
            ("forward", weight, (inputs, points), {}),
            ("gradient of the weights", (outputs, points), (inputs, points), {"Bt": True}),
            ("gradient of the input", weight, (outputs, points), {"At": True}),
        ]
    return [
        ("forward", (points, inputs), weight, {"Bt": True}),
        ("gradient of the weights", (points, outputs), (points, inputs), {"At": True}),
        ("gradient of the input", (points, outputs), weight, {}),
    ]


def _products_alone(points, sizes):
    """Return a function that makes every product of a step, evaluated one by one as the step's are."""
    rng = np.random.default_rng(0)
    made = {}
    jobs = []
    for i, (inputs, outputs) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        layer = products("rows", points, inputs, outputs)
        for _, a, b, flags in layer if i else layer[:2]:  # the first layer's input needs no gradient
            made |= {shape: operand(rng, shape) for shape in (a, b) if shape not in made}
            jobs.append((made[a], made[b], flags))

    def alone():
        for a, b, flags in jobs:
            dr.eval(dr.matmul(a, b, **flags))

    return alone


def operand(rng, shape) -> mi.TensorXf:
    """Draw a matrix. Not zeros, nor equal numbers: a processor may clock otherwise on those."""
    return dr.opaque(mi.TensorXf(rng.uniform(-0.1, 0.1, shape).astype(np.float32)))


def _peer(interpreter, job):
    """Time PyTorch in a process of its own."""
    command = [interpreter, str(Path(__file__).with_name("torch_peer.py")), json.dumps(job)]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise ConfigError(f"--torch {interpreter}: cannot be started ({error.strerror})") from None
    if ran.returncode:
        said = ran.stderr.strip().splitlines() or [f"ended with {ran.returncode}"]
        raise ConfigError(f"--torch {interpreter}: {said[-1]}")
    return json.loads(ran.stdout.splitlines()[-1])
