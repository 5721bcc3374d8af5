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


@njit(cache=True, fastmath=True)
def apply_data(moments, z, a, cell, out_z, out_a):
    """Add the data's normal matrix applied to (z, a)."""
    rows, cols = z.shape
    for i in range(rows - 1):
        for j in range(cols - 1):
            if moments[i, j, 9] == 0.0:
                continue
            sw, se, nw, ne = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
            f0 = (se + ne - sw - nw) / (2 * cell)
            f1 = (nw + ne - sw - se) / (2 * cell)
            f2 = 0.25 * (sw + se + nw + ne)
            f3 = 0.25 * (a[i, j] + a[i, j + 1] + a[i + 1, j] + a[i + 1, j + 1])
            m = moments[i, j]
            e = (m[0] * f0 + m[1] * f1 + m[2] * f2 + m[3] * f3) / (2 * cell)
            n = (m[1] * f0 + m[4] * f1 + m[5] * f2 + m[6] * f3) / (2 * cell)
            c = 0.25 * (m[2] * f0 + m[5] * f1 + m[7] * f2 + m[8] * f3)
            b = 0.25 * (m[3] * f0 + m[6] * f1 + m[8] * f2 + m[9] * f3)
            _to_corners(i, j, e, n, c, b, out_z, out_a)


@njit(cache=True, fastmath=True)
def apply_prior(z, k0, k1, k2, out):
    """Add (k0 + k1 D'D + k2 L'L) z: D first differences, L the five-point Laplacian."""
    rows, cols = z.shape
    for i in range(rows):
        for j in range(cols):
            out[i, j] += k0 * z[i, j]
            if j + 1 < cols:
                e = k1 * (z[i, j + 1] - z[i, j])
                out[i, j + 1] += e
                out[i, j] -= e
            if i + 1 < rows:
                e = k1 * (z[i + 1, j] - z[i, j])
                out[i + 1, j] += e
                out[i, j] -= e
    # Second differences along each axis and the twist: together the thin plate, free at its edges.
    for i in range(rows):
        for j in range(cols):
            if 0 < j < cols - 1:
                e = k2 * (z[i, j + 1] - 2 * z[i, j] + z[i, j - 1])
                out[i, j + 1] += e
                out[i, j] -= 2 * e
                out[i, j - 1] += e
            if 0 < i < rows - 1:
                e = k2 * (z[i + 1, j] - 2 * z[i, j] + z[i - 1, j])
                out[i + 1, j] += e
                out[i, j] -= 2 * e
                out[i - 1, j] += e
            if j + 1 < cols and i + 1 < rows:
                e = 2 * k2 * (z[i + 1, j + 1] - z[i + 1, j] - z[i, j + 1] + z[i, j])
                out[i + 1, j + 1] += e
                out[i + 1, j] -= e
                out[i, j + 1] -= e
                out[i, j] += e


@njit(cache=True, fastmath=True)
def rows_to_gain(cell, weight, c_east, c_north, c_level, knot, share, features, out):
    """Add to `out` (knots) what the data rows say of the fields' `features` (4, duals)."""
    for i in range(len(cell)):
        q = cell[i]
        v = weight[i] * (c_east[i] * features[0, q] + c_north[i] * features[1, q]
                         + c_level[i] * features[2, q] + features[3, q])  # fmt: skip
        for k in range(knot.shape[1]):
            out[knot[i, k]] += v * share[i, k]


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
    """Add the rows to the cells' 4x4 matrices (duals, 10)."""
    for i in range(len(cell)):
        q = cell[i]
        w = weight[i]
        e, n, c = c_east[i], c_north[i], c_level[i]
        out[q, 0] += w * e * e
        out[q, 1] += w * e * n
        out[q, 2] += w * e * c
        out[q, 3] += w * e
        out[q, 4] += w * n * n
        out[q, 5] += w * n * c
        out[q, 6] += w * n
        out[q, 7] += w * c * c
        out[q, 8] += w * c
        out[q, 9] += w


@njit(cache=True, fastmath=True)
def gain_normal(knot, share, weight, out):
    """Add the rows' normal matrix in the gains alone to `out` (knots, knots)."""
    for i in range(knot.shape[0]):
        for k in range(knot.shape[1]):
            for q in range(knot.shape[1]):
                out[knot[i, k], knot[i, q]] += weight[i] * share[i, k] * share[i, q]


@njit(cache=True)
def couple_gain(cell, weight, c_east, c_north, c_level, knot, share, cols, cell_m, depth, out):
    """Add to `out` (2, rows, cols, knots) what ties nodes of a grid 2^depth wider to the gains."""
    step = 1 << depth
    for i in range(len(cell)):
        r = cell[i] // cols
        c = cell[i] % cols
        y = ((r % step) + 0.5) / step
        x = ((c % step) + 0.5) / step
        for k in range(4):
            up = k // 2
            right = k % 2
            fy = y if up else 1 - y
            fx = x if right else 1 - x
            z = (c_east[i] * (fy if right else -fy) + c_north[i] * (fx if up else -fx)) / (
                step * cell_m
            ) + c_level[i] * fx * fy
            for m in range(knot.shape[1]):
                v = weight[i] * share[i, m]
                out[0, r // step + up, c // step + right, knot[i, m]] += v * z
                out[1, r // step + up, c // step + right, knot[i, m]] += v * fx * fy


@njit(cache=True, fastmath=True)
def apply_local(local, z, a, out_z, out_a):
    """Add the cells' own matrices on their corners' (z, a), packed (36, r, c), applied to the fields."""
    rows, cols = z.shape
    u = np.empty(8)
    v = np.empty(8)
    for i in range(rows - 1):
        for j in range(cols - 1):
            u[0], u[1], u[2], u[3] = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
            u[4], u[5], u[6], u[7] = a[i, j], a[i, j + 1], a[i + 1, j], a[i + 1, j + 1]
            v[:] = 0.0
            k = 0
            for p in range(8):
                v[p] += local[i, j, k] * u[p]
                k += 1
                for q in range(p + 1, 8):
                    m = local[i, j, k]
                    v[p] += m * u[q]
                    v[q] += m * u[p]
                    k += 1
            out_z[i, j] += v[0]
            out_z[i, j + 1] += v[1]
            out_z[i + 1, j] += v[2]
            out_z[i + 1, j + 1] += v[3]
            out_a[i, j] += v[4]
            out_a[i, j + 1] += v[5]
            out_a[i + 1, j] += v[6]
            out_a[i + 1, j + 1] += v[7]


@njit(cache=True)
def local_of_moments(moments, cell):
    """Return the cells' matrices on their corners (r, c, 36) from those on features (r, c, 10)."""
    rows, cols = moments.shape[0], moments.shape[1]
    feature = np.zeros((4, 8))
    for k in range(4):
        feature[0, k] = (1.0 if k % 2 else -1.0) / (2 * cell)
        feature[1, k] = (1.0 if k // 2 else -1.0) / (2 * cell)
        feature[2, k] = 0.25
        feature[3, 4 + k] = 0.25
    out = np.zeros((rows, cols, 36))
    full = np.empty((4, 4))
    for i in range(rows):
        for j in range(cols):
            if moments[i, j, 9] == 0.0:
                continue
            k = 0
            for p in range(4):
                for q in range(p, 4):
                    full[p, q] = full[q, p] = moments[i, j, k]
                    k += 1
            pack(feature.T @ full @ feature, out[i, j])
    return out


@njit(cache=True)
def pack(matrix, out):
    """Add the upper triangle of an 8 x 8 matrix to `out` (36,)."""
    k = 0
    for p in range(8):
        for q in range(p, 8):
            out[k] += matrix[p, q]
            k += 1


@njit(cache=True)
def coarsen_local(fine):
    """Return the matrices of cells twice as wide (r / 2, c / 2, 36): exact for bilinear fields."""
    rows, cols = fine.shape[0] // 2, fine.shape[1] // 2
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
    out = np.zeros((rows, cols, 36))
    full = np.empty((8, 8))
    for i in range(2 * rows):
        for j in range(2 * cols):
            k = 0
            for p in range(8):
                for q in range(p, 8):
                    full[p, q] = full[q, p] = fine[i, j, k]
                    k += 1
            c = child[2 * (i % 2) + j % 2]
            pack(c.T @ full @ c, out[i // 2, j // 2])
    return out
