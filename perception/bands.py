"""Kernels over bands of rows, one band a thread.

A kernel ``kernel(first, last, *arrays)`` releases the interpreter's lock and writes only rows [first, last) of its
results; what it writes does not depend on the band, so neither do results on the number of threads.
Threads of our own rather than numba's: those of OpenMP do not survive a fork, and its plainest
layer forbids two callers at once.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numba

# Fewer values than this are done before a second thread has woken.
_WORTH = 60_000
# Threads of ours do not share their work out again: all of them may be waiting for one another.
_within = threading.local()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_count(), "bathynav-bands", _mark)


def _mark() -> None:
    _within.band = True


# A forked child has the pool but not its threads: it makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def thread_count() -> int:
    """Return the number of threads: processors allowed to us, or NUMBA_NUM_THREADS."""
    return int(numba.config.NUMBA_NUM_THREADS)


def over_bands(kernel: Callable[..., Any], rows: int, values: int, *arrays: Any) -> None:
    """Call ``kernel(first, last, *arrays)`` for bands that make up `rows`; `values` tells if threads are worth it."""
    threads = min(thread_count(), rows)
    if threads < 2 or values < _WORTH or getattr(_within, "band", False):
        kernel(0, rows, *arrays)
        return
    edges = [rows * k // threads for k in range(threads + 1)]
    jobs: list[Future[Any]] = [
        _pool().submit(kernel, first, last, *arrays) for first, last in pairwise(edges[1:])
    ]
    kernel(0, edges[1], *arrays)
    for job in jobs:
        job.result()


def in_threads(task: Callable[[Any], Any], items: list[Any]) -> list[Any]:
    """Return the task's results for the items, in their order."""
    if thread_count() < 2 or len(items) < 2 or getattr(_within, "band", False):
        return [task(item) for item in items]
    return list(_pool().map(task, items))
