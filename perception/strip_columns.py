"""One pass's floor, objects, echo and shadow laid on the columns of its strip."""

from __future__ import annotations

import numpy as np

from perception.gain import Equalised
from perception.levels import SHADOW, Levels
from perception.object_table import ObjectRow
from perception.records import BoolArray, FloatArray, IntArray


def columns_across(
    sides: list[tuple[Equalised, Levels]],
    sample_m: float,
    altitude_m: FloatArray,
    cell_m: float | None,
) -> FloatArray:
    """Return the columns' across-track places, symmetric about the track where both sides are there."""
    reach = []
    for equalised, _ in sides:
        heard = np.flatnonzero(np.isfinite(equalised.ratio).any(axis=0))
        slant = (heard[-1] + 1) * sample_m if len(heard) else 0.0
        least = float(np.min(altitude_m))
        reach.append(float(np.sqrt(max(slant**2 - least**2, 0.0))))
    cell = cell_m or max(2 * sample_m, max(reach) / 500)
    left, right = (int(np.floor(r / cell)) for r in reach)
    return (np.arange(-left, right) + 0.5) * cell


# Lines worked on at once: tens of megabytes for a thousand columns.
_LINES = 512


def stretches(lines: int) -> list[slice]:
    """Return the lines of a strip in stretches to be worked on one after the other."""
    return [slice(first, min(first + _LINES, lines)) for first in range(0, lines, _LINES)]


def lay_on_columns(
    sides: list[tuple[Equalised, Levels]],
    across: FloatArray,
    altitude_m: FloatArray,
    sample_m: float,
) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Return echo (n, m), shadow and seen masks on the strip's columns, over a flat floor."""
    n, m = len(altitude_m), len(across)
    echo = np.full((n, m), np.nan, np.float32)
    shadow, seen = np.zeros((n, m), bool), np.zeros((n, m), bool)
    cell = across[1] - across[0] if m > 1 else sample_m
    for (equalised, levels), columns in zip(sides, (across < 0, across > 0), strict=True):
        if not columns.any():
            continue
        x = np.abs(across[columns])
        for rows in stretches(n):
            echo[rows, columns], shadow[rows, columns], seen[rows, columns] = _lay_lines(
                equalised.ratio[rows], levels.label[rows], x, cell, altitude_m[rows], sample_m
            )
    return echo, shadow, seen


def _lay_lines(
    ratio: FloatArray,
    label: IntArray,
    x: FloatArray,
    cell: float,
    altitude_m: FloatArray,
    sample_m: float,
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Return one side's echo (n, k), shadow and seen on columns at ground range `x` (k,)."""
    n, width = ratio.shape
    # Mean echo over a column's samples, by running sums: speckle falls and no sample is dropped.
    known = np.isfinite(ratio)
    sums = np.concatenate(
        [np.zeros((n, 1)), np.cumsum(np.where(known, ratio, 0), axis=1, dtype=float)], axis=1
    )
    counts = np.concatenate(
        [np.zeros((n, 1), np.int32), np.cumsum(known, axis=1, dtype=np.int32)], axis=1
    )
    inner = np.hypot(np.maximum(x - cell / 2, 0), altitude_m[:, None]) / sample_m
    outer = np.hypot(x + cell / 2, altitude_m[:, None]) / sample_m
    low = np.clip(np.floor(inner), 0, width - 1).astype(np.int32)
    high = np.clip(np.maximum(np.ceil(outer), low + 1), 1, width).astype(np.int32)
    number = np.take_along_axis(counts, high, 1) - np.take_along_axis(counts, low, 1)
    total = np.take_along_axis(sums, high, 1) - np.take_along_axis(sums, low, 1)
    inside = (number > 0) & (outer <= width + 1)
    echo: FloatArray = np.where(inside, total / np.maximum(number, 1), np.nan)
    middle = np.clip((np.hypot(x, altitude_m[:, None]) / sample_m).astype(np.int32), 0, width - 1)
    shadow: BoolArray = inside & (np.take_along_axis(label, middle, 1) == SHADOW)
    # Ground before the first echo (on a slope, or beside nadir) is floor all the same; ground past the last
    # sample of its ping is not.
    last = np.where(known.any(axis=1), width - known[:, ::-1].argmax(axis=1), 0)
    seen: BoolArray = outer <= last[:, None] + 1
    return echo, shadow, seen


def add_object(
    elevation: FloatArray,
    sigma: FloatArray,
    row: ObjectRow,
    across: FloatArray,
    along_m: FloatArray,
) -> None:
    """Add one object's fitted shape to the lines' contours, in place."""
    beta = row.shape if np.isfinite(row.shape) else 1.0
    tenth = np.sqrt((2 * np.log(10.0)) ** (1 / beta))
    sx, sy = max(row.half_across_m / tenth, 1e-3), max(row.half_along_m / tenth, 1e-3)
    lines = np.flatnonzero(np.abs(along_m - row.along_m) < 2.5 * row.half_along_m)
    columns = np.flatnonzero(np.abs(across - row.across_m) < 2.5 * row.half_across_m)
    if len(lines) == 0 or len(columns) == 0:
        return
    box = np.ix_(lines, columns)
    q = ((along_m[lines] - row.along_m) / sy)[:, None] ** 2 + (
        (across[columns] - row.across_m) / sx
    ) ** 2
    profile = np.exp(-0.5 * np.minimum(q**beta, 60.0))
    sign = 1.0 if row.kind == "hill" else -1.0
    elevation[box] += sign * row.height_m * profile
    # Height's own sigma scales with the profile; on its flanks the place and shape count, a quarter of the height.
    flank = 0.5 * row.height_m * 2 * np.sqrt(profile * (1 - profile)) * 0.5
    sigma[box] = np.sqrt(sigma[box] ** 2 + (row.sigma_m * profile) ** 2 + flank**2)
