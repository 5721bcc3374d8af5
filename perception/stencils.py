"""Stencils of the joint inversion: small loops over nodes, dual cells and data rows.

Arrays: `z` and `a` are (rows, cols) nodes; features and moments are (k, rows - 1, cols - 1) or flat
(k, duals); data rows are (n,) with the index of their dual cell.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit


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
def rows_and_gain(cell, weight, c_east, c_north, c_level, knot, share, features, gain, q, out):
    """Add what the data rows make of `gain` to the cells' `q` (4, duals), and of `features` to `out` (knots)."""
    for i in range(len(cell)):
        j = cell[i]
        w = weight[i]
        e, n, c = c_east[i], c_north[i], c_level[i]
        v = w * (e * features[0, j] + n * features[1, j] + c * features[2, j] + features[3, j])
        g = 0.0
        for k in range(knot.shape[1]):
            out[knot[i, k]] += v * share[i, k]
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


@njit(cache=True, nogil=True)
def local_of_moments(first, last, moments, cell, out):
    """Add rows of the cells' matrices on their corners (36, r, c) from those on features (10, r, c)."""
    feature = np.zeros((4, 8))
    for k in range(4):
        feature[0, k] = (1.0 if k % 2 else -1.0) / (2 * cell)
        feature[1, k] = (1.0 if k // 2 else -1.0) / (2 * cell)
        feature[2, k] = 0.25
        feature[3, 4 + k] = 0.25
    full = np.empty((4, 4))
    for i in range(first, last):
        for j in range(moments.shape[2]):
            if moments[9, i, j] == 0.0:
                continue
            k = 0
            for p in range(4):
                for q in range(p, 4):
                    full[p, q] = full[q, p] = moments[k, i, j]
                    k += 1
            add_congruent(feature, full, out, i, j)


@njit(cache=True, nogil=True)
def add_congruent(change, full, out, i, j):
    """Add the upper triangle of ``change' full change`` to `out` (36, r, c) at (i, j)."""
    m = full.shape[0]
    half = np.zeros((m, 8))
    for p in range(m):
        for s in range(m):
            v = full[p, s]
            for q in range(8):
                half[p, q] += v * change[s, q]
    k = 0
    for p in range(8):
        for q in range(p, 8):
            total = 0.0
            for s in range(m):
                total += change[s, p] * half[s, q]
            out[k, i, j] += total
            k += 1


@njit(cache=True, nogil=True)
def coarsen_local(first, last, fine, out):
    """Add rows of the matrices of cells twice as wide (36, r / 2, c / 2): exact for bilinear fields."""
    # Corner values of each child by those of its parent.
    line = np.array([[[1.0, 0.0], [0.5, 0.5]], [[0.5, 0.5], [0.0, 1.0]]])
    child = np.zeros((4, 8, 8))
    for di in range(2):
        for dj in range(2):
            for p in range(4):
                for q in range(4):
                    v = line[di, p // 2, q // 2] * line[dj, p % 2, q % 2]
                    child[2 * di + dj, p, q] = v
                    child[2 * di + dj, 4 + p, 4 + q] = v
    full = np.empty((8, 8))
    for i in range(2 * first, 2 * last):
        for j in range(2 * out.shape[2]):
            if fine[35, i, j] == 0.0:
                continue
            k = 0
            for p in range(8):
                for q in range(p, 8):
                    full[p, q] = full[q, p] = fine[k, i, j]
                    k += 1
            add_congruent(child[2 * (i % 2) + j % 2], full, out, i // 2, j // 2)
