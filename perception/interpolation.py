"""Bilinear interpolation for kernels; `perception.records.bilinear` is its twin on arrays."""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def cell_height(surface, row0, col0, row, col):  # type: ignore[no-untyped-def]
    """Bilinear height with corner (row0, col0); a NaN corner of zero weight does not count."""
    fr, fc = row - row0, col - col0
    total = 0.0
    for i in range(2):
        for j in range(2):
            weight = (fr if i else 1.0 - fr) * (fc if j else 1.0 - fc)
            if weight > 0.0:
                r = min(row0 + i, surface.shape[0] - 1)
                c = min(col0 + j, surface.shape[1] - 1)
                total += weight * surface[r, c]
    return total
