"""Two experiments, or two single runs, side by side: paired where they share seeds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from perception.records import FloatArray, InputError, NoOverlapError
from scenarios.outputs import read_metrics
from scenarios.results import mean_interval, numbers, read_results


@dataclass(frozen=True, slots=True)
class Difference:
    """How one metric differs between A and B.

    Attributes
    ----------
    mean_a, mean_b : means over the runs that are compared.
    difference, low, high : mean of B - A with its 95 % interval (NaN for single runs).
    p_value : of no difference, corrected for the number of metrics (Holm); NaN where untested.
    pairs : number of paired runs; 0 where the runs are not paired.
    """

    metric: str
    mean_a: float
    mean_b: float
    difference: float
    low: float
    high: float
    p_value: float
    pairs: int

    @property
    def significant(self) -> bool:
        return self.p_value < 0.05


def compare_folders(a: Path, b: Path) -> list[Difference]:
    """Compare two output folders, metric by metric.

    Experiments (folders with results.parquet) are paired run by run through their seeds and tested
    by Wilcoxon's signed ranks, which asks nothing of the distribution; without common seeds by
    Mann-Whitney. Two single runs give differences without significance.

    Raises
    ------
    InputError
        One is an experiment and the other is not, or a folder holds neither.
    NoOverlapError
        They have no metric in common.
    """
    experiments = [(folder / "results.parquet").exists() for folder in (a, b)]
    if experiments[0] != experiments[1]:
        one, other = (a, b) if experiments[0] else (b, a)
        raise InputError(f"{one} is an experiment and {other} is not; compare like with like")
    found = _experiments(a, b) if experiments[0] else _single_runs(a, b)
    if not found:
        raise NoOverlapError(f"{a} and {b} have no metric in common")
    return found


def _single_runs(a: Path, b: Path) -> list[Difference]:
    first, second = read_metrics(a), read_metrics(b)
    nothing = math.nan
    return [
        Difference(n, first[n], second[n], second[n] - first[n], nothing, nothing, nothing, 0)
        for n in first
        if n != "seed" and _is_number(first[n]) and _is_number(second.get(n))
    ]


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _experiments(a: Path, b: Path) -> list[Difference]:
    first, second = read_results(a), read_results(b)
    seeds_a, seeds_b = (t.column("seed").to_numpy() for t in (first, second))
    common, rows_a, rows_b = np.intersect1d(seeds_a, seeds_b, return_indices=True)
    names = [
        f.name for f in first.schema if str(f.type) == "double" and f.name in second.schema.names
    ]
    raw = []
    for name in names:
        va, vb = numbers(first, name), numbers(second, name)
        if common.size:
            raw.append(_paired(name, va[rows_a], vb[rows_b]))
        else:
            raw.append(_unpaired(name, va[np.isfinite(va)], vb[np.isfinite(vb)]))
    return _holm([r for r in raw if r is not None])


def _paired(name: str, a: FloatArray, b: FloatArray) -> Difference | None:
    good = np.isfinite(a) & np.isfinite(b)
    if not good.any():
        return None
    a, b = a[good], b[good]
    mean, low, high = mean_interval(b - a)
    # Signed ranks have nothing to rank where every pair is equal.
    p_value = float(stats.wilcoxon(b - a).pvalue) if a.size > 1 and np.any(a != b) else math.nan
    return Difference(name, float(a.mean()), float(b.mean()), mean, low, high, p_value, a.size)


def _unpaired(name: str, a: FloatArray, b: FloatArray) -> Difference | None:
    if a.size < 2 or b.size < 2:
        return None
    interval = stats.ttest_ind(b, a, equal_var=False).confidence_interval(0.95)
    p_value = float(stats.mannwhitneyu(a, b).pvalue)
    difference = float(b.mean() - a.mean())
    return Difference(
        name, float(a.mean()), float(b.mean()), difference,
        float(interval.low), float(interval.high), p_value, 0,
    )  # fmt: skip


def _holm(rows: list[Difference]) -> list[Difference]:
    """Correct p-values for testing many metrics at once (Holm 1979)."""
    tested = sorted((r.p_value, i) for i, r in enumerate(rows) if math.isfinite(r.p_value))
    corrected = list(rows)
    largest = 0.0
    for rank, (p_value, i) in enumerate(tested):
        largest = max(largest, min(1.0, p_value * (len(tested) - rank)))
        corrected[i] = replace(rows[i], p_value=largest)
    return corrected
