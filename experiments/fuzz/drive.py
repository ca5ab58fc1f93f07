"""Carry out cases: make the damaged file, hand it to a worker, see what becomes of either."""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from . import worker
from .declared import declared as declared_bytes
from .kinds import case, seeds

ROOT = Path(__file__).parents[2]
FAULTS = ("crashed", "hung", "traceback", "unclear", "wrong", "memory", "printed")
"""Outcomes that must not be; the others are "read" and "refused"."""
WHOLE = -2
"""The index of a seed itself, which must be read."""


class Worker:
    """A worker process, started anew when it has ended.

    ``reader`` is as for :mod:`.worker`, ``seconds`` the processor time that a small file may take,
    ``patience`` the wall time, for each second of processor time that a case has, after which it is stuck.
    """

    def __init__(self, reader: str, seconds: float = 5.0, patience: float = 20.0):
        self.reader = reader
        self.seconds = seconds
        self.patience = patience
        self.process = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def _start(self):
        # Freed memory is overwritten, so that its use is seen; large blocks go back to the system at once.
        more = {"MALLOC_PERTURB_": "165", "MALLOC_MMAP_THRESHOLD_": "65536"}
        self.printed = tempfile.TemporaryFile()  # noqa: SIM115 it lives as long as the process
        self.process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", "-m", "experiments.fuzz.worker", self.reader],
            cwd=ROOT,
            env=os.environ | more,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.printed,
        )
        self.process.stdout.readline()  # it is ready: starting counts for no file

    def stop(self) -> None:
        """End the process."""
        if self.process is None:
            return
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.printed):
            with contextlib.suppress(OSError):
                stream.close()
        self.process = None

    def read(self, path: Path, index: int, declared: int, limited: bool = True) -> dict:
        """Have a file read; returns its ``outcome``, ``error`` and ``peak`` bytes of memory."""
        if self.process is None:
            self._start()
        seconds = worker.cpu_limit(declared, self.seconds)
        request = {"path": str(path), "index": index, "declared": declared}
        request |= {"limited": limited, "seconds": seconds}
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(request).encode() + b"\n")
            self.process.stdin.flush()
        wait = self.patience * seconds
        if not select.select([self.process.stdout], [], [], wait)[0]:
            self.stop()
            return {"outcome": "hung", "error": f"no answer in {wait:.0f} s of wall time"}
        if line := self.process.stdout.readline():
            return json.loads(line)
        code = self.process.wait()
        self.printed.seek(max(self.printed.seek(0, os.SEEK_END) - 1500, 0))
        said = self.printed.read().decode(errors="replace")
        self.stop()
        if code == -signal.SIGPROF:
            return {"outcome": "hung", "error": f"{seconds:g} s of processor time\n{said}"}
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return {"outcome": "crashed", "error": f"{name}\n{said}"}


def piece(settings, folder, what: str, first: int, count: int, reader: str = "") -> dict:
    """Read damaged files of one of ``kinds.KINDS``; those that go wrong, and why, are kept in ``folder``.

    File i of the configuration's seed is the same whichever others are made. Every worker reads all whole
    files first; one that is not read is a fault as well. ``reader`` takes the place of that of ``what``.

    Returns
    -------
    dict
        ``counts``: files by outcome; ``errors``: refusals by the name of the error; ``beyond``: the most
        memory that a file took beyond the image that it declares, bytes; ``faults``: [index, outcome, error]
        of every file that went wrong.
    """
    whole = seeds(what)
    counts = Counter()
    errors = Counter()
    beyond = 0
    faults = []
    with tempfile.TemporaryDirectory() as work, Worker(reader or what) as process:

        def read(name, data, index):
            (path := Path(work) / name).write_bytes(data)
            return process.read(path, index, declared_bytes(data), limited=index != WHOLE)

        for index in range(first, first + count):
            if process.process is None:  # a reader's first call takes memory that later ones do not
                for name, data in whole:
                    answer = read(name, data, WHOLE)
                    if answer["outcome"] != "read" and name != "deep.exr":
                        faults.append((name, answer["outcome"], answer.get("error", "")))
            name, data = case(what, whole, settings.seed, index)
            answer = read(name, data, index)
            outcome = answer["outcome"]
            error = answer.get("error", "")
            counts[outcome] += 1
            if outcome == "refused":
                errors[answer["kind"]] += 1
            beyond = max(beyond, answer.get("peak", 0) - declared_bytes(data))
            if outcome in FAULTS:
                faults.append((index, outcome, error))
                kept = folder / f"{index}-{outcome}-{name}"
                kept.write_bytes(data)
                kept.with_name(kept.name + ".txt").write_text(error, errors="replace")
    return {"counts": counts, "errors": errors, "beyond": beyond, "faults": faults}
