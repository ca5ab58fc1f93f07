"""All jobs: given to processes or to a cluster, looked after until the last, and summed up."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import logging
import queue
import re
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from envedit.core.atomic_files import write_atomically
from envedit.core.errors import ConfigError, EnveditError, InputError

from .board import Board
from .jobs import Job
from .process import COMMAND, DONE, LONGEST, POLL, Outcome, cores, run_job

CORES_A_JOB = 4
"""A run is parallel kernels with serial stretches between: two jobs on eight cores beat one."""
AGAIN = 2.0
"""Seconds until a job that another call holds is looked at again."""
CONNECT = 10.0
"""Seconds in which a scheduler must answer at first."""


class Processes:
    """Run jobs in threads of this process, a child process each; the cores are divided among them."""

    def __init__(self, run: Callable[..., Outcome], workers: int, threads: int | None):
        self.slots, self._run, self._stop = workers, run, threading.Event()
        self._pool = concurrent.futures.ThreadPoolExecutor(workers)
        self._shares = queue.SimpleQueue()
        total = max(cores(), workers)
        for i in range(workers):
            self._shares.put(threads or (total + i) // workers)
        self.words = f"{workers} at a time, {threads or total / workers:.3g} threads each"

    def submit(self, job: Job, waited: bool = False):
        """Return a future of an outcome."""
        return self._pool.submit(self._one, job, waited)

    def _one(self, job, waited):
        share = self._shares.get()
        try:
            return self._run(job, threads=share, stop=self._stop, waited=waited)
        finally:
            self._shares.put(share)

    def outcome(self, job: Job, future) -> Outcome:
        """Return what became of a job whose future is done."""
        try:
            return future.result()
        except (OSError, EnveditError) as error:  # a disk that is full, a folder of somebody else
            return _broken(job, error)

    def close(self) -> None:
        """Interrupt what runs, and wait until it has written its checkpoints."""
        self._stop.set()
        self._pool.shutdown(cancel_futures=True)


class Cluster:
    """Run jobs as tasks of a Dask cluster."""

    slots = None  # workers come and go

    def __init__(self, run: Callable[..., Outcome], address: str, threads: int | None):
        try:
            from distributed import Client
        except ImportError:
            missing = "dask.distributed is missing: pip install 'envedit[cluster]'"
            raise ConfigError(f"--scheduler {address}: {missing}") from None
        if not re.fullmatch(r"((tcp|tls|wss?|ucx)://)?[^\s/]+:\d+", address):
            raise ConfigError(f"--scheduler {address}: wanted HOST:PORT or tcp://HOST:PORT")
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # its tracebacks when it is gone
        try:
            self._client = Client(address, timeout=CONNECT, set_as_default=False)
            jobs = sum(self._client.nthreads().values())
        except (OSError, ValueError) as error:
            raise ConfigError(f"--scheduler {address}: no scheduler there ({error})") from None
        self._run, self._threads = run, threads
        self.words = f"{jobs} at a time on {address}" if jobs else f"waiting for workers of {address}"

    def submit(self, job: Job, waited: bool = False):
        """Return a future of an outcome."""
        # A key of its own for every try: the scheduler is to remember none.
        key, with_ = f"{job.key}-{uuid.uuid4().hex}", {"threads": self._threads, "waited": waited}
        return self._client.submit(self._run, job, **with_, key=key, pure=False, retries=2)

    def outcome(self, job: Job, future) -> Outcome:
        """Return what became of a job whose future is done."""
        if future.status == "cancelled":
            return Outcome(job, "lost", error="the scheduler went away")
        try:
            return future.result()
        except Exception as error:  # whatever a task raises, or the death of its workers
            return _broken(job, error)

    def close(self) -> None:
        """Give back what has not begun; what runs on a worker runs to its end."""
        with contextlib.suppress(Exception):  # a scheduler that is gone
            self._client.close(timeout=2)


def _broken(job, error):
    return Outcome(job, "failed", error=" ".join(f"{type(error).__name__}: {error}".split())[:LONGEST])


def sweep(
    jobs: Iterable[Job],
    out,
    workers: int | None = None,
    scheduler: str | None = None,
    threads: int | None = None,
    command: Sequence[str] = COMMAND,
    quiet: bool = False,
    stream=None,
) -> list[Outcome]:
    """Carry out all jobs that are not done, and tell how far it has come.

    .. code-block:: python

       jobs = [
           job(f"{name}-{angle}", {"input": {"envmap": file}, "target": {"rotate_degrees": angle}})
           for name, file in maps.items() for angle in (60, 140)
       ]
       outcomes = sweep(jobs, "runs/angles")
       measured = [json.loads((job.folder("runs/angles") / "metrics.json").read_text()) for job in jobs]

    Parameters
    ----------
    jobs : iterable of Job
        Those of the same content are run once.
    out : path
        Folder of the jobs' folders; ``sweep.tsv`` in it lists names, states, seconds, folders and errors.
    workers : int, optional
        Jobs at a time on this machine; None: one for every four cores.
    scheduler : str, optional
        Address of a Dask scheduler; ``workers`` does not count then.
    threads : int, optional
        Threads of a job; None: the cores divided by the jobs at a time.
    command : sequence of str
        What carries out a job, as :data:`COMMAND`.
    quiet : bool
        Tell nothing.
    stream : file, optional
        Where to; stderr. A bar if it is a terminal.

    Returns
    -------
    list of Outcome
        One for each of ``jobs``, in their order.

    Raises
    ------
    ConfigError, InputError
        Two jobs of one name; no scheduler; a folder that cannot be used.
    KeyboardInterrupt
        After the running jobs have had time for their checkpoints.
    """
    jobs, out = list(jobs), Path(out).absolute()
    names = [job.name for job in jobs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"two jobs are called {twice[0]}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}): give another --out") from None
    distinct = {job.key: job for job in reversed(jobs)}
    found = {
        key: Outcome(job, "skipped") for key, job in distinct.items() if (job.folder(out) / DONE).exists()
    }
    todo = [job for job in jobs if distinct[job.key] is job and job.key not in found]
    if todo:
        run = functools.partial(run_job, out=out, command=tuple(command))
        workers = min(workers or max(1, cores() // CORES_A_JOB), len(todo))
        engine = Cluster(run, scheduler, threads) if scheduler else Processes(run, workers, threads)
        board = Board(len(todo), engine.slots, quiet, stream or sys.stderr)
        board.begin(f"{len(distinct)} jobs, {len(found)} done before, {len(todo)} to run: {engine.words}")
        try:
            for outcome in _drive(todo, engine, board):
                found[outcome.job.key] = outcome
                board.tell(outcome, out)
        finally:
            engine.close()
            board.close()
    outcomes = [dataclasses.replace(found[job.key], job=job) for job in jobs]
    write_atomically(out / "sweep.tsv", _tsv(outcomes).encode())
    return outcomes


def _drive(todo, engine, board):
    """Submit jobs and yield outcomes as they come; what another call holds is looked at again and again."""
    running, held = {engine.submit(job): job for job in todo}, []
    while running or held:
        for future in [future for future in running if future.done()]:
            job = running.pop(future)
            outcome = engine.outcome(job, future)
            if outcome.state == "held":
                board.once(f"{job.name}: waiting, {outcome.error} is at it")
                held.append((time.monotonic() + AGAIN, job))
            else:
                yield outcome
        due = [job for when, job in held if when <= time.monotonic()]
        held = [(when, job) for when, job in held if job not in due]
        running |= {engine.submit(job, waited=True): job for job in due}
        board.refresh()
        time.sleep(POLL)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a line for each job, and one that counts them."""
    width = max((len(one.job.name) for one in outcomes), default=0)
    lines = [
        f"{one.job.name:{width}}  {one.state:7}  {one.seconds:8.1f} s  {one.job.key}  {one.error}".rstrip()
        for one in outcomes
    ]
    states = [one.state for one in outcomes]
    counts = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    return "\n".join([*lines, f"{len(outcomes)} jobs: {', '.join(counts)}"])


def _tsv(outcomes):
    rows = [("name", "state", "seconds", "folder", "error")]
    rows += [
        (o.job.name, o.state, f"{o.seconds:.1f}", o.job.key, " ".join(o.error.split())) for o in outcomes
    ]
    return "".join("\t".join(row) + "\n" for row in rows)
