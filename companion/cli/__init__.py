"""The `companion` command: one file per command group."""

import os

# Before NumPy loads: one thread per algorithm gives the same bytes on every run, and keeps
# libraries from fighting over two cores.
for _pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_pool, "1")
os.environ.setdefault("MAVLINK20", "1")
