"""The trade of speed for accuracy: what is run, how it is measured and judged, what tables make of it."""

import json
import resource
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from envedit import config
from envedit.cli import budget
from envedit.core import latlong
from envedit.core.errors import EnveditError
from envedit.images import images
from envedit.losses import metrics
from envedit.sweep import DONE
from experiments.__main__ import main
from experiments.harness import Case, Done
from experiments.levels import experiment as levels
from experiments.tradeoff import analyse, measured, plan, plot, runs
from experiments.tradeoff.experiment import EXPERIMENT
from experiments.tradeoff.judge import Judge, loss_noise, without_noise

# ---- what is run -------------------------------------------------------------------------------------------


def toml_of(setting):
    tables = config.presets.overlaid(plan.base("sky.hdr", "glossy"), setting.tables)
    return Case(setting.name, tables).job().toml


def flat(setting):
    tables = tomllib.loads(toml_of(setting))
    return {f"{t}.{k}": v for t, keys in tables.items() if isinstance(keys, dict) for k, v in keys.items()}


def test_a_knob_changes_what_it_says_and_nothing_else():
    standard, changed = flat(plan.Setting("standard", "standard", {})), {}
    for setting in [one for one in plan.SETTINGS if one.group == "knob"]:
        found = {k: v for k, v in flat(setting).items() if v != standard[k]}
        asked = {f"{t}.{k}": v for t, keys in setting.tables.items() for k, v in keys.items()}
        assert found == asked, setting.name  # also: none repeats what is standard anyway
        changed.setdefault(setting.name.split(": ")[0], set()).update(found)
    assert changed == {
        "samples of T": {"renderer.spp"},
        "path depth": {"renderer.max_depth"},
        "map width": {"input.width"},
        "film width": {"scene.width"},
        "steps at most": {"optimizer.iterations"},
        "optimizer": {"optimizer.kind"},
        "gain without detail, cycles": {"representation.cycles"},
        "samples of target and result": {"target.spp", "output.spp"},
    }
    # Nothing is kept from one run to the next, but kernels.
    assert standard["renderer.cache"] is False and standard["fit.cache"] is False
    assert flat(plan.PAPER)["renderer.kind"] == "path"


def test_combinations_are_named_by_what_they_change():
    keys = {"T": "renderer.spp", "map": "input.width", "film": "scene.width", "samples": "target.spp"}
    for setting in [one for one in plan.SETTINGS if one.group == "joint"]:
        found = flat(setting)
        assert found["target.spp"] == found["output.spp"]
        for part in setting.name.partition(": ")[2].split(", ") if ":" in setting.name else []:
            knob, level = part.split()
            assert found[keys[knob]] == int(level), setting.name


def test_the_standard_preset_runs_before_amid_and_after():
    names = [one.name for one in plan.settings("settings", "glossy")]
    assert len(names) == len(set(names)) == 3 + len(plan.SETTINGS)
    standard = [one.name for one in plan.STANDARD]
    assert [names[i] for i in (0, 1 + len(plan.SETTINGS) // 2, -1)] == standard
    matte = [one.name for one in plan.settings("settings", "matte")]
    assert set(names) - set(matte) == {"siren, map 128"}
    paper = [one.name for one in plan.settings("paper", "glossy")]
    assert paper == [*standard[:2], "paper", standard[2]]
    seeds = [config.loads(toml_of(one)).seed for one in plan.STANDARD]
    assert len(set(seeds)) == 3 and seeds[0] == config.loads(toml_of(plan.SETTINGS[0])).seed


@pytest.fixture
def maps(tmp_path, monkeypatch):
    """A folder of maps: a bright texel at the horizon, in a grey sky."""
    (tmp_path / "puresky").mkdir()
    for i, name in enumerate(plan.MAPS):
        sky = np.full((16, 32, 3), 0.4, np.float32)
        sky[7, 3 + i] = 5000
        images.write_exr(tmp_path / "puresky" / f"{name}_puresky_1k.exr", sky)
    monkeypatch.setenv("ENVEDIT_DATA", str(tmp_path))
    return tmp_path


class FakeJudge:
    """Judges by what the configuration says, without rendering."""

    def __init__(self, settings):
        assert settings.target.degrees == 60

    def __call__(self, folder):
        return judgement(30 + tomllib.loads((folder / "job.toml").read_text())["input"]["width"] / 64)

    def bounds(self):
        return {"unedited": judgement(20.0), "ceiling": judgement(50.0)}


def judgement(psnr, sun=None):
    return {
        "render": {"psnr": psnr, "ssim": 0.9, "psnr_without_noise": psnr},
        "map": {"psnr": 20.0, "ssim": 0.7},
        "sun_degrees": sun,
        "loss_noise": 0.01,
        "timing": {"fit_s": 0.25, "transport_s": 0.5},
    }


def test_all_runs_of_a_cell_are_made_in_turn(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(runs, "carry_out", lambda folder: made.append(folder.name) or {"wall_s": len(made)})
    monkeypatch.setattr(runs, "Judge", FakeJudge)
    settings = config.from_dict(plan.base("sky.hdr", "matte"), tmp_path)
    found = runs.cell(settings, tmp_path, "matte", "settings", ["optimizer.iterations=7"])
    assert made == [run["setting"] for run in found["runs"]]
    assert made == [one.name for one in plan.settings("settings", "matte")]
    assert [run["cost"]["wall_s"] for run in found["runs"]] == list(range(1, len(made) + 1))
    psnr = {run["setting"]: run["judged"]["render"]["psnr"] for run in found["runs"]}
    assert psnr["map width: 64"] == 31 and psnr["standard, seed 1"] == 34
    assert found["ceiling"]["render"]["psnr"] == 50
    for name in made:
        left = config.load(tmp_path / name / "job.toml")
        assert left.optimizer.iterations == 7 and left.input.envmap == settings.input.envmap


@pytest.mark.slow
def test_a_run_that_fails_ends_its_cell(tmp_path, capfd):
    (tmp_path / "job.toml").write_text("seed = 'x'")
    with pytest.raises(EnveditError, match="the run ended with exit code 2"):
        runs.carry_out(tmp_path)
    assert "seed" in capfd.readouterr().err


# ---- a run, measured ---------------------------------------------------------------------------------------


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home of one's own, so that nobody else's kernels are counted."""
    monkeypatch.setattr(measured.Path, "home", lambda: tmp_path)
    (tmp_path / ".drjit").mkdir()
    return tmp_path


def python(text, *more):
    return [sys.executable, "-S", "-c", text, *map(str, more)]


@pytest.mark.slow
def test_cost_is_that_of_the_process(home):
    # A child is a copy of this process for a moment, and told as no smaller.
    here = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    megabytes = here + 200
    code, small = measured.measure(python("pass"))
    assert code == 0 and small["compiled"] == 0
    hungry = f"a = bytearray({megabytes} << 20); a[::4096] = b'1' * len(a[::4096])"
    code, large = measured.measure(python(hungry))
    assert code == 0
    # Beside Python's own. Of a small one it is told what this process has: it counts before exec.
    assert megabytes << 20 < large["peak_bytes"] < (megabytes + 40) << 20
    assert small["peak_bytes"] < large["peak_bytes"]
    code, slow = measured.measure(python("import time; time.sleep(0.3)"))
    assert slow["wall_s"] >= 0.3 and slow["wall_s"] > slow["cpu_s"] > 0
    assert measured.measure(python("raise SystemExit(5)"))[0] == 5
    assert measured.measure(python("import os; os.kill(os.getpid(), 9)"))[0] == -9


# Stands for envedit.run: counts its calls, and compiles a kernel in those that are told.
COMPILES = """
import pathlib, sys
folder, home, calls, code = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), *map(int, sys.argv[3:])
n = len(list(home.glob("call-*")))
(home / f"call-{n}").touch()
if n < calls:
    (home / ".drjit" / f"{n}.llvm.bin").touch()
(folder / "earlier-1").mkdir(exist_ok=True)
(folder / "report.html").touch()
(folder / "edited.exr").touch()
sys.exit(code)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "compiling, longest, calls, compiled",
    [(0, 60, 1, 0), (1, 60, 2, 0), (9, 60, 2, 1), (1, 0, 1, 1)],
    ids=["nothing", "once", "ever", "too long to repeat"],
)
def test_a_run_that_compiled_is_made_again(home, monkeypatch, compiling, longest, calls, compiled):
    folder = home / "job"
    folder.mkdir()
    monkeypatch.setattr(measured, "AGAIN_BELOW", longest)
    run = python(COMPILES, folder, home, compiling, 0)
    assert measured.main(["measured.py", str(folder), *run]) == 0
    assert len(list(home.glob("call-*"))) == calls
    cost = json.loads((folder / measured.COST).read_text())
    assert cost["compiled"] == compiled and ("first" in cost) == (calls == 2)
    assert sorted(path.name for path in folder.iterdir()) == ["cost.json", "edited.exr"]


@pytest.mark.parametrize("code", [3, 130])
def test_a_run_that_fails_has_no_cost(home, code):
    assert measured.main(["measured.py", str(home), *python(COMPILES, home, home, 9, code)]) == code
    assert not (home / measured.COST).exists() and len(list(home.glob("call-*"))) == 1


# ---- how good a map is -------------------------------------------------------------------------------------


def tiny(settings, **more):
    return Judge(settings, **({"spp": 32, "true_spp": 128, "width": 64, "film": 12} | more))


@pytest.fixture
def sunny(tmp_path):
    # An elevation of the sun that the plane is lit from; its column moves by whole texels under the turn.
    sky = np.full((48, 96, 3), 0.3, np.float32)
    sky[12, 60] = (1400, 1200, 900)  # as much light as leaves the picture below white
    images.write_exr(tmp_path / "sunny.exr", sky)
    return config.from_dict(plan.base(str(tmp_path / "sunny.exr"), "matte"), tmp_path)


@pytest.mark.slow
def test_the_true_map_is_as_good_as_noise_allows_and_the_unedited_one_is_not(sunny):
    judge = tiny(sunny, width=96)
    source = images.read(sunny.input.envmap)[0]
    np.testing.assert_array_equal(judge.true, latlong.resize(np.roll(source, -16, 1), 48, 96))
    assert judge.target.shape == (2, 12, 12, 3) and (judge.target[0] != judge.target[1]).any()
    bounds = judge.bounds()
    best, before = bounds["ceiling"], bounds["unedited"]
    assert best["map"]["psnr"] == metrics.PSNR_CAP and best["sun_degrees"] == 0
    assert best["render"]["psnr"] > before["render"]["psnr"] + 10
    assert best["render"]["psnr_without_noise"] > best["render"]["psnr"]
    # 60 degrees of azimuth, on the circle of the sun's row.
    elevation = np.pi * np.rint(np.argmax(judge.true[..., 0]) // 96) / 47
    angle = 2 * np.degrees(np.arcsin(np.sin(np.radians(30)) * np.sin(elevation)))
    assert before["sun_degrees"] == pytest.approx(angle, abs=1e-6)


@pytest.mark.slow
def test_a_map_without_a_sun_has_no_place_of_it(tmp_path):
    images.write_exr(tmp_path / "grey.exr", np.full((8, 16, 3), 999, np.float32))
    judge = tiny(config.from_dict(plan.base(str(tmp_path / "grey.exr"), "matte"), tmp_path), true_spp=2)
    assert judge.compare(judge.true)["sun_degrees"] is None


@pytest.mark.slow
def test_runs_are_judged_by_the_map_at_full_resolution(sunny, tmp_path):
    judge = tiny(sunny)
    true = latlong.rotate(images.read(sunny.input.envmap)[0], 60)
    (tmp_path / "metrics.json").write_text(json.dumps({"timing": {"fit_s": 0}}))
    rows = "".join(f"{i},{1 + 0.1 * (-1) ** i}\n" for i in range(12))
    (tmp_path / "history.csv").write_text("iteration,loss\n" + rows)
    # Without it, by the working map, whatever its width.
    images.write_exr(tmp_path / "edited.exr", latlong.resize(true, 32, 64))
    assert judge(tmp_path)["map"]["psnr"] > 60
    images.write_exr(tmp_path / "edited.exr", np.full((8, 16, 3), 0.3, np.float32))
    assert judge(tmp_path)["map"]["psnr"] < 60
    images.write_exr(tmp_path / "edited_full.exr", true)
    found = judge(tmp_path)
    assert found["map"]["psnr"] == metrics.PSNR_CAP and found["timing"] == {"fit_s": 0}
    # Alternating by 0.1 about 1: second differences are 0.4, over sqrt(6); the last third are 4 of 12 steps.
    assert found["loss_noise"] == pytest.approx(0.4 / np.sqrt(6))


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


def test_loss_noise_knows_no_trend(rng):
    steps = np.arange(3000)
    trend = 5 - steps / 1000
    noisy = trend + 0.01 * rng.standard_normal(3000)
    # Over the last third the loss is 2.5 on average; 998 second differences tell the noise to 5 %.
    assert loss_noise(noisy) == pytest.approx(0.01 / 2.5, rel=0.15)
    assert loss_noise(trend) == pytest.approx(0, abs=1e-12)
    assert loss_noise([1.0] * 8) is None and loss_noise([]) is None
    assert loss_noise([0.0] * 30) is None and loss_noise([1.0] * 9) == 0


# ---- ratios and tables -------------------------------------------------------------------------------------


def one(setting, group, time, psnr, **more):
    judged = judgement(psnr)
    judged |= {key: more[key] for key in more if key in judged}
    cost = {"wall_s": time, "cpu_s": more.get("cpu_s", 1.5 * time), "peak_bytes": 100 * time}
    return {"setting": setting, "group": group, "cost": cost, "judged": judged}


def standard(times=(9.0, 10.0, 14.0), psnrs=(40.0, 41.0, 43.0)):
    return [
        one(f"standard, seed {i}", "standard", *of) for i, of in enumerate(zip(times, psnrs, strict=True))
    ]


def compared(found, cell="a, matte"):
    """Return the rows of a case with these runs, as :func:`.harness.rows_of` does."""
    done = Done(Case(f"{cell}: settings", {}), Path())
    done.__dict__["metrics"] = {"runs": found, "unedited": judgement(25.0), "ceiling": judgement(50.0)}
    return [{"cell": cell} | row for row in analyse.compared(done)]


def test_ratios_are_to_the_median_of_the_cell_and_changes_from_the_same_seed():
    x = one("x", "knob", 5.0, 42.0, map={"psnr": 21.0, "ssim": 0.8})
    rows = compared([*standard(), x])
    assert rows[-1]["ratio"] == pytest.approx({"time": 0.5, "again": 4.25 / 9.25, "memory": 0.5})
    assert rows[-1]["change"] == pytest.approx({"psnr": 2.0, "map_psnr": 1.0, "map_ssim": 0.1})
    assert {row["setting"] for row in rows} == {"standard", "x"}
    for row in rows[:3]:
        assert set(row["ratio"].values()) == {1.0} and set(row["change"].values()) == {0.0}


def test_runs_that_had_less_of_the_processor_are_reported():
    cpu = [("x", 16.0), ("x", 15.0), ("x", 10.0), ("y", 9.0), ("y", 16.0)]
    rows = compared([*standard(), *(one(name, "knob", 10.0, 40.0, cpu_s=s) for name, s in cpu)])
    assert analyse.disturbed(rows) == [rows[5]]  # two runs of y do not show which is usual
    assert "a, matte: settings: x had less of the processor" in analyse.summary(rows)


def test_means_are_geometric_for_ratios_and_leave_out_missing_suns():
    a = one("x", "knob", 5.0, 38.0, sun_degrees=2.0, loss_noise=0.1)
    b = one("x", "knob", 20.0, 39.0, loss_noise=None)
    rows = [
        row
        for cell, run in (("a", a), ("b", b))
        for row in compared([*standard((10.0,), (40.0,)), run], cell)
    ]
    means = {row["setting"]: row for row in analyse.means(rows)}
    assert list(means) == ["standard", "x"]
    assert means["standard"]["cells"] == means["x"]["cells"] == 2
    assert means["x"]["ratio"]["time"] == pytest.approx(1.0) and means["x"]["change"]["psnr"] == -1.5
    assert means["x"]["sun"] == 2.0 and means["x"]["noise"] == 0.1 and means["standard"]["sun"] is None


def test_numbers_of_a_run_are_without_the_judges_noise():
    run = one("x", "knob", 10.0, 0, render={"psnr": 38.0, "psnr_without_noise": 41.0})
    found = analyse.flat(run["cost"], run["judged"])
    assert found["psnr"] == 41.0 and found["time"] == 10.0 and found["again"] == 9.25
    assert found["memory"] == 1000 and found["share"] == 1.5
    assert analyse.flat(run["cost"], judgement(200.0))["psnr"] == 55.0  # a picture without a visible error


def test_the_front_is_what_nothing_beats():
    points = [(1, 1), (2, 3), (3, 2), (0.5, 0), (2, 2.5), (4, 4), (4, 4)]
    assert analyse.front(points) == [(0.5, 0), (1, 1), (2, 3), (4, 4)]
    assert analyse.front([]) == []
    assert analyse.front([(1, 5), (1, 6)]) == [(1, 6)]


def test_the_best_setting_within_a_time_is_found():
    given = ("slow", 1.8, 0.5, 0.5), ("standard", 1.0, 0, 0), ("half", 0.5, -1, -0.1), ("odd", 0.5, -2, 3)
    rows = [
        {"setting": name, "ratio": {"time": time}, "change": {"psnr": psnr, "map_psnr": map_psnr}}
        for name, time, psnr, map_psnr in given
    ]
    assert analyse.best_within(rows, 2.0)["setting"] == "slow"
    assert analyse.best_within(rows, 1.0)["setting"] == "odd"
    assert analyse.best_within(rows[:3], 0.999)["setting"] == "half"
    assert analyse.best_within(rows, 0.4) is None


def test_seeds_differ_by_the_pooled_deviation():
    rows = compared(standard((10.0, 12.0), (40.0, 42.0)), "a")
    found = analyse.spread(rows + compared(standard((30.0, 30.0), (30.0, 30.0)), "b"))
    assert found["psnr"] == pytest.approx(1.0)  # variances 2 and 0
    assert found["time"] == pytest.approx(np.sqrt(2 / 11**2 / 2))


@pytest.mark.slow
def test_tables_and_figures_are_made_of_results(maps, capsys):
    pytest.importorskip("matplotlib")
    out, rng = maps / "out", np.random.default_rng(0)
    asked = ["tradeoff", "table", "--out", str(out)]
    assert main(asked) == 0 and "no case is done" in capsys.readouterr().out
    for case in EXPERIMENT.cases(SimpleNamespace(sets=[])):
        part = case.name.split(": ")[1]
        scene = case.about["cell"].split(", ")[1]
        asked_for = [(s, rng.uniform(4, 25)) for s in plan.settings(part, scene)]
        found = [one(s.name, s.group, time, 36 + time / 6) for s, time in asked_for]
        folder = case.job().folder(out)
        folder.mkdir(parents=True)
        made = {"runs": found, "unedited": judgement(25.0), "ceiling": judgement(50.0)}
        (folder / case.result).write_text(json.dumps(made))
        (folder / DONE).touch()
    assert main(asked) == 0
    text = capsys.readouterr().out
    assert text.startswith("Standard deviation between seeds")
    for start in ("overcast_soil, matte | draft", f"{plan.MAPS[-1]}, glossy | paper", "joint 5: T 32"):
        assert f"\n| {start}" in text
    # Only what ran in all cells is the best within a time.
    assert "paper" not in text.partition("presets:")[0]
    readme = (Path(plan.__file__).parent / "README.md").read_text()
    for columns in analyse.COLUMNS.values():
        head = f"| {' | '.join(columns)} |"
        assert head in text and head in readme
    assert main(["tradeoff", "sheet", "--out", str(out)]) == 0
    files = [Path(line) for line in capsys.readouterr().out.split()]
    assert [file.name for file in files] == ["front.png", "knobs.png"]
    assert all(file.stat().st_size > 20_000 for file in files)
    assert plot.draw([], out) == []


@pytest.mark.parametrize("level", budget.LEVELS, ids=lambda level: level.name)
def test_a_level_of_the_budget_is_run_as_it_says(level, tmp_path):
    found = config.from_dict(levels.tables_of(plan.base("sky.hdr", "glossy"), level), tmp_path)
    assert (found.input.width, found.scene.width) == (level.map, level.film)
    assert (found.target.spp, found.output.spp) == (level.spp, level.spp)
    assert found.scene.parameters == {"roughness": 0.05} and not found.renderer.cache
    names = "target", "judge", "transport", "start", "fit", "edit", "report"
    times = {f"{name}_s": 2**i for i, name in enumerate(names)}
    alike = {"render": budget.REFERENCE_RENDER, "machine": 1.0}
    assert levels.parts(times, alike) == {"rendering": 3, "tracing": 12, "numbers": 112}
    slower = {"render": 2 * budget.REFERENCE_RENDER, "machine": 4.0}
    assert levels.parts(times, slower) == {"rendering": 1.5, "tracing": 6, "numbers": 28}


def test_levels_lose_what_the_standard_one_has_more():
    def row(level, cell, total, psnr):
        seconds = dict.fromkeys(("rendering", "tracing", "numbers"), 1.0) | {"total": total}
        return {"level": level, "cell": cell, "seconds": seconds, "psnr": {"rendering": psnr, "map": 20.0}}

    rows = [row("coarse", "a", 3.0, 38.0), row("coarse", "b", 5.0, 39.0), row("coarse", "c", 4.0, 0.0)]
    rows += [row("standard", "a", 9.0, 40.0), row("standard", "b", 9.0, 40.0)]
    coarse, best = levels.combine(rows)
    assert coarse["runs"] == 3 and coarse["total"] == "4.0 to 5.0"
    assert coarse["lost"] == {"rendering": 1.5, "map": 0.0} and best["lost"]["rendering"] == 0
    assert levels.combine(rows[:1])[0]["lost"] == {"rendering": None, "map": None}
