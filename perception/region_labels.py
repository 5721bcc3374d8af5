"""Connected regions of equal class: their numbers, the sums over their cells, their common borders.

Kernels on plain arrays. Region numbers run from 1, 0 is no data; neighbours share a cell's side, so
that a region is one polygon. Work goes by strips of rows, each within a core's cache; what crosses
from strip to strip is joined on the short lists of pieces.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import get_num_threads, njit, prange

IntMap = npt.NDArray[np.int32]
Sums = npt.NDArray[np.float64]
Edges = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]

# Rows of a strip: few enough for the pieces of a strip to stay in cache, many enough for few seams.
_STRIP = 64

# Columns of the sums over a region's cells.
(COUNT, SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY, SUM_H, SUM_K, SUM_P, MAX_P, LOW, HIGH, SUM_SCALE) = (
    range(13)
)


@dataclass(frozen=True, slots=True)
class Labels:
    """Numbered regions and what their cells add up to.

    Attributes
    ----------
    region : (rows, cols) number from 1 in the order of first appearance, 0 no data.
    class_of : (n + 1,) class by region number.
    sums : (n + 1, 13), columns as named above; x and y in columns and rows.
    """

    region: IntMap
    class_of: npt.NDArray[np.uint8]
    sums: Sums


@njit(cache=True)
def find_root(parent: npt.NDArray[np.int32], a: int) -> int:
    """Return the root of a in a union-find forest, halving the way for the next time."""
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(cache=True)
def _label_strip(class_code: npt.NDArray[np.uint8], region: IntMap) -> int:
    """Number the pieces of one strip from 1 in the order of first appearance; return how many."""
    rows, cols = class_code.shape
    parent = np.zeros(1024, np.int32)
    n = 1
    for i in range(rows):
        for j in range(cols):
            c = class_code[i, j]
            if c == 0:
                region[i, j] = 0
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
                a, b = find_root(parent, west), find_root(parent, north)
                low = min(a, b)
                parent[max(a, b)] = low
                region[i, j] = low
    number = in_order(parent[:n])
    for i in range(rows):
        for j in range(cols):
            region[i, j] = number[region[i, j]]
    return number.max()


@njit(cache=True)
def in_order(parent: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Number the sets of a union-find forest from 1 by their first members; member 0 stays 0."""
    number = np.zeros(len(parent), np.int32)
    of_root = np.zeros(len(parent), np.int32)
    count = 0
    for a in range(1, len(parent)):
        r = find_root(parent, a)
        if of_root[r] == 0:
            count += 1
            of_root[r] = count
        number[a] = of_root[r]
    return number


@njit(cache=True, parallel=True)
def _label_strips(class_code: npt.NDArray[np.uint8], region: IntMap) -> npt.NDArray[np.int64]:
    counts = np.zeros(-(-len(class_code) // _STRIP), np.int64)
    for k in prange(len(counts)):
        rows = slice(k * _STRIP, min((k + 1) * _STRIP, len(class_code)))
        counts[k] = _label_strip(class_code[rows], region[rows])
    return counts


@njit(cache=True)
def _join_seams(
    class_code: npt.NDArray[np.uint8], region: IntMap, first: npt.NDArray[np.int64]
) -> npt.NDArray[np.int32]:
    """Return the region number of every piece: pieces of one class that meet at a seam are one."""
    parent = np.arange(first[-1] + 1).astype(np.int32)
    for k in range(1, len(first) - 1):
        i = k * _STRIP
        for j in range(region.shape[1]):
            c = class_code[i, j]
            if c != 0 and c == class_code[i - 1, j]:
                a = find_root(parent, first[k] + region[i, j])
                b = find_root(parent, first[k - 1] + region[i - 1, j])
                parent[max(a, b)] = min(a, b)
    return in_order(parent)


@njit(cache=True, parallel=True)
def _sum_strips(
    class_code: npt.NDArray[np.uint8],
    region: IntMap,
    planes: tuple[Any, ...],
    first: npt.NDArray[np.int64],
    class_of: npt.NDArray[np.uint8],
    sums: Sums,
) -> None:
    """Add up every strip's cells by their piece; `planes` are heights, H, K, certainty and scale."""
    elevation_m, mean, gauss, certainty, scale = planes
    for k in prange(len(first) - 1):
        for i in range(k * _STRIP, min((k + 1) * _STRIP, len(region))):
            for j in range(region.shape[1]):
                if region[i, j] == 0:
                    continue
                piece = first[k] + region[i, j]
                class_of[piece] = class_code[i, j]
                row = sums[piece]
                row[COUNT] += 1
                row[SUM_X] += j
                row[SUM_Y] += i
                row[SUM_XX] += j * j
                row[SUM_XY] += i * j
                row[SUM_YY] += i * i
                row[SUM_H] += mean[i, j]
                row[SUM_K] += gauss[i, j]
                row[SUM_P] += certainty[i, j]
                row[MAX_P] = max(row[MAX_P], certainty[i, j])
                row[LOW] = min(row[LOW], elevation_m[i, j])
                row[HIGH] = max(row[HIGH], elevation_m[i, j])
                row[SUM_SCALE] += scale[i, j]


@njit(cache=True)
def fold_sums(sums: Sums, number: npt.NDArray[np.int32]) -> Sums:
    """Add up the sums of members that have one number, (count + 1, 13)."""
    out = np.zeros((number.max() + 1, sums.shape[1]))
    out[:, LOW] = np.inf
    out[:, HIGH] = -np.inf
    for a in range(1, len(number)):
        row, more = out[number[a]], sums[a]
        for c in range(sums.shape[1]):
            if c in (MAX_P, HIGH):
                row[c] = max(row[c], more[c])
            elif c == LOW:
                row[c] = min(row[c], more[c])
            else:
                row[c] += more[c]
    return out


@njit(cache=True, parallel=True)
def _renumber(region: IntMap, number: npt.NDArray[np.int32], first: npt.NDArray[np.int64]) -> None:
    for k in prange(len(first) - 1):
        for i in range(k * _STRIP, min((k + 1) * _STRIP, len(region))):
            for j in range(region.shape[1]):
                if region[i, j] != 0:
                    region[i, j] = number[first[k] + region[i, j]]


def label_and_sum(class_code: npt.NDArray[np.uint8], planes: tuple[Any, ...]) -> Labels:
    """Number the connected regions of equal class and add up their cells.

    Parameters
    ----------
    class_code : (rows, cols); 0 no data.
    planes : heights, H, K, certainty and scale, (rows, cols) each.
    """
    region = np.empty(class_code.shape, np.int32)
    counts = _label_strips(class_code, region)
    first = np.concatenate([[0], np.cumsum(counts)])
    pieces = int(first[-1]) + 1
    piece_class = np.zeros(pieces, np.uint8)
    sums = np.zeros((pieces, 13))
    sums[:, LOW], sums[:, HIGH] = np.inf, -np.inf
    _sum_strips(class_code, region, planes, first, piece_class, sums)
    number = _join_seams(class_code, region, first)
    _renumber(region, number, first)
    class_of = np.zeros(int(number.max()) + 1, np.uint8)
    class_of[number] = piece_class
    return Labels(region, class_of, fold_sums(sums, number))


@njit(cache=True, parallel=True)
def write_merge(
    region: IntMap,
    class_code: npt.NDArray[np.uint8],
    number: npt.NDArray[np.int32],
    class_of: npt.NDArray[np.uint8],
) -> None:
    """Write each cell's surviving region and class in place; `class_of` goes by the new numbers."""
    for i in prange(region.shape[0]):
        for j in range(region.shape[1]):
            a = number[region[i, j]]
            region[i, j] = a
            class_code[i, j] = class_of[a]


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
def add_border(
    keys: npt.NDArray[np.int64], length: npt.NDArray[np.float64], used: int, key: int, metres: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], int]:
    """Add metres to a pair's border in a hash table that grows; return the table and its fill."""
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


@njit(cache=True, nogil=True)
def _strip_borders(
    region: IntMap, start: int, stop: int, cell_m: float, cell_north_m: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return keys and lengths of the borders of rows start to stop, to the row beyond included."""
    rows, cols = region.shape
    keys = np.full(1 << 12, -1, np.int64)
    length = np.zeros(1 << 12)
    used = 0
    for i in range(start, stop):
        # Runs of one pair are added up first: most borders go on as they were a cell ago.
        run_key, run_m = np.int64(-1), 0.0
        for j in range(cols):
            a = np.int64(region[i, j])
            if a == 0:
                continue
            b = np.int64(region[i, j + 1]) if j + 1 < cols else a
            if b != a and b != 0:
                key = (min(a, b) << 32) | max(a, b)
                keys, length, used = add_border(keys, length, used, key, cell_north_m)
            b = np.int64(region[i + 1, j]) if i + 1 < rows else a
            if b != a and b != 0:
                key = (min(a, b) << 32) | max(a, b)
                if key != run_key:
                    if run_m > 0:
                        keys, length, used = add_border(keys, length, used, run_key, run_m)
                    run_key, run_m = key, 0.0
                run_m += cell_m
        if run_m > 0:
            keys, length, used = add_border(keys, length, used, run_key, run_m)
    found = keys >= 0
    return keys[found], length[found]


def region_borders(region: IntMap, cell_m: float, cell_north_m: float) -> Edges:
    """Return neighbouring pairs (n, 2), ascending, smaller number first, and their borders' lengths in m."""
    starts = range(0, len(region), _STRIP)

    def strip(start: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        stop = min(start + _STRIP, len(region))
        found: tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]
        found = _strip_borders(region, start, stop, cell_m, cell_north_m)
        return found

    parts = _by_threads(strip, starts)
    keys = np.concatenate([keys for keys, _ in parts])
    return _unique_pairs(keys, np.concatenate([length for _, length in parts]))


def _by_threads(work: Callable[[int], Any], items: range) -> list[Any]:
    """Map over threads, as many as numba has; the work must release the interpreter's lock."""
    if len(items) < 2 or get_num_threads() == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(get_num_threads()) as pool:
        return list(pool.map(work, items))


def _unique_pairs(keys: npt.NDArray[np.int64], length: npt.NDArray[np.float64]) -> Edges:
    """Add up the lengths of equal keys; the pairs ascending."""
    order = np.argsort(keys, kind="stable")
    keys, length = keys[order], length[order]
    if len(keys) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    first = np.flatnonzero(np.r_[True, np.diff(keys) > 0])
    keys = keys[first]
    return np.column_stack([keys >> 32, keys & 0xFFFFFFFF]), np.add.reduceat(length, first)


def fold_borders(
    edges: npt.NDArray[np.int64], border: npt.NDArray[np.float64], number: npt.NDArray[np.int32]
) -> Edges:
    """Return pairs and lengths between the sets that regions now belong to."""
    a = number[edges[:, 0]].astype(np.int64)
    b = number[edges[:, 1]].astype(np.int64)
    apart = a != b
    return _unique_pairs((np.minimum(a, b) << 32 | np.maximum(a, b))[apart], border[apart])
