"""Quadratics fitted by least squares over boxes of cells, at a cost that does not depend on the box.

What the normal equations need are sums over the box of x^a y^b and of z x^a y^b, x and y from its centre. One step
along a row changes them by a binomial shift and by the cells that come and go,

    S0' = S0 - out + in,   S1' = S1 - S0 + ...,   S2' = S2 - 2 S1 + S0 + ...,

first along rows, then down columns. The recursion starts afresh every few hundred cells: rounding cannot grow.
Cells without a height leave their terms out of the sums, so holes and edges are fitted as they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from perception.curvature import Derivatives, NoiseGain
from perception.records import FloatArray

Array = npt.NDArray[np.float64]

# Cells from one fresh start of the recursion to the next, or the box itself where it is larger.
_FRESH = 256
# Powers of x that the cells' own sums need (mask: up to 4) and those of the heights (up to 2).
_MASK, _HEIGHT = 5, 3
# (power of x, power of y) of the six terms 1, x, y, x^2, x y, y^2.
_TERMS = np.array([[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]])


def box_derivatives(
    z: FloatArray, cell_m: float, cell_north_m: float, half: tuple[int, int]
) -> tuple[Derivatives, NoiseGain]:
    """Return derivatives of the quadratic fitted to each cell's box, and their noise gains.

    Parameters
    ----------
    z : (rows, cols) heights, rows north to south; NaN no data.
    half : the box reaches so many rows and columns from its centre (1, 1: nine cells).

    Returns
    -------
    Derivatives, NoiseGain
        (rows, cols) each; NaN where z is. Terms that the known cells of a box do not determine are zero.
    """
    known = np.isfinite(z)
    heights = np.where(known, z, 0.0) - (np.mean(z[known]) if known.any() else 0.0) * known
    planes = [_slide_rows(known.astype(np.float64), half[1], _MASK)]
    planes.append(_slide_rows(heights, half[1], _HEIGHT))
    out, gain = np.empty((5, *z.shape)), np.empty((6, *z.shape))
    _solve_columns(planes[0], planes[1], known, half[0], half[1], out, gain)
    # Rows run south and y north; x and y were in cells.
    unit = np.array([1 / cell_m, -1 / cell_north_m])
    scale = [unit[0], unit[1], unit[0] ** 2, unit[0] * unit[1], unit[1] ** 2]
    derivatives = Derivatives(*(plane * s for plane, s in zip(out, scale, strict=True)))
    squares = [s**2 for s in scale] + [scale[2] * scale[4]]
    return derivatives, NoiseGain(*(g * s for g, s in zip(gain, squares, strict=True)))


@njit(cache=True, parallel=True)
def _slide_rows(values: Array, half: int, powers: int) -> Array:
    """Return sums over j - half .. j + half of values x^a, a below `powers`, (powers, rows, cols)."""
    rows, cols = values.shape
    out = np.zeros((powers, rows, cols))
    fresh = max(_FRESH, 2 * half + 1)
    for i in prange(rows):
        s = np.zeros(powers)
        for j in range(cols):
            if j % fresh == 0:
                s[:] = 0.0
                for k in range(max(j - half, 0), min(j + half + 1, cols)):
                    _add(s, values[i, k], float(k - j))
            else:
                gone = values[i, j - 1 - half] if j - 1 - half >= 0 else 0.0
                come = values[i, j + half] if j + half < cols else 0.0
                _add(s, -gone, -float(half))
                _shift(s)
                _add(s, come, float(half))
            for a in range(powers):
                out[a, i, j] = s[a]
    return out


@njit(cache=True)
def _add(s: Array, value: float, x: float) -> None:
    term = value
    for a in range(len(s)):
        s[a] += term
        term *= x


@njit(cache=True)
def _shift(s: Array) -> None:
    """Turn sums of x^a into sums of (x - 1)^a: the centre moves on by one."""
    # T_a = sum of (-1)^(a-k) C(a, k) S_k is the a-th backward difference at a.
    for a in range(1, len(s)):
        for k in range(len(s) - 1, a - 1, -1):
            s[k] -= s[k - 1]


@njit(cache=True, parallel=True)
def _solve_columns(
    mask: Array, height: Array, known: Any, half: int, across: int, out: Array, gain: Array
) -> None:
    """Slide down the columns and solve each box; `mask` and `height` hold the sums along rows."""
    rows, cols = known.shape
    full = _inverse(*_full_sums(half, across))
    whole = (2 * half + 1) * (2 * across + 1)
    fresh = max(_FRESH, 2 * half + 1)
    for j in prange(cols):
        m, h = np.zeros((_MASK, _MASK)), np.zeros((_HEIGHT, _HEIGHT))
        for i in range(rows):
            if i % fresh == 0:
                m[:], h[:] = 0.0, 0.0
                for k in range(max(i - half, 0), min(i + half + 1, rows)):
                    _add_row(m, h, mask, height, k, j, 1.0, float(k - i))
            else:
                if i - 1 - half >= 0:
                    _add_row(m, h, mask, height, i - 1 - half, j, -1.0, -float(half))
                for a in range(_MASK):
                    _shift(m[a])
                for a in range(_HEIGHT):
                    _shift(h[a])
                if i + half < rows:
                    _add_row(m, h, mask, height, i + half, j, 1.0, float(half))
            if not known[i, j]:
                out[:, i, j] = np.nan
                gain[:, i, j] = np.nan
                continue
            # Counts are whole numbers, and sums of them are exact.
            inverse = full if m[0, 0] == whole else _inverse(m, half, across)
            _write(inverse, h, out[:, i, j], gain[:, i, j])


@njit(cache=True)
def _add_row(
    m: Array, h: Array, mask: Array, height: Array, i: int, j: int, sign: float, y: float
) -> None:
    for a in range(_MASK):
        _add(m[a], sign * mask[a, i, j], y)
    for a in range(_HEIGHT):
        _add(h[a], sign * height[a, i, j], y)


@njit(cache=True)
def _full_sums(half: int, across: int) -> tuple[Array, int, int]:
    m = np.zeros((_MASK, _MASK))
    for i in range(-half, half + 1):
        for j in range(-across, across + 1):
            term = 1.0
            for a in range(_MASK):
                _add(m[a], term, float(i))
                term *= j
    return m, half, across


@njit(cache=True)
def _inverse(m: Array, half: int, across: int) -> Array:
    """Return the (pseudo-)inverse of the normal matrix; undetermined terms get no part."""
    a, size = np.empty((6, 6)), np.empty(6)
    # In units of the box the matrix is well scaled whatever the box.
    for k in range(6):
        size[k] = float(max(across, 1)) ** _TERMS[k, 0] * float(max(half, 1)) ** _TERMS[k, 1]
    for k in range(6):
        for n in range(6):
            a[k, n] = m[_TERMS[k, 0] + _TERMS[n, 0], _TERMS[k, 1] + _TERMS[n, 1]]
            a[k, n] /= size[k] * size[n]
    inverse: Array = np.linalg.pinv(a, 1e-9)  # type: ignore[assignment]
    for k in range(6):
        for n in range(6):
            inverse[k, n] /= size[k] * size[n]
    return inverse


@njit(cache=True)
def _write(inverse: Array, h: Array, d: Array, gain: Array) -> None:
    """Write p, q, r, s, t in cells (y south) and their noise gains pp, qq, rr, ss, tt, rt."""
    factor = (1.0, 1.0, 2.0, 1.0, 2.0)
    for k in range(5):
        total = 0.0
        for n in range(6):
            total += inverse[k + 1, n] * h[_TERMS[n, 0], _TERMS[n, 1]]
        d[k] = factor[k] * total
        gain[k] = factor[k] ** 2 * inverse[k + 1, k + 1]
    gain[5] = 4 * inverse[3, 5]
