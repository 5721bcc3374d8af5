"""The cost that planning minimises, and the rasters it is made of.

``integral over the path of (w + a * max(0, altitude - floor)) ds`` with ds the three-dimensional
length of path. `w` (no unit) says how good the ground is, `a` (per metre) how dear altitude is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from perception.files import read_toml
from perception.records import REGION_CLASSES, FloatArray, InputError, RegionMap

# A route keeps to low ground: our reading of the paper's symbols for the path planner.
CLASS_WEIGHTS: dict[str, float] = {
    "peak": 2.0,
    "pit": 1.0,
    "ridge": 2.0,
    "valley": 1.0,
    "saddle ridge": 1.5,
    "saddle valley": 1.25,
    "flat": 1.0,
    "minimal": 1.5,
}


@dataclass(frozen=True, slots=True)
class CostTerms:
    """The switches of the cost.

    Attributes
    ----------
    altitude_per_m : `a`, price of a metre of altitude above the floor, per metre of path.
    uncertainty_per_m : added to `w` for each metre of the map's sigma; 0 off.
    position_per_m : added to `w` for each metre of expected position error; 0 off.
    """

    altitude_per_m: float = 0.1
    uncertainty_per_m: float = 0.0
    position_per_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("altitude_per_m", "uncertainty_per_m", "position_per_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"cost term {name} must be 0 or more, got {value}")


def read_terms(path: Path | None) -> CostTerms:
    """Read the table `[cost]` of a TOML file; None gives the defaults."""
    if path is None:
        return CostTerms()
    table = read_toml(path).get("cost")
    known = {f.name for f in fields(CostTerms)}
    if not isinstance(table, dict):
        raise InputError(f"{path}: has no table [cost]; it may hold {', '.join(sorted(known))}")
    for key, value in table.items():
        if key not in known:
            raise InputError(
                f"{path}: unknown key {key!r} in [cost]; there are {', '.join(sorted(known))}"
            )
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{path}: {key} must be a number, got {value!r}")
    return CostTerms(**{key: float(value) for key, value in table.items()})


def read_class_weights(path: Path) -> dict[str, float]:
    """Read the table `[weights]` of a TOML: class name (spaces or underscores) to weight.

    Classes left out keep their default. Weights are positive: 1 is neutral ground.
    """
    table = read_toml(path).get("weights")
    if not isinstance(table, dict):
        raise InputError(f"{path}: has no table [weights]; give e.g. valley = 1.0 under it")
    weights = dict(CLASS_WEIGHTS)
    for key, value in table.items():
        name = key.replace("_", " ").strip().lower()
        if name not in CLASS_WEIGHTS:
            raise InputError(
                f"{path}: no region class {key!r}; there are {', '.join(CLASS_WEIGHTS)}"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 1e3:
            raise InputError(
                f"{path}: weight of {key} must be a number in (0, 1000], got {value!r}"
            )
        weights[name] = float(value)
    return weights


def region_weights(regions: RegionMap, weights: Mapping[str, float] | None = None) -> FloatArray:
    """Return `w` of every cell, weighted by class probability where there is one.

    Parameters
    ----------
    weights : class name to weight; `CLASS_WEIGHTS` without.

    Returns
    -------
    (rows, cols) weights; 1 where there is no class.
    """
    table = dict(CLASS_WEIGHTS if weights is None else weights)
    by_code = np.array([table.get(name, 1.0) for name in REGION_CLASSES])
    hard: FloatArray = by_code[np.clip(regions.class_code, 0, len(by_code) - 1)]
    if regions.probability is None:
        return hard
    probability = regions.probability[1:]
    total = probability.sum(axis=0)
    good = np.isfinite(total) & (total > 0)
    soft = np.tensordot(by_code[1:], np.nan_to_num(probability), axes=1)
    return np.where(good, soft / np.where(good, total, 1.0), hard)
