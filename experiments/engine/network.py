"""The network: a forward and a reverse pass, against its own matrix products, and against PyTorch.

Nothing can be quicker than the products that a step has to make: one forward and two backward a layer, but
for the first, whose input needs no gradient. What is above them is what the engine adds.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.representations.siren import network as siren

from .timing import compiled, growth, side_by_side

NETWORKS = {"paper": (256, 6), "standard": (128, 3), "draft": (64, 3)}
"""Width and hidden sine layers after the first, by preset."""
MAP = (64, 256)
"""Active texels of a 256x128 map: 16,384 points."""
OMEGA = 30.0
LAYOUTS = ("columns", "rows")
"""A point a column of an activation, (width, N), or a point a row, (N, width)."""


def measure(quick: bool = False, torch: str | None = None) -> dict:
    """Measure every network.

    Parameters
    ----------
    quick : bool
        One tiny network, for the self-check.
    torch : str, optional
        An interpreter that has PyTorch; by default this one, if it has it.

    Returns
    -------
    dict
        ``networks``: a row each, see :func:`step`; ``torch``: what PyTorch took for the same by name, or
        None; ``not_compared``: why it is None.
    """
    networks = {"tiny": (16, 2)} if quick else NETWORKS
    shape = (8, 32) if quick else MAP
    # Before and after: a subprocess cannot take turns with this one, and the machine may have slowed down.
    peers = [] if quick else [_peer(torch, networks, shape)]
    rows = [step(name, *size, shape, quick) for name, size in networks.items()]
    if peers and peers[0]:
        peers.append(_peer(torch, networks, shape))
    both = [peer for peer in peers if peer]
    return {
        "points": shape[0] * shape[1],
        "networks": rows,
        "torch": _quicker(both) if both else None,
        "not_compared": None if both else "PyTorch (not asked for)" if quick else "PyTorch (not installed)",
    }


def step(name: str, hidden: int, depth: int, shape=MAP, quick: bool = False) -> dict:
    """Measure ``siren.forward`` and ``siren.backward`` of one network, in turns with their products alone.

    Returns
    -------
    dict
        ``name``, ``hidden``, ``depth``, ``layout``; times of ``forward``, ``step`` and, by layout, of
        ``products``; ``ratio``: median of the step over that of its own products; ``ratio_best``: over those
        of the quicker layout; ``gflop``: arithmetic of the products; ``kernels`` after warm-up; ``memory``
        over 200 steps.
    """
    params = siren.init(0, hidden, depth, OMEGA)
    x = dr.opaque(siren.coordinates(*shape))
    points = shape[0] * shape[1]
    layout = "rows" if x.shape[0] == points else "columns"
    ones = dr.opaque(mi.TensorXf, 1, siren.forward(params, x, OMEGA)[0].shape)

    def forward():
        return siren.forward(params, x, OMEGA)[0]

    def both():
        _, tape = siren.forward(params, x, OMEGA)
        return siren.backward(params, tape, ones)

    sizes = [2] + [hidden] * (depth + 1) + [3]
    jobs = {"forward": forward, "step": both} | {
        layout_: _products_alone(layout_, points, sizes) for layout_ in LAYOUTS
    }
    taken = side_by_side(jobs, 3 if quick else 11)
    floor = {name_: taken[name_]["median_s"] for name_ in LAYOUTS}
    weights = sum(a * b for a, b in zip(sizes[:-1], sizes[1:], strict=True))
    work = 2 * points * (3 * weights - sizes[0] * sizes[1])
    return {
        "name": name,
        "hidden": hidden,
        "depth": depth,
        "layout": layout,
        "forward": taken["forward"],
        "step": taken["step"],
        "products": {name_: taken[name_] for name_ in LAYOUTS},
        "ratio": taken["step"]["median_s"] / floor[layout],
        "ratio_best": taken["step"]["median_s"] / min(floor.values()),
        "gflop": work / 1e9,
        "kernels": compiled(both),
        "memory": growth(both, 20 if quick else 200, 5 if quick else 20),
    }


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


def _products_alone(layout, points, sizes):
    """Return a function that makes every product of a step, evaluated one by one as the step's are."""
    rng = np.random.default_rng(0)
    made, jobs = {}, []
    for i, (inputs, outputs) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        for which, a, b, flags in products(layout, points, inputs, outputs):
            if i == 0 and which == "gradient of the input":
                continue
            made |= {shape: operand(rng, shape) for shape in (a, b) if shape not in made}
            jobs.append((made[a], made[b], flags))

    def alone():
        for a, b, flags in jobs:
            dr.eval(dr.matmul(a, b, **flags))

    return alone


def operand(rng, shape) -> mi.TensorXf:
    """Draw a matrix. Not zeros, nor equal numbers: a processor may clock otherwise on those."""
    return dr.opaque(mi.TensorXf(rng.uniform(-0.1, 0.1, shape).astype(np.float32)))


# ---------------------------------------------------------------------- the peer


def _peer(interpreter, networks, shape):
    """Time PyTorch in a process of its own; None where it is not installed."""
    if not interpreter:
        if importlib.util.find_spec("torch") is None:
            return None
        interpreter = sys.executable
    job = {"networks": networks, "shape": shape, "omega": OMEGA, "threads": dr.thread_count()}
    script = Path(__file__).with_name("torch_peer.py")
    try:
        ran = subprocess.run(
            [interpreter, str(script), json.dumps(job)], capture_output=True, text=True, check=False
        )
    except OSError as error:
        sys.exit(f"--torch {interpreter}: cannot be started ({error.strerror})")
    if ran.returncode:
        said = ran.stderr.strip().splitlines() or [f"ended with {ran.returncode}"]
        sys.exit(f"--torch {interpreter}: {said[-1]}")
    return json.loads(ran.stdout.splitlines()[-1])


def _quicker(runs):
    """Merge runs of the peer: the quicker one of each network."""
    names = runs[0]["networks"]
    merged = {
        name: min((run["networks"][name] for run in runs), key=lambda row: row["median_s"]) for name in names
    }
    return {**runs[0], "networks": merged}
