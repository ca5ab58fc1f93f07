"""Carry out many runs: ``python -m experiments.sweep JOBS --out OUT [--workers N] [--scheduler ADDRESS]``.

A job is a name and a complete configuration. Its folder is ``OUT/<hash>``, the hash being that of the
resolved configuration with the contents of the files it names: the same work is found again wherever its
files lie and however it is called. In the folder: ``job.toml``, what the run leaves, ``log.txt``, and
``done.json``, written last.

JOBS is a TOML file with a table for each job, ``[jobs.NAME]``, laid over ``[common]``; or a folder of
configurations ``NAME.toml``. What is done is skipped; what was interrupted continues from the run's own
checkpoint; what failed leaves ``failed.json``, does not stop the others, and is tried again by the next call.
Any process may be killed at any time: nothing but the jobs in flight is lost. Two calls may work on one
folder; locks keep them off each other's jobs.

By default jobs are processes on this machine, a few at a time, among which its cores are divided. With
``--scheduler`` they are tasks of a Dask cluster (``pip install envedit[cluster]``) whose workers see OUT and
the input files under the same paths and can import ``experiments``, as from within a clone::

    dask scheduler                                     # prints its address, tcp://HOST:8786
    dask worker tcp://HOST:8786 --nthreads 1           # on each node; a thread is a job at a time
    python -m experiments.sweep JOBS --out /shared/runs --scheduler tcp://HOST:8786

On Slurm, ``SLURMCluster`` of dask-jobqueue starts both and knows the address. With more than one worker on a
node give ``--threads``, or each job takes all of the node's cores.

For Linux and macOS. On Linux a job dies with whoever started it; on macOS an orphan runs on, under its lock.
"""

from .drive import sweep, table
from .jobs import Job, job, read_jobs
from .process import COMMAND, Outcome, run_job

__all__ = ["COMMAND", "Job", "Outcome", "job", "read_jobs", "run_job", "sweep", "table"]
