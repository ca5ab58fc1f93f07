"""A whole edit compiles its kernels in the first three iterations, whatever the light does later."""

import resource
from pathlib import Path

import numpy as np
import pytest

from envedit import config, pipeline
from envedit.renderers import StoredRenderer
from envedit.solve import adam_loop, gauss_newton, layers_solver, map_problem
from tests.oracles.kernels import compiled, history

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_core")]

SMALL = ["input.width=64", "scene.width=32", "fit.epochs=30", "fit.cache=false", "renderer.cache=false"]
SMALL += ["representation.hidden=32", "target.spp=32", "output.spp=16", "renderer.spp=64"]
SMALL += ["optimizer.iterations=45"]
ADAM = ["optimizer.kind=adam", "representation.turn=false"]  # a turned map would be the result without a step


@pytest.mark.parametrize("kind", ["siren", "pixels"])
def test_no_kernel_is_compiled_after_the_third_iteration(kind, monkeypatch):
    # The analytic sun moves by 60 degrees: columns of T are traced and replaced in iterations 10 to 40.
    settings = config.loads("", overrides=[*SMALL, f"representation.kind={kind}", *ADAM])
    fresh, columns, launched = {}, [], []
    compare, render = adam_loop.Objective.__call__, StoredRenderer.render

    def counted(objective, rendering, crop, step):
        number, fresh[step] = history()
        launched.append(number)
        return compare(objective, rendering, crop, step)

    def watched(renderer, envmap, step):
        columns.append(len(renderer.transport.columns))
        return render(renderer, envmap, step)

    monkeypatch.setattr(adam_loop.Objective, "__call__", counted)
    monkeypatch.setattr(StoredRenderer, "render", watched)
    compiled(lambda: pipeline.run(settings))
    assert len(fresh) == 45 and min(launched) > 10  # the history was kept
    assert {step: count for step, count in fresh.items() if step >= 3 and count} == {}
    assert columns[-1] > columns[1]  # else nothing was traced after the first step, and nothing shown


def test_no_kernel_is_compiled_after_the_third_gauss_newton_step(monkeypatch):
    settings = config.loads("", overrides=[*SMALL, "target.rotate_degrees=100", "representation.turn=false"])
    fresh, launched, traced, normal = [], [], [], map_problem.Problem.normal

    def counted(problem, *arguments, **options):
        for kept, number in zip((launched, fresh), history(), strict=True):
            kept.append(number)
        if len(fresh) == 5:  # a texel that becomes bright gets a column
            transport = arguments[0].transport
            influence = transport.influence.copy()
            influence.ravel()[transport.columns] = 0
            bright = problem.envmap.copy()
            bright.reshape(-1, 3)[influence.argmax()] = 1e5
            more = transport.resolved(bright)
            more.apply(bright)
            traced.append(len(np.setdiff1d(more.columns, transport.columns)))
        return normal(problem, *arguments, **options)

    explain = layers_solver.LayersSolver.explain

    def explained(*arguments):
        explanation = explain(*arguments)
        history()
        for kept in (launched, fresh, traced):
            kept.clear()
        return explanation

    monkeypatch.setattr(map_problem.Problem, "normal", counted)
    monkeypatch.setattr(gauss_newton, "LEAST_DECREASE", 1e-9)  # some steps more
    # What is before and between solves, the search and T's error, has kernels of its own.
    monkeypatch.setattr(layers_solver.LayersSolver, "explain", explained)
    monkeypatch.setattr(layers_solver.LayersSolver, "_another", lambda *_: None)
    monkeypatch.setattr(layers_solver.LayersSolver, "_corrected", lambda *_: None)
    steps = []
    compiled(lambda: steps.extend(pipeline.run(settings).history))
    assert len(fresh) > 5 and len(steps) > 2 and min(launched) > 5
    assert fresh[3:] == [0] * len(fresh[3:])
    assert traced[0] > 0


def test_memory_does_not_grow_over_200_iterations(monkeypatch):
    more = ["representation.kind=siren", "representation.hidden=16", "representation.turn=false"]
    more += ["target.spp=256", "optimizer.iterations=200"]
    settings = config.loads("", overrides=[*SMALL, *more])
    live, compare = {}, adam_loop.Objective.__call__

    def watched(objective, rendering, crop, step):
        # Resident pages now, not the peak: field 1 of statm.
        live[step] = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
        return compare(objective, rendering, crop, step)

    monkeypatch.setattr(adam_loop.Objective, "__call__", watched)
    pipeline.run(settings)
    # A leak of one 64 x 32 map a step would be 12 MB over these 120 steps; the history takes 0.1 MB.
    assert len(live) == 200 and live[199] - live[79] < 4e6
