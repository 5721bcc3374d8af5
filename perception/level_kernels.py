"""Operators of one grid of the joint problem, node row by node row.

Each kernel writes the rows [first, last) of a result and nothing else, in an order that does not depend on them: bands of
rows may be computed by several threads, to the bit as by one. Arrays: `z` and `a` (rows, cols) nodes; `moments`
(10, rows - 1, cols - 1) and `local` (36, rows - 1, cols - 1) packed upper triangles of the cells' matrices.

What a kernel calls is written into it (``inline``): a fast-math function that was called was optimised one way when
freshly compiled and another when linked from numba's cache, so that the first run on a machine and the second differed.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit


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
    r0, r1, r2 = max(i - 2, 0), max(i - 1, 0), z[i]
    r3, r4 = min(i + 1, rows - 1), min(i + 2, rows - 1)
    w1, w2, w3 = k1 * d[0] + k2 * b[1], k0 + k1 * d[1] + k2 * b[2], k1 * d[2] + k2 * b[3]
    for j in range(cols):
        across[j] = (
            w1 * z[r1, j] + w2 * r2[j] + w3 * z[r3, j] + k2 * (b[0] * z[r0, j] + b[4] * z[r4, j])
        )
        slope[j] = k1 * r2[j] + 2 * k2 * (d[0] * z[r1, j] + d[1] * r2[j] + d[2] * z[r3, j])
    for j in range(2, cols - 2):
        out[j] = (
            across[j] + 2 * slope[j] - slope[j - 1] - slope[j + 1]
            + k2 * (6 * r2[j] - 4 * (r2[j - 1] + r2[j + 1]) + r2[j - 2] + r2[j + 2])
        )  # fmt: skip
    for j in range(cols):
        if 2 <= j < cols - 2:
            continue
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
    across, slope = np.empty(z.shape[1]), np.empty(z.shape[1])
    for i in range(first, last):
        prior_row(z, i, weights[0], weights[1], weights[2], across, slope, out[i])


@njit(inline="always")
def feature_row(moments, i, z, a, cell, out):
    """Write the parts (4, cols - 1) of dual row i: gradient east, level less and plus gradient north, albedo."""
    half = 0.5 / cell
    for j in range(z.shape[1] - 1):
        sw, se, nw, ne = z[i, j], z[i, j + 1], z[i + 1, j], z[i + 1, j + 1]
        f0 = (se + ne - sw - nw) * half
        f1 = (nw + ne - sw - se) * half
        f2 = 0.25 * (sw + se + nw + ne)
        f3 = 0.25 * (a[i, j] + a[i, j + 1] + a[i + 1, j] + a[i + 1, j + 1])
        m2, m3, m5 = moments[2, i, j], moments[3, i, j], moments[5, i, j]
        m1, m6, m8 = moments[1, i, j], moments[6, i, j], moments[8, i, j]
        out[0, j] = (moments[0, i, j] * f0 + m1 * f1 + m2 * f2 + m3 * f3) * half
        north = (m1 * f0 + moments[4, i, j] * f1 + m5 * f2 + m6 * f3) * half
        level = 0.25 * (m2 * f0 + m5 * f1 + moments[7, i, j] * f2 + m8 * f3)
        out[1, j] = level - north
        out[2, j] = level + north
        out[3, j] = 0.25 * (m3 * f0 + m6 * f1 + m8 * f2 + moments[9, i, j] * f3)


@njit(inline="always")
def add_features(part, level, out_z, out_a):
    """Add a dual row's parts to one of its two rows of nodes; `level` is 1 for the south, 2 for the north one."""
    for j in range(part.shape[1]):
        out_z[j] += part[level, j] - part[0, j]
        out_a[j] += part[3, j]
    for j in range(part.shape[1]):
        out_z[j + 1] += part[level, j] + part[0, j]
        out_a[j + 1] += part[3, j]


@njit(cache=True, fastmath=True, nogil=True)
def apply_features(first, last, moments, z, a, cell, height, albedo, out_z, out_a):
    """Write rows of the finest grid's operator, data and priors, applied to (z, a)."""
    rows, cols = z.shape
    across, slope = np.empty(cols), np.empty(cols)
    part = np.empty((2, 4, cols - 1))
    if first > 0:
        feature_row(moments, first - 1, z, a, cell, part[(first - 1) % 2])
    for i in range(first, last):
        prior_row(z, i, height[0], height[1], height[2], across, slope, out_z[i])
        prior_row(a, i, albedo[0], albedo[1], albedo[2], across, slope, out_a[i])
        if i > 0:
            add_features(part[(i - 1) % 2], 2, out_z[i], out_a[i])
        if i < rows - 1:
            feature_row(moments, i, z, a, cell, part[i % 2])
            add_features(part[i % 2], 1, out_z[i], out_a[i])


@njit(inline="always")
def corner_row(local, i, z, a, out):
    """Write the parts (8, cols - 1) of dual row i for its corners' z and a: south-west, south-east, north..."""
    cells = z.shape[1] - 1
    out[:] = 0.0
    k = 0
    for p in range(8):
        u = (z if p < 4 else a)[i + p % 4 // 2, p % 2 : p % 2 + cells]
        for q in range(p, 8):
            v = (z if q < 4 else a)[i + q % 4 // 2, q % 2 : q % 2 + cells]
            m = local[k, i]
            for j in range(cells):
                out[p, j] += m[j] * v[j]
            if q > p:
                for j in range(cells):
                    out[q, j] += m[j] * u[j]
            k += 1


@njit(inline="always")
def add_corners(part, north, out_z, out_a):
    """Add a dual row's parts to its south (0) or north (2) row of nodes."""
    for j in range(part.shape[1]):
        out_z[j] += part[north, j]
        out_a[j] += part[4 + north, j]
    for j in range(part.shape[1]):
        out_z[j + 1] += part[north + 1, j]
        out_a[j + 1] += part[5 + north, j]


@njit(cache=True, fastmath=True, nogil=True)
def apply_corners(first, last, local, z, a, height, albedo, out_z, out_a):
    """Write rows of a coarser grid's operator, data and priors, applied to (z, a)."""
    rows, cols = z.shape
    across, slope = np.empty(cols), np.empty(cols)
    part = np.empty((2, 8, cols - 1))
    if first > 0:
        corner_row(local, first - 1, z, a, part[(first - 1) % 2])
    for i in range(first, last):
        prior_row(z, i, height[0], height[1], height[2], across, slope, out_z[i])
        prior_row(a, i, albedo[0], albedo[1], albedo[2], across, slope, out_a[i])
        if i > 0:
            add_corners(part[(i - 1) % 2], 2, out_z[i], out_a[i])
        if i < rows - 1:
            corner_row(local, i, z, a, part[i % 2])
            add_corners(part[i % 2], 0, out_z[i], out_a[i])


@njit(cache=True, fastmath=True, nogil=True)
def advance(first, last, right, applied, diagonal, keep, gain, step, x):
    """One Chebyshev step on rows: ``step = keep * step + gain * (right - applied) / diagonal``; ``x += step``."""
    for i in range(first, last):
        for j in range(x.shape[1]):
            step[i, j] = keep * step[i, j] + gain * (right[i, j] - applied[i, j]) / diagonal[i, j]
            x[i, j] += step[i, j]


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
    for i in range(first, last):
        low, high = coarse[i // 2], coarse[(i + 1) // 2]
        for j in range(cols):
            fine[i, 2 * j] = 0.5 * (low[j] + high[j])
        for j in range(cols - 1):
            fine[i, 2 * j + 1] = 0.5 * (fine[i, 2 * j] + fine[i, 2 * j + 2])


@njit(cache=True, nogil=True)
def restrict_rows(first, last, fine, coarse):
    """Write rows of the transpose of `prolong_rows` applied to `fine`."""
    rows, cols = coarse.shape
    line = np.empty(fine.shape[1])
    for i in range(first, last):
        line[:] = fine[2 * i]
        if i > 0:
            line += 0.5 * fine[2 * i - 1]
        if i < rows - 1:
            line += 0.5 * fine[2 * i + 1]
        for j in range(cols):
            coarse[i, j] = line[2 * j]
        for j in range(cols - 1):
            coarse[i, j] += 0.5 * line[2 * j + 1]
            coarse[i, j + 1] += 0.5 * line[2 * j + 1]
