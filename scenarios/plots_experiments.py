"""Figures of a sweep: distributions, convergence of the means, failures by cause."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from perception.files import whole_file
from perception.records import FloatArray
from scenarios.results import metric_names, numbers

_MOST_PANELS = 12  # more are not read on one sheet; the Parquet holds all


def plot_experiment(out: Path, table: Any, settings: set[str], causes: dict[str, int]) -> None:
    """Write distribution.png and convergence.png, and failures.png where runs failed."""
    names = [n for n in metric_names(table, settings) if np.isfinite(numbers(table, n)).any()]
    for file, draw in (("distribution.png", _histogram), ("convergence.png", _running_mean)):
        if names:
            _sheet(out / file, table, names[:_MOST_PANELS], draw)
    if causes:
        _failures(out / "failures.png", causes)


def _sheet(path: Path, table: Any, names: list[str], draw: Any) -> None:
    from matplotlib.figure import Figure

    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(4 * columns, 2.8 * rows), layout="constrained")
    for axes, name in zip(figure.subplots(rows, columns, squeeze=False).flat, names, strict=False):
        values = numbers(table, name)
        draw(axes, values[np.isfinite(values)])
        axes.set_title(name, fontsize=9)
    for axes in list(figure.axes)[len(names) :]:
        axes.set_axis_off()
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _histogram(axes: Any, values: FloatArray) -> None:
    axes.hist(values, bins=min(40, max(8, int(np.sqrt(values.size)))), color="#35608d")
    axes.axvline(np.median(values), color="k", lw=1, label="median")
    axes.set_ylabel("runs")


def _running_mean(axes: Any, values: FloatArray) -> None:
    number = np.arange(1, values.size + 1)
    mean = np.cumsum(values) / number
    spread = np.sqrt(np.maximum(np.cumsum(values**2) / number - mean**2, 0) / number)
    axes.fill_between(number, mean - 1.96 * spread, mean + 1.96 * spread, alpha=0.3, lw=0)
    axes.plot(number, mean, lw=1)
    axes.set_xlabel("runs")
    axes.set_ylabel("mean, 95 %")


def _failures(path: Path, causes: dict[str, int]) -> None:
    from matplotlib.figure import Figure

    shown = list(causes.items())[:_MOST_PANELS][::-1]
    figure = Figure(figsize=(8, 1 + 0.4 * len(shown)), layout="constrained")
    axes = figure.subplots()
    axes.barh([cause[:70] for cause, _ in shown], [n for _, n in shown], color="#a23b3b")
    axes.set_xlabel("runs that failed")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
