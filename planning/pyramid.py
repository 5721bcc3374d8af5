"""The grid stage on large maps: a corridor from a thinned map, then the full search inside it.

Thinned costs to and from every node tell which ground can lie on a path within some per cent of the
best; the search at full resolution looks at that ground only. Where it finds no way there (a gap or a
wall that the thinned map does not show), it looks everywhere.
"""

from __future__ import annotations

import numpy as np

from perception.records import IntArray
from planning.field import search
from planning.layers import thin_surface, thinned
from planning.surface import Surface

# Cells from which the corridor pays.
_WHOLE_CELLS = 1_500_000
# Nodes of the thinned map, and what a path may cost beyond the thinned best to be looked at.
_NODES, _MARGIN = 160_000, 0.02


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
    thin = thinned(surface, _NODES)
    rough = thin_surface(thin)
    block = round(thin.cell_m[0] / surface.cell_m[0])
    rows, cols = rough.shape
    a, b = (
        (min(node[0] // block, rows - 1), min(node[1] // block, cols - 1))
        for node in (source, target)
    )
    rough.barred[a] = rough.barred[b] = False
    through = search(rough, a, None, 16).cost + search(rough, b, None, 16).cost
    best = float(through.min())
    if not np.isfinite(best):
        return None
    near = through <= best * (1.0 + _MARGIN)
    # A block's width of doubt on either side.
    near[1:] |= near[:-1].copy()
    near[:-1] |= near[1:].copy()
    near[:, 1:] |= near[:, :-1].copy()
    near[:, :-1] |= near[:, 1:].copy()
    r, c = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    r0, r1 = int(r[0]) * block, min((int(r[-1]) + 1) * block, surface.shape[0])
    c0, c1 = int(c[0]) * block, min((int(c[-1]) + 1) * block, surface.shape[1])
    inside = near[r[0] : r[-1] + 1, c[0] : c[-1] + 1]
    outside = ~np.repeat(np.repeat(inside, block, axis=0), block, axis=1)[: r1 - r0, : c1 - c0]
    window = (slice(r0, r1), slice(c0, c1))
    part = Surface(
        surface.bottom_m[window], surface.lower_m[window], surface.barred[window] | outside,
        surface.stack[window], surface.origin_m, surface.cell_m, surface.top_m, surface.limits,
        surface.terms,
    )  # fmt: skip
    shift = np.array([r0, c0])
    start, goal = (source[0] - r0, source[1] - c0), (target[0] - r0, target[1] - c0)
    field = search(part, start, goal, neighbours)
    cost = float(field.cost[goal])
    if not np.isfinite(cost):
        return None
    return cost, field.path(*goal) + shift
