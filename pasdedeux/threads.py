"""One thread for linear algebra: the problems here are small, so threads would mostly wait for each other.

With two threads, reconstructing two people over 300 frames took six times the processor time (12.7 against 2.0 s).
Rounding also depends on the number of threads.
"""

from __future__ import annotations

import os

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "POLARS_MAX_THREADS",
)
"""Variables that libraries read on import."""
_ELSE_OPENMP = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "BLIS_NUM_THREADS")
"""Libraries fall back to OMP_NUM_THREADS if these are not set."""


def use_one_thread() -> None:
    """Limit libraries that are not imported yet to one thread, unless the environment sets a number."""
    said = _ELSE_OPENMP if "OMP_NUM_THREADS" in os.environ else ()
    for name in THREAD_VARIABLES:
        if name not in said:
            os.environ.setdefault(name, "1")
