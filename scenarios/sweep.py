"""A sweep: a scenario and a `[sweep]` table, laid out as a fixed sequence of runs.

The layout is a pure function of the file: run i has the same settings and the same seed whoever
computes it, in whatever order, on however many workers.
"""

from __future__ import annotations

import copy
import difflib
import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy import stats

from perception.files import read_toml
from perception.records import FloatArray, InputError
from scenarios.schema import rasters_from

_BITS = 63  # of a child's seed: the widest that TOML's signed integers hold


class Axis(BaseModel):
    """One swept key: explicit values, or a distribution to draw from."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    values: tuple[Any, ...] | None = None
    uniform: tuple[float, float] | None = None
    log_uniform: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    integers: tuple[int, int] | None = None

    def kind(self) -> str:
        """Return the name of the one field that is given."""
        given = [n for n in type(self).model_fields if getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(
                "needs exactly one of values, uniform, log_uniform, normal, integers; "
                f"got {', '.join(given) or 'none'}"
            )
        return given[0]

    def at(self, quantile: float) -> Any:
        """Return the axis' value at a quantile in [0, 1): one draw for every method."""
        kind = self.kind()
        if kind == "values":
            assert self.values is not None
            return self.values[min(int(quantile * len(self.values)), len(self.values) - 1)]
        low, high = getattr(self, kind)
        if kind == "uniform":
            return low + (high - low) * quantile
        if kind == "log_uniform":
            return math.exp(math.log(low) + (math.log(high) - math.log(low)) * quantile)
        if kind == "integers":
            return min(low + int(quantile * (high - low + 1)), high)
        # The open interval: a quantile of 0 would be minus infinity.
        return low + high * float(stats.norm.ppf(min(max(quantile, 1e-12), 1 - 1e-12)))


class Criterion(BaseModel):
    """A bound on one metric that every run should keep."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    at_most: float | None = None
    at_least: float | None = None

    def holds(self, value: float | None) -> bool:
        """Return whether a metric's value keeps the bounds; a missing value does not."""
        if value is None or math.isnan(value):
            return False
        above = self.at_least is None or value >= self.at_least
        return above and (self.at_most is None or value <= self.at_most)


class Sweep(BaseModel):
    """The `[sweep]` table."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: Literal["grid", "latin-hypercube", "monte-carlo"] = "monte-carlo"
    task: str = "mission"
    until: str = ""
    runs: int = Field(default=1, ge=1, le=10_000_000)
    repeats: int = Field(default=1, ge=1)
    seed: int = Field(default=0, ge=0)
    time_limit_s: float = Field(default=3600.0, gt=0)
    memory_limit_mb: float = Field(default=8192.0, gt=0)
    keep_outputs: bool = False
    keys: dict[str, Axis] = Field(default_factory=dict)
    criteria: dict[str, Criterion] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RunSpec:
    """One run of a sweep.

    Attributes
    ----------
    index : position in the sweep, from 0.
    settings : swept key to value.
    config : the scenario with those settings in place and its own seed.
    key : content address: a digest of task, config and seed.
    """

    index: int
    settings: dict[str, Any]
    config: dict[str, Any]
    seed: int
    key: str


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """A sweep that was read and checked; iterate `runs()` for its runs in order."""

    path: Path
    sweep: Sweep
    scenario: dict[str, Any]
    n_runs: int

    @property
    def key(self) -> str:
        """Return the digest that tells this sweep from any other.

        Limits and what is kept do not change a result, so they do not change the key either.
        """
        drop = {"time_limit_s", "memory_limit_mb", "keep_outputs", "criteria"}
        return _digest([self.sweep.model_dump(exclude=drop), self.scenario])

    def runs(self) -> Iterator[RunSpec]:
        """Yield the runs in order, lazily: a sweep of millions costs no memory."""
        for index, settings in enumerate(_layout(self.sweep)):
            config = copy.deepcopy(self.scenario)
            for name, value in settings.items():
                _set_key(config, name, value)
            seed = _child_seed(self.sweep.seed, index)
            config["seed"] = seed
            key = _digest([self.sweep.task, self.sweep.until, config])
            yield RunSpec(index, settings, config, seed, key)


def read_sweep(path: Path) -> SweepPlan:
    """Read a sweep file.

    A swept key is written as in the scenario file with dots between its tables
    (``"navigation.heading_bias_deg" = { uniform = [-1, 1] }``).

    Raises
    ------
    InputError
        No `[sweep]`, an unknown or wrong key in it, an axis without values, an empty grid.
    """
    # Relative paths of rasters start at the sweep's file, wherever a run is computed.
    scenario = rasters_from(read_toml(path), path.parent)
    table = scenario.pop("sweep", None)
    if not isinstance(table, dict):
        raise InputError(f"{path}: has no [sweep] table; `bathynav run` takes a single scenario")
    try:
        sweep = Sweep.model_validate(table)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_complaint(error)}") from error
    for name, axis in sweep.keys.items():
        try:
            kind = axis.kind()
        except ValueError as error:
            raise InputError(f"{path}: [sweep.keys] {name!r} {error}") from error
        if kind == "values" and not axis.values:
            raise InputError(f"{path}: [sweep.keys] {name!r} has no values: the grid is empty")
        if sweep.method == "grid" and kind != "values":
            raise InputError(
                f"{path}: [sweep.keys] {name!r} gives {kind}, but a grid needs values = [...]"
            )
        if kind == "log_uniform" and min(getattr(axis, kind)) <= 0:
            raise InputError(f"{path}: [sweep.keys] {name!r} log_uniform needs positive bounds")
    return SweepPlan(Path(path), sweep, scenario, _count(sweep))


def _first_complaint(error: ValidationError) -> str:
    """Return one line for a validation error: the key, what is wrong, and a near miss."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        name = str(first["loc"][-1])
        near = difflib.get_close_matches(name, list(Sweep.model_fields), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return f"[sweep] has no key {where!r} (value {first['input']!r}){hint}"
    return f"[sweep] {where} = {first['input']!r}: {first['msg']}"


def _count(sweep: Sweep) -> int:
    if sweep.method != "grid":
        return sweep.runs * sweep.repeats
    sizes = [len(axis.values or ()) for axis in sweep.keys.values()]
    return math.prod(sizes) * sweep.repeats


def _layout(sweep: Sweep) -> Iterator[dict[str, Any]]:
    """Yield the swept settings of every run, in the sweep's fixed order."""
    names = list(sweep.keys)
    axes = [sweep.keys[n] for n in names]
    if sweep.method == "grid":
        for values in itertools.product(*(axis.values or () for axis in axes)):
            for _ in range(sweep.repeats):
                yield dict(zip(names, values, strict=True))
        return
    for row in _quantiles(sweep, len(axes)):
        settings = {n: axis.at(float(q)) for n, axis, q in zip(names, axes, row, strict=True)}
        for _ in range(sweep.repeats):
            yield dict(settings)


def _quantiles(sweep: Sweep, n_axes: int) -> Iterator[FloatArray]:
    # The layout's stream is no child of the runs' seeds: spawn keys of length 2 never meet theirs.
    rng = np.random.default_rng(np.random.SeedSequence(sweep.seed, spawn_key=(0, 1)))
    if sweep.method == "latin-hypercube" and n_axes:
        yield from stats.qmc.LatinHypercube(d=n_axes, rng=rng).random(sweep.runs)
        return
    for _ in range(sweep.runs):
        yield rng.random(n_axes)


def _child_seed(root: int, index: int) -> int:
    """Return the seed of run `index`: the index-th child that SeedSequence.spawn would give."""
    child = np.random.SeedSequence(root, spawn_key=(index,))
    return int(child.generate_state(1, np.uint64)[0]) >> (64 - _BITS)


def _set_key(config: dict[str, Any], dotted: str, value: Any) -> None:
    *tables, last = dotted.split(".")
    for name in tables:
        config = config.setdefault(name, {})
        if not isinstance(config, dict):
            raise InputError(f"[sweep.keys] {dotted!r}: {name!r} is a value, not a table")
    config[last] = value


def _digest(value: Any) -> str:
    text = json.dumps(_canonical(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _canonical(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _canonical(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_canonical(v) for v in value]
    if isinstance(value, (str, int, float, bool)) or value is None:
        return value
    return str(value)
