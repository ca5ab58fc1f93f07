"""Sweeps: jobs and their hashes, and real processes that are killed at bad moments."""

import dataclasses
import importlib.util
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import envedit
from envedit import config
from envedit.cli.sweep import main
from envedit.core.errors import ConfigError, InputError
from envedit.solve import adam_loop, checkpoint
from envedit.sweep import COMMAND, Outcome, drive, job, process, program, read_jobs, run_job, sweep
from tests.oracles import ROOT
from tests.oracles.builders import BALL, LIGHT, SENSOR, write_scene

STUB = '''
"""Stands for a run: notes what it does, and fails, waits or breaks off as files beside the notes say."""
import os, pathlib, sys, time, tomllib

folder, notes = map(pathlib.Path, sys.argv[1:3])
seed = tomllib.loads((folder / "job.toml").read_text())["seed"]

def note(what):
    file = os.open(notes / "notes", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, f"{seed} {what} {os.getpid()}\\n".encode())

try:
    note("begin")
    print("out", flush=True)
    if (notes / f"fail-{seed}").exists():
        print("first words\\nthe last line", file=sys.stderr)
        sys.exit(5)
    if (folder / "checkpoint.npz").exists():
        note("checkpoint")
        if words := {"unusable": "the checkpoint cannot be read (why): delete it",
                     "other": "belongs to another configuration or other input files",
                     "full": "cannot be written (No space left on device)"}.get(
                         (folder / "checkpoint.npz").read_text()):
            print("envedit:", "/long" * 200 + "/checkpoint.npz:", words, file=sys.stderr)
            sys.exit(3)
    while (notes / f"hold-{seed}").exists():
        time.sleep(0.01)
except KeyboardInterrupt:
    (folder / "checkpoint.npz").write_text("state")
    note("interrupted")
    sys.exit(130)
(folder / "result").write_text(str(seed))
note("end")
'''


LIMIT_SECONDS = 600
"""Until a test gives up waiting; what it waits for takes a second where nothing else runs."""


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """The stand-in's command and its notes; what the test started is ended."""
    monkeypatch.setattr(drive, "RETRY_SECONDS", 0.05)
    stub = Stub(tmp_path)
    monkeypatch.setattr("envedit.sweep.read_jobs", lambda path: stub.of(read_jobs(path)))
    yield stub
    stub.free()
    for driver in stub.drivers:
        driver.kill()
        driver.communicate()
    stub.background.shutdown()


class Stub:
    def __init__(self, folder):
        self.folder, self.out, self.notes = folder, folder / "out", folder / "notes"
        self.drivers, self.background = [], ThreadPoolExecutor(1)
        self.notes.mkdir()
        (folder / "stub.py").write_text(STUB)
        self.command = ("{python}", "-S", str(folder / "stub.py"), "{folder}", str(self.notes))

    def jobs(self, count):
        return self.of(job(f"job {seed}", f"seed = {seed}") for seed in range(count))

    def of(self, jobs):
        """The same jobs, carried out by the stand-in."""
        return [dataclasses.replace(one, command=self.command) for one in jobs]

    def written(self, count):
        """Jobs in a file."""
        tables = "\n".join(f'[jobs."job {seed}"]\nseed = {seed}' for seed in range(count))
        (self.folder / "jobs.toml").write_text(f"[common]\nvariant = 'llvm_ad_rgb'\n{tables}")
        return self.folder / "jobs.toml"

    def block(self, what, *seeds):
        for seed in seeds:
            (self.notes / f"{what}-{seed}").touch()

    def free(self):
        for path in self.notes.glob("*-*"):
            path.unlink()

    def noted(self, what):
        """Seeds and process ids of what was done, in order."""
        try:
            lines = (self.notes / "notes").read_text().splitlines()
        except FileNotFoundError:
            return []
        return [(int(s), int(pid)) for s, did, pid in map(str.split, lines) if did == what]

    def counts(self, what, jobs):
        seeds = [seed for seed, _ in self.noted(what)]
        return [seeds.count(seed) for seed in range(jobs)]

    def driver(self, count, *options, connect=LIMIT_SECONDS):
        """A driver as a process of its own."""
        text = (
            # A shell starts what runs in its background with Ctrl-C ignored, and that is inherited.
            "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"
            "import dataclasses, sys; from envedit import sweep; from envedit.cli.sweep import main;"
            "from envedit.sweep import drive, process, read_jobs as read;"
            f"stub = lambda one: dataclasses.replace(one, command={self.command!r});"
            "sweep.read_jobs = lambda path: [*map(stub, read(path))];"
            f"drive.CONNECT_SECONDS, process.GRACE_SECONDS = {connect}, {LIMIT_SECONDS};"
            "sys.exit(main(sys.argv[1:]))"
        )
        arguments = [str(self.written(count)), "--out", str(self.out), *options]
        started = subprocess.Popen(
            [sys.executable, "-c", text, *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.drivers.append(started)
        return started

    def run(self, count=None, jobs=None, **options):
        said = io.StringIO()
        found = sweep(self.of(jobs or self.jobs(count)), self.out, stream=said, **options)
        return [one.state for one in found], said.getvalue()


def until(true):
    end = time.monotonic() + LIMIT_SECONDS
    while not (value := true()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)
    return value


def files(folder):
    return sorted(path.name for path in folder.iterdir())


def output(driver):
    return driver.communicate(timeout=LIMIT_SECONDS)[0]


def dead(pid):
    """Whether a process has ended; only on Linux."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


DASK = importlib.util.find_spec("distributed") is not None
dask = pytest.mark.skipif(not DASK, reason="dask.distributed is missing: pip install '.[cluster]'")
linux = pytest.mark.skipif(sys.platform != "linux", reason="only on Linux do jobs die with their driver")


# ---- what is left, what is done again ----------------------------------------------------------------------


def test_jobs_are_done_once_and_leave_their_folders(stub):
    jobs = stub.jobs(3)
    states, said = stub.run(jobs=jobs)
    assert states == ["done"] * 3
    for seed, one in enumerate(jobs):
        folder = one.folder(stub.out)
        assert files(folder) == ["done.json", "job.toml", "log.txt", "result"]
        assert (folder / "result").read_text() == str(seed)
        assert config.load(folder / "job.toml").seed == seed
        assert (folder / "log.txt").read_text().splitlines()[1:] == ["out"]
        about = json.loads((folder / "done.json").read_text())
        assert about["name"] == f"job {seed}" and about["seconds"] >= 0 and about["resumed"] is False
    assert said.splitlines()[0].startswith("3 jobs, 0 done before, 3 to run: 1 at a time")
    states, said = stub.run(jobs=jobs)
    assert states == ["skipped"] * 3 and said == ""
    assert stub.counts("begin", 3) == [1, 1, 1]
    rows = (stub.out / "sweep.tsv").read_text().splitlines()
    assert rows[1].split("\t") == ["job 0", "skipped", "0.0", jobs[0].key, ""]


@pytest.mark.slow
@linux
def test_a_driver_that_is_killed_loses_only_what_was_in_flight(stub):
    held = (1, 2)
    stub.block("hold", *held)
    driver = stub.driver(5, "--workers", str(len(held)))
    until(lambda: {seed for seed, _ in stub.noted("begin")} == {0, *held} and stub.noted("end"))
    jobs = stub.jobs(5)
    until((jobs[0].folder(stub.out) / "done.json").exists)
    driver.kill()
    output(driver)
    flying = [pid for seed, pid in stub.noted("begin") if seed in held]
    until(lambda: all(dead(pid) for pid in flying))
    assert (jobs[1].folder(stub.out) / "job.lock").exists()  # nobody was left to remove it
    stub.free()
    again = stub.driver(5)
    said = output(again)
    assert again.returncode == 0, said
    assert stub.counts("begin", 5) == [1 + (seed in held) for seed in range(5)]
    assert stub.counts("end", 5) == [1] * 5
    assert "5 jobs: 1 skipped, 4 done" in said
    assert files(jobs[1].folder(stub.out)) == ["done.json", "job.toml", "log.txt", "result"]


@pytest.mark.slow
def test_a_job_that_is_killed_is_reported_and_done_by_the_next_call(stub):
    stub.block("hold", 0)
    driver = stub.driver(4)
    (_, pid), *_ = until(lambda: stub.noted("begin"))
    os.kill(pid, signal.SIGKILL)
    said = output(driver)
    assert driver.returncode == 1
    line = next(line for line in said.splitlines() if line.startswith("[1/4] job 0: failed"))
    assert "killed by signal 9" in line and "log.txt" in line
    jobs = stub.jobs(4)
    assert "signal 9" in json.loads((jobs[0].folder(stub.out) / "failed.json").read_text())["error"]
    assert not (jobs[0].folder(stub.out) / "done.json").exists()
    stub.free()
    assert stub.run(jobs=jobs)[0] == ["done", "skipped", "skipped", "skipped"]
    assert stub.counts("begin", 4) == [2, 1, 1, 1] and stub.counts("end", 4) == [1] * 4
    assert "failed.json" not in files(jobs[0].folder(stub.out))


def test_a_failed_job_is_reported_by_its_last_words_and_does_not_stop_the_others(stub, capsys):
    stub.block("fail", 1)
    ask = [str(stub.written(3)), "--out", str(stub.out)]
    assert main(ask) == 1
    said = capsys.readouterr()
    line = next(line for line in said.err.splitlines() if "job 1" in line)
    assert "exit code 5: the last line" in line and "1 failed" in line
    shown = said.out.splitlines()
    assert [row.split()[2] for row in shown[:3]] == ["done", "failed", "done"]
    assert shown[1].endswith("exit code 5: the last line") and shown[3] == "3 jobs: 2 done, 1 failed"
    folder = stub.jobs(3)[1].folder(stub.out)
    assert json.loads((folder / "failed.json").read_text())["code"] == 5
    assert "first words" in (folder / "log.txt").read_text()
    assert main([*ask, "--quiet"]) == 1  # it is tried again
    said = capsys.readouterr()
    assert said.out == "" and "the last line" in said.err
    stub.free()
    assert main([*ask, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert stub.counts("begin", 3) == [1, 3, 1]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "workers"), [(signal.SIGTERM, 1), (signal.SIGINT, 2)])
def test_an_interrupted_driver_lets_its_jobs_write_their_checkpoints(stub, number, workers):
    stub.block("hold", *range(workers))
    driver = stub.driver(3, "--workers", str(workers))
    until(lambda: len(stub.noted("begin")) == workers)
    driver.send_signal(number)
    said = output(driver)
    assert driver.returncode == 130 and "run again to continue" in said and "Traceback" not in said
    expected = [int(seed < workers) for seed in range(3)]
    assert stub.counts("interrupted", 3) == stub.counts("begin", 3) == expected
    folder = stub.jobs(3)[0].folder(stub.out)
    assert files(folder) == ["checkpoint.npz", "job.toml", "log.txt"]
    stub.free()
    assert stub.run(3)[0] == ["done"] * 3
    assert stub.counts("checkpoint", 3) == expected
    assert json.loads((folder / "done.json").read_text())["resumed"] is True


@pytest.mark.parametrize(("state", "outcome"), [("unusable", "done"), ("other", "done"), ("full", "failed")])
def test_a_checkpoint_that_is_no_use_is_removed_for_a_second_try_and_outlives_a_full_disk(
    state, outcome, stub
):
    """Exit code 3 is that of any input error."""
    folder = stub.jobs(1)[0].folder(stub.out)
    folder.mkdir(parents=True)
    (folder / "checkpoint.npz").write_text(state)
    assert stub.run(1)[0] == [outcome] and stub.counts("checkpoint", 1) == [1]
    assert stub.counts("begin", 1) == [1 if state == "full" else 2]
    assert (folder / "checkpoint.npz").exists() == (state == "full")
    if state == "full":
        assert (folder / "checkpoint.npz").read_text() == "full"
        assert len(json.loads((folder / "failed.json").read_text())["error"]) < 350


def test_what_a_checkpoint_that_is_no_use_is_told_by_is_what_envedit_says(tmp_path):
    what = checkpoint.digest(config.from_dict({}), "", [])
    (tmp_path / checkpoint.NAME).write_bytes(b"no archive")
    with pytest.raises(InputError) as said:
        checkpoint.load(tmp_path, what)
    assert process.UNUSABLE_CHECKPOINT[0] in str(said.value)
    checkpoint.save(tmp_path, what, adam_loop.State(), {}, {}, np.zeros((1, 1, 3), np.float32))
    with pytest.raises(InputError) as said:
        checkpoint.load(tmp_path, "other")
    assert process.UNUSABLE_CHECKPOINT[1] in str(said.value)


@pytest.mark.slow
def test_two_drivers_do_not_do_the_same_job(stub):
    stub.block("hold", 0)
    driver = stub.driver(3, "--workers", "1")
    until(lambda: stub.noted("begin"))
    other = stub.background.submit(stub.run, 3, workers=1)
    until(lambda: stub.counts("end", 3) == [0, 1, 1])  # what is not held is done meanwhile
    stub.free()
    said = output(driver)
    assert driver.returncode == 0, said
    states, said = other.result(LIMIT_SECONDS)
    assert states[0] == "skipped" and f"job 0: waiting, process {driver.pid} on" in said
    assert stub.counts("begin", 3) == stub.counts("end", 3) == [1, 1, 1]


def test_jobs_of_the_same_content_run_once(stub):
    jobs = [job("a", "seed = 0"), job("b", "seed = 0\n[input]\nwidth = 256"), job("c", "seed = 1")]
    assert stub.run(jobs=jobs)[0] == ["done"] * 3
    assert stub.counts("begin", 2) == [1, 1]
    with pytest.raises(ConfigError, match="two jobs are called a"):
        stub.run(jobs=[jobs[0], jobs[0]])


def test_a_folder_that_cannot_be_written_to_is_an_error_on_one_line(stub, capsys):
    (stub.folder / "file").write_text("")
    assert main([str(stub.written(1)), "--out", str(stub.folder / "file" / "x")]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1
    one = stub.jobs(1)[0]
    stub.out.mkdir()
    one.folder(stub.out).write_text("")  # a job's folder is a file: that job fails, the others do not
    states, said = stub.run(2)
    assert states == ["failed", "done"] and "cannot be made" in said
    stub.command = ("/no/such/program", "{folder}")
    states, said = stub.run(jobs=[job("x", "seed = 7")])
    assert states == ["failed"] and "No such file" in said


# ---- threads -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("cores", "asked", "workers"), [(11, 3, 3), (3, None, 1), (13, None, 3)])
def test_cores_are_divided_among_the_jobs(stub, monkeypatch, cores, asked, workers):
    monkeypatch.setattr(drive, "cores", lambda: cores)
    show = "import os, sys; print(*sys.argv[1:], os.environ['OMP_NUM_THREADS'])"
    stub.command = ("{python}", "-S", "-c", show, "{threads}")
    jobs, threads = stub.jobs(4), cores // workers
    states, said = stub.run(jobs=jobs, workers=asked)
    assert states == ["done"] * 4 and f"to run: {workers} at a time, {threads} threads" in said
    shown = {(one.folder(stub.out) / "log.txt").read_text().splitlines()[-1] for one in jobs}
    assert shown == {f"{threads} {threads}"}


@pytest.mark.slow
def test_drjit_takes_the_number_of_threads(stub):
    run = "from envedit.run import main; sys.exit(main())"
    assert run in COMMAND[2]
    show = (
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb');"
        "print(drjit.thread_count(), sys.argv[1:], file=sys.stderr); sys.exit(1)"
    )
    stub.command = (*COMMAND[:2], COMMAND[2].replace(run, show), *COMMAND[3:])
    one = stub.jobs(1)[0]
    error = run_job(one, stub.out, threads=5).error
    folder = one.folder(stub.out)
    assert error == f"exit code 1: 5 ['{folder}/job.toml', '--out', '{folder}', '--resume']"


# ---- jobs --------------------------------------------------------------------------------------------------


def test_the_key_is_that_of_content_and_not_of_names_or_places(tmp_path):
    keys = {}
    for place in ("here", "there"):
        folder = tmp_path / place
        folder.mkdir()
        (folder / "map.exr").write_bytes(b"a map")
        write_scene(folder, SENSOR, BALL, LIGHT, name="scene.xml")
        text = f'[input]\nenvmap = "map.exr"\n[scene]\nfile = "scene.xml"\n[output]\ndir = "{place}"'
        keys[place] = job(place, text, folder)
    assert keys["here"].key == keys["there"].key and re.fullmatch("[0-9a-f]{32}", keys["here"].key)
    loaded = config.loads(keys["here"].toml)
    assert loaded.input.envmap == str(tmp_path / "here" / "map.exr")
    (tmp_path / "there" / "map.exr").write_bytes(b"another map")
    assert job("there", text, tmp_path / "there").key != keys["here"].key
    assert job("x", {"seed": 1}).key == job("y", "seed = 1").key != job("x", "seed = 2").key
    assert job("x", "").key == job("x", 'preset = "standard"').key != job("x", 'preset = "draft"').key
    # A map that is not there is not known by its content, and one of another name is another one.
    gone = [job("x", f'[input]\nenvmap = "{name}"', tmp_path).key for name in ("p.exr", "q.exr")]
    assert gone[0] != gone[1]


def test_results_of_another_version_are_not_used(stub, monkeypatch):
    old = stub.jobs(1)[0]
    assert stub.run(jobs=[old])[0] == ["done"]
    assert re.fullmatch(rf"{re.escape(envedit.__version__)}\+[0-9a-f]{{12}}", program())
    monkeypatch.setattr("envedit.sweep.jobs.program", lambda: "another")
    new = stub.jobs(1)[0]
    assert new.key != old.key and job("x", "", version="1").key != job("x", "").key
    outcome = run_job(new, stub.out, 1)  # as on a worker that has the old one
    assert outcome.state == "failed" and program() in outcome.error and "install the same" in outcome.error
    assert not new.folder(stub.out).exists() and stub.counts("begin", 1) == [1]


def test_files_that_a_scene_names_count(tmp_path):
    mesh = '<shape type="ply"><string name="filename" value="ball.ply"/></shape>'
    write_scene(tmp_path, SENSOR, '<include filename="part.xml"/>', LIGHT, name="scene.xml")
    write_scene(tmp_path, mesh, name="part.xml")
    text = '[scene]\nfile = "scene.xml"'
    keys = [job("x", text, tmp_path).key]
    for content in ("one", "two"):
        (tmp_path / "ball.ply").write_text(content)
        keys.append(job("x", text, tmp_path).key)
    assert len(set(keys)) == 3
    shipped = {name: job("x", f'[scene]\nfile = "{name}"').key for name in ("sphere", "matte")}
    assert shipped["sphere"] != shipped["matte"]


def test_a_file_that_no_run_could_read_is_not_hashed(tmp_path):
    """A sparse file of 60 GB, which would take half a minute or more."""
    with open(tmp_path / "sky.hdr", "wb") as file:
        file.truncate(60 * 10**9)
    with pytest.raises(InputError, match=r"sky.hdr: 60000000000 bytes, expected at most"):
        job("x", '[input]\nenvmap = "sky.hdr"', tmp_path)


def test_files_in_scene_parameters_are_found_from_the_job_s_folder_too(tmp_path):
    (tmp_path / "mesh.ply").write_text("one")
    text = '[scene]\nfile = "mesh"\nparameters = { mesh = "mesh.ply", kind = "rough" }'
    made = job("x", text, tmp_path)
    parameters = config.loads(made.toml).scene.parameters
    assert dict(parameters) == {"mesh": str(tmp_path / "mesh.ply"), "kind": "rough"}
    (tmp_path / "mesh.ply").write_text("two")
    assert job("x", text, tmp_path).key != made.key
    other = tmp_path / "other"
    other.mkdir()
    (other / "mesh.ply").write_text("one")
    assert job("x", text, other).key == made.key


def test_jobs_are_read_from_a_file_and_from_a_folder(tmp_path):
    (tmp_path / "jobs.toml").write_text(
        "[common]\nseed = 3\n[common.fit]\nepochs = 7\n"
        '[jobs.a]\n[jobs."b c".fit]\nlr = 0.1\n[jobs.d]\nseed = 4\n'
    )
    jobs = read_jobs(tmp_path / "jobs.toml")
    assert [one.name for one in jobs] == ["a", "b c", "d"]
    loaded = [config.loads(one.toml) for one in jobs]
    assert [one.seed for one in loaded] == [3, 3, 4] and {one.fit.epochs for one in loaded} == {7}
    assert loaded[1].fit.lr == 0.1
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "b.toml").write_text("seed = 2")
    (folder / "a.toml").write_text("[fit]\nepochs = 7\n[input]\nenvmap = '../x.exr'")
    jobs = read_jobs(folder)
    assert [one.name for one in jobs] == ["a", "b"]
    assert Path(config.loads(jobs[0].toml).input.envmap).resolve() == tmp_path / "x.exr"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no job in it"), ("[jobs]\na = 1", "a: expected a table"), ("[[", "not TOML"),
        ("common = 1\n[jobs.a]", "common: expected a table"), ("[job.a]", "unknown table or key job"),
        ("[jobs.a]\nsede = 1", "job a: unknown table or key sede"), ('[jobs."a\\n"]', "printable"),
    ],
)  # fmt: skip
def test_a_file_of_jobs_that_is_not_usable_is_an_error_on_one_line(tmp_path, capsys, text, words):
    (tmp_path / "jobs.toml").write_text(text)
    assert main([str(tmp_path / "jobs.toml"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_jobs_that_are_not_there_are_an_error(tmp_path, capsys):
    for path in (tmp_path, tmp_path / "none.toml"):
        assert main([str(path), "--out", str(tmp_path / "out")]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_jobs_are_not_waited_for_at_a_pipe(tmp_path, capsys):
    (tmp_path / "folder").mkdir()
    for pipe in (tmp_path / "jobs.toml", tmp_path / "folder" / "a.toml"):
        os.mkfifo(pipe)
    with open(os.open(tmp_path / "jobs.toml", os.O_RDWR), "wb"):  # somebody may write
        for path in (tmp_path / "jobs.toml", tmp_path / "folder"):
            assert main([str(path), "--out", str(tmp_path / "out")]) == 2
            assert "cannot be read (is no regular file)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong", [["--workers", "0"], ["--threads", "-1"], ["--workers", "2", "--scheduler", "x"]]
)
def test_usage(wrong, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path), "--out", str(tmp_path), *wrong])
    assert stop.value.code == 2 and wrong[-2] in capsys.readouterr().err


# ---- progress ----------------------------------------------------------------------------------------------


def test_lines_tell_when_it_ends(tmp_path, monkeypatch):
    now, said = [0.0], io.StringIO()
    monkeypatch.setattr(drive.time, "monotonic", lambda: now[0])
    progress = drive.Progress(5, said)
    progress.report(Outcome(job("j", "seed = 1"), "skipped", 0), tmp_path)
    for at, state, seconds in ((40, "done", 40), (400, "failed", 360), (400, "skipped", 0), (400, "done", 8)):
        now[0] = at
        progress.report(Outcome(job("j", "seed = 1"), state, seconds), tmp_path)
    none_carried_out, *lines = said.getvalue().splitlines()
    assert "left" not in none_carried_out
    assert "about 0:02:00 left" in lines[0] and "1 failed, about 0:06:40 left" in lines[1]
    assert "about 0:03:20 left" in lines[2] and "left" not in lines[3]


# ---- the real run ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_real_run_is_made(tmp_path):
    tiny = {
        "input": {"width": 16}, "scene": {"width": 16}, "target": {"spp": 8}, "optimizer": {"iterations": 2},
        "renderer": {"spp": 16, "max_depth": 2, "cache": False},
        "output": {"spp": 8, "report": False, "full": False},
    }  # fmt: skip
    one = job("tiny", tiny)
    said = io.StringIO()
    (outcome,) = sweep([one], tmp_path, threads=1, stream=said)
    assert outcome.state == "done", (one.folder(tmp_path) / "log.txt").read_text()
    left = files(one.folder(tmp_path))
    assert {"metrics.json", "edited.exr", "config.toml", "job.toml", "done.json", "log.txt"} <= set(left)
    assert not [name for name in left if name.startswith(("earlier", "job.lock", "checkpoint"))]
    # done.json is lost: the run itself knows that it is complete.
    (one.folder(tmp_path) / "done.json").unlink()
    before = (one.folder(tmp_path) / "metrics.json").stat().st_mtime_ns
    assert sweep([one], tmp_path, threads=1, stream=said)[0].state == "done"
    assert (one.folder(tmp_path) / "metrics.json").stat().st_mtime_ns == before


# ---- on a Dask cluster -------------------------------------------------------------------------------------


@pytest.mark.skipif(DASK, reason="dask.distributed is there")
def test_without_dask_the_option_says_what_to_install(stub, capsys):
    where = ["--out", str(stub.out), "--scheduler", "tcp://127.0.0.1:1"]
    assert main([str(stub.written(2)), *where]) == 4
    assert "pip install '.[cluster]'" in capsys.readouterr().err


@pytest.fixture
def cluster(stub):
    """A scheduler and a way to start workers, by the commands of docs/cluster.md; ended with the test.

    They run in a folder of their own: envedit is found because it is installed.
    """
    show = [sys.executable, "-c", "import envedit; print(envedit.__file__)"]
    found = subprocess.run(show, cwd=stub.folder, capture_output=True, text=True).stdout.strip()
    if found != envedit.__file__:
        pytest.skip(f"envedit is not installed in the environment of dask: got {found or 'nothing'}")
    started = []

    def start(*arguments):
        log = open(stub.folder / f"dask-{len(started)}.log", "wb")  # noqa: SIM115
        command = [str(Path(sys.executable).with_name("dask")), *arguments]
        started.append(subprocess.Popen(command, cwd=stub.folder, stdout=log, stderr=log))
        log.close()
        return started[-1]

    place = stub.folder / "scheduler.json"
    local = ("--host", "127.0.0.1", "--no-dashboard")
    scheduler = start("scheduler", *local, "--port", "0", "--scheduler-file", str(place))
    until(place.exists)
    address = until(lambda: place.read_text() and json.loads(place.read_text())["address"])
    space = ("--local-directory", str(stub.folder), "--nthreads", "1", "--no-nanny")
    yield address, scheduler, lambda: start("worker", address, *local, *space)
    for one in started:
        one.kill()
        one.wait()


@pytest.mark.slow
@dask
@linux
def test_jobs_run_on_a_cluster_and_the_death_of_a_worker_costs_what_it_was_at(stub, cluster):
    address, _, worker = cluster
    stub.block("hold", 0, 1)
    workers = {one.pid: one for one in (worker(), worker())}
    driver = stub.driver(5, "--scheduler", address)
    until(lambda: {seed for seed, _ in stub.noted("begin")} == {0, 1})
    victim = stub.noted("begin")[0][1]
    parent = int(Path(f"/proc/{victim}/stat").read_text().rpartition(")")[2].split()[1])
    workers[parent].kill()
    until(lambda: dead(victim))
    until(lambda: len(stub.noted("begin")) >= 3 or stub.free())
    stub.free()
    said = output(driver)
    assert driver.returncode == 0, said
    assert stub.counts("end", 5) == [1] * 5
    assert sorted(stub.counts("begin", 5)) == [1, 1, 1, 1, 2]
    assert stub.run(5)[0] == ["skipped"] * 5


@pytest.mark.slow
@dask
def test_the_death_of_the_scheduler_costs_what_was_in_flight(stub, cluster):
    address, scheduler, worker = cluster
    stub.block("hold", 1)
    worker()
    driver = stub.driver(4, "--scheduler", address)
    until(lambda: 1 in dict(stub.noted("begin")))
    before = stub.counts("end", 4)
    scheduler.kill()
    said = output(driver)
    assert driver.returncode == 1 and said.count("the scheduler went away: run again") == 1, said
    assert "Traceback" not in said
    stub.free()
    assert set(stub.run(4)[0]) <= {"done", "skipped"}
    assert stub.counts("end", 4) == [1] * 4
    assert all(begun == 1 for begun, ended in zip(stub.counts("begin", 4), before, strict=True) if ended)
    assert max(stub.counts("begin", 4)) <= 2


@pytest.mark.slow
@dask
def test_the_death_of_the_driver_costs_a_cluster_nothing_that_runs(stub, cluster):
    address, _, worker = cluster
    worker()
    stub.block("hold", 1)
    driver = stub.driver(4, "--scheduler", address)
    until(lambda: 1 in dict(stub.noted("begin")))
    driver.kill()
    output(driver)
    again = stub.driver(4, "--scheduler", address)
    until(lambda: "to run" in again.stdout.readline())
    stub.free()
    said = output(again)
    assert again.returncode == 0, said
    assert stub.counts("begin", 4) == stub.counts("end", 4) == [1] * 4


@pytest.mark.slow
@dask
def test_a_cluster_reports_failures_and_an_address_where_nobody_is(stub, cluster):
    address, _, worker = cluster
    worker()
    stub.block("fail", 1)
    driver = stub.driver(2, "--scheduler", address)
    said = output(driver)
    assert driver.returncode == 1 and "job 1: failed, 0 s: exit code 5: the last line" in said, said
    driver = stub.driver(3, "--scheduler", "tcp://127.0.0.1:1", connect=1)
    said = output(driver)
    assert driver.returncode == 2 and "no scheduler there" in said, said
    driver = stub.driver(3, "--scheduler", "nonsense://x:1", connect=1)
    said = output(driver)
    assert driver.returncode == 2 and "expected HOST:PORT" in said, said
