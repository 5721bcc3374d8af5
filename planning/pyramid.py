"""The grid stage on large maps: corridors from coarse to fine, then the full search inside the last.

Costs to and from every node of a thinned map tell which ground can lie on a path within some per cent
of the best; each finer map is searched on that ground only. Where the last search finds no way there (a
gap or a wall that the thinned maps do not show), it looks everywhere.
"""

from __future__ import annotations

import math

import numpy as np

from perception.records import BoolArray, IntArray
from planning.field import search
from planning.surface import Surface
from planning.thinning import Thin, thin_surface, thinned

# Cells from which corridors pay.
_WHOLE_CELLS = 1_500_000
# Nodes of the thinned maps, and what a path may cost there beyond the best to be looked at further: a
# block's mean hides the better half of it, the less the finer the block.
_LEVELS = ((160_000, 0.015), (1_600_000, 0.003))
# A level finer than this (cells per block) costs as much as the map itself.
_LEAST_BLOCK = 2


def guided_search(
    surface: Surface, source: tuple[int, int], target: tuple[int, int], neighbours: int = 32
) -> tuple[float, IntArray]:
    """Return cost and nodes (n, 2) of the best grid path; infinite and empty where there is none."""
    if surface.barred.size > _WHOLE_CELLS:
        found = _in_corridor(surface, source, target, neighbours)
        if found is not None:
            return found
    field = search(surface, source, target, neighbours)
    cost = float(field.cost[target])
    return cost, field.path(*target) if np.isfinite(cost) else np.zeros((0, 2), np.int64)


def _in_corridor(
    surface: Surface, source: tuple[int, int], target: tuple[int, int], neighbours: int
) -> tuple[float, IntArray] | None:
    near: BoolArray | None = None
    block = 1
    for nodes, margin in _LEVELS:
        if math.ceil(math.sqrt(surface.barred.size / nodes)) < _LEAST_BLOCK:
            break
        thin = thinned(surface, nodes)
        finer = round(thin.cell_m[0] / surface.cell_m[0])
        near = _near_best(thin, finer, source, target, margin, _refined(near, block, finer, thin))
        block = finer
        if near is None:
            return None
    if near is None:
        return None
    window = _window(near, block, surface.shape)
    inside = near[
        window[0].start // block : -(-window[0].stop // block),
        window[1].start // block : -(-window[1].stop // block),
    ]
    part = _part(surface, window, _spread(inside, block))
    shift = np.array([window[0].start, window[1].start])
    start = (source[0] - int(shift[0]), source[1] - int(shift[1]))
    goal = (target[0] - int(shift[0]), target[1] - int(shift[1]))
    field = search(part, start, goal, neighbours)
    cost = float(field.cost[goal])
    if not np.isfinite(cost):
        return None
    return cost, field.path(*goal) + shift


def _near_best(
    thin: Thin,
    block: int,
    source: tuple[int, int],
    target: tuple[int, int],
    margin: float,
    inside: BoolArray | None,
) -> BoolArray | None:
    """Return which blocks lie on a path within `margin` of the best, one block wider; None without a path."""
    rough = thin_surface(thin)
    rows, cols = rough.shape
    a, b = (
        (min(node[0] // block, rows - 1), min(node[1] // block, cols - 1))
        for node in (source, target)
    )
    window = (slice(0, rows), slice(0, cols))
    if inside is not None:
        window = _window(inside, 1, rough.shape)
        inside = inside[window]
    rough = _part(rough, window, inside)
    r0, c0 = window[0].start, window[1].start
    a, b = (a[0] - r0, a[1] - c0), (b[0] - r0, b[1] - c0)
    rough.barred[a] = rough.barred[b] = False
    through = search(rough, a, None, 16).cost + search(rough.reversed(), b, None, 16).cost
    best = float(through.min())
    if not np.isfinite(best):
        return None
    near = np.zeros((rows, cols), bool)
    near[window] = through <= best * (1.0 + margin)
    # A block's width of doubt on either side.
    near[1:] |= near[:-1].copy()
    near[:-1] |= near[1:].copy()
    near[:, 1:] |= near[:, :-1].copy()
    near[:, :-1] |= near[:, 1:].copy()
    return near


def _refined(near: BoolArray | None, block: int, finer: int, thin: Thin) -> BoolArray | None:
    """Return which of the finer map's blocks meet those chosen on the coarser one."""
    if near is None:
        return None
    rows, cols = thin.lower.shape
    # The middle of a finer block lies in one coarse block; the coarse choice is a block wider than needed.
    r = np.minimum((np.arange(rows) * finer + finer // 2) // block, near.shape[0] - 1)
    c = np.minimum((np.arange(cols) * finer + finer // 2) // block, near.shape[1] - 1)
    return near[np.ix_(r, c)]


def _spread(inside: BoolArray, block: int) -> BoolArray:
    return np.repeat(np.repeat(inside, block, axis=0), block, axis=1)


def _window(near: BoolArray, block: int, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of cells that hold all chosen blocks."""
    r, c = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    return (
        slice(int(r[0]) * block, min((int(r[-1]) + 1) * block, shape[0])),
        slice(int(c[0]) * block, min((int(c[-1]) + 1) * block, shape[1])),
    )


def _part(surface: Surface, window: tuple[slice, slice], inside: BoolArray | None) -> Surface:
    """Return a window of a surface with the ground outside the corridor barred."""
    barred = surface.barred[window].copy()
    if inside is not None:
        barred |= ~inside[: barred.shape[0], : barred.shape[1]]
    return Surface(
        surface.bottom_m[window], surface.lower_m[window], barred, surface.stack[window],
        surface.origin_m, surface.cell_m, surface.top_m, surface.limits, surface.terms,
    )  # fmt: skip
