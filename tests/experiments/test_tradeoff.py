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
from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.losses import metrics
from envedit.sweep import DONE
from experiments.__main__ import main
from experiments.harness import Case
from experiments.tradeoff import cell, cost, experiment
from experiments.tradeoff.judge import Judge, without_noise

STANDARD = [f"{experiment.STANDARD}{seed}" for seed in range(3)]


# ---- what is run -------------------------------------------------------------------------------------------
def toml_of(tables):
    return Case("x", config.presets.overlaid(experiment.base("sky.hdr", "glossy"), tables)).job().toml


def flat(tables):
    found = tomllib.loads(toml_of(tables))
    return {f"{t}.{k}": v for t, keys in found.items() if isinstance(keys, dict) for k, v in keys.items()}


def test_a_setting_changes_what_it_says_and_nothing_else():
    standard, changed = flat({}), {}
    for name, tables in cell.SETTINGS.items():
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


def judgement(psnr):
    names = {"fit", "transport", "target", "judge", "start", "edit", "report"}
    return {
        "render": {"psnr": psnr - 1, "psnr_without_noise": psnr},
        "map": {"psnr": 20.0, "ssim": 0.7},
        "sun_degrees": None,
        "timing": {f"{name}_s": 0.25 for name in names},
    }


def test_all_runs_of_a_cell_are_made_in_turn(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(cell, "carry_out", lambda folder: made.append(folder.name) or {"wall_s": len(made)})
    monkeypatch.setattr(cell, "Judge", FakeJudge)
    standard = experiment.base(str(tmp_path / "sky.hdr"), "matte")
    settings = config.from_dict(standard)
    found = cell.cell(settings, tmp_path, standard, ["optimizer.iterations=7"])
    assert made == [run["setting"] for run in found["runs"]] == list(cell.SETTINGS)
    assert [run["cost"]["wall_s"] for run in found["runs"]] == list(range(1, len(made) + 1))
    psnr = {run["setting"]: run["judged"]["render"]["psnr_without_noise"] for run in found["runs"]}
    assert psnr["map width: 64"] == 31 and psnr["standard, seed 1"] == 34
    for name in made:
        left = config.load(tmp_path / name / "job.toml")
        assert left.optimizer.iterations == 7 and left.input.envmap == settings.input.envmap


# ---- a run, measured ---------------------------------------------------------------------------------------
def measured(folder, text):
    return cost.measured([sys.executable, "-S", "-c", text], folder)


@pytest.mark.slow
def test_cost_is_that_of_the_process(tmp_path):
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    small = measured(tmp_path, "pass")
    assert small["peak_bytes"] < 64 << 20 and small["peak_bytes"] >> 20 < here
    large = measured(tmp_path, "a = bytearray(200 << 20); a[::4096] = b'1' * len(a[::4096])")
    assert 200 << 20 < large["peak_bytes"] < 240 << 20
    slow = measured(tmp_path, "import time; time.sleep(0.3)")
    assert slow["wall_s"] >= 0.3 and slow["wall_s"] > slow["cpu_s"] > 0
    for ends, code in (("raise SystemExit(5)", 5), ("import os; os.kill(os.getpid(), 9)", 137)):
        with pytest.raises(EnveditError, match=f"exit code {code};"):
            measured(tmp_path, ends)


@pytest.mark.parametrize(("compiling", "calls"), [(0, 1), (9, 2)], ids=["nothing", "ever"])
def test_a_run_that_compiled_is_made_again(tmp_path, monkeypatch, compiling, calls):
    made = []
    monkeypatch.setattr(cost, "measured", lambda command, folder: made.append(command) or {"wall_s": 1.0})
    monkeypatch.setattr(cell, "kernels", lambda: min(len(made), compiling))
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
    return config.from_dict(experiment.base(str(tmp_path / "sunny.exr"), "matte"), tmp_path)


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
def test_runs_are_judged_by_the_map_at_full_resolution(sunny, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.tradeoff.judge.WIDTH", 64)
    judge = Judge(sunny)
    true = latlong.rotate(images.read(sunny.input.envmap)[0], 60)
    (tmp_path / "metrics.json").write_text(json.dumps({"timing": {"fit_s": 0}}))
    # Without it, by the working map, whatever its width.
    images.write_exr(tmp_path / "edited.exr", latlong.resize(true, 32, 64))
    assert judge(tmp_path)["map"]["psnr"] > 60
    images.write_exr(tmp_path / "edited.exr", np.full((8, 16, 3), 0.3, np.float32))
    assert judge(tmp_path)["map"]["psnr"] < 60
    images.write_exr(tmp_path / "edited_full.exr", true)
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


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Results of all six cells: the standard preset's runs and one setting, ``x``."""
    (tmp_path / "puresky").mkdir()
    for i, name in enumerate(experiment.MAPS):
        sky = np.full((4, 8, 3), i, np.float32)
        images.write_exr(tmp_path / f"puresky/{name}_puresky_1k.exr", sky)
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    cases = experiment.cases(SimpleNamespace(sets=[]))
    for i, case in enumerate(cases):
        runs = [one(STANDARD[k], (9.0, 10.0, 14.0)[k], 40.0 + k) for k in range(3)]
        runs.append(one("x", 5.0 if i % 2 else 20.0, 70.0, sun_degrees=2.0 if i else None))
        folder = case.job().folder(tmp_path / "out")
        folder.mkdir(parents=True)
        bounds = {"unedited": judgement(25.0), "true": judgement(50.0)}
        (folder / case.result).write_text(json.dumps({"runs": runs, "bounds": bounds}))
        (folder / DONE).touch()
    return tmp_path / "out"


def test_ratios_are_to_the_median_of_the_cell_and_changes_from_the_same_seed(results, capsys):
    assert main(["tradeoff", "table", "--out", str(results)]) == 0
    shown = capsys.readouterr().out.splitlines()
    lines = [[text.strip() for text in line.split("|")[1:-1]] for line in shown]
    heads = [i for i, line in enumerate(lines) if line[:1] in (["setting"], ["cell"])]
    means = {line[0]: line[1:] for line in lines[heads[0] : heads[1]] if line}
    # Geometric means: of 0.5 and 2; of 4.5 and 19.5 over 9.5. The rendering is shown with at most 55 dB.
    assert means["x"] == ["6", "1.00", "0.99", "1.00", "+15.00", "+0.00", "+0.000", "2.0"]
    assert means["standard, seed 1"][:2] == ["6", "1.00"] and means["standard, seed 1"][4] == "+1.00"
    assert means["(unedited map)"] == ["6", *["-"] * 7]
    rows = {tuple(line[:2]): line[2:] for line in lines[heads[1] :] if line}
    cell_of = f"{experiment.MAPS[0]}, matte"
    x = rows[cell_of, "x"]
    assert x[:6] == ["20.0", "19.5", "0.5", "0.5", "0.8", "2.00"]
    assert x[6:] == ["55.0", "20.0", "0.700", "-"]
    assert rows[cell_of, "(true map)"][:7] == ["-"] * 6 + ["50.0"]
