"""Merging of regions on their graph: the small and the doubtful join a neighbour."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from perception.region_labels import add_border, find_root, in_order


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
def _remap_borders(
    edges: npt.NDArray[np.int64], border: npt.NDArray[np.float64], parent: npt.NDArray[np.int32]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    keys = np.full(1 << 12, -1, np.int64)
    length = np.zeros(1 << 12)
    used = 0
    for n in range(len(border)):
        a = np.int64(find_root(parent, edges[n, 0]))
        b = np.int64(find_root(parent, edges[n, 1]))
        if a != b:
            key = (min(a, b) << 32) | max(a, b)
            keys, length, used = add_border(keys, length, used, key, border[n])
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
            x, y = find_root(parent, a), find_root(parent, best[a])
            if x == y or not (weak[x] or area[x] < least[x] or weak[y] or area[y] < least[y]):
                continue
            if _gives_way(y, x, area, least, weak):
                x, y = y, x
            parent[x] = y
            area[y] += area[x]
        edges, border = _remap_borders(edges, border, parent)
    for a in range(n):
        parent[a] = find_root(parent, a)
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
def join_equal(
    edges: npt.NDArray[np.int64],
    parent: npt.NDArray[np.int32],
    class_of: npt.NDArray[np.uint8],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8]]:
    """Join what the merging left side by side with one class.

    Returns
    -------
    number : (n + 1,) new number of each region, in the order of first appearance.
    new_class_of : class by the new numbers.
    """
    joined = parent.copy()
    survivor = class_of[parent]
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        if survivor[a] == survivor[b]:
            x, y = find_root(joined, a), find_root(joined, b)
            joined[max(x, y)] = min(x, y)
    number = in_order(joined)
    new_class = np.zeros(number.max() + 1, np.uint8)
    for a in range(1, len(number)):
        new_class[number[a]] = survivor[a]
    return number, new_class
