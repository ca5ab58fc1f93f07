"""The measurement of a GPU, as far as a machine without one can try it: failures, time, and tiny sizes."""

import json
import os
import subprocess
import sys

import pytest

from experiments import gpu
from tests.oracles import ROOT


@pytest.fixture
def steps(monkeypatch):
    """Let steps be made up in place of measured; the fixture is their results by step and variant."""
    made = {}

    def measured(step, variant, left):
        assert 0 < left <= 480
        return made.get((step, variant), {"wall_s": 1.0})

    monkeypatch.setattr(gpu, "measured", measured)
    return made


def test_both_variants_are_measured_and_without_a_gpu_the_cpu_alone(tmp_path, steps, capsys):
    out = tmp_path / "gpu.json"
    steps["solver", "llvm_ad_rgb"] = {"error": "slow"}  # the CPU is only there to compare with
    assert gpu.main([str(out)]) == 0
    found = json.loads(out.read_text())
    assert list(found["steps"]) == ["doctor", "quickstart", "engine", "solver", "fit"]
    assert all(list(one) == ["cuda_ad_rgb", "llvm_ad_rgb"] for one in found["steps"].values())
    assert found["machine"]["cores"] and "cuda_ad_rgb fit: 1.0 s" in capsys.readouterr().out
    steps["doctor", "cuda_ad_rgb"] = {"error": "no GPU"}
    assert gpu.main([str(out)]) == 1
    found = json.loads(out.read_text())["steps"]
    assert "cuda_ad_rgb" not in found["engine"] and found["engine"]["llvm_ad_rgb"] == {"wall_s": 1.0}


@pytest.mark.slow
def test_a_step_that_fails_or_takes_too_long_is_a_result():
    found = gpu.measured("doctor", "none_ad_rgb", 60)
    assert found.keys() == {"error"} and "none_ad_rgb" in found["error"]
    assert gpu.measured("fit", "llvm_ad_rgb", 0.5) == {"error": "not done after 0 s"}


@pytest.mark.slow
def test_steps_are_measured_at_tiny_sizes(tmp_path, monkeypatch):
    """Other tests run what *doctor* and *engine* do, and *quickstart* is as *solver*."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    commands = gpu.commands
    monkeypatch.setattr(gpu, "commands", lambda *asked: commands(*asked)[-1:])  # without warming up
    solver, fit = (gpu.measured(step, "llvm_ad_rgb", 600, small=True) for step in ("solver", "fit"))
    assert solver["wall_s"] > 0 and fit["wall_s"] > 0, (solver, fit)
    assert solver["psnr"]["render"] > solver["psnr"]["initial"]
    assert fit["epochs"] == 6


@pytest.mark.slow
def test_the_script_calls_the_program_from_anywhere(tmp_path):
    command = ["bash", ROOT / "experiments/gpu.sh"]
    own = os.environ | {"PYTHON": sys.executable}
    done = subprocess.run(command, env=own, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "usage: experiments/gpu.sh OUT.json" in done.stderr
