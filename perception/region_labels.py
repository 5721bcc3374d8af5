"""Connected regions of equal class, their borders, and the merging of the small and the doubtful.

Kernels on plain arrays. Region numbers run from 1, 0 is no data; neighbours share a cell's side, so
that a region is one polygon.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

IntMap = npt.NDArray[np.int32]


@njit(cache=True)
def _root(parent: npt.NDArray[np.int32], a: int) -> int:
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(cache=True)
def label_classes(class_code: npt.NDArray[np.uint8]) -> tuple[IntMap, int]:
    """Number the connected regions of equal class, (rows, cols); class 0 stays 0.

    One scan with union-find, one to renumber in the order of first appearance.
    """
    rows, cols = class_code.shape
    region = np.zeros((rows, cols), np.int32)
    parent = np.zeros(1024, np.int32)
    n = 1
    for i in range(rows):
        for j in range(cols):
            c = class_code[i, j]
            if c == 0:
                continue
            west = region[i, j - 1] if j > 0 and class_code[i, j - 1] == c else 0
            north = region[i - 1, j] if i > 0 and class_code[i - 1, j] == c else 0
            if west == 0 and north == 0:
                if n == len(parent):
                    grown = np.zeros(2 * n, np.int32)
                    grown[:n] = parent
                    parent = grown
                parent[n] = n
                region[i, j] = n
                n += 1
            elif west == 0 or north == 0 or west == north:
                region[i, j] = max(west, north)
            else:
                a, b = _root(parent, west), _root(parent, north)
                low = min(a, b)
                parent[max(a, b)] = low
                region[i, j] = low
    number = np.zeros(n, np.int32)
    count = 0
    for a in range(1, n):
        r = _root(parent, a)
        if r == a:
            count += 1
            number[a] = count
        else:
            number[a] = number[r]
    _renumber(region, number)
    return region, count


@njit(cache=True)
def _renumber(region: IntMap, number: npt.NDArray[np.int32]) -> None:
    for i in range(region.shape[0]):
        for j in range(region.shape[1]):
            region[i, j] = number[region[i, j]]


@njit(cache=True)
def _slot(keys: npt.NDArray[np.int64], key: int) -> int:
    """Return the place of `key` in an open-addressing table of a power-of-two size."""
    mask = len(keys) - 1
    # Fibonacci hashing; the shift keeps the product's well-mixed upper bits.
    place = ((key * 0x9E3779B97F4A7C1) >> 20) & mask
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & mask
    return place


@njit(cache=True)
def _add_border(
    keys: npt.NDArray[np.int64], length: npt.NDArray[np.float64], used: int, key: int, metres: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], int]:
    if 2 * used > len(keys):
        more_keys = np.full(2 * len(keys), -1, np.int64)
        more_length = np.zeros(2 * len(keys))
        for k in range(len(keys)):
            if keys[k] != -1:
                place = _slot(more_keys, keys[k])
                more_keys[place] = keys[k]
                more_length[place] = length[k]
        keys, length = more_keys, more_length
    place = _slot(keys, key)
    if keys[place] == -1:
        keys[place] = key
        used += 1
    length[place] += metres
    return keys, length, used


@njit(cache=True)
def _pairs(
    keys: npt.NDArray[np.int64], length: npt.NDArray[np.float64], used: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    edges = np.empty((used, 2), np.int64)
    border = np.empty(used)
    n = 0
    for k in range(len(keys)):
        if keys[k] != -1:
            edges[n, 0] = keys[k] >> 32
            edges[n, 1] = keys[k] & 0xFFFFFFFF
            border[n] = length[k]
            n += 1
    return edges, border


@njit(cache=True)
def region_borders(
    region: IntMap, cell_m: float, cell_north_m: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return neighbouring pairs (n, 2), smaller number first, and their common borders' lengths in m."""
    rows, cols = region.shape
    keys = np.full(1 << 16, -1, np.int64)
    length = np.zeros(1 << 16)
    used = 0
    for i in range(rows):
        # Runs of one pair are added up first: most borders go on as they were a cell ago.
        run_key, run_m = np.int64(-1), 0.0
        for j in range(cols):
            a = np.int64(region[i, j])
            if a == 0:
                continue
            b = np.int64(region[i, j + 1]) if j + 1 < cols else a
            if b != a and b != 0:
                key = (min(a, b) << 32) | max(a, b)
                keys, length, used = _add_border(keys, length, used, key, cell_north_m)
            b = np.int64(region[i + 1, j]) if i + 1 < rows else a
            if b != a and b != 0:
                key = (min(a, b) << 32) | max(a, b)
                if key != run_key:
                    if run_m > 0:
                        keys, length, used = _add_border(keys, length, used, run_key, run_m)
                    run_key, run_m = key, 0.0
                run_m += cell_m
        if run_m > 0:
            keys, length, used = _add_border(keys, length, used, run_key, run_m)
    return _pairs(keys, length, used)


@njit(cache=True)
def _remap_borders(
    edges: npt.NDArray[np.int64], border: npt.NDArray[np.float64], parent: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    keys = np.full(1 << 12, -1, np.int64)
    length = np.zeros(1 << 12)
    used = 0
    for n in range(len(border)):
        a = np.int64(_root(parent, edges[n, 0]))
        b = np.int64(_root(parent, edges[n, 1]))
        if a != b:
            key = (min(a, b) << 32) | max(a, b)
            keys, length, used = _add_border(keys, length, used, key, border[n])
    return _pairs(keys, length, used)


@njit(cache=True)
def merge_regions(
    edges: npt.NDArray[np.int64],
    border: npt.NDArray[np.float64],
    area: npt.NDArray[np.float64],
    least: npt.NDArray[np.float64],
    weak: npt.NDArray[np.bool_],
) -> npt.NDArray[np.int32]:
    """Give every small or weak region to the neighbour with which it shares the longest border.

    Parameters
    ----------
    area, least, weak : (n + 1,) by region number: its area, the least area it may have, and whether it
        lacks a certain core.

    Returns
    -------
    (n + 1,) number of the region that each one ends up in. The larger partner names the union.

    Notes
    -----
    Rounds: each chooses once, unions are made smallest first, then borders are added up again. Strong
    neighbours are preferred, so that doubtful patches join a certain region instead of one another.
    """
    n = len(area)
    parent = np.arange(n).astype(np.int32)
    area = area.copy()
    least = least.copy()
    weak = weak.copy()
    for _ in range(64):
        best = np.zeros(n, np.int64)
        score = np.zeros(n)
        for e in range(len(border)):
            for side in range(2):
                a, b = edges[e, side], edges[e, 1 - side]
                if weak[a] or area[a] < least[a]:
                    sound = not weak[b] and area[b] >= least[b]
                    value = border[e] * (4.0 if sound else 1.0)
                    if value > score[a] or (value == score[a] and area[b] > area[best[a]]):
                        score[a] = value
                        best[a] = b
        chosen = np.nonzero(best)[0]
        if len(chosen) == 0:
            break
        for a in chosen[np.argsort(area[chosen])]:
            x, y = _root(parent, a), _root(parent, best[a])
            if x == y or not (weak[x] or area[x] < least[x] or weak[y] or area[y] < least[y]):
                continue
            if _gives_way(y, x, area, least, weak):
                x, y = y, x
            parent[x] = y
            area[y] += area[x]
        edges, border = _remap_borders(edges, border, parent)
    for a in range(n):
        parent[a] = _root(parent, a)
    return parent


@njit(cache=True)
def _gives_way(
    a: int,
    b: int,
    area: npt.NDArray[np.float64],
    least: npt.NDArray[np.float64],
    weak: npt.NDArray[np.bool_],
) -> bool:
    """Return whether a joins b under b's name: a certain one names the union, then the larger."""
    if weak[a] != weak[b]:
        return weak[a]
    return area[a] < area[b]


@njit(cache=True)
def apply_merge(
    region: IntMap,
    class_code: npt.NDArray[np.uint8],
    parent: npt.NDArray[np.int32],
    class_of: npt.NDArray[np.uint8],
) -> None:
    """Write each cell's surviving class in place."""
    for i in range(region.shape[0]):
        for j in range(region.shape[1]):
            class_code[i, j] = class_of[parent[region[i, j]]]


# Columns of the sums over a region's cells.
(COUNT, SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY, SUM_H, SUM_K, SUM_P, MAX_P, LOW, HIGH, SUM_SCALE) = (
    range(13)
)


@njit(cache=True)
def region_sums(
    region: IntMap,
    count: int,
    elevation_m: npt.NDArray[Any],
    mean: npt.NDArray[Any],
    gauss: npt.NDArray[Any],
    certainty: npt.NDArray[Any],
    scale: npt.NDArray[Any],
) -> npt.NDArray[np.float64]:
    """Add up what the region table needs, (count + 1, 13); x and y in columns and rows."""
    sums = np.zeros((count + 1, 13))
    sums[:, 10] = np.inf
    sums[:, 11] = -np.inf
    for i in range(region.shape[0]):
        for j in range(region.shape[1]):
            a = region[i, j]
            if a == 0:
                continue
            row = sums[a]
            row[0] += 1
            row[1] += j
            row[2] += i
            row[3] += j * j
            row[4] += i * j
            row[5] += i * i
            row[6] += mean[i, j]
            row[7] += gauss[i, j]
            p = certainty[i, j]
            row[8] += p
            row[9] = max(row[9], p)
            z = elevation_m[i, j]
            row[10] = min(row[10], z)
            row[11] = max(row[11], z)
            row[12] += scale[i, j]
    return sums
