"""Gridding: the samples of a strip summed into the cells of any window of the map's lattice.

The lattice has its edges at multiples of the cell, everywhere; a window is part of it. What falls into a cell
is the same whichever window holds the cell, to the last bit: so a map made tile by tile equals the map
made in one piece.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from perception.records import FloatArray, IntArray

# At this part of a cell a slanting lattice of samples leaves no cell empty.
_FILL_STEP = 0.6
# Lines farther apart than this many usual steps have a gap between them, which is not bridged.
_GAP_STEPS = 4.0
# What a cell sums: weight 1/sigma^2, weight x height, points, weight x position variance, true data.
WEIGHT, HEIGHT, POINTS, POSITION, COUNT = range(5)


@dataclass(frozen=True, slots=True)
class Window:
    """Cells of the lattice: first row (counted north) and column (east), and how many of each."""

    row: int
    col: int
    rows: int
    cols: int

    def grown(self, cells: int) -> Window:
        """Return the window with a rim of so many cells."""
        return Window(
            self.row - cells, self.col - cells, self.rows + 2 * cells, self.cols + 2 * cells
        )

    def common(self, other: Window) -> Window | None:
        """Return the cells that both have; None where there are none."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        rows = min(self.row + self.rows, other.row + other.rows) - row
        cols = min(self.col + self.cols, other.col + other.cols) - col
        return Window(row, col, rows, cols) if rows > 0 and cols > 0 else None

    def within(self, outer: Window) -> tuple[slice, slice]:
        """Return where this window lies in an array that holds `outer`."""
        row, col = self.row - outer.row, self.col - outer.col
        return slice(row, row + self.rows), slice(col, col + self.cols)


@dataclass(frozen=True, slots=True)
class Spacing:
    """How densely a strip's samples are filled in: points between neighbours, and the gap not bridged."""

    along_parts: int
    across_parts: int
    gap_m: float


def spacing_of(
    easting_m: FloatArray, northing_m: FloatArray, across_m: FloatArray, cell_m: float
) -> Spacing:
    """Return the filling-in that leaves no cell inside a strip empty, from the *whole* strip's poses."""
    step = np.hypot(np.diff(easting_m), np.diff(northing_m))
    usual = float(np.median(step)) if len(step) else cell_m
    across = float(np.median(np.diff(across_m))) if len(across_m) > 1 else cell_m
    return Spacing(
        along_parts=max(1, int(np.ceil(usual / (_FILL_STEP * cell_m)))),
        across_parts=max(1, int(np.ceil(across / (_FILL_STEP * cell_m)))),
        gap_m=max(_GAP_STEPS * usual, 1e-6),
    )


def bin_lines(
    height_m: FloatArray,
    sigma_m: FloatArray,
    easting_m: FloatArray,
    northing_m: FloatArray,
    heading_rad: FloatArray,
    across_m: FloatArray,
    position_m2: FloatArray,
    spacing: Spacing,
    cell_m: float,
    window: Window,
    anchor: tuple[int, int],
    sums: FloatArray | None = None,
) -> FloatArray:
    """Sum consecutive lines of a strip into the cells of a window.

    Between neighbouring samples points are interpolated bilinearly so that no cell inside the strip stays
    empty; the count holds the samples alone.

    Parameters
    ----------
    height_m, sigma_m : (n, m); NaN height or a sigma that is not positive is no data.
    easting_m, northing_m, heading_rad, position_m2 : (n,) poses, and the variance of their position.
    across_m : (m,) ascending, starboard positive.
    anchor : (row, col) of a lattice cell near the *whole* strip, from which positions are counted: the
        same for every window, so that rounding is.
    sums : to add to; None starts from zero.

    Returns
    -------
    (rows, cols, 5) sums by `WEIGHT`, `HEIGHT`, `POINTS`, `POSITION`, `COUNT`; rows south to north.
    """
    if sums is None:
        sums = np.zeros((window.rows, window.cols, 5))
    _bin(
        height_m, sigma_m,
        (easting_m - anchor[1] * cell_m) / cell_m, (northing_m - anchor[0] * cell_m) / cell_m,
        np.asarray(heading_rad, float), across_m / cell_m, position_m2, spacing.along_parts,
        spacing.across_parts, spacing.gap_m / cell_m, window.row - anchor[0], window.col - anchor[1], sums,
    )  # fmt: skip
    return sums


@numba.njit(cache=True, nogil=True)
def _bin(
    height: FloatArray, sigma: FloatArray, east: FloatArray, north: FloatArray, heading: FloatArray,
    across: FloatArray, position_m2: FloatArray, along_parts: int, across_parts: int, gap: float,
    first_row: int, first_col: int, sums: FloatArray,
) -> None:  # fmt: skip
    """Add lines to the sums; positions in cells from the anchor."""
    n, m = height.shape
    rows, cols, _ = sums.shape
    line_z, line_var = np.empty(m), np.empty(m)
    z, var, cell = np.empty(m), np.empty(m), np.empty(m, np.int32)
    for i in range(n):
        i1 = min(i + 1, n - 1)
        parts = along_parts
        if i1 == i or np.hypot(east[i1] - east[i], north[i1] - north[i]) > gap:
            parts = 1
        turn = 0.0
        if parts > 1:
            turn = np.arctan2(np.sin(heading[i1] - heading[i]), np.cos(heading[i1] - heading[i]))
        for a in range(parts):
            f = a / parts
            c, s = np.cos(heading[i] + f * turn), np.sin(heading[i] + f * turn)
            e0 = east[i] + f * (east[i1] - east[i])
            n0 = north[i] + f * (north[i1] - north[i])
            first, last = _inside(e0 - first_col, c, cols, across)
            low, high = _inside(n0 - first_row, -s, rows, across)
            first, last = max(first, low), min(last, high)
            if first > last:
                continue
            # One column more, to interpolate towards.
            part = slice(first, min(last + 2, m))
            _between_lines(height[i, part], sigma[i, part], height[i1, part], sigma[i1, part], f,
                           line_z[part], line_var[part])  # fmt: skip
            for b in range(across_parts):
                g = b / across_parts
                size = last - first + 1 if b == 0 else min(last, m - 2) - first + 1
                _between_columns(line_z[part], line_var[part], g, size, z, var)
                _cells(z, var, across[part], g, size, e0, n0, c, s, first_row, first_col, rows, cols,
                       cell)  # fmt: skip
                _scatter(z, var, cell, size, position_m2[i], a + b == 0, sums)


# The loops of the next three carry no branches and count from 0, so that the compiler vectorises them.


@numba.njit(cache=True, nogil=True)
def _between_lines(
    height: FloatArray, sigma: FloatArray, next_height: FloatArray, next_sigma: FloatArray, f: float,
    z: FloatArray, var: FloatArray,
) -> None:  # fmt: skip
    """Interpolate height and variance between two lines; at f = 0 the second does not count, even missing."""
    if f == 0.0:
        for j in range(len(z)):
            z[j] = height[j]
            var[j] = np.float64(sigma[j]) * np.float64(sigma[j])
        return
    for j in range(len(z)):
        z[j] = (1 - f) * np.float64(height[j]) + f * np.float64(next_height[j])
        one = np.float64(sigma[j]) * np.float64(sigma[j])
        two = np.float64(next_sigma[j]) * np.float64(next_sigma[j])
        # A sigma of zero is no data: it must not become one by its neighbour's.
        var[j] = (1 - f) * one + f * two if (one > 0) & (two > 0) else 0.0


@numba.njit(cache=True, nogil=True)
def _between_columns(
    line_z: FloatArray, line_var: FloatArray, g: float, size: int, z: FloatArray, var: FloatArray
) -> None:
    """Interpolate between neighbouring columns, likewise."""
    if g == 0.0:
        for j in range(size):
            z[j] = line_z[j]
            var[j] = line_var[j]
        return
    for j in range(size):
        z[j] = (1 - g) * line_z[j] + g * line_z[j + 1]
        one, two = line_var[j], line_var[j + 1]
        var[j] = (1 - g) * one + g * two if (one > 0) & (two > 0) else 0.0


@numba.njit(cache=True, nogil=True)
def _cells(
    z: FloatArray, var: FloatArray, across: FloatArray, g: float, size: int, e0: float, n0: float,
    c: float, s: float, first_row: int, first_col: int, rows: int, cols: int, cell: IntArray,
) -> None:  # fmt: skip
    """Find each point's cell in the window; -1 where it is outside or there is no data."""
    ahead = 1 if g > 0.0 else 0
    for j in range(size):
        x = across[j] + g * (across[j + ahead] - across[j])
        row = np.int32(np.floor(n0 - s * x)) - np.int32(first_row)
        col = np.int32(np.floor(e0 + c * x)) - np.int32(first_col)
        good = (row >= 0) & (row < rows) & (col >= 0) & (col < cols) & (var[j] > 0) & (z[j] == z[j])
        cell[j] = np.int32(row * np.int32(cols) + col) if good else np.int32(-1)


@numba.njit(cache=True, nogil=True)
def _scatter(
    z: FloatArray, var: FloatArray, cell: IntArray, size: int, position_m2: float, true_data: bool,
    sums: FloatArray,
) -> None:  # fmt: skip
    """Add a row of points to their cells' sums; neighbours in one cell are added up before."""
    flat = sums.reshape(-1)
    datum = 1.0 if true_data else 0.0
    held = np.int32(-1)
    weight, height, number = 0.0, 0.0, 0.0
    # One turn more than there are points: the last cell's sums are still held.
    for j in range(size + 1):
        now = cell[j] if j < size else np.int32(-1)
        if now != held:
            if held >= 0:
                # Unsigned: numba would look for negative indices otherwise.
                k = np.uint64(5) * np.uint64(held)
                flat[k] += weight
                flat[k + np.uint64(1)] += height
                flat[k + np.uint64(2)] += number
                flat[k + np.uint64(3)] += weight * position_m2
                flat[k + np.uint64(4)] += number * datum
            held, weight, height, number = now, 0.0, 0.0, 0.0
        if now >= 0:
            w = 1.0 / var[j]
            weight += w
            height += w * z[j]
            number += 1.0


@numba.njit(cache=True, nogil=True)
def _inside(start: float, slope: float, size: int, across: FloatArray) -> tuple[int, int]:
    """Return the columns whose points, or those up to the next column, may have 0 <= start + slope x < size.

    A hundredth of a cell of margin: the points themselves are judged one by one.
    """
    m = len(across)
    if abs(slope) < 1e-12:
        if start < -0.01 or start > size + 0.01:
            return 0, -1
        return 0, m - 1
    one, two = (-0.01 - start) / slope, (size + 0.01 - start) / slope
    low, high = min(one, two), max(one, two)
    first = max(int(np.searchsorted(across, low)) - 1, 0)
    last = min(int(np.searchsorted(across, high, side="right")), m) - 1
    return first, last
