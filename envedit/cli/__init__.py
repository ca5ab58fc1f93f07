"""The command lines: the only part that prints and chooses exit codes."""

import os

# Dr.Jit has the cores. OpenBLAS, which numpy brings, waits for its own threads in loops: beside other work a
# factorisation of 700 unknowns took 1.1 s with two threads and 6 ms with one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
