"""Carry out many runs: ``envedit sweep JOBS --out OUT [--workers N | --scheduler ADDRESS]``.

A job is a name and a complete configuration (docs/cluster.md). Its folder is ``OUT/<hash>``, the hash being
that of the resolved configuration, of the contents of the files it names and of this program: the same work
is found again wherever its files lie and however it is called. In the folder: ``job.toml``, what the run
leaves, ``log.txt``, ``done.json``, written last, or ``failed.json``: the next call tries that job again. Two
calls may work on one folder: whoever carries out a job holds ``job.lock`` in its folder.

Every job is a process, started by a thread of this process or by a worker of a Dask cluster. On Linux a job
dies with whoever started it; on macOS an orphan runs on, and holds its lock.
"""

from .drive import sweep, table
from .jobs import Job, job, program, read_jobs
from .process import COMMAND, DONE, Outcome, run_job

__all__ = ["COMMAND", "DONE", "Job", "Outcome", "job", "program", "read_jobs", "run_job", "sweep", "table"]
