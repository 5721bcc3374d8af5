"""What every output folder holds beside its results: metrics.json and the resolved config.toml."""

from __future__ import annotations

import functools
import importlib.metadata
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from perception.files import existing_file, write_text
from perception.records import InputError

_VERSIONS = ("bathynav", "numpy", "scipy", "gtsam", "ompl", "numba", "rasterio")


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions that decide a result."""
    found = {}
    for name in _VERSIONS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def write_metrics(
    out: Path,
    metrics: Mapping[str, Any],
    config: Mapping[str, Any],
    seed: int | None = None,
) -> None:
    """Write `metrics.json` (flat keys, units in names) and `config.toml` into `out`.

    NaN and infinity become null: JSON has no word for them.
    """
    record = {
        **{key: _plain(value) for key, value in metrics.items()},
        "config": _plain(dict(config)),
        "seed": seed,
        "versions": versions(),
    }
    write_text(out / "metrics.json", json.dumps(record, indent=2, allow_nan=False) + "\n")
    write_text(out / "config.toml", tomli_w.dumps(_without_none(_plain(dict(config)))))


def read_metrics(folder: Path) -> dict[str, Any]:
    """Read a folder's `metrics.json`."""
    path = existing_file(folder / "metrics.json")
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: is not valid JSON ({error}); make it again") from error
    return record


def _plain(value: Any) -> Any:
    """Turn numpy values, paths and containers into what JSON and TOML know."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def _without_none(value: Any) -> Any:
    """Drop keys without a value: TOML has no null."""
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list):
        return [_without_none(v) for v in value if v is not None]
    return value
