"""The trade of speed for accuracy: what is run, how it is measured and judged, what tables make of it."""

import argparse
import json
import re
import resource
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from envedit import config
from envedit.cli import budget
from envedit.core import latlong
from envedit.core.errors import ConfigError, InputError
from envedit.images import images
from envedit.losses import metrics
from envedit.sweep import drive
from experiments import harness
from experiments.__main__ import main
from experiments.levels import experiment as levels
from experiments.tradeoff import analyse, experiment, measured, plan, plot
from experiments.tradeoff.judge import Judge, loss_noise, without_noise

# ---- what is run -------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """A folder of maps: a bright texel at the horizon, in a grey sky."""
    for i, name in enumerate(plan.MAPS):
        sky = np.full((16, 32, 3), 0.4, np.float32)
        sky[7, 3 + i] = 5000
        images.write_exr(tmp_path / f"{name}.exr", sky)
    return tmp_path


def asked(folder, *more):
    return ["--maps", str(folder), "--out", str(folder / "out"), *more]


def arguments(folder, *more):
    parser = argparse.ArgumentParser()
    experiment.options(parser)
    harness.add_options(parser, folder)
    return parser.parse_args(asked(folder, *more))


def test_every_run_is_a_job_of_its_own(folder):
    pairs = experiment.pairs(arguments(folder, "--joint", "5"))
    jobs = [plan.job_of(cell, setting) for cell, setting in pairs]
    assert len({job.key for job in jobs}) == len({job.name for job in jobs}) == len(jobs)
    names = [s.name for s in plan.settings(5)]
    assert len(names) == len(set(names))
    assert {(cell.map, cell.scene) for cell, _ in pairs} == {(m, s) for m in plan.MAPS for s in plan.SCENES}
    # A fit takes longest: SIRENs in one scene, the paper's preset in one cell, unless asked for.
    assert {cell.scene for cell, s in pairs if s.group == "siren"} == {"glossy"}
    assert [cell.name for cell, s in pairs if s.group == "paper"] == [f"{plan.MAPS[-1]}, glossy"]
    given = arguments(folder, "--paper", "all", "--siren-scenes", "matte", "glossy", "--joint", "0")
    more = experiment.pairs(given)
    assert len([1 for _, s in more if s.group == "paper"]) == 6
    assert {cell.scene for cell, s in more if s.group == "siren"} == set(plan.SCENES)
    assert not any(s.name.startswith("joint") for _, s in more)


def test_a_knob_changes_what_it_says_and_nothing_else(folder):
    cell = plan.cells(folder)[0]

    def flat(setting):
        tables = tomllib.loads(plan.job_of(cell, setting).toml)
        return {
            f"{t}.{k}": v for t, keys in tables.items() if isinstance(keys, dict) for k, v in keys.items()
        }

    standard = flat(plan.Setting("standard", "standard", {}))
    changed = {}
    for setting in plan.knobs():
        found = {k: v for k, v in flat(setting).items() if v != standard[k]}
        asked = {f"{t}.{k}": v for t, keys in setting.table.items() for k, v in keys.items()}
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
    widths = {flat(s)["input.width"] for s in plan.knobs()}
    assert min(widths) == 64 and max(widths) == 512
    # Nothing is kept from one run to the next, but kernels.
    assert standard["renderer.cache"] is False and standard["fit.cache"] is False
    assert flat(plan.PAPER)["renderer.kind"] == "path" and flat(plan.DRAFT)["input.width"] == 128


def test_joint_settings_fill_every_range_evenly():
    settings = plan.joint(12, seed=3)
    factors = {
        "T": ("renderer", "spp"),
        "map": ("input", "width"),
        "film": ("scene", "width"),
        "samples": ("target", "spp"),
    }
    for factor, (table, key) in factors.items():
        levels = plan.FACTORS[factor]
        drawn = [s.table[table][key] for s in settings]
        low, high = 12 // len(levels), -(-12 // len(levels))
        assert {drawn.count(level) for level in levels} <= {low, high}, factor
    assert all(s.table["output"] == s.table["target"] for s in settings)
    assert settings == plan.joint(12, seed=3) != plan.joint(12, seed=4)
    assert plan.joint(0) == []
    # Not one and the same order in every factor.
    assert len({tuple(np.argsort([s.table[t][k] for s in settings])) for t, k in factors.values()}) == 4


def test_all_settings_are_configurations(folder):
    cell = plan.cells(folder)[0]
    for setting in [*plan.settings(3), plan.PAPER, *plan.settings(2, quick=True), plan.references(1)]:
        settings = config.loads(plan.job_of(cell, setting).toml)
        assert settings.target.rotate_degrees == plan.ANGLE and settings.output.full


def test_the_standard_preset_runs_before_amid_and_after(folder):
    cells = plan.cells(folder, plan.MAPS[:2], ["matte"])
    todo = [(cell, s) for s in plan.knobs()[:3] for cell in cells]

    def settings(work):
        return [case.about["setting"] for case in work]

    work = experiment.session_cases(todo, "monday")
    groups = [setting.group for setting in settings(work)]
    assert groups == ["standard"] * 2 + ["knob"] * 3 + ["standard"] * 2 + ["knob"] * 3 + ["standard"] * 2
    assert [tuple(c.about.values()) for c in work if c.about["setting"].group == "knob"] == todo
    keys = [case.job().key for case in work]
    assert len(set(keys)) == len(keys)
    later = [case.job().key for case in experiment.session_cases(todo, "tuesday")]
    same = [a == b for a, b in zip(keys, later, strict=True)]
    assert same == [group == "knob" for group in groups]  # the standard preset is measured anew
    # One run alone has all three beside it.
    alone = settings(experiment.session_cases(todo[:1], "x"))
    assert [setting.group for setting in alone] == ["standard", "standard", "knob", "standard"]


def test_maps_that_are_missing_are_named(folder, capsys, monkeypatch):
    assert {c.file.suffix for c in plan.cells(folder)} == {".exr"}
    (folder / f"{plan.MAPS[0]}_puresky_1k.hdr").write_bytes(b"")  # PolyHaven's name comes first
    assert plan.cells(folder)[0].file.suffix == ".hdr"
    out = ["--out", str(folder / "out")]
    assert main(["tradeoff", "run", "--maps", str(folder / "nowhere"), *out]) == 3
    assert f"no map {plan.MAPS[0]}_puresky_1k.hdr" in capsys.readouterr().err
    monkeypatch.delenv("ENVEDIT_DATA", raising=False)
    assert main(["tradeoff", "run", *out]) == 3
    assert "--maps" in capsys.readouterr().err
    assert main(["tradeoff", "run", *asked(folder, "--joint", "-1")]) == 2
    for wrong in (["--workers", "0"], ["--paper", "two"]):
        with pytest.raises(SystemExit) as stop:
            main(["tradeoff", "run", *wrong])
        assert stop.value.code == 2


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


@pytest.mark.parametrize(
    "compiling, longest, calls, compiled",
    [(0, 60, 1, 0), (1, 60, 2, 0), (9, 60, 2, 1), (1, 0, 1, 1)],
    ids=["nothing", "once", "ever", "too long to repeat"],
)
def test_a_run_that_compiled_is_made_again(home, monkeypatch, compiling, longest, calls, compiled):
    folder = home / "job"
    folder.mkdir()
    monkeypatch.setattr(measured, "AGAIN_BELOW", longest)
    monkeypatch.setattr(measured, "command", lambda folder, _: python(COMPILES, folder, home, compiling, 0))
    assert measured.main(["measured.py", str(folder), "2", "monday"]) == 0
    assert len(list(home.glob("call-*"))) == calls
    cost = json.loads((folder / "cost.json").read_text())
    assert cost["compiled"] == compiled and cost["session"] == "monday" and cost["threads"] == 2
    assert ("first" in cost) == (calls == 2)
    assert sorted(path.name for path in folder.iterdir()) == ["cost.json", "edited.exr"]


@pytest.mark.parametrize("code", [3, 130])
def test_a_run_that_fails_has_no_cost(home, monkeypatch, code):
    monkeypatch.setattr(measured, "command", lambda folder, _: python(COMPILES, folder, home, 9, code))
    assert measured.main(["measured.py", str(home), "2", "monday"]) == code
    assert not (home / "cost.json").exists() and len(list(home.glob("call-*"))) == 1


def test_a_run_is_envedits_command_line(tmp_path):
    whole = measured.command(tmp_path, 10**6)
    assert whole[1:] == [
        "-m",
        "envedit.run",
        str(tmp_path / "job.toml"),
        "--out",
        str(tmp_path),
        "--quiet",
    ]
    part = measured.command(tmp_path, 0)
    assert part[1] == "-c" and "set_thread_count" in part[2] and part[3] == "0"
    # Another run's share of the cores: the program behind -c is that command line too.
    told = subprocess.run([*part[:3], "1", "--help"], capture_output=True, text=True, check=False)
    assert told.returncode == 0 and "envedit run" in told.stdout


# ---- all of them -------------------------------------------------------------------------------------------

STUB = """
import json, pathlib, sys
folder, threads, session = pathlib.Path(sys.argv[1]), *sys.argv[2:]
notes = pathlib.Path(__file__).parent
with open(notes / "notes", "a") as file:
    file.write(folder.name + "\\n")
if (notes / "fail").exists() and "spp = 16" in (folder / "job.toml").read_text():
    print("broken", file=sys.stderr)
    sys.exit(5)
cost = {"wall_s": 2.0, "cpu_s": 3.0, "peak_bytes": 10**9, "compiled": 0, "session": session}
(folder / "cost.json").write_text(json.dumps(cost))
"""


class FakeJudge:
    """Judges by what the configuration says, without rendering."""

    def __call__(self, cell, folder):
        if (folder / "unusable").exists():
            raise InputError("edited.exr: cannot be read")
        text = (folder / "job.toml").read_text()
        width = int(re.search(r"width = (\d+)", text)[1])
        return judgement(psnr=30 + width / 64)

    def bounds(self, cell):
        return {"unedited": judgement(20.0), "ceiling": judgement(50.0)}


def judgement(psnr, sun=None):
    return {
        "render": {"psnr": psnr, "ssim": 0.9, "psnr_without_noise": psnr},
        "map": {"psnr": 20.0, "ssim": 0.7},
        "sun_degrees": sun,
        "loss_noise": 0.01,
        "timing": {"fit_s": 0.25, "transport_s": 0.5},
        "transport": {},
    }


@pytest.fixture
def stub(folder, monkeypatch):
    monkeypatch.setattr(drive, "POLL", 0.02)
    few = [plan.DRAFT, *[s for s in plan.knobs() if s.name in ("samples of T: 16", "map width: 64")]]
    monkeypatch.setattr(plan, "settings", lambda count, quick: few)
    (folder / "stub.py").write_text(STUB)
    monkeypatch.setattr(plan, "COMMAND", ("{python}", "-S", str(folder / "stub.py"), "{folder}", "{threads}"))
    monkeypatch.setattr(experiment, "judge_of", lambda given, out: FakeJudge())


@pytest.mark.slow
def test_what_is_done_is_skipped_and_what_failed_is_tried_again(folder, stub, monkeypatch, capsys):
    monkeypatch.setattr(experiment.time, "strftime", lambda *_: "first")
    ask = asked(folder, "--quick", "--paper", "none")

    def done():
        return (folder / "notes").read_text().split() if (folder / "notes").exists() else []

    def results():
        return json.loads((folder / "out" / "results.json").read_text())

    assert main(["tradeoff", "run", "--dry-run", *ask]) == 0 and not done()
    assert "overcast_soil, matte: draft" in capsys.readouterr().out
    (folder / "fail").touch()
    assert main(["tradeoff", "run", *ask]) == 1
    assert capsys.readouterr().err.count("exit code 5: broken (") == 2  # a setting in two cells
    ran = done()
    assert len(ran) == len(set(ran)) == 3 * 2 + 3 * 2  # three settings, three standard runs, two cells
    found = results()
    assert len(found["runs"]) == 10 and len(found["cells"]) == 2
    assert {r["session"] for r in found["runs"]} == {"first"}
    # Again: what failed alone, with standard runs of its own.
    monkeypatch.setattr(experiment.time, "strftime", lambda *_: "second")
    (folder / "fail").unlink()
    assert main(["tradeoff", "run", *ask]) == 0
    assert len(done()) == 12 + 2 + 6
    found = results()
    assert len(found["runs"]) == 18
    sessions = [r["session"] for r in found["runs"] if r["setting"] == "samples of T: 16"]
    assert sessions == ["second"] * 2
    # And nothing at all: neither runs nor standard runs.
    assert main(["tradeoff", "run", *ask]) == 0 and len(done()) == 20
    assert results()["runs"] == found["runs"] and found["about"]["versions"]["mitsuba"]
    one = next(r for r in found["runs"] if r["setting"] == "map width: 64")
    assert one["time"] == 2.0 and one["again"] == 1.25 and one["memory"] == 10**9 and one["psnr"] == 31.0
    # One that cannot be judged is reported and left out.
    (folder / "out" / one["folder"] / "unusable").touch()
    capsys.readouterr()
    assert main(["tradeoff", "table", *ask]) == 0 and len(results()["runs"]) == 17
    assert ": map width: 64: not judged: edited.exr: cannot be read" in capsys.readouterr().err
    # Nor are results of another version.
    monkeypatch.setattr("envedit.sweep.jobs.program", lambda: "another")
    assert main(["tradeoff", "table", *ask]) == 0 and capsys.readouterr().out == "no run is done\n"


# ---- how good a map is -------------------------------------------------------------------------------------


def tiny(out, **more):
    return Judge(out, **({"spp": 32, "true_spp": 128, "width": 64, "film": 12} | more))


@pytest.fixture
def cell(folder):
    # An elevation of the sun that the plane is lit from; its column moves by whole texels under the turn.
    sky = np.full((48, 96, 3), 0.3, np.float32)
    sky[12, 60] = (1400, 1200, 900)  # as much light as leaves the picture below white
    images.write_exr(folder / "sunny.exr", sky)
    return plan.Cell("sunny", "matte", folder / "sunny.exr")


@pytest.mark.slow
def test_the_true_map_is_as_good_as_noise_allows_and_the_unedited_one_is_not(cell, tmp_path):
    judge = tiny(tmp_path, width=96)
    true, wanted = judge.true(cell)
    np.testing.assert_array_equal(true, latlong.resize(np.roll(images.read(cell.file)[0], -16, 1), 48, 96))
    assert wanted.shape == (2, 12, 12, 3) and (wanted[0] != wanted[1]).any()
    bounds = judge.bounds(cell)
    best, before = bounds["ceiling"], bounds["unedited"]
    assert best["map"]["psnr"] == metrics.PSNR_CAP and best["sun_degrees"] == 0
    assert best["render"]["psnr"] > before["render"]["psnr"] + 10
    assert best["render"]["psnr_without_noise"] > best["render"]["psnr"]
    # 60 degrees of azimuth, on the circle of the sun's row.
    elevation = np.pi * np.rint(np.argmax(true[..., 0]) // 96) / 47
    angle = 2 * np.degrees(np.arcsin(np.sin(np.radians(30)) * np.sin(elevation)))
    assert before["sun_degrees"] == pytest.approx(angle, abs=1e-6)
    # Kept, and judged again if it would be judged otherwise.
    judge._halves = None
    assert judge.bounds(cell) == bounds
    assert tiny(tmp_path, width=96, spp=8).bounds(cell)["ceiling"] != best


def test_a_map_without_a_sun_has_no_place_of_it(folder, tmp_path):
    images.write_exr(folder / "grey.exr", np.full((8, 16, 3), 999, np.float32))
    cell = plan.Cell("grey", "matte", folder / "grey.exr")
    judge = tiny(tmp_path, spp=2, true_spp=2)
    assert judge.compare(cell, judge.true(cell)[0])["sun_degrees"] is None


def leave(folder, edited, full=None):
    """What a run leaves, of what is looked at."""
    folder.mkdir(exist_ok=True)
    images.write_exr(folder / "edited.exr", edited)
    if full is not None:
        images.write_exr(folder / "edited_full.exr", full)
    told = {
        "render": {"psnr": 44.0},
        "iterations": 12,
        "timing": {"fit_s": 0},
        "transport": None,
        "choices": [],
    }
    (folder / "metrics.json").write_text(json.dumps(told))
    rows = "".join(f"{i},{1 + 0.1 * (-1) ** i}\n" for i in range(12))
    (folder / "history.csv").write_text("iteration,loss\n" + rows)
    return folder


@pytest.mark.slow
def test_runs_are_judged_by_the_map_at_full_resolution_once(cell, tmp_path):
    judge = tiny(tmp_path)
    true = latlong.rotate(images.read(cell.file)[0], plan.ANGLE)
    wrong = np.full((8, 16, 3), 0.3, np.float32)
    found = judge(cell, leave(tmp_path / "a", wrong, true))
    assert found["map"]["psnr"] == metrics.PSNR_CAP and found["full"]
    assert found["working"]["psnr"] < 60 and found["own"] == 44.0 and found["iterations"] == 12
    # Alternating by 0.1 about 1: second differences are 0.4, over sqrt(6); the last third are 4 of 12 steps.
    assert found["loss_noise"] == pytest.approx(0.4 / np.sqrt(6))
    # Without it, by the working map, whatever its width.
    small = judge(cell, leave(tmp_path / "b", latlong.resize(true, 32, 64)))
    assert not small["full"] and small["map"]["psnr"] > 60 and small["working"] == small["map"]
    # Once.
    leave(tmp_path / "a", wrong, wrong)
    assert judge(cell, tmp_path / "a") == found
    assert tiny(tmp_path, spp=8)(cell, tmp_path / "a")["map"]["psnr"] < 60
    (tmp_path / "b" / "judged.json").write_text("{")  # cut short
    assert judge(cell, tmp_path / "b")["map"] == small["map"]


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


def one(setting, group, time, psnr, cell=("a", "matte"), session="s", **more):
    values = {"again": time / 2, "memory": 100 * time, "map_psnr": 20.0, "map_ssim": 0.5, "sun": None}
    values |= {"noise": 0.01, "time": time, "psnr": psnr} | more
    return {
        "setting": setting,
        "group": group,
        "map": cell[0],
        "scene": cell[1],
        "session": session,
        **values,
    }


def standard(times=(9.0, 10.0, 14.0), psnrs=(40.0, 41.0, 43.0), **more):
    return [
        one(f"standard, seed {i}", "standard", t, p, **more)
        for i, (t, p) in enumerate(zip(times, psnrs, strict=True))
    ]


def test_ratios_are_to_the_median_of_the_same_session_and_cell():
    runs = [
        *standard(),
        *standard((20.0, 20.0, 20.0), session="t"),
        *standard((100.0,), (10.0,), cell=("b", "matte")),
        one("x", "knob", 5.0, 42.0, map_psnr=21.0, map_ssim=0.6),
        one("y", "knob", 5.0, 42.0, session="t"),
        one("z", "knob", 5.0, 42.0, session="u"),
        one("x", "knob", 5.0, 12.0, cell=("b", "matte")),
    ]
    found = {(r["setting"], r["map"]): r for r in analyse.ratios(runs)}
    assert found["x", "a"]["ratio"] == {"time": 0.5, "again": 0.5, "memory": 0.5}
    # Results: of the standard preset with the same seed, which shares the noise of the target.
    assert found["x", "a"]["change"] == pytest.approx({"psnr": 2.0, "map_psnr": 1.0, "map_ssim": 0.1})
    assert found["y", "a"]["ratio"]["time"] == 0.25  # a busier session
    assert ("z", "a") not in found  # nothing was measured beside it
    assert found["x", "b"]["ratio"]["time"] == 0.05 and found["x", "b"]["change"]["psnr"] == 2.0


def test_without_the_same_seed_changes_are_from_the_median():
    runs = [run for run in standard() if run["setting"] != analyse.PAIRED]  # 41 and 43 dB
    assert len(runs) == 2
    (found,) = [r for r in analyse.ratios([*runs, one("x", "knob", 5.0, 42.5)]) if r["setting"] == "x"]
    assert found["change"]["psnr"] == 0.5


def test_runs_that_had_less_of_the_processor_are_told():
    def run(setting, cpu, wall):
        return one(setting, "knob", wall, 40.0) | {"cost": {"cpu_s": cpu, "wall_s": wall}}

    slow = run("x", 10.0, 10.0)
    runs = [run("x", 16.0, 10.0), run("x", 15.0, 10.0), slow, run("y", 9.0, 10.0), run("y", 16.0, 10.0)]
    assert analyse.disturbed(runs) == [slow]  # two runs of y do not tell which is usual


def test_means_are_geometric_for_ratios_and_leave_out_missing_suns():
    cells = ("a", "matte"), ("b", "matte")
    runs = [r for cell in cells for r in standard((10.0,), (40.0,), cell=cell)]
    runs += [one("x", "knob", 5.0, 38.0, cells[0], sun=2.0, noise=0.1)]
    runs += [one("x", "knob", 20.0, 39.0, cells[1], noise=None)]
    rows = {r["setting"]: r for r in analyse.means(analyse.ratios(runs))}
    assert list(rows) == ["standard", "x"]
    assert rows["standard"]["cells"] == rows["x"]["cells"] == 2
    assert rows["x"]["ratio"]["time"] == pytest.approx(1.0) and rows["x"]["change"]["psnr"] == -1.5
    assert rows["standard"]["ratio"] == dict.fromkeys(("time", "again", "memory"), 1.0)
    assert rows["x"]["sun"] == 2.0 and rows["x"]["noise"] == 0.1 and rows["standard"]["sun"] is None


def test_the_standard_preset_is_its_median():
    rows = analyse.means(analyse.ratios(standard()))  # 9, 10 and 14 s; 40, 41 and 43 dB
    assert [r["setting"] for r in rows] == ["standard"]
    assert set(rows[0]["ratio"].values()) == {1.0} and set(rows[0]["change"].values()) == {0.0}


def test_numbers_of_a_run_are_without_the_judges_noise():
    cost = {"wall_s": 10.0, "peak_bytes": 5}
    found = analyse.flat(cost, judgement(40.0) | {"render": {"psnr": 38.0, "psnr_without_noise": 41.0}})
    assert found["psnr"] == 41.0 and found["time"] == 10.0 and found["again"] == 9.25 and found["memory"] == 5
    assert analyse.flat(cost, judgement(200.0))["psnr"] == 55.0  # a picture without an error that is seen


def test_the_front_is_what_nothing_beats():
    assert analyse.front([(1, 1), (2, 3), (3, 2), (0.5, 0), (2, 2.5), (4, 4), (4, 4)]) == [3, 0, 1, 5]
    assert analyse.front([]) == []
    assert analyse.front([(1, 5), (1, 6)]) == [1]


def rows_of(*given):
    return [
        {
            "setting": name,
            "group": "knob",
            "cells": 1,
            "ratio": dict.fromkeys(("time", "again", "memory"), time),
            "change": {"psnr": psnr, "map_psnr": map_psnr, "map_ssim": 0.0},
            "sun": None,
            "noise": None,
        }
        for name, time, psnr, map_psnr in given
    ]


def test_the_best_setting_within_a_time_is_found():
    rows = rows_of(
        ("slow", 1.8, 0.5, 0.5), ("standard", 1.0, 0, 0), ("half", 0.5, -1, -0.1), ("odd", 0.5, -2, 3)
    )
    assert analyse.best_within(rows, 2.0)["setting"] == "slow"
    assert analyse.best_within(rows, 1.0)["setting"] == "odd"
    assert analyse.best_within(rows[:3], 0.999)["setting"] == "half"
    assert analyse.best_within(rows, 0.4) is None
    lines = analyse.halving(rows[:3]).splitlines()
    assert len(lines) == 2 + len(analyse.SHARES)
    assert "| 0.75 | half | 0.50 | 0.50 | -1.00 | -0.10 | +0.000 | - |" in lines
    assert "| 0.35 | none: the quickest takes 0.50 |" in lines[-1]
    assert {line.count("|") for line in lines} == {9}


def test_seeds_differ_by_the_pooled_deviation():
    runs = [*standard((10.0, 12.0), (40.0, 42.0)), *standard((30.0, 30.0), (30.0, 30.0), cell=("b", "matte"))]
    found = analyse.spread(runs)
    assert found["psnr"] == pytest.approx(1.0)  # variances 2 and 0
    assert found["time"] == pytest.approx(np.sqrt(2 / 11**2 / 2))
    assert analyse.spread(runs[:1]) is None


def made_up():
    """Results in the form of results.json, of two cells and some settings of every kind."""
    rng, runs = np.random.default_rng(0), []
    cells = ("overcast_soil", "matte"), ("kloofendal", "glossy")
    for cell in cells:
        runs += standard((11.0, 12.0, 12.5), (40.0, 40.2, 39.9), cell=cell, sun=1.0)
        runs.append(one("draft", "preset", 6.0, 38.0, cell))
        for setting in [*plan.knobs(), *plan.joint(6)]:
            time = float(rng.uniform(4, 25))
            runs.append(one(setting.name, setting.group, time, 36 + time / 6, cell, map_psnr=18 + time / 10))
    for setting in [*plan.siren(), plan.PAPER]:
        time = float(rng.uniform(30, 900))
        runs.append(one(setting.name, setting.group, time, 35.0, cells[1]))
    bounds = [
        {"map": m, "scene": s, "unedited": judgement(25.0), "ceiling": judgement(50.0)} for m, s in cells
    ]
    return {"runs": runs, "cells": bounds}


@pytest.mark.slow
def test_tables_and_pictures_are_made_of_results(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    files = plot.draw(made_up(), tmp_path)
    assert [p.name for p in files] == ["front.png", "cells.png", "knobs.png"]
    assert all(p.stat().st_size > 20_000 for p in files)
    found = analyse.tables(made_up())
    text = "\n".join(found.values())
    assert "| overcast_soil, matte | draft | 6.0 | 3.0 |" in text and "| paper |" in text
    assert "standard deviation" in text.lower() and "joint 6: T " in text
    # Halving is of what ran in both cells: not of SIRENs or the paper's preset.
    assert "siren" not in found["halving-time"] and "paper" not in found["halving-time"]
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match="pip install"):
        plot.draw(made_up(), tmp_path)


def test_the_readme_has_a_place_for_every_table():
    text = (Path(plan.__file__).parent / "README.md").read_text()
    assert set(re.findall(r"<!-- table: ([\w-]+) -->", text)) == set(analyse.tables(made_up()))


def test_without_the_standard_preset_nothing_is_drawn(tmp_path):
    with pytest.raises(InputError, match="no run of the standard preset"):
        plot.draw({"runs": [one("x", "knob", 1, 1)], "cells": []}, tmp_path)


@pytest.mark.parametrize("level", budget.LEVELS, ids=lambda level: level.name)
def test_a_level_of_the_budget_is_run_as_it_says(level, tmp_path):
    cell = plan.Cell("sky", "glossy", tmp_path / "sky.hdr")
    found = config.from_dict(levels.tables_of(cell, level), tmp_path)
    assert (found.input.width, found.scene.width) == (level.map, level.film)
    assert (found.target.spp, found.output.spp) == (level.spp, level.spp)
    assert found.scene.parameters == {"roughness": 0.05} and not found.renderer.cache
    names = "target", "judge", "transport", "start", "fit", "edit", "report"
    times = {f"{name}_s": 2**i for i, name in enumerate(names)}
    alike = {"render": budget.REFERENCE_RENDER, "machine": 1.0}
    assert levels.parts(times, alike) == {"rendering": 3, "tracing": 12, "numbers": 112}
    slower = {"render": 2 * budget.REFERENCE_RENDER, "machine": 4.0}
    assert levels.parts(times, slower) == {"rendering": 1.5, "tracing": 6, "numbers": 28}
