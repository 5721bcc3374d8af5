"""Figures of a terrain-matching experiment: error, consistency, convergence, integrity, by group.

A group is one combination of the swept values; with more than eight, the first swept key alone.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from perception.files import whole_file
from perception.records import FloatArray
from scenarios.results import numbers, share_interval

_MOST_GROUPS = 8
_COLOURS = ("#35608d", "#c2571a", "#3d8a4e", "#8a3d7d", "#a08a1d", "#3d8a8a", "#8a3d3d", "#555555")


@dataclass(frozen=True, slots=True)
class Group:
    """Runs of one combination of settings: their name and rows in the table."""

    name: str
    rows: FloatArray
    colour: str


def plot_terrain(out: Path, table: Any, settings: set[str]) -> None:
    """Write terrain-error, -cep, -consistency, -convergence and -integrity.png."""
    done = [i for i, s in enumerate(table.column("status").to_pylist()) if s == "done"]
    if not done:
        return
    table = table.take(done)
    groups = groups_of(table, settings)
    for name, draw, size in (
        ("terrain-error", _error, (7.5, 4.8)), ("terrain-cep", _cep, (7.5, 4.2)),
        ("terrain-consistency", _consistency, (7.5, 4.8)),
        ("terrain-convergence", _convergence, (7.5, 4.2)),
        ("terrain-integrity", _integrity, (7.5, 4.2)),
    ):  # fmt: skip
        _sheet(out / f"{name}.png", draw, size, table, groups)


def groups_of(table: Any, settings: set[str]) -> list[Group]:
    """Group the runs by their swept values, at most eight groups."""
    keys = sorted(settings & set(table.column_names))
    columns = [table.column(k).to_pylist() for k in keys]
    varying = [i for i, c in enumerate(columns) if len(set(c)) > 1]
    rows = list(zip(*(columns[i] for i in varying), strict=True)) or [()] * table.num_rows
    if len(set(rows)) > _MOST_GROUPS:
        few = [i for i in varying if len(set(columns[i])) <= _MOST_GROUPS][:1]
        varying = few
        rows = [tuple(columns[i][r] for i in few) for r in range(table.num_rows)]
    names = [keys[i].split(".")[-1] for i in varying]
    found = sorted(set(rows), key=lambda row: tuple((isinstance(v, str), v) for v in row))
    return [
        Group(
            ", ".join(f"{n} {v:g}" if isinstance(v, float) else str(v) for n, v in zip(names, row, strict=True)) or "all runs",
            np.array([i for i, r in enumerate(rows) if r == row]),
            _COLOURS[k % len(_COLOURS)],
        )
        for k, row in enumerate(found)
    ]  # fmt: skip


def _sheet(
    path: Path, draw: Any, size: tuple[float, float], table: Any, groups: list[Group]
) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    draw(figure.subplots(), table, groups)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _series(table: Any, name: str, group: Group) -> FloatArray:
    column = table.column(name).to_pylist()
    return np.array([json.loads(column[i]) for i in group.rows])


def _error(axes: Any, table: Any, groups: list[Group]) -> None:
    for g in groups:
        time = _series(table, "series_time_s", g)[0] / 60
        error = np.maximum(_series(table, "series_error_m", g), 1e-2)
        axes.plot(time, np.median(error, axis=0), color=g.colour, label=g.name)
        low, high = np.quantile(error, [0.05, 0.95], axis=0)
        axes.fill_between(time, low, high, color=g.colour, alpha=0.13, lw=0)
        bound = np.sqrt(np.mean(_series(table, "series_bound_m", g) ** 2, axis=0))
        axes.plot(time, bound, color=g.colour, ls="--", lw=1)
    axes.plot([], [], color="k", ls="--", lw=1, label="Cramer-Rao bound (rms)")
    axes.set(yscale="log", xlabel="time, min", ylabel="horizontal error, m (median, 5 to 95 %)")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def _cep(axes: Any, table: Any, groups: list[Group]) -> None:
    x = np.arange(len(groups))
    for name, label, shift, alpha in (("cep50_m", "CEP50", -0.18, 1.0), ("cep95_m", "CEP95", 0.18, 0.5)):  # fmt: skip
        values = [np.median(numbers(table, name)[g.rows]) for g in groups]
        axes.bar(x + shift, values, 0.34, color=[g.colour for g in groups], alpha=alpha)
        for at, value in zip(x + shift, values, strict=True):
            axes.annotate(
                f"{label}\n{value:.2g}", (at, value), ha="center", va="bottom", fontsize=7
            )
    bound = [np.sqrt(np.mean(numbers(table, "bound_m")[g.rows] ** 2)) for g in groups]
    axes.plot(x, bound, "k_", ms=40, label="Cramer-Rao bound (rms)")
    axes.set(yscale="log", ylabel="error over the second half, m (median of runs)")
    axes.margins(y=0.15)
    _name_groups(axes, groups)
    axes.legend(fontsize=8, markerscale=0.4)


def _consistency(axes: Any, table: Any, groups: list[Group]) -> None:
    for g in groups:
        time = _series(table, "series_time_s", g)[0] / 60
        mean = _series(table, "series_nees", g).mean(axis=0)
        axes.plot(time, np.maximum(mean, 1e-2), color=g.colour, label=f"{g.name} ({len(g.rows)})")
    fewest = min(len(g.rows) for g in groups)
    low, high = stats.chi2.ppf([0.025, 0.975], 2 * fewest) / fewest
    axes.axhspan(low, high, color="k", alpha=0.08, lw=0)
    axes.axhline(2.0, color="k", lw=1, ls="--", label=f"2 expected; 95 % of means of {fewest} runs")
    axes.set(yscale="log", xlabel="time, min", ylabel="normalised error squared (mean of runs)")
    axes.legend(fontsize=8)


def _convergence(axes: Any, table: Any, groups: list[Group]) -> None:
    for g in groups:
        after = numbers(table, "converged_after_s")[g.rows]
        found = np.sort(after[np.isfinite(after)])
        end = float(_series(table, "series_time_s", g).max())
        steps = np.concatenate([[0.0], found, [end]])
        share = np.concatenate([[0.0], np.arange(1, len(found) + 1), [len(found)]]) / len(after)
        axes.step(np.maximum(steps, 1.0), share, where="post", color=g.colour, label=g.name)
    axes.set(xscale="log", xlabel="time, s", ylabel="share of runs converged", ylim=(0, 1.02))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def _integrity(axes: Any, table: Any, groups: list[Group]) -> None:
    x = np.arange(len(groups))
    kinds = (
        ("false_fix", "false fixes", "#a23b3b"), ("lost", "runs lost", "#c9a13b"),
        ("available", "rows converged", "#3d8a4e"),
    )  # fmt: skip
    for k, (name, label, colour) in enumerate(kinds):
        values = [numbers(table, name)[g.rows] for g in groups]
        mean = np.array([v.mean() for v in values])
        at = x + 0.26 * (k - 1)
        axes.bar(at, mean, 0.24, color=colour, label=label)
        for place, value, own in zip(at, mean, values, strict=True):
            axes.annotate(f"{value:.1%}", (place, value), ha="center", va="bottom", fontsize=7)
            if name != "available":
                low, high = share_interval(int(own.sum()), len(own))
                axes.plot([place, place], [low, high], color="k", lw=1)
    axes.set(ylabel="share (bars: 95 %, Wilson)", ylim=(0, 1.1))
    _name_groups(axes, groups)
    axes.legend(fontsize=8)


def _name_groups(axes: Any, groups: list[Group]) -> None:
    names = [g.name.replace(", ", "\n") for g in groups]
    axes.set_xticks(np.arange(len(groups)), names, fontsize=8)
