"""Run a sweep on any number of workers: resumable, and the same to the bit.

A run's record is written once, by this process, under the digest of what was run; what is there
is not run again. Workers only compute, so a cluster needs no common disk.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.files import write_text
from perception.records import InputError, Progress, silent
from scenarios.cluster import SchedulerLostError, open_cluster
from scenarios.outputs import versions
from scenarios.run_server import RunServer
from scenarios.sweep import RunSpec, SweepPlan
from scenarios.tasks import TASKS, check_config, find_task

logger = logging.getLogger(__name__)

# Enough tasks under way to keep every worker busy, few enough to keep memory flat.
_TASKS_PER_WORKER = 4
# A Dask task costs milliseconds, so short runs share one: as many as take about this long together.
_BATCH_SECONDS = 0.2
_LARGEST_BATCH = 32


@dataclass(frozen=True, slots=True)
class ExperimentState:
    """What an experiment's folder holds now."""

    n_runs: int
    n_done: int
    n_new: int


def run_experiment(
    plan: SweepPlan,
    out: Path,
    scheduler: str | None = None,
    n_workers: int | None = None,
    progress: Progress = silent,
) -> ExperimentState:
    """Run every run of a sweep that has no record in `out` yet.

    Parameters
    ----------
    scheduler : address of a running Dask scheduler; None starts a local cluster.
    n_workers : size of the local cluster; None takes one a core.

    Raises
    ------
    InputError
        A run's config is wrong (checked for all before any runs), or `out` holds another sweep.
    SchedulerLostError
        The cluster cannot be reached or vanished; finished runs are kept.
    """
    find_task(plan.sweep.task)
    _claim_folder(plan, out)
    for spec in plan.runs():
        check_config(plan.sweep.task, spec.config, plan.path)
    done = sum(1 for spec in plan.runs() if read_record(out, spec.key) is not None)
    if done < plan.n_runs:
        _run_missing(plan, out, scheduler, n_workers, progress, done)
    return ExperimentState(plan.n_runs, plan.n_runs, plan.n_runs - done)


def record_path(out: Path, key: str) -> Path:
    """Return where a run's record lies; two letters of the key keep folders small."""
    return out / "runs" / key[:2] / key / "record.json"


def read_record(out: Path, key: str) -> dict[str, Any] | None:
    """Return a run's record, or None where it is not there or not whole."""
    try:
        record: dict[str, Any] = json.loads(record_path(out, key).read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return record if record.get("key") == key else None


def _claim_folder(plan: SweepPlan, out: Path) -> None:
    """Mark `out` as this sweep's, or refuse it if it is another's."""
    marker = out / "sweep.json"
    mine = {"sweep": plan.key, "versions": versions(), "n_runs": plan.n_runs}
    if not marker.exists():
        if (out / "runs").exists():
            raise InputError(f"{out}: holds runs of an unknown sweep; give --out a new folder")
        write_text(marker, json.dumps(mine, indent=2) + "\n")
        return
    try:
        theirs = json.loads(marker.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{marker}: is not valid JSON; give --out a new folder") from error
    if theirs.get("sweep") != mine["sweep"]:
        raise InputError(f"{out}: holds another sweep than {plan.path}; give --out a new folder")
    changed = [k for k, v in versions().items() if theirs.get("versions", {}).get(k) != v]
    if changed:
        raise InputError(
            f"{out}: was made with another version of {', '.join(changed)}; its runs cannot be "
            "mixed with new ones: give --out a new folder"
        )


def _run_missing(
    plan: SweepPlan,
    out: Path,
    scheduler: str | None,
    n_workers: int | None,
    progress: Progress,
    done: int,
) -> None:
    missing = (spec for spec in plan.runs() if read_record(out, spec.key) is None)
    with open_cluster(scheduler, n_workers) as client:
        try:
            for record in _through(client, plan, out, missing):
                path = record_path(out, record["key"])
                write_text(path, json.dumps(record, indent=1) + "\n")
                done += 1
                progress("runs", done, plan.n_runs)
        except (OSError, TimeoutError) as error:
            raise SchedulerLostError(
                f"the scheduler {scheduler or 'of the local cluster'} went away ({error}); "
                f"{done} of {plan.n_runs} runs are kept: the same command goes on from there"
            ) from error


def _through(
    client: Any, plan: SweepPlan, out: Path, specs: Iterator[RunSpec]
) -> Iterator[dict[str, Any]]:
    """Keep a bounded number of runs under way; yield records as they come."""
    from distributed import CancelledError, as_completed

    workers = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
    pending = as_completed(loop=client.loop)
    waiting: dict[str, list[RunSpec]] = {}
    batch = 1

    def submit() -> None:
        chosen = list(itertools.islice(specs, batch))
        if chosen:
            requests = [_request(plan, spec, out) for spec in chosen]
            future: Future[Any] = client.submit(
                execute, requests, key=f"run-{chosen[0].key}", pure=True, retries=2
            )
            waiting[future.key] = chosen  # type: ignore[attr-defined]
            pending.add(future)

    for _ in range(workers * _TASKS_PER_WORKER):
        submit()
    for future in pending:
        chosen = waiting.pop(future.key)
        try:
            answers = future.result()
        except CancelledError as error:
            raise OSError("its runs were cancelled") from error
        future.release()
        for spec, answer in zip(chosen, answers, strict=True):
            yield {**_header(plan, spec), **answer}
        mean_s = sum(a["seconds"] for a in answers) / len(answers)
        batch = max(1, min(_LARGEST_BATCH, int(_BATCH_SECONDS / mean_s)))
        submit()


def _request(plan: SweepPlan, spec: RunSpec, out: Path) -> dict[str, Any]:
    folder = record_path(out, spec.key).parent.absolute() if plan.sweep.keep_outputs else None
    config = {**spec.config, "until": plan.sweep.until} if plan.sweep.until else spec.config
    return {
        "task": plan.sweep.task,
        "config": config,
        "folder": None if folder is None else str(folder),
        "time_limit_s": plan.sweep.time_limit_s,
        "memory_limit_mb": plan.sweep.memory_limit_mb,
    }


def _header(plan: SweepPlan, spec: RunSpec) -> dict[str, Any]:
    return {
        "key": spec.key,
        "index": spec.index,
        "task": plan.sweep.task,
        "settings": spec.settings,
        "seed": spec.seed,
        "config": spec.config,
        "versions": versions(),
    }


_server: RunServer | None = None


def execute(requests: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Run requests one after the other in this worker's server; the function that workers call."""
    return [_execute_one(request) for request in requests]


def _execute_one(request: dict[str, Any]) -> dict[str, Any]:
    global _server
    if _server is None:
        _server = RunServer(TASKS[request["task"]][2])
    if request["folder"] is not None:
        os.makedirs(request["folder"], exist_ok=True)
        return _server.run(request)
    folder = tempfile.mkdtemp(prefix="bathynav-run-")
    try:
        return _server.run({**request, "folder": folder})
    finally:
        shutil.rmtree(folder, ignore_errors=True)
