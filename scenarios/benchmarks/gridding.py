"""Ten million soundings into cells: beside numpy's bincount, verde and GMT on the same soundings.

All but bincount start from positions and heights and give means; ours starts from poses and gives the five sums
that fusion needs (weight, weighted height, points, position, count). Times are processor seconds of one process,
least of several: wall time says more of the machine's other work than of these.
"""

from __future__ import annotations

import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapping.gridding import COUNT, HEIGHT, Spacing, Window, bin_lines
from perception.records import FloatArray, Progress
from scenarios.benchmarks import Row, Table

_SIDE = 1000  # cells of 1 m
_COLUMNS = 1000
_HALF_SWATH_M = 60.0


@dataclass(frozen=True, slots=True)
class _Soundings:
    """Lines of soundings: poses (n,), heights and their sigma (n, m)."""

    east: FloatArray
    north: FloatArray
    heading: FloatArray
    across: FloatArray
    height: FloatArray
    sigma: FloatArray

    def positions(self) -> tuple[FloatArray, FloatArray]:
        east = self.east[:, None] + np.cos(self.heading)[:, None] * self.across
        north = self.north[:, None] - np.sin(self.heading)[:, None] * self.across
        return east.ravel(), north.ravel()


def run(progress: Progress) -> Table:
    """Measure each method on soundings in the order of a survey, and in no order."""
    n = 10_000_000
    rows: list[Row] = []
    for done, order in enumerate(("survey order", "lines in no order"), start=1):
        rows += _one_order(order, n)
        progress("gridding", done, 2)
    return Table("gridding", tuple(rows), {"seed": 1, "soundings": n, "cells": _SIDE**2})


def _one_order(order: str, n: int) -> list[Row]:
    soundings = _survey(n) if order == "survey order" else _scattered(n)
    east, north = soundings.positions()
    height = soundings.height.ravel()
    index = north.astype(int) * _SIDE + east.astype(int)
    case = f"10 million soundings, 1 m cells, {order}"
    bare = _seconds(lambda: _bincount(index, height), 3)
    ours = _seconds(lambda: _ours(soundings), 3)
    sums, (total, number) = _ours(soundings), _bincount(index, height)
    apart = np.abs(sums[..., HEIGHT].ravel() * 0.04 - total).max() / np.abs(total).max()
    if apart > 1e-9 or (sums[..., COUNT].ravel() != number).any():
        raise AssertionError(f"gridding differs from bincount by {apart:.1e} of the largest sum")
    rows = [
        Row(case, "numpy bincount x 2, cells known", "time", bare, "s"),
        Row(case, "bin_lines, from poses to five sums", "time", ours, "s", "<= 2 x bincount"),
        Row(case, "bin_lines", "over bincount", ours / bare, "", "<= 2"),
    ]
    rows.append(_verde(case, east, north, height))
    rows.append(_gmt(case, east, north, height))
    return rows


def _survey(n: int) -> _Soundings:
    """Return seven parallel tracks over the square, there and back."""
    rng = np.random.default_rng(1)
    lines = n // _COLUMNS
    way = np.linspace(0.0, 7 * 860.0, lines, endpoint=False)
    track, along = np.divmod(way, 860.0)
    up = track % 2 == 0
    return _Soundings(
        east=80.0 + 120.0 * track + rng.normal(0, 0.1, lines),
        north=np.where(up, 70.0 + along, 930.0 - along),
        heading=np.where(up, 0.0, np.pi) + rng.normal(0, 0.01, lines),
        across=np.linspace(-_HALF_SWATH_M, _HALF_SWATH_M, _COLUMNS),
        height=rng.normal(-30.0, 1.0, (lines, _COLUMNS)),
        sigma=np.full((lines, _COLUMNS), 0.2),
    )


def _scattered(n: int) -> _Soundings:
    """Return lines of any heading anywhere: every line meets cold memory."""
    rng = np.random.default_rng(1)
    lines = n // _COLUMNS
    return _Soundings(
        east=rng.uniform(100.0, 900.0, lines),
        north=rng.uniform(100.0, 900.0, lines),
        heading=rng.uniform(0.0, 2 * np.pi, lines),
        across=np.linspace(-_HALF_SWATH_M, _HALF_SWATH_M, _COLUMNS),
        height=rng.normal(-30.0, 1.0, (lines, _COLUMNS)),
        sigma=np.full((lines, _COLUMNS), 0.2),
    )


def _seconds(work: Callable[[], Any], times: int) -> float:
    best = np.inf
    for _ in range(times):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return float(best)


def _ours(soundings: _Soundings) -> FloatArray:
    return bin_lines(
        soundings.height, soundings.sigma, soundings.east, soundings.north, soundings.heading,
        soundings.across, np.zeros(len(soundings.east)), Spacing(1, 1, 1.0), 1.0,
        Window(0, 0, _SIDE, _SIDE), (0, 0),
    )  # fmt: skip


def _bincount(index: Any, height: FloatArray) -> Any:
    cells = _SIDE**2
    return np.bincount(index, height, minlength=cells), np.bincount(index, minlength=cells)


def _verde(case: str, east: FloatArray, north: FloatArray, height: FloatArray) -> Row:
    try:
        import verde
    except ImportError:
        return Row(case, "verde BlockReduce(mean)", "time", None, "s", note="not installed")
    reducer = verde.BlockReduce("mean", spacing=1.0, region=(0, _SIDE, 0, _SIDE))
    seconds = _seconds(lambda: reducer.filter((east, north), height), 1)
    return Row(case, f"verde {verde.__version__} BlockReduce(mean)", "time", seconds, "s")


def _gmt(case: str, east: FloatArray, north: FloatArray, height: FloatArray) -> Row:
    program = shutil.which("gmt")
    if program is None:
        return Row(case, "GMT blockmean", "time", None, "s", note="not installed")
    version = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "soundings.bin"
        np.column_stack([east, north, height]).tofile(path)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            [program, "blockmean", str(path), "-bi3d", "-bo3d", f"-R0/{_SIDE}/0/{_SIDE}", "-I1", "-r"],
            stdout=subprocess.DEVNULL, check=True, cwd=folder,
        )  # fmt: skip
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    name = f"GMT {version.stdout.strip()} blockmean, binary in and out"
    return Row(case, name, "time", seconds, "s")
