"""One thread for linear algebra: its problems here are small, so that threads would mostly wait for each other.

The reconstruction of two people in 300 frames took six times the processor time with two threads (12.7 against 2.0 s),
and sums of several threads are rounded otherwise.
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
"""What libraries read when they are first imported."""
_ELSE_OPENMP = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "BLIS_NUM_THREADS")
"""Without these, their libraries take OMP_NUM_THREADS."""


def use_one_thread() -> None:
    """Let libraries that are not imported yet have one thread, where the environment does not say how many."""
    said = _ELSE_OPENMP if "OMP_NUM_THREADS" in os.environ else ()
    for name in THREAD_VARIABLES:
        if name not in said:
            os.environ.setdefault(name, "1")
