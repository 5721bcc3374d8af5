"""What a sweep can run: name -> function of (config, folder) that returns flat metrics.

A task is imported only in the process that runs it. It is deterministic in its config, which
holds its seed, and writes below `folder` only.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from perception.records import InputError

Task = Callable[[dict[str, Any], Path], dict[str, Any]]

# name -> (module, function, modules worth importing once before runs are forked)
TASKS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "mission": (
        "scenarios.pipeline",
        "mission_task",
        ("scenarios.pipeline", "scipy.sparse", "numba"),
    ),
    "terrain": (
        "scenarios.terrain_matching",
        "terrain_task",
        ("scenarios.terrain_matching", "numba", "filterpy.kalman"),
    ),
    "arithmetic": ("scenarios.tasks", "arithmetic_task", ("numpy.random",)),
}


def find_task(name: str) -> Task:
    """Return the task of that name."""
    if name not in TASKS:
        raise InputError(f"[sweep] task = {name!r}: there are {', '.join(TASKS)}")
    module, function, _ = TASKS[name]
    task: Task = getattr(importlib.import_module(module), function)
    return task


def check_config(task: str, config: dict[str, Any], path: Path) -> None:
    """Refuse a run's config before anything runs; tasks without a schema take what they get."""
    if task == "arithmetic":
        return
    if task == "terrain":
        from scenarios.terrain_matching import experiment_of

        experiment_of(config, str(path))
        return
    from scenarios.schema import scenario_of

    scenario_of(config, str(path))


def arithmetic_task(config: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Estimate the mean of normal draws: a run of known answer, to measure the runner itself.

    Keys: ``seed``, ``mean``, ``sigma``, ``draws``, and ``fault`` ("crash", "hang", "memory",
    "error") for rehearsing what may go wrong.
    """
    import os
    import time

    import numpy as np

    fault = config.get("fault", "")
    if fault == "crash":
        os.abort()
    if fault == "hang":
        time.sleep(86_400)
    if fault == "memory":
        hoard = []
        while True:
            hoard.append(np.ones(4_000_000))
    if fault == "error":
        raise ValueError("the fault that was asked for")
    rng = np.random.default_rng(config["seed"])
    draws = config.get("mean", 0.0) + config.get("sigma", 1.0) * rng.standard_normal(
        config.get("draws", 100)
    )
    return {
        "mean": float(draws.mean()),
        "mean_error": float(abs(draws.mean() - config.get("mean", 0))),
    }
