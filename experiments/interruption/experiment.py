"""Kill runs at random moments and see whether ``--resume`` ends them as if nothing had happened.

A trial starts ``python -m envedit.run`` with empty caches, sends SIGKILL at a moment drawn evenly from the
time that an undisturbed run takes, looks at what is left, and resumes. Every second trial is killed again
while it resumes. Every file of the results must have the bytes of the undisturbed run's, but for times and
the folder's name, and no file that can be seen after a kill may be half written.
"""

import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from envedit.core.errors import InputError
from envedit.sweep.process import CONFIG
from experiments.harness import Experiment, calling
from experiments.interruption.compare import differing, look

KINDS, RENDERERS = ("layers", "siren", "pixels", "log-pixels"), ("transport", "path")


def run(folder: Path, out: Path, place: Path, *more: str, seconds: float | None = None) -> int:
    """Run a case's configuration with caches and a log in ``place``, and kill it after some seconds.

    Returns the exit code: -SIGKILL of a run that was killed.
    """
    command = [sys.executable, "-m", "envedit.run", str(folder / CONFIG), "--out", str(out), *more]
    environment, root = os.environ | {"XDG_CACHE_HOME": str(place / "cache")}, Path(__file__).parents[2]
    place.mkdir(parents=True, exist_ok=True)
    with (
        open(place / "log", "w") as log,
        subprocess.Popen(command, cwd=root, env=environment, stdout=log, stderr=log) as process,
    ):
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()


def trials(settings, folder, numbers) -> dict:
    """Carry out an undisturbed run and trials; the configuration's seed is that of the moments, too."""
    work, reference = folder / "work", folder / "work/whole"
    shutil.rmtree(work, ignore_errors=True)
    for attempt in ("first", "second"):  # the first compiles kernels, which stay
        shutil.rmtree(reference, ignore_errors=True)
        begun = time.monotonic()
        if code := run(folder, reference, work / attempt):
            raise InputError(f"the undisturbed run ended with {code}: see {work / attempt / 'log'}")
    seconds = time.monotonic() - begun
    found = [trial(settings.seed, n, folder, work / f"trial-{n}", reference, seconds) for n in numbers]
    return {"trials": found}


def trial(seed, number, folder, place, reference, seconds) -> dict:
    """Kill a run once or twice and resume it; returns what was left each time and what differs at the end."""
    rng, out, kills = np.random.default_rng([seed, number]), place / "out", []
    for attempt in range(1 + number % 2):
        moment = float(rng.uniform(0, seconds))
        kill = {"after_s": round(moment, 2), "stage": "done before", "half": []}
        code = run(folder, out, place, *["--resume"] * attempt, seconds=moment)
        if code == -signal.SIGKILL:
            said = (place / "log").read_text().splitlines()
            stage = said[-1].split(":")[0] if said else "importing"
            kill["stage"] = "exiting" if stage.startswith("results in") else stage
            kill |= look(out, reference)
        kills.append(kill)
        if code != -signal.SIGKILL:
            break
    code = run(folder, out, place, "--resume")
    return {"number": number, "kills": kills, "differs": ["exit code"] if code else differing(out, reference)}


def wrong(row) -> list[str]:
    """Name the files of a trial that differ, or that were half written after a kill."""
    return row["differs"] + [f"half of {name}" for kill in row["kills"] for name in kill["half"]]


def of_kills(form):
    """Return what makes a cell of the kills of a trial."""
    return lambda row: ", ".join(form(kill) for kill in row["kills"])


def summary(rows) -> str:
    kills = sum(kill["stage"] != "done before" for row in rows for kill in row["kills"])
    good = sum(not wrong(row) for row in rows)
    return f"{kills} kills; {good} of {len(rows)} trials resumed to the bytes of an undisturbed run"


def cases(given):
    found = []
    for i, (renderer, kind) in enumerate(itertools.product(RENDERERS, KINDS)):
        tables = {
            "input": {"envmap": "sunsky", "width": 32},
            "scene": {"file": "sphere", "width": 48, "height": 48},
            "target": {"rotate_degrees": 60.0, "spp": 100},
            "representation": {"kind": kind, "hidden": 16, "depth": 1},
            "fit": {"epochs": 40},
            "optimizer": {"iterations": 200, "checkpoint_s": 0.0},
            "renderer": {"kind": renderer, "spp": 4 if renderer == "path" else 64, "max_depth": 3},
            "output": {"spp": 144},
        }
        numbers = list(range(i * given.trials, (i + 1) * given.trials))
        about = {"kind": kind, "renderer": renderer}
        function = "experiments.interruption.experiment:trials"
        found.append(calling(f"{kind}-{renderer}", function, tables, about, numbers=numbers))
    return found


EXPERIMENT = Experiment(
    "interruption",
    "Kill runs at random moments and see whether --resume ends them as if nothing had happened.",
    cases,
    lambda done: done.metrics["trials"],
    {
        "trial": "{number}",
        "representation": "{kind}",
        "renderer": "{renderer}",
        "killed after": of_kills(lambda kill: f"{kill['after_s']} s"),
        "while": of_kills(lambda kill: kill["stage"]),
        "checkpoint of step": of_kills(lambda kill: str(kill.get("step") or "none")),
        "files / temporary / half": of_kills(
            lambda kill: f"{kill.get('files', 0)} / {kill.get('temporary', 0)} / {len(kill['half'])}"
        ),
        "result": lambda row: "DIFFERS: " + ", ".join(wrong(row)) if wrong(row) else "the same bytes",
    },
    failures=lambda rows: [f"trial {row['number']}: {', '.join(wrong(row))}" for row in rows if wrong(row)],
    summary=summary,
    options=lambda parser: parser.add_argument("--trials", type=int, default=3, help="of each case"),
    alone=True,
)
