"""One job: its folder, its process, and what is left behind, whatever happens to either."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

import envedit
from envedit.core import file_locks
from envedit.core.atomic_files import make_folder, write_atomically
from envedit.core.errors import InputError
from envedit.core.machine import cores
from envedit.core.types import FilePath

from .jobs import Job, program

CONFIG = "job.toml"
LOCK = "job.lock"
LOG = "log.txt"
CHECKPOINT = "checkpoint.npz"
FAILED = "failed.json"
DONE = "done.json"
POLL_SECONDS = 0.2
"""Between looks at whether a job is to be interrupted."""
GRACE_SECONDS = 15.0
"""What an interrupted job has for its checkpoint."""
ERROR_LENGTH = 300
"""Characters of an error that are reported."""
UNUSABLE_CHECKPOINT = "the checkpoint cannot be read", "belongs to another configuration"
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
# that died before is known by its id.
_GUARD = (
    "import ctypes, os, signal, sys\n"
    "if sys.platform == 'linux': ctypes.CDLL(None).prctl(1, signal.SIGKILL)\n"  # PR_SET_PDEATHSIG
    "signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
    "if os.getppid() != int(sys.argv[1]): os._exit(1)\n"
    "os.execvp(sys.argv[2], sys.argv[2:])"
)


@dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    job: Job
    # "done"; "skipped": it was done before; "failed"; "held": another call carries it out; "stopped": by the
    # user; "lost": the scheduler went away
    state: str
    seconds: float = 0.0  # what it took, this time
    # Of a failed job: exit code and last line of its output. Of one that is held: who holds it.
    error: str = ""


def run_job(
    job: Job, out: FilePath, threads: int | None = None, stop: threading.Event | None = None
) -> Outcome:
    """Carry out a job, whose folder is under ``out``, unless it is done: by a process of its own.

    Exit code 0 of its command: done. 3 with a line that says so, after it was started with a checkpoint: that
    is damaged or belongs to something else, and is removed for a second try. ``threads`` are those of the
    job; None: the cores of this machine over the jobs at a time of this Dask worker. Once ``stop`` is set,
    the job is interrupted as by Ctrl-C and gets some seconds for its checkpoint. InputError if the folder
    cannot be made or written to.
    """
    # ---- Nothing to do, or not by this installation
    folder = job.folder(out)
    stop = stop or threading.Event()
    if stop.is_set():
        return Outcome(job, "stopped")
    if (folder / DONE).exists():
        return Outcome(job, "skipped")
    if job.program != program():
        here = f"{socket.gethostname()} has envedit {program()}, expected {job.program}"
        return Outcome(job, "failed", error=f"{here}; install the same on every machine")

    # ---- Carry it out in its folder, which no other process works in meanwhile
    make_folder(folder)
    threads = threads or max(1, cores() // _jobs_at_a_time())
    try:
        with file_locks.locked(folder / LOCK) as lock:
            if (folder / DONE).exists():
                return Outcome(job, "skipped")
            return _carry_out(job, folder, threads, stop, lock)
    except file_locks.Busy as busy:
        return Outcome(job, "held", error=str(busy))


def _carry_out(job, folder, threads, stop, lock):
    """Start the process, again without its checkpoint if that is unusable, and write what became of it."""
    # ---- What is run
    write_atomically(folder / CONFIG, job.toml.encode())
    (folder / FAILED).unlink(missing_ok=True)
    values = {"{python}": sys.executable, "{folder}": str(folder.absolute()), "{threads}": str(threads)}
    argv = [_filled(part, values) for part in job.command or COMMAND]

    # ---- The run
    begun = time.monotonic()
    resumed = (folder / CHECKPOINT).exists()
    code, last_line = _run(argv, folder, threads, stop, lock)
    unusable = code == InputError.exit_code and any(words in last_line for words in UNUSABLE_CHECKPOINT)
    if resumed and unusable and (folder / CHECKPOINT).exists():
        (folder / CHECKPOINT).unlink()
        code, last_line = _run(argv, folder, threads, stop, lock)
    seconds = round(time.monotonic() - begun, 1)

    # ---- What became of it
    if code != 0 and stop.is_set():
        return Outcome(job, "stopped", seconds)
    record = {
        "name": job.name,
        "seconds": seconds,
        "resumed": resumed,
        "threads": threads,
        "host": socket.gethostname(),
        "envedit": envedit.__version__,
        "time_utc": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime()),
    }
    if code == 0:
        _write(folder / DONE, record)
        return Outcome(job, "done", seconds)
    error = f"killed by signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"exit code {code}"
    if last_line:
        error += f": {last_line[:ERROR_LENGTH]}"
    _write(folder / FAILED, record | {"code": code, "error": error})
    return Outcome(job, "failed", seconds, error)


def _filled(part, values):
    """Put values into one part of a command, which may have other braces."""
    for key, value in values.items():
        part = part.replace(key, value)
    return part


def _write(path, record):
    write_atomically(path, (json.dumps(record, indent=1) + "\n").encode())


def _run(argv, folder, threads, stop, lock):
    """Run a process, which holds the lock as well; return its exit code and the last line of its output."""
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1"}
    with open(folder / LOG, "ab+") as log:
        where = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {socket.gethostname()}"
        log.write(f"--- {where}: {shlex.join(argv)}\n".encode())
        log.flush()
        begin = log.tell()
        process = subprocess.Popen(
            [sys.executable, "-S", "-c", _GUARD, str(os.getpid()), *argv],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C is for us to pass on, and a group can be ended as a whole
            env=environment,
            pass_fds=[lock.fileno()],
        )
        try:
            code = _wait(process, stop)
        finally:
            if process.poll() is None:
                _signal(process, signal.SIGKILL)
                process.wait()
        end = log.seek(0, os.SEEK_END)
        log.seek(max(begin, end - 4096))
        lines = [line.strip() for line in log.read().decode(errors="replace").splitlines() if line.strip()]
    return code, lines[-1] if lines else ""


def _wait(process, stop):
    """Wait for a process; interrupt it once ``stop`` is set, and kill it if it does not end then."""
    while not stop.is_set():
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(POLL_SECONDS)
    _signal(process, signal.SIGINT)
    with contextlib.suppress(subprocess.TimeoutExpired):
        return process.wait(GRACE_SECONDS)
    _signal(process, signal.SIGKILL)
    return process.wait()


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
