"""Strips in their place: corrected poses and height in memory, heights in memory or in a file.

Fusion needs of a strip its poses always and its rows of heights only where a window touches it. A survey of any
length is held as its poses; the rows are read when their turn comes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mapping.gridding import (
    COUNT,
    HEIGHT,
    POINTS,
    POSITION,
    WEIGHT,
    Window,
    bin_lines,
    spacing_of,
)
from perception.records import BoolArray, ElevationStrip, FloatArray, Trajectory

# Lines that share one bounding box: few enough to leave out most of a long strip, many enough to be quick.
_BLOCK_LINES = 64

# first line, last line + 1 -> (heights, sigma), each (lines, m); the rows as the strip's maker left them.
Rows = Callable[[int, int], tuple[FloatArray, FloatArray]]


def _unread(first: int, last: int) -> tuple[FloatArray, FloatArray]:
    raise ValueError("a placed strip was given no rows to read")


@dataclass(frozen=True, slots=True)
class PlacedStrip:
    """One strip at its corrected place.

    Attributes
    ----------
    across_m : (m,) columns, starboard positive.
    easting_m, northing_m, heading_rad : (n,) corrected poses.
    position_m2 : (n,) variance of the horizontal position per axis; 0 unknown.
    reach_m : (n, 2) least and greatest `across_m` with data; NaN none.
    height_m : to be added to the heights; `height_sigma_m` its 1-sigma, common to all cells.
    rows : gives heights and sigma of consecutive lines.
    """

    across_m: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    heading_rad: FloatArray
    position_m2: FloatArray
    reach_m: FloatArray
    height_m: float = 0.0
    height_sigma_m: float = 0.0
    rows: Rows = _unread

    def anchor(self, cell_m: float) -> tuple[int, int]:
        """Return (row, col) of the lattice cell from which this strip's positions are counted."""
        row, col = np.floor(self.northing_m[0] / cell_m), np.floor(self.easting_m[0] / cell_m)
        return int(row), int(col)


@dataclass(frozen=True, slots=True)
class PassRaster:
    """One strip on part of a window: cell (row, col) of it is the window's cell (row0 + row, col0 + col).

    `height_m`, `variance_m2`, `position_m2`, `count` (rows, cols); NaN and 0 no data. Rows run south to north.
    `ambiguous` (rows, cols): where most of the pass's echoes are of two surfaces at one range; None nowhere.
    `clear` (rows, cols): where most are of one surface that sound reached, neither that nor shadow; None everywhere.
    """

    row0: int
    col0: int
    height_m: FloatArray
    variance_m2: FloatArray
    position_m2: FloatArray
    count: FloatArray
    ambiguous: BoolArray | None = None
    clear: BoolArray | None = None

    @property
    def window(self) -> tuple[slice, slice]:
        rows, cols = self.height_m.shape
        return slice(self.row0, self.row0 + rows), slice(self.col0, self.col0 + cols)


def reach_of(strip: ElevationStrip, seen: np.ndarray | None = None) -> FloatArray:
    """Return (n, 2) the least and greatest `across_m` of each line that holds a height; NaN none."""
    if seen is None:
        seen = np.isfinite(strip.elevation_m) & (strip.sigma_m > 0)
    first = seen.argmax(axis=1)
    last = seen.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
    reach = strip.across_m[np.column_stack([first, last])].astype(float)
    reach[~seen.any(axis=1)] = np.nan
    return reach


def placed(
    strip: ElevationStrip, trajectory: Trajectory | None = None, height_sigma_m: float = 0.0
) -> PlacedStrip:
    """Return a strip in memory as it stands; `trajectory` tells its positions' sigma, matched by ping."""
    return PlacedStrip(
        rows=lambda first, last: (strip.elevation_m[first:last], strip.sigma_m[first:last]),
        across_m=np.asarray(strip.across_m, float),
        easting_m=np.asarray(strip.easting_m, float),
        northing_m=np.asarray(strip.northing_m, float),
        heading_rad=np.asarray(strip.heading_rad, float),
        position_m2=position_variance(strip.ping, trajectory),
        reach_m=reach_of(strip),
        height_sigma_m=height_sigma_m,
    )


def position_variance(ping: np.ndarray, trajectory: Trajectory | None) -> FloatArray:
    """Return (n,) mean variance of the horizontal position per axis at each line; 0 unknown."""
    if trajectory is None or trajectory.ping is None:
        return np.zeros(len(ping))
    order = np.argsort(trajectory.ping)
    variance = 0.5 * (trajectory.sigma_easting_m**2 + trajectory.sigma_northing_m**2)
    return np.interp(ping, trajectory.ping[order], np.nan_to_num(variance[order]))


def extent(strips: Sequence[PlacedStrip], cell_m: float) -> Window | None:
    """Return the window of all cells in which a strip has a height; None where none has."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for strip in strips:
        seen = np.isfinite(strip.reach_m[:, 0])
        if not seen.any():
            continue
        heading, reach = strip.heading_rad[seen, None], strip.reach_m[seen]
        north = strip.northing_m[seen, None] - np.sin(heading) * reach
        east = strip.easting_m[seen, None] + np.cos(heading) * reach
        low = np.minimum(low, [north.min(), east.min()])
        high = np.maximum(high, [north.max(), east.max()])
    if not np.isfinite(low).all():
        return None
    first = np.floor(low / cell_m).astype(int)
    rows, cols = (np.floor(high / cell_m).astype(int) - first + 1).tolist()
    return Window(int(first[0]), int(first[1]), rows, cols)


def boxes(strip: PlacedStrip, cell_m: float) -> list[tuple[int, int, Window]]:
    """Return (first line, last line + 1, cells they may touch) for each block of lines with data.

    A block reaches to the first line of the next, towards which its last line is filled in. Between two
    lines the heading turns evenly, so points leave the chord by `reach (1 - cos(turn / 2))` at most.
    """
    n = len(strip.easting_m)
    reach = strip.reach_m
    east = strip.easting_m[:, None] + np.cos(strip.heading_rad)[:, None] * reach
    north = strip.northing_m[:, None] - np.sin(strip.heading_rad)[:, None] * reach
    found = []
    for first in range(0, n, _BLOCK_LINES):
        last = min(first + _BLOCK_LINES, n)
        part = slice(first, min(last + 1, n))
        if not np.isfinite(reach[part]).any():
            continue
        turns = np.abs(np.angle(np.exp(1j * np.diff(strip.heading_rad[part]))))
        turn = float(turns.max()) if len(turns) else 0.0
        bulge = float(np.nanmax(np.abs(reach[part]))) * (1 - float(np.cos(turn / 2)))
        low = [np.nanmin(north[part]) - bulge, np.nanmin(east[part]) - bulge]
        high = [np.nanmax(north[part]) + bulge, np.nanmax(east[part]) + bulge]
        # A cell more on each side, for rounding.
        row, col = (int(np.floor(v / cell_m)) - 1 for v in low)
        rows, cols = (
            int(np.floor(v / cell_m)) + 2 - start for v, start in zip(high, (row, col), strict=True)
        )
        found.append((first, last, Window(row, col, rows, cols)))
    return found


def on_window(
    strip: PlacedStrip,
    blocks: Sequence[tuple[int, int, Window]],
    cell_m: float,
    window: Window,
) -> PassRaster | None:
    """Return what a strip says of the cells of a window; None where it says nothing.

    Parameters
    ----------
    blocks : the strip's `boxes`.
    """
    touching = [(first, last, box) for first, last, box in blocks if box.common(window)]
    if not touching:
        return None
    part = hull([box for _, _, box in touching]).common(window)
    if part is None:
        return None
    spacing = spacing_of(strip.easting_m, strip.northing_m, strip.across_m, cell_m)
    sums = np.zeros((part.rows, part.cols, 5))
    for first, last in _runs(touching, len(strip.easting_m)):
        height, sigma = strip.rows(first, last)
        lines = slice(first, last)
        bin_lines(
            height, sigma, strip.easting_m[lines], strip.northing_m[lines],
            strip.heading_rad[lines], strip.across_m, strip.position_m2[lines], spacing, cell_m, part,
            strip.anchor(cell_m), sums,
        )  # fmt: skip
    offset = (part.row - window.row, part.col - window.col)
    return _pass_raster(sums, offset, strip.height_m, strip.height_sigma_m)


def runs_on(
    blocks: Sequence[tuple[int, int, Window]], window: Window, n: int
) -> Iterator[tuple[int, int]]:
    """Yield the runs of a strip's `n` lines whose blocks touch a window, each with the first line past it."""
    touching = [block for block in blocks if block[2].common(window)]
    return _runs(touching, n) if touching else iter(())


def hull(windows: Sequence[Window]) -> Window:
    """Return the least window that holds all of them."""
    row, col = min(w.row for w in windows), min(w.col for w in windows)
    rows = max(w.row + w.rows for w in windows) - row
    return Window(row, col, rows, max(w.col + w.cols for w in windows) - col)


def _runs(touching: Sequence[tuple[int, int, Window]], n: int) -> Iterator[tuple[int, int]]:
    """Yield runs of consecutive lines, each with the first line past it: what is filled in ends there."""
    start, end = touching[0][:2]
    for first, last, _ in touching[1:]:
        if first != end:
            yield start, min(end + 1, n)
            start = first
        end = last
    yield start, min(end + 1, n)


def _pass_raster(
    sums: FloatArray, offset: tuple[int, int], height_m: float, height_sigma_m: float
) -> PassRaster | None:
    filled = sums[..., WEIGHT] > 0
    if not filled.any():
        return None
    weight = np.where(filled, sums[..., WEIGHT], 1.0)
    # Harmonic mean of the data's variance, not divided by their number: they err together.
    variance = sums[..., POINTS] / weight + height_sigma_m**2
    return PassRaster(
        row0=offset[0],
        col0=offset[1],
        height_m=np.where(filled, sums[..., HEIGHT] / weight + height_m, np.nan),
        variance_m2=np.where(filled, variance, np.nan),
        position_m2=np.where(filled, sums[..., POSITION] / weight, 0.0),
        count=sums[..., COUNT],
    )
