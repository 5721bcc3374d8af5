"""Stencils of the joint inversion: small loops over nodes, dual cells and data rows.

Arrays: `z` and `a` are (rows, cols) nodes; features and moments are (k, rows - 1, cols - 1) or flat
(k, duals); data rows are (n,) with the index of their dual cell.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit

from perception.records import FloatArray


@njit(cache=True, fastmath=True)
def dual_features(z, a, cell, out):
    """Write (gradient east, gradient north, mean z, mean a) of every dual cell to `out` (4, r, c)."""
    rows, cols = z.shape
    for i in range(rows - 1):
        for j in range(cols - 1):
            sw, se, nw, ne = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
            out[0, i, j] = (se + ne - sw - nw) / (2 * cell)
            out[1, i, j] = (nw + ne - sw - se) / (2 * cell)
            out[2, i, j] = 0.25 * (sw + se + nw + ne)
            out[3, i, j] = 0.25 * (a[i, j] + a[i, j + 1] + a[i + 1, j] + a[i + 1, j + 1])


@njit(cache=True, fastmath=True)
def _to_corners(i, j, e, n, level, b, out_z, out_a):
    """Give a dual cell's gradient (e, n), level and albedo part to its four nodes."""
    out_z[i, j] += level - e - n
    out_z[i, j + 1] += level + e - n
    out_z[i + 1, j] += level - e + n
    out_z[i + 1, j + 1] += level + e + n
    out_a[i, j] += b
    out_a[i, j + 1] += b
    out_a[i + 1, j] += b
    out_a[i + 1, j + 1] += b


@njit(cache=True, fastmath=True)
def spread_features(q, cell, out_z, out_a):
    """Add the transpose of `dual_features` applied to `q` (4, r, c)."""
    rows, cols = out_z.shape
    for i in range(rows - 1):
        for j in range(cols - 1):
            e = q[0, i, j] / (2 * cell)
            n = q[1, i, j] / (2 * cell)
            m = 0.25 * q[2, i, j]
            b = 0.25 * q[3, i, j]
            _to_corners(i, j, e, n, m, b, out_z, out_a)


@njit(cache=True, fastmath=True, nogil=True)
def rows_and_gain(
    first, last, order, edge, cell, weight, c_east, c_north, c_level, knot, share, features, gain, q, out
):  # fmt: skip
    """Add what the data rows make of `gain` to the cells' `q` (4, duals), and of `features` to `out` (blocks, knots).

    Blocks [first, last) of rows: ``order[edge[b] : edge[b + 1]]``. No two blocks share a cell.
    """
    for b in range(first, last):
        for i in order[edge[b] : edge[b + 1]]:
            j = cell[i]
            w = weight[i]
            e, n, c = c_east[i], c_north[i], c_level[i]
            v = w * (e * features[0, j] + n * features[1, j] + c * features[2, j] + features[3, j])
            g = 0.0
            for k in range(knot.shape[1]):
                out[b, knot[i, k]] += v * share[i, k]
                g += gain[knot[i, k]] * share[i, k]
            g *= w
            q[0, j] += g * e
            q[1, j] += g * n
            q[2, j] += g * c
            q[3, j] += g


@njit(cache=True, fastmath=True)
def gain_to_features(cell, value, c_east, c_north, c_level, out):
    """Add weighted row values to the features (4, duals) of their cells."""
    for i in range(len(cell)):
        q = cell[i]
        v = value[i]
        out[0, q] += v * c_east[i]
        out[1, q] += v * c_north[i]
        out[2, q] += v * c_level[i]
        out[3, q] += v


@njit(cache=True, fastmath=True)
def accumulate_moments(cell, weight, c_east, c_north, c_level, out):
    """Add the rows to the cells' 4x4 matrices (10, duals)."""
    for i in range(len(cell)):
        q = cell[i]
        w = weight[i]
        e, n, c = c_east[i], c_north[i], c_level[i]
        out[0, q] += w * e * e
        out[1, q] += w * e * n
        out[2, q] += w * e * c
        out[3, q] += w * e
        out[4, q] += w * n * n
        out[5, q] += w * n * c
        out[6, q] += w * n
        out[7, q] += w * c * c
        out[8, q] += w * c
        out[9, q] += w


@njit(cache=True, fastmath=True)
def gain_normal(knot, share, weight, out):
    """Add the rows' normal matrix in the gains alone to `out` (knots, knots)."""
    for i in range(knot.shape[0]):
        for k in range(knot.shape[1]):
            for q in range(knot.shape[1]):
                out[knot[i, k], knot[i, q]] += weight[i] * share[i, k] * share[i, q]


def feature_map(cell: float) -> FloatArray:
    """Return the features (4) of a cell by its corners' z and a (8)."""
    out = np.zeros((4, 8))
    for k in range(4):
        out[0, k] = (1 if k % 2 else -1) / (2 * cell)
        out[1, k] = (1 if k // 2 else -1) / (2 * cell)
    out[2, :4] = out[3, 4:] = 0.25
    return out


def child_map(child: int) -> FloatArray:
    """Return the corners' z and a (8) of one of four children by its parent's: bilinear."""
    line = np.array([[[1.0, 0.0], [0.5, 0.5]], [[0.5, 0.5], [0.0, 1.0]]])
    return np.kron(np.eye(2), np.kron(line[child // 2], line[child % 2]))


def packed_map(change: FloatArray) -> FloatArray:
    """Return the matrix that takes packed symmetric F to packed ``change' F change``."""
    size = change.shape[0]
    first, second = np.triu_indices(size)
    top, side = np.triu_indices(change.shape[1])
    out = np.empty((len(top), len(first)))
    for k, (p, q) in enumerate(zip(first, second, strict=True)):
        unit = np.zeros((size, size))
        unit[p, q] = unit[q, p] = 1.0
        out[:, k] = (change.T @ unit @ change)[top, side]
    return out
