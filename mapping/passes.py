"""Kernels of fusion: what one pass adds to the cells it shares with others. All arrays (rows, cols).

`keep` tells in which cells the pass has a say. Plain numpy would do (`tests/mapping/test_fusion.py` has it so), at several times the
time and memory: each line of it makes rasters that are read once.
"""

from __future__ import annotations

import numba
import numpy as np

from perception.records import BoolArray, FloatArray


@numba.njit(cache=True)
def add_weighted(
    height: FloatArray, variance: FloatArray, keep: BoolArray, weight: FloatArray, total: FloatArray,
    number: FloatArray,
) -> None:  # fmt: skip
    """Add a pass to the sums of weights 1 / variance, of weighted heights, and of passes."""
    rows, cols = height.shape
    for i in range(rows):
        for j in range(cols):
            if keep[i, j]:
                w = 1.0 / variance[i, j]
                weight[i, j] += w
                total[i, j] += w * height[i, j]
                number[i, j] += 1.0


@numba.njit(cache=True)
def judge(
    height: FloatArray, variance: FloatArray, keep: BoolArray, weight: FloatArray, total: FloatArray,
    number: FloatArray, worst: FloatArray, least: float, drop: bool,
) -> None:  # fmt: skip
    """Compare a pass with the rest of the passes in cells that have two others at least.

    `least` deviation counts. First for every pass with `drop` False: `worst` becomes the greatest deviation in sigma. Then with `drop` True:
    the pass loses its say where the deviation is its own.
    """
    rows, cols = height.shape
    for i in range(rows):
        for j in range(cols):
            if not keep[i, j] or number[i, j] < 3:
                continue
            w = 1.0 / variance[i, j]
            others = weight[i, j] - w
            if others <= 1e-12:
                continue
            rest = (total[i, j] - w * height[i, j]) / others
            ratio = abs(height[i, j] - rest) / np.sqrt(variance[i, j] + 1.0 / others)
            if not drop:
                worst[i, j] = max(worst[i, j], ratio)
            elif ratio > least and ratio >= worst[i, j]:
                keep[i, j] = False


@numba.njit(cache=True)
def add_spread(
    height: FloatArray, variance: FloatArray, position: FloatArray, count: FloatArray, keep: BoolArray,
    mean: FloatArray, chi2: FloatArray, positions: FloatArray, counts: FloatArray,
) -> None:  # fmt: skip
    """Add a pass's squared deviation from the mean in sigma, its weighted position variance and its data."""
    rows, cols = height.shape
    for i in range(rows):
        for j in range(cols):
            if keep[i, j]:
                w = 1.0 / variance[i, j]
                apart = height[i, j] - mean[i, j]
                chi2[i, j] += w * apart * apart
                positions[i, j] += w * position[i, j]
                counts[i, j] += count[i, j]
