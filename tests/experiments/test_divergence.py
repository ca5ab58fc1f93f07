"""An environment map by Adam on its texels: what the losses of path tracing and of stored transport are."""

import math

import mitsuba as mi
import numpy as np
import pytest

from envedit import config
from envedit.images import images
from experiments.divergence import experiment as divergence
from experiments.harness import Case, Done, table

pytestmark = pytest.mark.slow


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(divergence, "WIDTH", 8)
    monkeypatch.setattr(divergence, "TARGET_SPP", 256)
    monkeypatch.setattr(divergence, "JUDGE_SPP", 64)
    monkeypatch.setattr(divergence, "JUDGED_EVERY", 2)
    monkeypatch.setattr(divergence, "SHOWN", (1, 2, 4))
    tables = {"scene": {"file": "sphere", "width": 8}, "optimizer": {"lr": 0.02, "iterations": 4}}
    return config.from_dict(tables)


def test_transport_has_no_noise_and_path_tracing_has(small, tmp_path):
    done = []
    for name, how in {"traced": {"spp": 1, "least": 1.05}, "stored": {"spp": 0}}.items():
        folder = tmp_path / name
        folder.mkdir()
        done.append(Done(Case(name, {}, {"method": name}), folder))
        done[-1].__dict__["metrics"] = divergence.estimate(small, folder, **how)
    traced, stored = (one.metrics for one in done)
    assert [point["step"] for point in traced["judged"]] == [0, 2, 4]
    for point in stored["judged"]:
        assert (point["variance"], abs(point["noise"]) < 1e-9) == (0.0, True)
    assert np.all(np.diff(stored["losses"]) < 0)  # the first steps are all downhill
    assert stored["judged"][-1]["loss"] < stored["judged"][0]["loss"]
    assert traced["judged"][0]["variance"] > 0 and 0 < traced["judged"][0]["noise"] <= 2
    assert images.read(str(tmp_path / "traced" / "map_4.exr"))[0].min() >= 1.05 - 1e-6
    assert stored["judged"][-1]["least"] < 1.05

    rows = [divergence.measure(one) | one.case.about for one in done]
    assert table(divergence.EXPERIMENT, rows).count("\n") == 3
    (drawn,) = divergence.draw(done, tmp_path)
    assert drawn.stat().st_size > 1000


def test_the_loss_of_a_noisy_rendering_is_the_judged_loss_and_its_variance(small):
    """Of the true map the first is 0, so that the loss of a step is its variance alone."""
    scene = divergence.inputs.load_scene(small.scene)
    sky = divergence.sky()
    render = divergence.path_tracing(scene, 4)
    target = mi.TensorXf(divergence.path_tracing(scene, 4096)(mi.TensorXf(sky), 99).numpy())
    errors = (divergence.squared_error(render(mi.TensorXf(sky), step), target) for step in range(64))
    losses = [float(error.array[0]) for error in errors]
    judged = [divergence.judge(scene, render, mi.TensorXf(sky), sky, target, 10 * k) for k in range(32)]
    variance = [point["variance"] for point in judged]
    spread = math.hypot(np.std(losses) / 8, np.std(variance) / math.sqrt(32))
    assert abs(np.mean(losses) - np.mean(variance)) < 4 * spread  # 1 in 16,000 draws of normal errors
    assert abs(np.mean([point["loss"] for point in judged])) < 0.02 * np.mean(losses)
