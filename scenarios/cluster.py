"""Dask clusters: a local one whose workers are processes of one thread, or a running one by address."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from perception.records import BathynavError


class SchedulerLostError(BathynavError):
    """The cluster cannot be reached, or went away."""


# glibc's marks above which freed memory goes back, and above which it never was the process's own.
_HELD = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 29,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 30,
}


@contextmanager
def open_cluster(
    scheduler: str | None = None, n_workers: int | None = None, hold_memory: bool = False
) -> Iterator[Any]:
    """Yield a Dask client: a cluster's by address, or that of a local one, which ends with the block.

    Parameters
    ----------
    scheduler : address of a running scheduler (tcp://HOST:PORT); None starts a local cluster.
    n_workers : size of the local cluster; None takes one a core.
    hold_memory : local workers keep memory that they will want again. Rasters come and go by the dozen: given
        back to the system and fetched anew each time, as is Dask's default, their pages cost as much
        as the work on them.

    Raises
    ------
    SchedulerLostError
        No scheduler answers at the address.
    """
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.ERROR)
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout="10s", set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SchedulerLostError(
                f"no Dask scheduler answers at {scheduler} ({error}); start one with "
                "`dask scheduler`, or leave --scheduler out"
            ) from error
        with client:
            yield client
        return
    settings = {
        # Runs have their own memory limit; Dask's would kill a worker for what its server's child took.
        "distributed.worker.memory.terminate": False,
        **(_HELD if hold_memory else {}),
        # What a worker has to say of its own end is not for the user.
        "logging.distributed": "critical",
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=n_workers or os.cpu_count() or 1,
            # numba's workqueue layer aborts a process that enters it from two threads.
            threads_per_worker=1,
            processes=True,
            memory_limit=0,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # Dask's default binds every interface
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client
