r"""Kill runs at random moments and see whether ``--resume`` ends them as if nothing had happened.

    python -m experiments.interruption.run [--kills 20] [--seed 0] [--out runs/interruption]
        [--kinds layers siren pixels log-pixels] [--renderers transport path] [--set table.key=value ...]

A trial starts ``python -m envedit.run`` with empty caches, sends SIGKILL at a moment drawn evenly from the
time that an undisturbed run takes, looks at what is left, and resumes. Every second trial is killed again
while it resumes. Every file of the results must have the bytes of the undisturbed run's, but for times and
the folder's name, and no file that can be seen after a kill may be half written. Runs take all cores. What is
done is skipped; exits with 1 if a trial fails.
"""

import argparse
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path

import numpy as np
from tqdm import tqdm

from experiments.harness import markdown, own_folder

ROOT = Path(__file__).parents[2]
KINDS = ("layers", "siren", "pixels", "log-pixels")
TINY = """
[input]
envmap = "sunsky"
width = 32
[scene]
file = "sphere"
width = 48
height = 48
[target]
rotate_degrees = 60.0
spp = 100
[representation]
kind = "{kind}"
hidden = 16
depth = 1
[fit]
epochs = 40
[optimizer]
iterations = 200
checkpoint_s = 0.0
[renderer]
kind = "{renderer}"
spp = {spp}
max_depth = 3
[output]
spp = 144
"""


def command_of(base: Path, kind: str, renderer: str, out: Path, overrides, *more: str) -> list[str]:
    """Return the command of a run; its configuration is written once, so that every trial has the same."""
    path = base / f"{kind}-{renderer}.toml"
    if not path.exists():
        path.write_text(TINY.format(kind=kind, renderer=renderer, spp=4 if renderer == "path" else 64))
    sets = [part for line in overrides for part in ("--set", line)]
    return [sys.executable, "-m", "envedit.run", str(path), "--out", str(out), *sets, *more]


def started(command, cache: Path, log) -> subprocess.Popen:
    """Start a run with a folder of caches."""
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)


def killed_after(seconds: float, command, cache: Path, log: Path) -> bool:
    """Start a run and kill it; False if it was done before. The last line it said is in ``log``."""
    with open(log, "w") as file:
        process = started(command, cache, file)
        try:
            process.wait(seconds)
            return False
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            return process.wait() == -signal.SIGKILL
        finally:
            if process.poll() is None:
                process.kill()


def look(folder: Path, reference: Path) -> dict:
    """Say what a killed run left: its checkpoint's step, files, temporary files, and those half written."""
    found = {"step": None, "files": 0, "temporary": 0, "half": []}
    for path in folder.iterdir() if folder.exists() else ():
        if path.name.startswith("."):
            found["temporary"] += 1
            continue
        found["files"] += 1
        try:
            if path.name == "checkpoint.npz":
                with open(path, "rb") as file, np.load(file) as stored:
                    found["step"] = json.loads(stored["meta"].tobytes())["state"]["step"]
                    whole = all(stored[key] is not None for key in stored.files)
            elif path.suffix == ".json":
                whole = json.loads(path.read_text()) is not None
            elif path.suffix in (".exr", ".png") and path.name != "preview.png":
                whole = path.read_bytes() == (reference / path.name).read_bytes()
            elif path.suffix == ".png":  # drawn anew as the edit goes on
                whole = path.read_bytes().endswith(b"IEND\xaeB`\x82")
            elif path.suffix == ".toml":  # all of its tables and keys
                mine, theirs = (tomllib.loads((f / path.name).read_text()) for f in (folder, reference))
                whole = _keys(mine) == _keys(theirs)
            elif path.suffix == ".csv":
                whole = len(path.read_bytes().split(b"\n")) == len(
                    (reference / path.name).read_bytes().split(b"\n")
                )
            else:
                whole = path.suffix != ".html" or path.read_text().rstrip().endswith("</html>")
        except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile):
            whole = False
        found["half"] += [] if whole else [path.name]
    return found


def _keys(tables):
    return {
        (name, key) for name, table in tables.items() for key in (table if isinstance(table, dict) else ())
    }


def differing(folder: Path, reference: Path) -> list[str]:
    """Name the files that differ from an undisturbed run's: by their bytes, but for times and folder."""
    names = {path.name for path in folder.iterdir()} | {path.name for path in reference.iterdir()}
    wrong = []
    for name in sorted(names):
        mine, theirs = folder / name, reference / name
        if not (mine.exists() and theirs.exists()):
            wrong.append(name)
        elif name == "metrics.json":
            wrong += [name] if measured(mine) != measured(theirs) else []
        elif name == "history.csv":
            wrong += [name] if rows(mine) != rows(theirs) else []
        elif name.endswith((".toml", ".json", ".html")):
            same = timeless(mine, folder, reference) == timeless(theirs, folder, reference)
            wrong += [] if same else [name]
        else:
            wrong += [name] if mine.read_bytes() != theirs.read_bytes() else []
    return wrong


def rows(path: Path) -> list[dict]:
    """Return a history without the times."""
    with open(path, newline="") as file:
        return [{key: row[key] for key in row if key != "step_ms"} for row in csv.DictReader(file)]


def timeless(path: Path, *folders: Path) -> str:
    """Return a text without dates, seconds and their bars, what a cache changes, and names of folders."""
    text = path.read_text()
    for folder in folders:
        text = text.replace(str(folder), "FOLDER")
    text = re.sub(
        r"<tr><td>(?:(?:fit|transport) seconds|(?:fit|T) taken from disk)</td><td>.*?</td></tr>", "", text
    )
    return re.sub(r"\d{4}-\d\d-\d\dT[\d:+]+|\b[\d.]+ m?s\b|width:[\d.]+rem", "TIME", text)


def measured(path: Path) -> dict:
    """Return metrics without the times and what a cache changes."""
    found = json.loads(path.read_text())
    for part in ("fit", "transport"):
        for key in ("cached", "seconds"):
            (found[part] or {}).pop(key, None)
    return {key: value for key, value in found.items() if key != "timing"}


def undisturbed(base: Path, kind: str, renderer: str, overrides) -> float:
    """Carry out a run that nobody kills, unless that is done; returns its seconds."""
    out = base / f"whole-{kind}-{renderer}"
    seconds = out.with_suffix(".seconds")
    if not seconds.exists():
        for attempt in ("first", "second"):  # the first compiles kernels, which stay
            shutil.rmtree(out, ignore_errors=True)
            begun, cache = time.monotonic(), base / f"cache-{out.name}-{attempt}"
            with open(out.with_suffix(".log"), "w") as log:
                code = started(command_of(base, kind, renderer, out, overrides), cache, log).wait()
            if code:
                raise SystemExit(f"{out}: the undisturbed run ended with {code}: see {out}.log")
        seconds.write_text(f"{time.monotonic() - begun:.3f}")
    return float(seconds.read_text())


def trial(base: Path, number: int, kind: str, renderer: str, seed: int, overrides) -> dict:
    """Kill a run once or twice and resume it, unless that is done; returns a row of the table."""
    folder = base / f"trial-{number:02d}"
    result = folder / "result.json"
    asked = {"kind": kind, "renderer": renderer, "seed": seed}
    if result.exists() and (known := json.loads(result.read_text())).get("asked") == asked:
        return known
    seconds = undisturbed(base, kind, renderer, overrides)
    reference, rng = base / f"whole-{kind}-{renderer}", np.random.default_rng([seed, number])
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    out, cache, row = folder / "out", folder / "cache", {"asked": asked, "kills": []}
    for attempt in range(1 + number % 2):
        moment = float(rng.uniform(0, seconds))
        more = ("--resume",) if attempt else ()
        log = folder / f"killed-{attempt}.log"
        if not killed_after(moment, command_of(base, kind, renderer, out, overrides, *more), cache, log):
            row["kills"].append({"after_s": round(moment, 2), "stage": "done before", "half": []})
            break
        said = log.read_text().splitlines()
        stage = said[-1].split(":")[0] if said else "importing"
        stage = "exiting" if stage.startswith("results in") else stage
        row["kills"].append({"after_s": round(moment, 2), "stage": stage} | look(out, reference))
    with open(folder / "resumed.log", "w") as log:
        command = command_of(base, kind, renderer, out, overrides, "--resume")
        row["code"] = started(command, cache, log).wait()
    row["differs"] = differing(out, reference) if row["code"] == 0 else ["exit code"]
    row["good"] = not row["differs"] and not any(kill["half"] for kill in row["kills"])
    result.write_text(json.dumps(row, indent=1))
    return row


def table(rows: list[dict]) -> str:
    """Return the table of all trials, in Markdown."""
    head = ["trial", "representation", "renderer", "killed after", "while", "checkpoint of step",
            "files / temporary / half", "result"]  # fmt: skip
    lines = []
    for number, row in enumerate(rows):
        kills = row["kills"]
        lines.append([
            str(number), row["asked"]["kind"], row["asked"]["renderer"],
            ", ".join(f"{kill['after_s']} s" for kill in kills),
            ", ".join(kill["stage"] for kill in kills),
            ", ".join(str(kill.get("step") or "none") for kill in kills),
            ", ".join(f"{k.get('files', 0)} / {k.get('temporary', 0)} / {len(k['half'])}" for k in kills),
            "the same bytes" if row["good"] else "DIFFERS: " + ", ".join(row["differs"] or ["half files"]),
        ])  # fmt: skip
    return markdown(head, lines)


def main(argv: list[str] | None = None) -> int:
    """Run all trials that are not done, print the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.interruption.run", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--kills", type=int, default=20, help="number of trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/interruption"))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument(
        "--renderers", nargs="+", choices=("transport", "path"), default=["transport", "path"]
    )
    parser.add_argument("--set", action="append", default=[], dest="overrides", metavar="table.key=value")
    chosen = parser.parse_args(argv)
    base = own_folder(chosen.out, *chosen.overrides)
    rows = []
    for number in tqdm(range(chosen.kills), unit="trial"):
        kind = chosen.kinds[number % len(chosen.kinds)]
        renderer = chosen.renderers[number // len(chosen.kinds) % len(chosen.renderers)]
        rows.append(trial(base, number, kind, renderer, chosen.seed, chosen.overrides))
    print(table(rows))
    good = sum(row["good"] for row in rows)
    kills = sum(kill["stage"] != "done before" for row in rows for kill in row["kills"])
    print(f"\n{kills} kills; {good} of {len(rows)} trials resumed to the bytes of an undisturbed run")
    return 0 if good == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
