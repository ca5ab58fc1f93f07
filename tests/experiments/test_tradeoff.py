"""The trade of speed for accuracy: what is run, how it is measured and judged, what tables make of it."""

import json
import resource
import sys
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from envedit import config
from envedit.core import latlong
from envedit.images import images
from envedit.losses import metrics
from experiments.harness import Case, Done, rows_of, table
from experiments.tradeoff import cell, cost, experiment, plan
from experiments.tradeoff.judge import Judge, without_noise


# ---- what is run -------------------------------------------------------------------------------------------
def toml_of(tables):
    return Case("x", config.presets.overlaid(plan.base("sky.hdr", "glossy"), tables)).job().toml


def flat(tables):
    found = tomllib.loads(toml_of(tables))
    return {f"{t}.{k}": v for t, keys in found.items() if isinstance(keys, dict) for k, v in keys.items()}


def test_a_setting_changes_what_it_says_and_nothing_else():
    standard, changed = flat({}), {}
    for name, tables in plan.SETTINGS.items():
        if ": " not in name:
            continue
        found = {k: v for k, v in flat(tables).items() if v != standard[k]}
        asked = {f"{t}.{k}": v for t, keys in tables.items() for k, v in keys.items()}
        assert found == asked, name  # also: none repeats what is standard anyway
        changed.setdefault(name.split(": ")[0], set()).update(found)
    assert changed["samples of T"] == {"renderer.spp"} and changed["optimizer"] == {"optimizer.kind"}
    assert changed["samples of target and result"] == {"target.spp", "output.spp"}
    # Nothing is kept from one run to the next, but kernels.
    assert standard["renderer.cache"] is False and standard["fit.cache"] is False


class FakeJudge:
    """Judges by what the configuration says, without rendering."""

    def __init__(self, settings):
        assert settings.target.degrees == 60

    def __call__(self, folder):
        return judgement(30 + tomllib.loads((folder / "job.toml").read_text())["input"]["width"] / 64)

    def bounds(self):
        return {"unedited": judgement(20.0), "true": judgement(50.0)}


def judgement(psnr, sun=None):
    names = {"fit", "transport", "target", "judge", "start", "edit", "report"}
    return {
        "render": {"psnr": psnr - 1, "psnr_without_noise": psnr},
        "map": {"psnr": 20.0, "ssim": 0.7},
        "sun_degrees": sun,
        "timing": {f"{name}_s": 0.25 for name in names},
    }


def test_all_runs_of_a_cell_are_made_in_turn(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(cell, "carry_out", lambda folder: made.append(folder.name) or {"wall_s": len(made)})
    monkeypatch.setattr(cell, "Judge", FakeJudge)
    settings = config.from_dict(plan.base("sky.hdr", "matte"), tmp_path)
    found = cell.cell(settings, tmp_path, "matte", ["optimizer.iterations=7"])
    assert made == [run["setting"] for run in found["runs"]]
    assert [made[k] for k in (0, 1 + len(plan.SETTINGS) // 2, -1)] == plan.STANDARD
    assert [run["cost"]["wall_s"] for run in found["runs"]] == list(range(1, len(made) + 1))
    psnr = {run["setting"]: run["judged"]["render"]["psnr_without_noise"] for run in found["runs"]}
    assert psnr["map width: 64"] == 31 and psnr["standard, seed 1"] == 34
    for name in made:
        left = config.load(tmp_path / name / "job.toml")
        assert left.optimizer.iterations == 7 and left.input.envmap == settings.input.envmap


# ---- a run, measured ---------------------------------------------------------------------------------------
def measured(folder, text):
    file = folder / "cost.json"
    command = [sys.executable, "-S", cost.__file__, file, sys.executable, "-S", "-c", text]
    return cell.subprocess.run(command).returncode, json.loads(file.read_text())


@pytest.mark.slow
def test_cost_is_that_of_the_process(tmp_path):
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    code, small = measured(tmp_path, "pass")
    assert code == 0 and small["peak_bytes"] < 64 << 20 and small["peak_bytes"] >> 20 < here
    code, large = measured(tmp_path, "a = bytearray(200 << 20); a[::4096] = b'1' * len(a[::4096])")
    assert code == 0 and 200 << 20 < large["peak_bytes"] < 240 << 20
    code, slow = measured(tmp_path, "import time; time.sleep(0.3)")
    assert slow["wall_s"] >= 0.3 and slow["wall_s"] > slow["cpu_s"] > 0
    assert measured(tmp_path, "raise SystemExit(5)")[0] == 5
    assert measured(tmp_path, "import os; os.kill(os.getpid(), 9)")[0] == 137


@pytest.mark.parametrize("compiling, longest, calls", [
    (0, 60, 1), (9, 60, 2), (1, 0, 1),
], ids=["nothing", "ever", "too long to repeat"])  # fmt: skip
def test_a_run_that_compiled_is_made_again(tmp_path, monkeypatch, compiling, longest, calls):
    made = []

    def run(command):
        made.append(command)
        (tmp_path / "cost.json").write_text('{"wall_s": 1.0}')
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(cell, "subprocess", SimpleNamespace(run=run))
    monkeypatch.setattr(cell, "kernels", lambda: min(len(made), compiling))
    monkeypatch.setattr(cell, "AGAIN_BELOW", longest)
    assert cell.carry_out(tmp_path) == {"wall_s": 1.0} and len(made) == calls


# ---- how good a map is -------------------------------------------------------------------------------------
@pytest.fixture
def tiny(monkeypatch):
    for name, value in {"SPP": 32, "TRUE_SPP": 128, "WIDTH": 96, "FILM": 12}.items():
        monkeypatch.setattr(f"experiments.tradeoff.judge.{name}", value)


@pytest.fixture
def sunny(tmp_path):
    # An elevation of the sun that the plane is lit from; its column moves by whole texels under the turn.
    sky = np.full((48, 96, 3), 0.3, np.float32)
    sky[12, 60] = (1400, 1200, 900)  # as much light as leaves the picture below white
    images.write_exr(tmp_path / "sunny.exr", sky)
    return config.from_dict(plan.base(str(tmp_path / "sunny.exr"), "matte"), tmp_path)


@pytest.mark.slow
def test_the_true_map_is_as_good_as_noise_allows_and_the_unedited_one_is_not(sunny, tiny):
    judge = Judge(sunny)
    source = images.read(sunny.input.envmap)[0]
    np.testing.assert_array_equal(judge.true, latlong.resize(np.roll(source, -16, 1), 48, 96))
    assert judge.target.shape == (2, 12, 12, 3) and (judge.target[0] != judge.target[1]).any()
    bounds = judge.bounds()
    best, before = bounds["true"], bounds["unedited"]
    assert best["map"]["psnr"] == metrics.PSNR_CAP and best["sun_degrees"] < 1e-5
    assert best["render"]["psnr"] > before["render"]["psnr"] + 10
    assert best["render"]["psnr_without_noise"] > best["render"]["psnr"]
    # 60 degrees of azimuth, on the circle of the sun's row.
    elevation = np.pi * np.rint(np.argmax(judge.true[..., 0]) // 96) / 47
    angle = 2 * np.degrees(np.arcsin(np.sin(np.radians(30)) * np.sin(elevation)))
    assert before["sun_degrees"] == pytest.approx(angle, abs=1e-6)


@pytest.mark.slow
def test_runs_are_judged_by_the_map_at_full_resolution(sunny, tiny, tmp_path):
    judge = Judge(sunny)
    (tmp_path / "metrics.json").write_text(json.dumps({"timing": {"fit_s": 0}}))
    images.write_exr(tmp_path / "edited.exr", np.full((8, 16, 3), 0.3, np.float32))
    assert judge(tmp_path)["map"]["psnr"] < 60
    images.write_exr(tmp_path / "edited_full.exr", judge.true)
    found = judge(tmp_path)
    assert found["map"]["psnr"] == metrics.PSNR_CAP and found["timing"] == {"fit_s": 0}


def test_error_without_noise_is_that_of_the_means(rng):
    wanted, bias, noise = 0.5, 0.02, 0.05

    def halves(level):
        display = level + noise * rng.standard_normal((2, 100, 100, 3))
        return np.clip(display, 0, 1) ** 2.2

    found = without_noise(halves(wanted + bias), halves(wanted))
    # The estimate of the square, 4e-4, has a standard deviation of noise^2 2 / sqrt(30000) = 3e-5, 0.3 dB.
    assert found == pytest.approx(-20 * np.log10(bias), abs=1.2)
    with_it = metrics.compare(halves(wanted + bias).mean(0), halves(wanted).mean(0))["psnr"]
    assert with_it < found - 5
    assert without_noise(np.full((2, 2, 2, 3), 0.3), np.full((2, 2, 2, 3), 0.3)) == metrics.PSNR_CAP
    opposite = np.stack([np.full((2, 2, 3), 0.3), np.full((2, 2, 3), 0.5)])
    assert without_noise(opposite, opposite[::-1]) == metrics.PSNR_CAP  # a square below 0


# ---- ratios and tables -------------------------------------------------------------------------------------
def one(setting, time, psnr, **more):
    spent = {"wall_s": time, "cpu_s": 1.5 * time, "peak_bytes": 1e8 * time}
    return {"setting": setting, "cost": spent, "judged": judgement(psnr) | more}


def done(time, sun):
    """A cell that is done: the standard preset's runs and one setting, ``x``."""
    runs = [one(plan.STANDARD[k], (9.0, 10.0, 14.0)[k], 40.0 + k) for k in range(3)]
    runs.append(one("x", time, 70.0, sun_degrees=sun))
    made = Done(Case("cell", {}, {"cell": "a map, matte"}), None)
    bounds = {"unedited": judgement(25.0), "true": judgement(50.0)}
    made.__dict__["metrics"] = {"runs": runs, "bounds": bounds}
    return made


def test_ratios_are_to_the_median_of_the_cell_and_changes_from_the_same_seed():
    rows = rows_of(experiment.EXPERIMENT, [done(20.0, None), done(5.0, 2.0)])
    x = next(row for row in rows if row["setting"] == "x")
    times = [x[name] for name in ("s", "again_s", "rendering_s", "tracing_s", "numbers_s", "gb")]
    assert times == [20, 19.5, 0.5, 0.5, 0.75, 2] and (x["psnr"], x["map_psnr"]) == (55, 20)
    shown = table(experiment.EXPERIMENT, rows).partition("runs:")[0].splitlines()
    cells = [[text.strip() for text in line.split("|")[1:-1]] for line in shown]
    means = {line[0]: line[1:] for line in cells if line}
    # Geometric means: of 0.5 and 2; of 4.5 and 19.5 over 9.5. The rendering is shown with at most 55 dB.
    assert means["x"] == ["2", "1.00", "0.99", "1.00", "+15.00", "+0.00", "+0.000", "2.0"]
    assert means["standard, seed 1"][:2] == ["2", "1.00"] and means["standard, seed 1"][4] == "+1.00"
    assert means["(unedited map)"] == ["2", *["-"] * 7]
