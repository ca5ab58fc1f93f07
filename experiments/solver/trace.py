"""The objective against steps and seconds, for Gauss-Newton and for Adam, from the same start.

Both minimise what they minimise in a run (Adam the losses of [loss]); shown is F of ``solve/gauss_newton.py``
at its final sigma, and the map's PSNR against the true one, at every step. Seconds are of the optimisation
alone. A Gauss-Newton step stands beside the milliseconds in which its bytes can be read.
"""

import time

import numpy as np

from envedit import inputs, renderers
from envedit.losses import metrics
from envedit.representations import Layers
from envedit.solve import adam_loop, gauss_newton, map_problem, search
from envedit.targets import target
from experiments import puresky
from experiments.engine.floors import bandwidth
from experiments.engine.transport import bytes_read
from experiments.harness import Experiment, calling, done_of, figure


def trace(settings, folder) -> dict:
    """Return ``curves``, by solver rows of (seconds, F, map PSNR in dB), and what :func:`floor` does."""
    lit = inputs.load_scene(settings.scene)
    original, _ = inputs.load_map(settings.input, lit)
    wanted = target.make(settings, lit, original)
    transport = renderers.trace(settings, lit, original.shape[:2])
    active = inputs.active_rows(settings.input.rows, original.shape[0])
    rows = active.slice
    layers = Layers.of(original[rows], active.place)
    problem = map_problem.Problem(layers, transport, original, wanted.picture)
    lights = search.search(problem, problem.state(layers.start())).run.state
    # Both start from the lights that were found, under the sky of the original.
    params = problem.found(lights | {name: 0 * lights[name] for name in ("gain", "saturation")})

    curves = {}
    for name in ("Gauss-Newton", "Adam"):
        problem = map_problem.Problem(layers, transport, original, wanted.picture)
        start = problem.state(params)
        for _ in range(2):  # the first time compiles the kernels
            seen = Seen(problem)
            if name == "Adam":
                objective = adam_loop.Objective(settings.loss, wanted.picture, None, original[rows], 100)
                adam_loop.READ_EVERY = 1
                arguments = layers, params, transport, objective, original, active.first, settings.optimizer
                adam_loop.optimise(*arguments, after_step=seen.adam)
            else:
                found = gauss_newton.solve(problem, params, after_step=seen.newton)
                took = float(np.median([row["step_ms"] for row in found.history]))
        points = []
        for seconds, state in [(0.0, start), *seen.states]:
            point = problem.evaluate(state)
            loss = problem.misfit(point.residual, map_problem.SIGMA) + problem.penalty(state, start)
            true = metrics.compare(point.edited[rows], wanted.envmap[rows], "gamma")["psnr"]
            points.append((seconds, float(loss), true))
        curves[name] = points
    return {"curves": curves, "step_ms": took, **floor(problem)}


def floor(problem: map_problem.Problem) -> dict:
    """Return the milliseconds of reading once what a step reads of T and of its blocks, and the bytes.

    T for one rendering and one gradient, the block transport, the splines in its cells for every channel, and
    the Jacobian, which is written and read again for the Hessian.
    """
    read = bytes_read(problem.transport)
    of_t = read["apply"] + read["adjoint"]
    of_blocks = problem.blocks.nbytes + 3 * 2 * 4 * problem.blocks.count * problem.nodes
    rate = bandwidth()["read"]
    return {"floor_ms": 1000 * (of_t + of_blocks) / rate, "of_t": of_t, "of_blocks": of_blocks, "rate": rate}


class Seen:
    """States after each step, with the seconds since the beginning."""

    def __init__(self, problem):
        self.problem, self.states, self.began = problem, [], time.perf_counter()

    def newton(self, run, point):
        self.states.append((time.perf_counter() - self.began, point.state))

    def adam(self, state, adam):
        self.states.append((time.perf_counter() - self.began, self.problem.state(adam.params)))


def cases(given):
    tables = {
        "input": {"envmap": puresky.file("sunflowers")},
        "scene": {"file": "sphere"},
        "target": {"rotate_degrees": 60.0},
    }
    return [calling("trace", "experiments.solver.trace:trace", tables)]


def measure(done) -> list[dict]:
    return [
        {"solver": name, "steps": len(points) - 1, "first": points[0], "last": points[-1]}
        | {key: value for key, value in done.metrics.items() if key != "curves"}
        for name, points in done.metrics["curves"].items()
    ]


def summary(rows) -> str:
    return (
        "a Gauss-Newton step: {step_ms:.0f} ms, floor {floor_ms:.1f} ms: {of_t:.3g} bytes of T, "
        "{of_blocks:.3g} of blocks and Jacobian at {rate:.3g} bytes a second"
    ).format_map(rows[0])


def draw(made, out, to, given):
    """Draw F against steps and seconds, and the map's PSNR against seconds: ``trace.png``."""
    with figure(to / "trace.png", 1, 3, size=(12, 3.6)) as panels:
        for name, points in done_of(made, out)[0].metrics["curves"].items():
            seconds, loss, psnr = np.transpose(points)
            for panel, x, y in zip(
                panels, (np.arange(len(loss)), seconds, seconds), (loss, loss, psnr), strict=True
            ):
                panel.plot(x, y, marker=".", label=name)
        labels = ("steps", "F"), ("seconds", "F"), ("seconds", "map PSNR, dB")
        for panel, (x, y) in zip(panels, labels, strict=True):
            panel.set(xlabel=x, ylabel=y, yscale="log" if y == "F" else "linear")
        panels[0].legend()
    return [to / "trace.png"]


EXPERIMENT = Experiment(
    "solver.trace",
    "The objective against steps and seconds, for Gauss-Newton and for Adam, from the same start.",
    cases,
    measure,
    {
        "solver": "{solver}",
        "steps": "{steps}",
        "seconds": "{last[0]:.2f}",
        "F at the start": "{first[1]:.4g}",
        "F at the end": "{last[1]:.4g}",
        "map, dB": "{last[2]:.2f}",
    },
    summary=summary,
    draw=draw,
    alone=True,
)
