"""Records of runs to one Parquet, and what it says: intervals, failures by cause."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy import stats

from perception.files import existing_file, whole_file
from perception.records import FloatArray, InputError
from scenarios.experiments import read_record
from scenarios.sweep import SweepPlan

_ROWS = 1000  # of a row group; fixed, so that the file does not depend on who wrote it
_FIXED = ("index", "seed", "status", "error", "passed")


def write_results(plan: SweepPlan, out: Path) -> None:
    """Write `results.parquet` (the same bytes for the same sweep) and `timings.parquet`.

    Seconds and peak memory differ from one computation to the next, so they have their own file.
    Columns are ``index, seed, status, error, passed``, then settings, then metrics by name.
    """
    settings, metrics = _columns(plan, out)
    fields = [
        pa.field("index", pa.int64()),
        pa.field("seed", pa.int64()),
        pa.field("status", pa.string()),
        pa.field("error", pa.string()),
        pa.field("passed", pa.bool_()),
        *(pa.field(n, t) for n, t in sorted(settings.items())),
        *(pa.field(n, t) for n, t in sorted(metrics.items())),
    ]
    _write(out / "results.parquet", pa.schema(fields), _result_rows(plan, out, settings, metrics))
    timings = pa.schema(
        [
            pa.field("index", pa.int64()),
            pa.field("seconds", pa.float64()),
            pa.field("peak_memory_mb", pa.float64()),
        ]
    )
    _write(out / "timings.parquet", timings, _timing_rows(plan, out))


def _records(plan: SweepPlan, out: Path) -> Iterator[dict[str, Any]]:
    for spec in plan.runs():
        record = read_record(out, spec.key)
        if record is None:
            raise InputError(
                f"{out}: run {spec.index} ({spec.key}) has no record; run the same command again"
            )
        # One content may stand at several places of a sweep: the place is the spec's.
        yield {**record, "index": spec.index, "settings": spec.settings}


def _columns(plan: SweepPlan, out: Path) -> tuple[dict[str, pa.DataType], dict[str, pa.DataType]]:
    settings: dict[str, pa.DataType] = {}
    metrics: dict[str, pa.DataType] = {}
    for record in _records(plan, out):
        for columns, values in ((settings, record["settings"]), (metrics, record["metrics"])):
            for name, value in values.items():
                kind = _type_of(value)
                if kind is not None and columns.get(name, kind) != kind:
                    kind = pa.string()
                if kind is not None:
                    columns[name] = kind
    return settings, {n: t for n, t in metrics.items() if n not in settings and n not in _FIXED}


def _type_of(value: Any) -> pa.DataType | None:
    if value is None:
        return None
    if isinstance(value, (bool, int, float)):
        return pa.float64()
    return pa.string()


def _cell(value: Any, kind: pa.DataType) -> Any:
    if value is None:
        return None
    if kind == pa.float64():
        return float(value)
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def _result_rows(
    plan: SweepPlan,
    out: Path,
    settings: dict[str, pa.DataType],
    metrics: dict[str, pa.DataType],
) -> Iterator[dict[str, Any]]:
    for record in _records(plan, out):
        row = {
            "index": record["index"],
            "seed": record["seed"],
            "status": record["status"],
            "error": record["error"],
            "passed": record["status"] == "done"
            and all(c.holds(record["metrics"].get(n)) for n, c in plan.sweep.criteria.items()),
        }
        row |= {n: _cell(record["settings"].get(n), t) for n, t in settings.items()}
        row |= {n: _cell(record["metrics"].get(n), t) for n, t in metrics.items()}
        yield row


def _timing_rows(plan: SweepPlan, out: Path) -> Iterator[dict[str, Any]]:
    for record in _records(plan, out):
        yield {n: record.get(n) for n in ("index", "seconds", "peak_memory_mb")}


def _write(path: Path, schema: pa.Schema, rows: Iterator[dict[str, Any]]) -> None:
    with whole_file(path) as temporary, pq.ParquetWriter(temporary, schema) as writer:
        chunk: list[dict[str, Any]] = []
        for row in rows:
            chunk.append(row)
            if len(chunk) == _ROWS:
                writer.write_table(pa.Table.from_pylist(chunk, schema))
                chunk = []
        if chunk:
            writer.write_table(pa.Table.from_pylist(chunk, schema))


def read_results(folder: Path) -> pa.Table:
    """Read an experiment's `results.parquet`.

    Raises
    ------
    InputError
        There is none, or it is not whole.
    """
    path = existing_file(folder / "results.parquet")
    try:
        return pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(
            f"{path}: is not a whole Parquet file ({error}); run the experiment's command again, "
            "finished runs are kept"
        ) from error


def numbers(table: pa.Table, name: str) -> FloatArray:
    """Return a column as floats, NaN where it has no value."""
    column = table.column(name).to_numpy(zero_copy_only=False)
    return np.array([math.nan if v is None else float(v) for v in column])


def metric_names(table: pa.Table, settings: set[str]) -> list[str]:
    """Return the numeric columns that are neither fixed nor swept."""
    return [
        f.name
        for f in table.schema
        if f.type == pa.float64() and f.name not in _FIXED and f.name not in settings
    ]


def mean_interval(values: FloatArray, confidence: float = 0.95) -> tuple[float, float, float]:
    """Return mean and its confidence interval by Student's t; NaN are left out."""
    values = values[np.isfinite(values)]
    if not values.size:
        return (math.nan,) * 3
    mean = float(values.mean())
    if values.size < 2:
        return mean, math.nan, math.nan
    half = float(
        stats.t.ppf(0.5 + confidence / 2, values.size - 1)
        * values.std(ddof=1)
        / math.sqrt(values.size)
    )
    return mean, mean - half, mean + half


def share_interval(successes: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's interval for a share; it stays sensible at 0 and at 1."""
    interval = stats.binomtest(successes, runs).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def failures_by_cause(table: pa.Table) -> dict[str, int]:
    """Count the runs that are not done, by status and error."""
    causes: dict[str, int] = {}
    for status, error in zip(
        table.column("status").to_pylist(), table.column("error").to_pylist(), strict=True
    ):
        if status != "done":
            cause = f"{status}: {error}"
            causes[cause] = causes.get(cause, 0) + 1
    return dict(sorted(causes.items(), key=lambda item: (-item[1], item[0])))
