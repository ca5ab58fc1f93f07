r"""Draw the objective against steps and seconds, for Gauss-Newton and for Adam, from the same start.

    ENVEDIT_DATA=... python -m experiments.solver.trace [--out experiments/solver/trace.png] \
        [--map sunflowers] [--scene sphere] [--angle 60]

Both minimise what they minimise in a run (Adam the losses of [loss]); shown is F of ``solve/gauss_newton.py``
at its final sigma, and the map's PSNR against the true one, at every step. Seconds are of the optimisation
alone. Prints the milliseconds of a Gauss-Newton step beside those in which its bytes can be read.
"""

import argparse
import time
from pathlib import Path

import mitsuba as mi
import numpy as np

from envedit import config, inputs, renderers
from envedit.losses import metrics
from envedit.representations import Layers
from envedit.solve import adam_loop, gauss_newton, light_search, map_problem
from envedit.targets import target
from experiments import puresky
from experiments.engine.floors import bandwidth
from experiments.engine.transport import bytes_read


def main():
    """Compute and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("experiments/solver/trace.png"))
    parser.add_argument("--map", default="sunflowers")
    parser.add_argument("--scene", default="sphere")
    parser.add_argument("--angle", type=float, default=60.0)
    given = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    settings = config.from_dict(
        {
            "input": {"envmap": str(puresky.of_script([given.map])[given.map])},
            "scene": {"file": given.scene},
            "target": {"rotate_degrees": given.angle},
        }
    )
    lit = inputs.load_scene(settings.scene)
    original, _ = inputs.load_map(settings.input, lit)
    wanted = target.make(settings, lit, original)
    transport = renderers.trace(settings, lit, original.shape[:2])
    active = inputs.active_rows(settings.input.rows, original.shape[0])
    rows = active.slice
    layers = Layers(active.place)
    params = layers.encode(original[rows])
    asked = light_search.SearchProblem(layers, transport, wanted.picture, None, original)
    params, _ = light_search.start(asked, params)

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
            points.append((seconds, loss, true))
        curves[name] = np.array(points)
        seconds, loss, true = points[-1]
        course = f"F {points[0][1]:.4g} -> {loss:.4g}, map {true:.2f} dB"
        print(f"{name}: {len(points) - 1} steps, {seconds:.2f} s, {course}")
    print(floor(problem, took))
    draw(given.out, curves)


def floor(problem: map_problem.Problem, took: float) -> str:
    """Compare the milliseconds of a step with those of reading once what it reads of T and of its blocks.

    T for one rendering and one gradient, the block transport, the splines in its cells for every channel, and
    the Jacobian, which is written and read again for the Hessian.
    """
    read = bytes_read(problem.transport)
    of_t = read["apply"] + read["adjoint"]
    of_blocks = problem.blocks.nbytes + 3 * 2 * 4 * problem.blocks.count * problem.nodes
    rate = bandwidth()["read"]
    least = 1000 * (of_t + of_blocks) / rate
    return (
        f"a Gauss-Newton step: {took:.0f} ms, {took / least:.1f} times the floor of {least:.1f} ms: "
        f"{of_t / 1e6:.0f} MB of T, {of_blocks / 1e6:.0f} MB of blocks and Jacobian at {rate / 1e9:.1f} GB/s"
    )


class Seen:
    """States after each step, with the seconds since the beginning."""

    def __init__(self, problem):
        self.problem, self.states, self.began = problem, [], time.perf_counter()

    def newton(self, run, point):
        self.states.append((time.perf_counter() - self.began, point.state))

    def adam(self, state, adam):
        self.states.append((time.perf_counter() - self.began, self.problem.state(adam.params)))


def draw(path: Path, curves) -> None:
    """Draw F against steps and seconds, and the map's PSNR against seconds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 3, figsize=(12, 3.6), constrained_layout=True)
    for name, points in curves.items():
        panels[0].plot(np.arange(len(points)), points[:, 1], marker=".", label=name)
        panels[1].plot(points[:, 0], points[:, 1], marker=".", label=name)
        panels[2].plot(points[:, 0], points[:, 2], marker=".", label=name)
    for panel, x, y in zip(panels, ("steps", "seconds", "seconds"), ("F", "F", "map PSNR, dB"), strict=True):
        panel.set_xlabel(x)
        panel.set_ylabel(y)
        panel.grid(alpha=0.3)
    panels[0].set_yscale("log")
    panels[1].set_yscale("log")
    panels[0].legend()
    figure.savefig(path, dpi=100)
    print(path)


if __name__ == "__main__":
    main()
