"""Operators of one grid of the joint problem, node row by node row.

Each kernel writes the rows [first, last) of a result and nothing else, in an order that does not depend on them: bands of
rows may be computed by several threads, to the bit as by one. They compute in the precision of the fields they are given.
Loops run over whole rows and read them through views that start at zero: only so does the compiler use its wide
registers, which makes them two to four times faster. Arrays: `z` and `a` (rows, cols) nodes; `moments`
(10, rows - 1, cols - 1) and `local` (36, rows - 1, cols - 1) packed upper triangles of the cells' matrices.

What a kernel calls is written into it (``inline``): a fast-math function that was called was optimised one way when
freshly compiled and another when linked from numba's cache, so that the first run on a machine and the second differed.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit

# Where the packed upper triangle of an 8 x 8 matrix holds row and column.
PLACE = np.zeros((8, 8), np.int64)
PLACE[np.triu_indices(8)] = np.arange(36)
PLACE = PLACE + np.triu(PLACE, 1).T


@njit(inline="always")
def end_weights(i, n):
    """Return row i of D'D and of B'B over n nodes: D first, B second differences, free at the ends."""
    before = 1.0 if i >= 1 else 0.0
    after = 1.0 if i + 1 < n else 0.0
    left = 1.0 if i >= 2 else 0.0
    here = 1.0 if 1 <= i <= n - 2 else 0.0
    right = 1.0 if i + 2 < n else 0.0
    return (
        (-before, before + after, -after),
        (left, -2 * (left + here), left + 4 * here + right, -2 * (here + right), right),
    )


@njit(inline="always")
def prior_row(z, i, k0, k1, k2, across, slope, out):
    """Write row i of (k0 + k1 D'D + k2 (B'B along each axis and twice the twist)) z: the thin plate, free at its edges.

    `across` and `slope` (cols,) are scratch.
    """
    rows, cols = z.shape
    d, b = end_weights(i, rows)
    one = z.dtype.type(1)
    r0, r1, r2 = z[max(i - 2, 0)], z[max(i - 1, 0)], z[i]
    r3, r4 = z[min(i + 1, rows - 1)], z[min(i + 2, rows - 1)]
    w0, w4 = one * (k2 * b[0]), one * (k2 * b[4])
    w1, w3 = one * (k1 * d[0] + k2 * b[1]), one * (k1 * d[2] + k2 * b[3])
    w2 = one * (k0 + k1 * d[1] + k2 * b[2])
    s1, s2, s3 = one * (2 * k2 * d[0]), one * (k1 + 2 * k2 * d[1]), one * (2 * k2 * d[2])
    for j in range(cols):
        across[j] = w0 * r0[j] + w1 * r1[j] + w2 * r2[j] + w3 * r3[j] + w4 * r4[j]
    for j in range(cols):
        slope[j] = s1 * r1[j] + s2 * r2[j] + s3 * r3[j]
    n = cols - 4
    k, two, four, six = one * k2, one + one, one * (4 * k2), one * (6 * k2)
    here, left, right, inner = across[2 : 2 + n], slope[1 : 1 + n], slope[3 : 3 + n], out[2 : 2 + n]
    west2, west, mid, east, east2 = (
        r2[:n],
        r2[1 : 1 + n],
        r2[2 : 2 + n],
        r2[3 : 3 + n],
        r2[4 : 4 + n],
    )
    middle = slope[2 : 2 + n]
    for j in range(n):
        inner[j] = (
            here[j] + two * middle[j] - left[j] - right[j]
            + six * mid[j] - four * (west[j] + east[j]) + k * (west2[j] + east2[j])
        )  # fmt: skip
    for end in range(4):
        j = end if end < 2 else cols - 4 + end
        e, f = end_weights(j, cols)
        out[j] = across[j] + e[1] * slope[j] + k2 * f[2] * r2[j]
        for q in range(-2, 3):
            if q != 0 and 0 <= j + q < cols:
                out[j] += k2 * f[q + 2] * r2[j + q]
                if abs(q) == 1:
                    out[j] += e[q + 1] * slope[j + q]


@njit(cache=True, fastmath=True, nogil=True)
def prior_rows(first, last, z, weights, out):
    """Write what the prior of `weights` (value, first and second difference) makes of `z`."""
    across, slope = np.empty(z.shape[1], z.dtype), np.empty(z.shape[1], z.dtype)
    for i in range(first, last):
        prior_row(z, i, weights[0], weights[1], weights[2], across, slope, out[i])


@njit(inline="always")
def feature_row(moments, i, z, a, half, feature, out):
    """Write the parts (4, cols - 1) of dual row i: gradient east, level, gradient north, albedo.

    `half` is half the cell's inverse, `feature` (4, cols - 1) scratch.
    """
    n = z.shape[1] - 1
    quarter = z.dtype.type(0.25)
    sw, se, nw, ne = z[i][:n], z[i][1 : 1 + n], z[i + 1][:n], z[i + 1][1 : 1 + n]
    f0, f1, f2, f3 = feature[0], feature[1], feature[2], feature[3]
    for j in range(n):
        f0[j] = ((se[j] - sw[j]) + (ne[j] - nw[j])) * half
    for j in range(n):
        f1[j] = ((nw[j] - sw[j]) + (ne[j] - se[j])) * half
    for j in range(n):
        f2[j] = ((sw[j] + se[j]) + (nw[j] + ne[j])) * quarter
    sw, se, nw, ne = a[i][:n], a[i][1 : 1 + n], a[i + 1][:n], a[i + 1][1 : 1 + n]
    for j in range(n):
        f3[j] = ((sw[j] + se[j]) + (nw[j] + ne[j])) * quarter
    m0, m1, m2, m3 = moments[0, i], moments[1, i], moments[2, i], moments[3, i]
    m4, m5, m6 = moments[4, i], moments[5, i], moments[6, i]
    m7, m8, m9 = moments[7, i], moments[8, i], moments[9, i]
    east, level, north, albedo = out[0], out[1], out[2], out[3]
    for j in range(n):
        east[j] = (m0[j] * f0[j] + m1[j] * f1[j] + m2[j] * f2[j] + m3[j] * f3[j]) * half
    for j in range(n):
        north[j] = (m1[j] * f0[j] + m4[j] * f1[j] + m5[j] * f2[j] + m6[j] * f3[j]) * half
    for j in range(n):
        level[j] = (m2[j] * f0[j] + m5[j] * f1[j] + m7[j] * f2[j] + m8[j] * f3[j]) * quarter
    for j in range(n):
        albedo[j] = (m3[j] * f0[j] + m6[j] * f1[j] + m8[j] * f2[j] + m9[j] * f3[j]) * quarter


@njit(inline="always")
def add_features(part, sign, out_z, out_a):
    """Add a dual row's parts to one of its two rows of nodes; `sign` is -1 for the south, 1 for the north one."""
    n = part.shape[1]
    east, level, north, albedo = part[0], part[1], part[2], part[3]
    up = part.dtype.type(sign)
    left, right = out_z[:n], out_z[1 : 1 + n]
    for j in range(n):
        left[j] += level[j] + up * north[j] - east[j]
    for j in range(n):
        right[j] += level[j] + up * north[j] + east[j]
    left, right = out_a[:n], out_a[1 : 1 + n]
    for j in range(n):
        left[j] += albedo[j]
    for j in range(n):
        right[j] += albedo[j]


@njit(cache=True, fastmath=True, nogil=True)
def apply_features(first, last, moments, z, a, cell, height, albedo, out_z, out_a):
    """Write rows of the finest grid's operator, data and priors, applied to (z, a)."""
    rows, cols = z.shape
    across, slope = np.empty(cols, z.dtype), np.empty(cols, z.dtype)
    part, feature = np.empty((2, 4, cols - 1), z.dtype), np.empty((4, cols - 1), z.dtype)
    half = z.dtype.type(0.5 / cell)
    if first > 0:
        feature_row(moments, first - 1, z, a, half, feature, part[(first - 1) % 2])
    for i in range(first, last):
        prior_row(z, i, height[0], height[1], height[2], across, slope, out_z[i])
        prior_row(a, i, albedo[0], albedo[1], albedo[2], across, slope, out_a[i])
        if i > 0:
            add_features(part[(i - 1) % 2], 1, out_z[i], out_a[i])
        if i < rows - 1:
            feature_row(moments, i, z, a, half, feature, part[i % 2])
            add_features(part[i % 2], -1, out_z[i], out_a[i])


@njit(inline="always")
def corner_row(local, place, i, z, a, out):
    """Write the parts (8, cols - 1) of dual row i for its corners' z and a: south-west, south-east, north...

    `place` (8, 8) is where the packed matrix holds row and column.
    """
    n = z.shape[1] - 1
    v0, v1, v2, v3 = z[i][:n], z[i][1 : 1 + n], z[i + 1][:n], z[i + 1][1 : 1 + n]
    v4, v5, v6, v7 = a[i][:n], a[i][1 : 1 + n], a[i + 1][:n], a[i + 1][1 : 1 + n]
    for p in range(8):
        at, o = place[p], out[p]
        m0, m1, m2, m3 = local[at[0], i], local[at[1], i], local[at[2], i], local[at[3], i]
        m4, m5, m6, m7 = local[at[4], i], local[at[5], i], local[at[6], i], local[at[7], i]
        for j in range(n):
            o[j] = (
                m0[j] * v0[j] + m1[j] * v1[j] + m2[j] * v2[j] + m3[j] * v3[j]
                + m4[j] * v4[j] + m5[j] * v5[j] + m6[j] * v6[j] + m7[j] * v7[j]
            )  # fmt: skip


@njit(inline="always")
def add_corners(part, north, out_z, out_a):
    """Add a dual row's parts to its south (0) or north (2) row of nodes."""
    n = part.shape[1]
    for k in range(2):
        own, onto = part[north + k], out_z[k : k + n]
        for j in range(n):
            onto[j] += own[j]
        own, onto = part[4 + north + k], out_a[k : k + n]
        for j in range(n):
            onto[j] += own[j]


@njit(cache=True, fastmath=True, nogil=True)
def apply_corners(first, last, local, z, a, height, albedo, out_z, out_a):
    """Write rows of a coarser grid's operator, data and priors, applied to (z, a)."""
    rows, cols = z.shape
    across, slope = np.empty(cols, z.dtype), np.empty(cols, z.dtype)
    part = np.empty((2, 8, cols - 1), z.dtype)
    place = PLACE
    if first > 0:
        corner_row(local, place, first - 1, z, a, part[(first - 1) % 2])
    for i in range(first, last):
        prior_row(z, i, height[0], height[1], height[2], across, slope, out_z[i])
        prior_row(a, i, albedo[0], albedo[1], albedo[2], across, slope, out_a[i])
        if i > 0:
            add_corners(part[(i - 1) % 2], 2, out_z[i], out_a[i])
        if i < rows - 1:
            corner_row(local, place, i, z, a, part[i % 2])
            add_corners(part[i % 2], 0, out_z[i], out_a[i])


@njit(cache=True, fastmath=True, nogil=True)
def begin(first, last, right, diagonal, gain, step, x):
    """The first Chebyshev step on rows, from nothing: ``x = step = gain * right / diagonal``."""
    g = x.dtype.type(gain)
    for i in range(first, last):
        r, d, s, out = right[i], diagonal[i], step[i], x[i]
        for j in range(x.shape[1]):
            s[j] = g * r[j] / d[j]
            out[j] = s[j]


@njit(cache=True, fastmath=True, nogil=True)
def advance(first, last, right, applied, diagonal, keep, gain, step, x):
    """One Chebyshev step on rows: ``step = keep * step + gain * (right - applied) / diagonal``; ``x += step``."""
    k, g = x.dtype.type(keep), x.dtype.type(gain)
    for i in range(first, last):
        r, y, d, s, out = right[i], applied[i], diagonal[i], step[i], x[i]
        for j in range(x.shape[1]):
            s[j] = k * s[j] + g * (r[j] - y[j]) / d[j]
        for j in range(x.shape[1]):
            out[j] += s[j]


@njit(cache=True, fastmath=True, nogil=True)
def dot_rows(first, last, u, v, out):
    """Write the rows' inner products."""
    for i in range(first, last):
        total = 0.0
        for j in range(u.shape[1]):
            total += u[i, j] * v[i, j]
        out[i] = total


@njit(cache=True, fastmath=True, nogil=True)
def add_rows(first, last, factor, value, out):
    """Add `factor` times `value`."""
    for i in range(first, last):
        for j in range(value.shape[1]):
            out[i, j] += factor * value[i, j]


@njit(cache=True, nogil=True)
def prolong_rows(first, last, coarse, fine):
    """Write rows of the bilinear interpolation of `coarse` to the grid of half its cell."""
    cols = coarse.shape[1]
    half = coarse.dtype.type(0.5)
    for i in range(first, last):
        low, high = coarse[i // 2], coarse[(i + 1) // 2]
        for j in range(cols):
            fine[i, 2 * j] = half * (low[j] + high[j])
        for j in range(cols - 1):
            fine[i, 2 * j + 1] = half * (fine[i, 2 * j] + fine[i, 2 * j + 2])


@njit(cache=True, nogil=True)
def restrict_rows(first, last, fine, coarse):
    """Write rows of the transpose of `prolong_rows` applied to `fine`."""
    rows, cols = coarse.shape
    line, half = np.empty(fine.shape[1], fine.dtype), fine.dtype.type(0.5)
    for i in range(first, last):
        line[:] = fine[2 * i]
        if i > 0:
            line += half * fine[2 * i - 1]
        if i < rows - 1:
            line += half * fine[2 * i + 1]
        for j in range(cols):
            coarse[i, j] = line[2 * j]
        for j in range(cols - 1):
            coarse[i, j] += half * line[2 * j + 1]
            coarse[i, j + 1] += half * line[2 * j + 1]


@njit(inline="always")
def row_times(i, start, column, value, z):
    """Return what row i of a sparse matrix makes of `z`."""
    total = 0.0
    for k in range(start[i], start[i + 1]):
        total += value[k] * z[column[k]]
    return total


@njit(cache=True, nogil=True)
def read_equations(first, last, start, column, value, weight, z, out):
    """Write `weight` times what equations [first, last), rows of a sparse matrix, make of `z` (nodes,)."""
    for i in range(first, last):
        out[i] = weight[i] * row_times(i, start, column, value, z)


@njit(cache=True, nogil=True)
def spread_equations(first, last, start, column, value, nodes, read, out):
    """Add to the nodes [first, last) of `nodes` what the transpose makes of `read` (equations,)."""
    for i in range(first, last):
        out[nodes[i]] += row_times(i, start, column, value, read)


@njit(cache=True, fastmath=True, nogil=True)
def coarsen_rows(first, last, fine, start, column, value, out):
    """Write rows of a coarser grid's packed matrices (36, r, c): what linear maps make of the four children's.

    Parameters
    ----------
    fine : (k, 2 r, 2 c) packed matrices of the children.
    start, column, value : the maps of the children (south-west, south-east, north...) as rows of a sparse
        matrix (36, 4 k).
    """
    kinds, cells = fine.shape[0], out.shape[2]
    child = np.empty((4 * kinds, cells), np.float32)
    total = np.empty(cells, np.float32)
    for i in range(first, last):
        for c in range(4):
            for k in range(kinds):
                row, own = fine[k, 2 * i + c // 2], child[c * kinds + k]
                for j in range(cells):
                    own[j] = row[2 * j + c % 2]
        for p in range(36):
            total[:] = 0
            for k in range(start[p], start[p + 1]):
                own, factor = child[column[k]], value[k]
                for j in range(cells):
                    total[j] += factor * own[j]
            out[p, i] = total
