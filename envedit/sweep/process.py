"""One job: its folder, its process, and what is left behind, whatever happens to either."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import selectors
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import envedit
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import InputError
from envedit.core.types import FilePath

from .jobs import Job, program
from .locks import Lock

DONE, FAILED, CONFIG, LOG, CHECKPOINT = "done.json", "failed.json", "job.toml", "log.txt", "checkpoint.npz"
POLL = 0.1
"""Seconds between looks at a process."""
GRACE = 15.0
"""Seconds that an interrupted job has for its checkpoint."""
STOPPED: set[str] = set()
"""Names of the sweeps of this process whose jobs are to end."""
LONGEST = 300
"""Characters of an error that is reported."""
_USELESS = "the checkpoint cannot be read", "belongs to another configuration"
"""What :mod:`envedit.solve.checkpoint` says of a checkpoint that no further try can use."""

COMMAND = (
    "{python}",
    "-c",
    # Dr.Jit takes its number of threads from a call, not from the environment.
    "import sys, drjit; drjit.set_thread_count(int(sys.argv.pop(1)));"
    "from envedit.run import main; sys.exit(main())",
    "{threads}",
    f"{{folder}}/{CONFIG}",
    "--out",
    "{folder}",
    "--resume",
)
"""What carries out a job; {python}, {folder} and {threads} are filled in where it runs."""

# What a process does before it becomes the job's command: it asks to die with the thread that started it
# (Linux), which exec keeps, and not to ignore Ctrl-C, as what a shell starts in the background does. A parent
# that died before is seen by its id.
_GUARD = (
    "import ctypes, os, signal, sys\n"
    "if sys.platform == 'linux': ctypes.CDLL(None).prctl(1, signal.SIGKILL)\n"  # PR_SET_PDEATHSIG
    "signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
    "if os.getppid() != int(sys.argv[1]): os._exit(1)\n"
    "os.execvp(sys.argv[2], sys.argv[2:])"
)


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes
    ----------
    state : str
        "done"; "skipped": it was done before; "failed"; "held": another call is at it; "stopped": by the
        user; "lost": the scheduler went away.
    seconds : float
        What it took, this time.
    error : str
        Of a failed job: exit code and last line of stderr. Of one that is held: who holds it.
    """

    job: Job
    state: str
    seconds: float = 0.0
    error: str = ""


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_job(
    job: Job,
    out: FilePath,
    command: Sequence[str] = (),
    threads: int | None = None,
    stop: str = "",
    waited: bool = False,
) -> Outcome:
    """Carry out a job unless it is done: in this thread, by a process of its own.

    Parameters
    ----------
    job : Job
        What to do.
    out : path
        Folder of all jobs.
    command : sequence of str
        What to call in place of the job's own command, as :data:`COMMAND`. Exit code 0: done. 3 with a line
        that says so, after it was started with a checkpoint: that is damaged or belongs to something else,
        and is removed for a second try.
    threads : int, optional
        Threads of the job; None: the cores of this machine over the jobs at a time of this Dask worker.
    stop : str
        Name of the sweep: when it is in :data:`STOPPED`, the job is interrupted as by Ctrl-C and gets some
        seconds for its checkpoint.
    waited : bool
        It was held when last looked at: if whoever held it left a failure, that is the outcome.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    folder = job.folder(out)
    if (folder / DONE).exists():
        return Outcome(job, "skipped")
    if stop in STOPPED:
        return Outcome(job, "stopped")
    if job.program != program():
        here = f"{socket.gethostname()} has envedit {program()}, expected {job.program}"
        return Outcome(job, "failed", error=f"{here}; install the same on every machine")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}): give another --out") from None
    with Lock(folder) as lock:
        if lock.holder:
            return Outcome(job, "held", error=lock.holder)
        if (folder / DONE).exists():
            return Outcome(job, "skipped")
        if waited and (folder / FAILED).exists():
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                return Outcome(job, "failed", error=json.loads((folder / FAILED).read_bytes())["error"])
        command = command or job.command or COMMAND
        return _run(job, folder, command, threads or max(1, cores() // _jobs_at_a_time()), stop, lock)


def _run(job, folder, command, threads, stop, lock):
    """Start the process, again without its checkpoint if that is no use, and write what became of it."""
    write_atomically(folder / CONFIG, job.toml.encode())
    (folder / FAILED).unlink(missing_ok=True)
    filled = {"{python}": sys.executable, "{folder}": str(folder.absolute()), "{threads}": str(threads)}
    argv = [functools.reduce(lambda text, key: text.replace(key, filled[key]), filled, p) for p in command]
    begun, resumed = time.monotonic(), (folder / CHECKPOINT).exists()
    ended, last = _supervise(argv, folder, threads, stop, lock)
    useless = ended == InputError.exit_code and any(words in last for words in _USELESS)
    if resumed and useless and (folder / CHECKPOINT).exists():
        (folder / CHECKPOINT).unlink()
        ended, last = _supervise(argv, folder, threads, stop, lock)
    seconds = round(time.monotonic() - begun, 1)
    if ended in ("stopped", "held"):
        return Outcome(job, ended, seconds, "another call" if ended == "held" else "")
    about = {"name": job.name, "seconds": seconds, "resumed": resumed, "threads": threads}
    about |= {"host": socket.gethostname(), "envedit": envedit.__version__}
    about["time_utc"] = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime())
    if ended == 0:
        _write(folder / DONE, about)
        return Outcome(job, "done", seconds)
    how = f"killed by signal {-ended} ({signal.strsignal(-ended)})" if ended < 0 else f"exit code {ended}"
    error = f"{how}: {last[:LONGEST]}" if last else how
    _write(folder / FAILED, about | {"code": ended, "error": error})
    return Outcome(job, "failed", seconds, error)


def _write(path, about):
    write_atomically(path, (json.dumps(about, indent=1) + "\n").encode())


def _supervise(argv, folder, threads, stop, lock):
    """Run a process; return its exit code, "stopped" or "held", and the last line of its stderr."""
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1"}
    with open(folder / LOG, "ab", buffering=0) as log:
        where = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {socket.gethostname()}"
        log.write(f"--- {where}: {shlex.join(argv)}\n".encode())
        process = subprocess.Popen(
            [sys.executable, "-S", "-c", _GUARD, str(os.getpid()), *argv],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for us to pass on, and a group can be ended as a whole
            env=environment,
        )
        try:
            lock.add(process.pid)
            ended, tail = _watch(process, log, stop, lock)
        finally:
            if process.poll() is None:
                _signal(process, signal.SIGKILL)
                process.wait()
            if process.stderr:
                process.stderr.close()
    lines = [line.strip() for line in tail.decode(errors="replace").splitlines() if line.strip()]
    return ended, lines[-1] if lines else ""


def _watch(process, log, stop, lock):
    """Copy a process's stderr to the log until it ends, has had its time to stop, or has lost its lock."""
    tail, until, reading = b"", math.inf, True
    with selectors.DefaultSelector() as selector:
        selector.register(process.stderr, selectors.EVENT_READ)
        while True:
            if reading and selector.select(POLL):
                data = os.read(process.stderr.fileno(), 1 << 16)
                log.write(data)
                tail, reading = (tail + data)[-4096:], bool(data)
            else:  # nothing is said; a child of the process may hold the pipe open after its end
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(0 if reading else POLL)
                if process.returncode is not None:
                    return (process.returncode if until == math.inf else "stopped"), tail
            if until == math.inf and stop in STOPPED:
                until = time.monotonic() + GRACE
                _signal(process, signal.SIGINT)
            if time.monotonic() > until:
                return "stopped", tail
            if not lock.beat():
                return "held", tail


def _signal(process, number):
    with contextlib.suppress(OSError):
        os.killpg(process.pid, number)


def _jobs_at_a_time():
    """How many tasks the Dask worker runs at a time that this is; 1 if it is none."""
    try:
        from distributed import get_worker

        return max(1, get_worker().state.nthreads)
    except (ImportError, ValueError, AttributeError):
        return 1
