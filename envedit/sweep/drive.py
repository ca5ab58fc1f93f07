"""All jobs: submitted, awaited, and summed up."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import importlib.util
import logging
import re
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

from envedit.core.atomic_files import write_atomically
from envedit.core.errors import ConfigError, InputError
from envedit.core.types import FilePath

from .board import Board
from .jobs import Job
from .process import DONE, GRACE, LONGEST, POLL, STOPPED, Outcome, cores, run_job

CORES_A_JOB = 4
"""A run is parallel kernels with serial stretches between: two jobs on eight cores beat one."""
AGAIN = 2.0
"""Seconds until a job that another call holds is looked at again."""
FOREVER = 1e9
"""Seconds that this process's own workers may be silent: the machine may have been suspended."""
CONNECT = 10.0
"""Seconds in which a scheduler must answer at first."""


class _OneByOne:
    """Jobs of this machine, one at a time; needs no Dask."""

    slots = 1

    def __init__(self, run: Callable[..., Outcome], threads: int | None):
        self._stop, self._pool = uuid.uuid4().hex, concurrent.futures.ThreadPoolExecutor(1)
        self._run = functools.partial(run, threads=threads or cores(), stop=self._stop)
        self.description = f"1 at a time, {threads or cores()} threads"

    def submit(self, job: Job, waited: bool = False) -> Any:
        """Return a future of an outcome."""
        return self._pool.submit(self._run, job, waited=waited)

    def close(self) -> None:
        """Interrupt what runs, and wait until it has written its checkpoint."""
        STOPPED.add(self._stop)
        self._pool.shutdown(cancel_futures=True)
        STOPPED.discard(self._stop)


class _Dask:
    """Jobs as tasks of Dask: of a cluster in this process, or of the scheduler at an address."""

    def __init__(self, run: Callable[..., Outcome], workers: int, address: str | None, threads: int | None):
        asked = f"--scheduler {address}" if address else f"--workers {workers}"
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            missing = "dask.distributed is missing: run pip install '.[cluster]' in the checkout"
            raise ConfigError(f"{asked}: {missing}") from None
        # Its tracebacks when a scheduler is gone.
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
        self._submitted: list[Any] = []
        self._stop, self._cluster = uuid.uuid4().hex, None
        self.slots = None if address else workers  # a cluster's workers come and go
        if address is None:
            threads = threads or max(1, cores() // workers)
            self.description = f"{workers} at a time, {threads} threads each"
            # Threads of this process, each of which waits for the process of a job.
            shape: dict[str, Any] = {"n_workers": 1, "threads_per_worker": workers, "processes": False}
            shape |= dict.fromkeys(("dashboard_address", "worker_dashboard_address"), "127.0.0.1:0")
            shape |= {"scheduler_kwargs": {"dashboard": False, "worker_ttl": FOREVER}}
            self._cluster = LocalCluster(**shape, silence_logs=logging.CRITICAL)
            self._client = Client(self._cluster, set_as_default=False)
        else:
            if not re.fullmatch(r"((tcp|tls|wss?|ucx)://)?[^\s/]+:\d+", address):
                raise ConfigError(f"{asked}: got {address}, expected HOST:PORT or tcp://HOST:PORT")
            try:
                self._client = Client(address, timeout=CONNECT, set_as_default=False)
                jobs = sum(self._client.nthreads().values())
            except (OSError, ValueError) as error:
                raise ConfigError(f"{asked}: no scheduler there ({error})") from None
            self.description = f"{jobs} at a time on {address}" if jobs else f"no workers at {address} yet"
        self._run = functools.partial(run, threads=threads, stop=self._stop)

    def submit(self, job: Job, waited: bool = False) -> Any:
        """Return a future of an outcome."""
        # A key of its own for every try: the scheduler remembers results by their keys.
        key = f"{job.key}-{uuid.uuid4().hex}"
        how = {"key": key, "pure": False, "retries": 2}
        how["priority"] = -len(self._submitted)  # in the order of the jobs, which Dask does not keep itself
        future = self._client.submit(self._run, job, waited=waited, **how)
        self._submitted.append(future)
        return future

    def close(self) -> None:
        """Give back what has not begun.

        What runs in this process is interrupted, and awaited until it has written its checkpoint; what runs
        on the workers of a scheduler runs to its end.
        """
        with contextlib.suppress(Exception):  # a scheduler that is gone
            if self._cluster is not None:
                STOPPED.add(self._stop)
                until = time.monotonic() + GRACE + POLL
                while not all(future.done() for future in self._submitted) and time.monotonic() < until:
                    time.sleep(POLL)
            self._client.close(timeout=2)
        if self._cluster is not None:
            self._cluster.close()
            STOPPED.discard(self._stop)


def _outcome(job, future):
    """Return what became of a job whose future is done."""
    if getattr(future, "status", "") == "cancelled":
        return Outcome(job, "lost", error="the scheduler went away")
    try:
        return future.result()
    except Exception as error:  # a full disk, a folder of somebody else, the death of workers
        words = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(job, "failed", error=words[:LONGEST])


def sweep(
    jobs: Iterable[Job],
    out: FilePath,
    workers: int | None = None,
    scheduler: str | None = None,
    threads: int | None = None,
    command: Sequence[str] = (),
    stream: TextIO | None = None,
) -> list[Outcome]:
    """Carry out all jobs that are not done, and report the progress.

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
        Jobs at a time on this machine; None: one for every four cores, or one where Dask is missing. Several
        need Dask.
    scheduler : str, optional
        Address of a Dask scheduler; ``workers`` does not count then.
    threads : int, optional
        Threads of a job; None: the cores divided by the jobs at a time.
    command : sequence of str
        What carries out every job, as :data:`.process.COMMAND`; empty: what each job says.
    stream : file, optional
        Where the progress is written, as a bar if it is a terminal; None: nowhere.

    Returns
    -------
    list of Outcome
        One for each of ``jobs``, in their order.

    Raises
    ------
    ConfigError, InputError
        Two jobs of one name; no Dask; no scheduler; a folder that cannot be used.
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
        if workers is None:
            workers = max(1, cores() // CORES_A_JOB) if importlib.util.find_spec("distributed") else 1
        workers = min(workers, len(todo))
        alone = workers == 1 and scheduler is None
        engine = _OneByOne(run, threads) if alone else _Dask(run, workers, scheduler, threads)
        board = Board(len(todo), engine.slots, stream)
        board.begin(
            f"{len(distinct)} jobs, {len(found)} done before, {len(todo)} to run: {engine.description}"
        )
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
    running = {engine.submit(job): job for job in todo}
    held: list[Any] = []
    while running or held:
        for future in [future for future in running if future.done()]:
            job = running.pop(future)
            outcome = _outcome(job, future)
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
