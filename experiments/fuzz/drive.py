"""Carry out cases: make the damaged file, hand it to a worker, see what becomes of either."""

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from . import documents, headers, mutate, pictures, scenes, worker

ROOT = Path(__file__).parents[2]
FAULTS = ("crashed", "hung", "traceback", "unclear", "wrong", "memory", "printed")
"""Outcomes that must not be; the others are "read" and "refused"."""
WHOLE = -2
"""The index of a seed itself, which must be read."""


@dataclass
class Tally:
    """How the cases of one kind went.

    Attributes
    ----------
    counts : Counter
        Cases by outcome.
    kinds : Counter
        Refusals by the name of the error.
    peak : int
        Most memory that a case took, bytes.
    beyond : int
        Most memory that a case took beyond the image that its file declares, bytes.
    faults : list of (int, str, str)
        Index, outcome and error of every case that went wrong.
    """

    counts: Counter = field(default_factory=Counter)
    kinds: Counter = field(default_factory=Counter)
    peak: int = 0
    beyond: int = 0
    faults: list = field(default_factory=list)

    def add(self, index: int, answer: dict, declared: int) -> None:
        """Count one case."""
        outcome = answer["outcome"]
        self.counts[outcome] += 1
        if outcome == "refused":
            self.kinds[answer["kind"]] += 1
        self.peak = max(self.peak, answer.get("peak", 0))
        self.beyond = max(self.beyond, answer.get("peak", 0) - declared)
        if outcome in FAULTS:
            self.faults.append((index, outcome, answer.get("error", "")))


def seeds(what: str) -> list[tuple[str, bytes]]:
    """Return the whole files of a kind, (name, content), in a fixed order."""
    with tempfile.TemporaryDirectory() as folder:
        made = {
            "exr": lambda: pictures.exr_files(Path(folder)),
            "hdr": pictures.hdr_files,
            "toml": documents.toml_files,
            "painted": lambda: pictures.painted_files(Path(folder)),
            "weights": pictures.weight_files,
            "checkpoint": lambda: pictures.checkpoint_files(Path(folder)),
            "scene": scenes.scene_files,
            "mesh": scenes.mesh_files,
            "texture": lambda: pictures.painted_files(Path(folder)),
            "entry": scenes.entry_files,
            "state": scenes.state_files,
        }[what]()
    return sorted(made.items())


def case(what: str, whole: list[tuple[str, bytes]], seed: int, index: int) -> tuple[str, bytes]:
    """Return name and content of a damaged file: the same for the same seeds, kind, seed and index."""
    rng = np.random.default_rng([seed, zlib.crc32(what.encode()), index])
    name, data = whole[rng.integers(len(whole))]
    return name, _MUTATED.get(what, mutate.mutated)(data, rng)


_MUTATED = {
    "toml": documents.mutated,
    "scene": scenes.mutated_scene,
    "entry": scenes.mutated_entry,
    "state": scenes.mutated_state,
}
"""Damage of kinds that bytes alone would not reach."""


class Worker:
    """A worker process, started anew when it has ended.

    Parameters
    ----------
    reader : str
        As for :mod:`.worker`.
    heap_check : str
        A library to preload that checks the heap, such as glibc's ``libc_malloc_debug.so.0``.
    seconds : float
        Processor time that a small file may take.
    patience : float
        Seconds of wall time, for each second of processor time that a case has, after which it is stuck.
    """

    def __init__(self, reader: str, heap_check: str = "", seconds: float = 5.0, patience: float = 20.0):
        self.reader, self.heap_check, self.seconds, self.patience = reader, heap_check, seconds, patience
        self.process = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def _start(self):
        # Freed memory is overwritten, so that its use is seen; large blocks go back to the system at once.
        more = {"MALLOC_PERTURB_": "165", "MALLOC_MMAP_THRESHOLD_": "65536"}
        if self.heap_check:
            more |= {"LD_PRELOAD": self.heap_check, "MALLOC_CHECK_": "3"}
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        self.printed = tempfile.TemporaryFile()  # noqa: SIM115 it lives as long as the process
        self.process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", "-m", "experiments.fuzz.worker", self.reader],
            cwd=ROOT,
            env=os.environ | more | {"PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.printed,
        )

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
            return {
                "outcome": "hung",
                "error": f"{seconds:g} s of processor time\n{said}",
            }
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return {"outcome": "crashed", "error": f"{name}\n{said}"}


def fuzz(
    what: str,
    indices,
    seed: int = 0,
    keep: Path | None = None,
    reader: str = "",
    heap_check: str = "",
    tick=lambda: None,
) -> Tally:
    """Read many damaged files of one kind.

    Every worker reads all whole files first; one that is not read is a fault, of index ``WHOLE``.

    Parameters
    ----------
    what : str
        One of ``readers.READERS``.
    indices : iterable of int
        Which cases; case i of a seed is the same file whichever others are made.
    seed : int
        Of the damage.
    keep : Path, optional
        Folder that receives the files that went wrong, and what went wrong with them.
    reader : str
        A reader in place of that of ``what``; see :mod:`.worker`.
    heap_check : str
        As for :class:`Worker`.
    tick : callable
        Called after every case.

    Returns
    -------
    Tally
    """
    tally, whole = Tally(), seeds(what)
    with tempfile.TemporaryDirectory() as folder, Worker(reader or what, heap_check) as process:

        def one(name, data, index):
            if process.process is None and index != WHOLE:
                for warm, raw in whole:  # a reader's first call takes memory that later ones do not
                    one(warm, raw, WHOLE)
            (path := Path(folder) / name).write_bytes(data)
            declared = headers.declared(data)
            answer = process.read(path, index, declared, limited=index != WHOLE)
            if index == WHOLE:
                if answer["outcome"] != "read" and not name.startswith("deep"):
                    tally.faults.append((index, answer["outcome"], f"{name}: {answer.get('error', '')}"))
                return
            tally.add(index, answer, declared)
            if keep and answer["outcome"] in FAULTS:
                kept = keep / f"{what}-{seed}-{index}-{answer['outcome']}-{name}"
                keep.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, kept) if path.exists() else kept.write_bytes(data)
                kept.with_name(kept.name + ".txt").write_text(answer.get("error", ""), errors="replace")

        for index in indices:
            one(*case(what, whole, seed, index), index)
            tick()
    return tally
