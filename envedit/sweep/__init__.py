"""Carry out many runs: ``envedit sweep JOBS --out OUT [--workers N | --scheduler ADDRESS]``.

A job is a name and a complete configuration. Its folder is ``OUT/<hash>``, the hash being that of the
resolved configuration, of the contents of the files it names and of this program: the same work is found
again wherever its files lie and however it is called, and results of another version are not used. In the
folder: ``job.toml``, what the run leaves, ``log.txt``, and ``done.json``, written last.

Jobs that are done are skipped; an interrupted one continues from the run's own checkpoint; a failed one
leaves ``failed.json``, does not stop the others, and is tried again by the next call. Any process may be
killed at any time: only the jobs in flight are lost. Two calls may work on one folder: whoever carries out a
job holds ``job.lock`` in its folder.

Every job is a process, started by a thread of this process or by a worker of a Dask cluster
(``pip install '.[cluster]'``). On Linux a job dies with whoever started it; on macOS an orphan runs on, and
holds its lock.
"""

from .drive import sweep, table
from .jobs import Job, job, program, read_jobs
from .process import COMMAND, DONE, Outcome, run_job

__all__ = ["COMMAND", "DONE", "Job", "Outcome", "job", "program", "read_jobs", "run_job", "sweep", "table"]
