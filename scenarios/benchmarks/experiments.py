"""The experiment runner itself: overhead a run, memory in the number of runs, sameness of results."""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path

from perception.files import write_text
from perception.records import Progress
from scenarios.benchmarks import Row, Table
from scenarios.experiments import run_experiment
from scenarios.results import write_results
from scenarios.sweep import SweepPlan, read_sweep
from scenarios.tasks import arithmetic_task

_SWEEP = """
mean = 2.0
draws = 1000
[sweep]
task = "arithmetic"
runs = {runs}
seed = 11
[sweep.keys]
sigma = {{ uniform = [0.5, 2.0] }}
"""
_SMALL, _LARGE = 200, 1000


def run(progress: Progress) -> Table:
    """Time sweeps of two sizes: their difference leaves out the start of the cluster."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        seconds, memory_mb = {}, {}
        for workers in (1, 2):
            for runs in (_SMALL, _LARGE):
                plan = _plan(folder, runs)
                out = folder / f"{workers}-{runs}"
                began = time.perf_counter()
                run_experiment(plan, out, n_workers=workers, progress=progress)
                write_results(plan, out)
                seconds[workers, runs] = time.perf_counter() - began
                memory_mb[workers, runs] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            overhead_s = (seconds[workers, _LARGE] - seconds[workers, _SMALL]) / (_LARGE - _SMALL)
            rows.append(
                Row(
                    f"{workers} worker{'s' * (workers > 1)}", "experiment", "seconds a run beyond it",
                    1e3 * (overhead_s - _bare_seconds(_plan(folder, _SMALL)) / workers), "ms",
                    goal="<= 20",
                )
            )  # fmt: skip
        grown = memory_mb[2, _LARGE] - memory_mb[1, _SMALL]
        rows.append(
            Row(f"{_SMALL} to {_LARGE} runs", "experiment", "growth of peak memory", grown, "MB")
        )
        same = _bytes(folder / f"1-{_LARGE}") == _bytes(folder / f"2-{_LARGE}")
        rows.append(
            Row("1 and 2 workers", "experiment", "results the same to the byte", float(same), "")
        )
    return Table("experiments", tuple(rows), {"runs": [_SMALL, _LARGE]})


def _plan(folder: Path, runs: int) -> SweepPlan:
    path = folder / f"sweep-{runs}.toml"
    write_text(path, _SWEEP.format(runs=runs))
    return read_sweep(path)


def _bare_seconds(plan: SweepPlan) -> float:
    """Return the seconds that a run takes by itself, called in a plain loop."""
    began = time.perf_counter()
    for spec in plan.runs():
        arithmetic_task(spec.config, Path())
    return (time.perf_counter() - began) / plan.n_runs


def _bytes(folder: Path) -> bytes:
    return (folder / "results.parquet").read_bytes()
