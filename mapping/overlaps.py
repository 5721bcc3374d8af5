"""Which strips saw the same ground, and where: by geometry, without comparing all pairs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.records import ElevationStrip, FloatArray, IntArray

# A strip counts as covering a lattice square that it fills to this part.
_LEAST_COVER = 0.35


@dataclass(frozen=True, slots=True)
class Window:
    """A square of ground that two strips cover.

    `first`, `second` are strips; `easting_m`, `northing_m` the centre, `side_m` the width.
    `first_line`, `second_line` the mean line of each that saw it; `cover` the smaller cover (0 to 1).
    """

    first: int
    second: int
    easting_m: float
    northing_m: float
    side_m: float
    first_line: float
    second_line: float
    cover: float


@dataclass(frozen=True, slots=True)
class Footprint:
    """The lattice squares that one strip covers: (n,) column, row, cover and mean line."""

    column: IntArray
    row: IntArray
    cover: FloatArray
    line: FloatArray


def footprint(strip: ElevationStrip, side_m: float) -> Footprint:
    """Return which squares of the lattice of width `side_m` the strip covers, and from which lines."""
    nothing = np.zeros(0)
    empty = Footprint(nothing.astype(int), nothing.astype(int), nothing, nothing)
    lines = np.arange(len(strip.time_s))
    if len(lines) < 2:
        return empty
    # Eight samples a square suffice to tell its cover.
    step = np.median(np.hypot(np.diff(strip.easting_m), np.diff(strip.northing_m)) + 1e-9)
    every_line = max(1, int(side_m / 8 / max(float(step), 1e-3)))
    spacing = float(np.median(np.diff(strip.across_m))) if len(strip.across_m) > 1 else side_m
    every_column = max(1, int(side_m / 8 / max(spacing, 1e-3)))
    lines = lines[::every_line]
    easting_m, northing_m = strip.positions()
    chosen = np.s_[::every_line, ::every_column]
    seen = np.isfinite(strip.echo[chosen]) | np.isfinite(strip.elevation_m[chosen])
    east, north = easting_m[chosen][seen], northing_m[chosen][seen]
    which = np.broadcast_to(lines[:, None], seen.shape)[seen]
    if not len(east):
        return empty
    column = np.floor(east / side_m).astype(np.int64)
    row = np.floor(north / side_m).astype(np.int64)
    squares, inverse = np.unique(np.column_stack([column, row]), axis=0, return_inverse=True)
    count = np.bincount(inverse, minlength=len(squares)).astype(float)
    mean_line = np.bincount(inverse, weights=which, minlength=len(squares)) / count
    sample_area = max(float(step), 1e-3) * every_line * spacing * every_column
    cover = np.minimum(count * sample_area / side_m**2, 1.0)
    return Footprint(squares[:, 0], squares[:, 1], cover, mean_line)


def find_overlaps(
    strips: Sequence[ElevationStrip], side_m: float, most_per_square: int = 12
) -> list[Window]:
    """Return the squares of ground seen by two strips, one `Window` per pair and square.

    Parameters
    ----------
    side_m : width of the squares.
    most_per_square : where many strips cross, only so many pairs are kept, the best covered first.
    """
    seen: dict[tuple[int, int], list[tuple[float, int, float]]] = defaultdict(list)
    for index, strip in enumerate(strips):
        f = footprint(strip, side_m)
        for column, row, cover, line in zip(f.column, f.row, f.cover, f.line, strict=True):
            if cover >= _LEAST_COVER:
                seen[int(column), int(row)].append((float(cover), index, float(line)))
    windows = []
    for (column, row), strips_here in sorted(seen.items()):
        pairs = [
            (min(a[0], b[0]), a, b) for i, a in enumerate(strips_here) for b in strips_here[i + 1 :]
        ]
        for cover, a, b in sorted(pairs, key=lambda pair: -pair[0])[:most_per_square]:
            windows.append(
                Window(
                    first=a[1],
                    second=b[1],
                    easting_m=(column + 0.5) * side_m,
                    northing_m=(row + 0.5) * side_m,
                    side_m=side_m,
                    first_line=a[2],
                    second_line=b[2],
                    cover=cover,
                )
            )
    return windows
