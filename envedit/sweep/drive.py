"""All jobs: submitted, awaited, and summed up."""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import datetime
import functools
import logging
import re
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TextIO

from envedit.core.atomic_files import make_folder, write_atomically
from envedit.core.errors import ConfigError, counted
from envedit.core.extras import required
from envedit.core.machine import cores
from envedit.core.types import FilePath

from .jobs import Job
from .process import DONE, ERROR_LENGTH, LOG, Outcome, run_job

CORES_PER_JOB = 4
"""A run is parallel kernels with serial stretches between: two jobs on eight cores beat one."""
RETRY_SECONDS = 1.0
"""Until a job that another call holds is tried again."""
CONNECT_SECONDS = 10.0
"""In which a scheduler must answer at first."""


def sweep(
    jobs: Iterable[Job],
    out: FilePath,
    workers: int | None = None,
    scheduler: str | None = None,
    threads: int | None = None,
    stream: TextIO | None = None,
) -> list[Outcome]:
    """Carry out all jobs that are not done, and report the progress.

    Jobs of the same content are run once. ``out`` is the folder of the jobs' folders; ``sweep.tsv`` in it
    lists names, states, seconds, folders and errors. There are ``workers`` jobs at a time on this machine, by
    default one for every four cores; with a ``scheduler``, the address of Dask's, that does not count. A job
    has ``threads`` threads, by default the cores divided by the jobs at a time. A line on each job is written
    to ``stream`` as it ends. Returns an outcome for each of ``jobs``, in their order.

    ConfigError or InputError for two jobs of one name, no Dask, no scheduler, or a folder that cannot be
    used; KeyboardInterrupt after the running jobs have had time for their checkpoints.
    """
    jobs = list(jobs)
    out = Path(out).absolute()
    names = [job.name for job in jobs]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"two jobs are called {twice[0]}")
    make_folder(out)

    # ---- What is to be done: one job of each content
    distinct = {job.key: job for job in reversed(jobs)}
    outcomes = {
        key: Outcome(job, "skipped") for key, job in distinct.items() if (job.folder(out) / DONE).exists()
    }
    to_run = [job for job in jobs if distinct[job.key] is job and job.key not in outcomes]

    # ---- Carry it out
    if to_run:
        done_before = (
            f"{counted(len(distinct), 'job', 'jobs')}, {len(outcomes)} done before, {len(to_run)} to run"
        )
        run = functools.partial(run_job, out=out)
        if scheduler is None:
            workers = min(workers or max(1, cores() // CORES_PER_JOB), len(to_run))
            engine = _on_this_machine(run, workers, threads)
        else:
            engine = _on_a_cluster(run, scheduler, threads)
        progress = Progress(len(to_run), stream)
        with engine as (submit, where):
            progress.say(f"{done_before}: {where}")
            for outcome in _completed(to_run, submit, progress):
                outcomes[outcome.job.key] = outcome
                progress.report(outcome, out)

    # ---- Sum up, under the names that were asked for
    every = [dataclasses.replace(outcomes[job.key], job=job) for job in jobs]
    write_atomically(out / "sweep.tsv", _tsv(every).encode())
    return every


@contextlib.contextmanager
def _on_this_machine(run, workers, threads):
    """Yield a function job -> future of its outcome, run by threads of this process, and a description."""
    threads = threads or max(1, cores() // workers)
    stop = threading.Event()
    executor = concurrent.futures.ThreadPoolExecutor(workers)
    run = functools.partial(run, threads=threads, stop=stop)
    each = " each" if workers > 1 else ""
    try:
        yield lambda job: executor.submit(run, job), f"{workers} at a time, {threads} threads{each}"
    finally:  # interrupt what runs, and wait until it has written its checkpoint
        stop.set()
        executor.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _on_a_cluster(run, address, threads):
    """Yield the same as :func:`_on_this_machine` for the workers of a Dask scheduler.

    At the end what has not begun is withdrawn, and what runs goes on to its end.
    """
    if not re.fullmatch(r"((tcp|tls|wss?|ucx)://)?[^\s/]+:\d+", address):
        raise ConfigError(f"--scheduler: got {address}, expected HOST:PORT or tcp://HOST:PORT")
    distributed = required("distributed", "cluster", f"--scheduler {address}")
    # Its tracebacks when a scheduler is gone.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        slots = sum(client.nthreads().values())
    except (OSError, ValueError) as error:
        raise ConfigError(f"--scheduler {address}: no scheduler there ({error})") from None
    executor = client.get_executor(pure=False, retries=2)
    run = functools.partial(run, threads=threads)
    submitted = []

    def submit(job):
        submitted.append(job)
        # In the order of the jobs, which Dask does not keep itself.
        return executor.submit(run, job, priority=-len(submitted))

    try:
        yield submit, f"{slots} at a time on {address}" if slots else f"no workers at {address} yet"
    finally:
        with contextlib.suppress(Exception):  # a scheduler that is gone
            executor.shutdown(wait=False)
            client.close(timeout=2)


def _completed(jobs, submit, progress):
    """Submit jobs and yield outcomes as they come; what another call holds is tried again and again."""
    running = {submit(job): job for job in jobs}
    held: list[Job] = []
    while running or held:
        if running:
            done, _ = concurrent.futures.wait(running, RETRY_SECONDS, concurrent.futures.FIRST_COMPLETED)
        else:
            time.sleep(RETRY_SECONDS)
            done = set()
        for future in done:
            job = running.pop(future)
            outcome = _outcome(job, future)
            if outcome.state == "held":
                progress.say_once(f"{job.name}: waiting, {outcome.error} is at it")
                held.append(job)
            else:
                yield outcome
        if not done:
            running |= {submit(job): job for job in held}
            held = []


def _outcome(job, future):
    """Return what became of a job whose future is done."""
    try:
        return future.result()
    except concurrent.futures.CancelledError:
        return Outcome(job, "lost", error="the scheduler went away")
    except Exception as error:  # a full disk, a folder of somebody else, the death of workers
        words = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(job, "failed", error=words[:ERROR_LENGTH])


# ---- progress and results ----------------------------------------------------------------------------------


class Progress:
    """Lines to a stream, if there is one, on how far a sweep has come, and when it will end at that rate."""

    def __init__(self, total: int, stream: TextIO | None):
        self._total = total
        self._stream = stream
        self._begun = time.monotonic()
        self._states: list[str] = []  # of the jobs that have ended
        self._said: set[str] = set()

    def report(self, outcome: Outcome, out: Path) -> None:
        """Say what became of a job."""
        if outcome.state == "lost":  # and so is all the rest
            self.say_once(f"{outcome.error}: run again to complete the table")
            return
        self._states.append(outcome.state)
        ended, failed = len(self._states), self._states.count("failed")
        carried_out = self._states.count("done") + failed  # the others were done before
        line = f"[{ended}/{self._total}] {outcome.job.name}: {outcome.state}"
        if outcome.state in ("done", "failed"):
            line += f", {outcome.seconds:.0f} s"
        if outcome.error:
            line += f": {outcome.error}"
        if outcome.state == "failed":
            line += f" ({outcome.job.folder(out) / LOG})"
        remarks = [f"{failed} failed"] if failed else []
        if carried_out and ended < self._total:
            left = round((self._total - ended) * (time.monotonic() - self._begun) / carried_out)
            until = time.strftime("%H:%M", time.localtime(time.time() + left))
            remarks.append(f"about {datetime.timedelta(seconds=left)} left, until {until}")
        self.say(f"{line}; {', '.join(remarks)}" if remarks else line)

    def say(self, line: str) -> None:
        """Write a line."""
        if self._stream is not None:
            print(line, file=self._stream, flush=True)

    def say_once(self, line: str) -> None:
        """Write a line that was not written before."""
        if line not in self._said:
            self._said.add(line)
            self.say(line)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a line for each job, and one that counts them."""
    width = max((len(outcome.job.name) for outcome in outcomes), default=0)
    lines = []
    for outcome in outcomes:
        job = outcome.job
        line = f"{job.name:{width}}  {outcome.state:7}  {outcome.seconds:8.1f} s  {job.key}  {outcome.error}"
        lines.append(line.rstrip())
    states = [outcome.state for outcome in outcomes]
    counts = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    return "\n".join([*lines, f"{counted(len(outcomes), 'job', 'jobs')}: {', '.join(counts)}"])


def _tsv(outcomes):
    rows = [("name", "state", "seconds", "folder", "error")]
    for outcome in outcomes:
        error = " ".join(outcome.error.split())
        rows.append((outcome.job.name, outcome.state, f"{outcome.seconds:.1f}", outcome.job.key, error))
    return "".join("\t".join(row) + "\n" for row in rows)
