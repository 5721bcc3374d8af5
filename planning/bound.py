"""A certified lower bound on the cost of any route.

Duality: any function u with ``u(start) = 0`` whose slope nowhere exceeds the cost density along any
motion is, at the goal, a lower bound on every path's cost, because a path cannot climb u faster than
it pays. The density is never below the local weight, whatever the altitude or pitch, so a function
that is linear on triangles and no steeper than the least weight near each triangle certifies. Such a
function comes from fast sweeping on a thinned map; whatever excess slope its discretisation leaves is
*measured on every triangle* and divided out, so that the certificate does not depend on the solver.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy import ndimage

from perception.records import FloatArray
from planning.surface import DRIFT_X, WEIGHT, Surface

_NODES = 40_000
_REPAIRS = 8


def lower_bound(surface: Surface, start: tuple[float, float], goal: tuple[float, float]) -> float:
    """Return a cost that no route from start to goal (easting, northing) can undercut."""
    ends = [surface.local(np.array(p[0]), np.array(p[1])) for p in (start, goal)]
    # No current carries faster than its strongest along the path.
    carried = 1.0
    if surface.drifts:
        carried = 1.0 / (1.0 + float(np.hypot(*surface.stack[..., DRIFT_X:].T).max()))
    return carried * _still_water_bound(surface, ends)


def _still_water_bound(surface: Surface, ends: list[tuple[FloatArray, FloatArray]]) -> float:
    straight = float(np.hypot(*(np.array(ends[1]) - np.array(ends[0]))))
    weights = surface.stack[..., WEIGHT]
    simple = straight * float(weights.min())
    if straight == 0.0 or (not surface.barred.any() and float(np.ptp(weights)) == 0.0):
        return simple
    density, node_m = _least_density(surface)
    return max(simple, _certified(density, node_m, ends))


def _least_density(surface: Surface) -> tuple[FloatArray, tuple[float, float]]:
    """Return the least weight around each thinned node, and the nodes' distances.

    The minimum is taken over every cell that a triangle at the node may touch. Barred ground is
    dear only where all of it is barred.
    """
    rows, cols = surface.shape
    block = max(1, math.ceil(math.sqrt(rows * cols / _NODES)))
    weight = surface.stack[..., WEIGHT].astype(float)
    dear = 20.0 * float(weight.max())
    density = np.where(surface.barred, dear, weight)
    # A square between nodes is passable if any corner's square is: a barred node alone bars nothing
    # within its neighbours' reach, so the minimum reaches one cell further than the block.
    least = ndimage.minimum_filter(density, size=2 * block + 3, mode="nearest")
    return (
        np.ascontiguousarray(least[::block, ::block]),
        (block * surface.cell_m[0], block * surface.cell_m[1]),
    )


def _certified(
    density: FloatArray, node_m: tuple[float, float], ends: list[tuple[FloatArray, FloatArray]]
) -> float:
    rows, cols = density.shape
    source = (
        min(round(float(ends[0][1]) / node_m[1]), rows - 1),
        min(round(float(ends[0][0]) / node_m[0]), cols - 1),
    )
    # A node's update leans on every triangle around it: it may ask for no more than the least of them.
    slowed = np.asarray(ndimage.minimum_filter(density, size=3, mode="nearest"))
    best = 0.0
    for _ in range(_REPAIRS):
        u = np.full(density.shape, np.inf)
        u[source] = 0.0
        _sweep(u, slowed, node_m[0], node_m[1])
        ratio = _excess(u, density, node_m[0], node_m[1])
        worst = float(ratio.max())
        at_goal = _linear(u, ends[1], node_m)
        at_start = _linear(u, ends[0], node_m)
        best = max(best, (at_goal - at_start) / max(worst, 1.0))
        if worst <= 1.002:
            break
        # Where it is too steep, ask for less next time; the rest keeps what it had.
        slowed = slowed / np.maximum(ratio, 1.0)
    return best


@njit(cache=True)
def _sweep(u, density, width, height):  # type: ignore[no-untyped-def]
    """Solve |grad u| = density by fast sweeping with the upwind (Godunov) scheme."""
    rows, cols = u.shape
    for _ in range(60):
        change = 0.0
        for order in range(4):
            for i in range(rows):
                r = i if order & 1 == 0 else rows - 1 - i
                for j in range(cols):
                    c = j if order & 2 == 0 else cols - 1 - j
                    a = np.inf
                    if c > 0:
                        a = u[r, c - 1]
                    if c + 1 < cols:
                        a = min(a, u[r, c + 1])
                    b = np.inf
                    if r > 0:
                        b = u[r - 1, c]
                    if r + 1 < rows:
                        b = min(b, u[r + 1, c])
                    f = density[r, c]
                    new = min(a + f * width, b + f * height)
                    if a < np.inf and b < np.inf:
                        p, q = 1.0 / (width * width), 1.0 / (height * height)
                        mean = (p * a + q * b) / (p + q)
                        root = (p + q) * f * f - p * q * (a - b) * (a - b)
                        if root > 0.0:
                            both = mean + math.sqrt(root) / (p + q)
                            if both >= max(a, b):
                                new = min(new, both)
                    if new < u[r, c]:
                        change = max(change, min(u[r, c] - new, 1e300))
                        u[r, c] = new
        if change < 1e-9:
            break


@njit(cache=True)
def _excess(u, density, width, height):  # type: ignore[no-untyped-def]
    """Return, per node, the greatest slope over density of the triangles that touch it."""
    rows, cols = u.shape
    ratio = np.zeros((rows, cols))
    for r in range(rows - 1):
        for c in range(cols - 1):
            u00, u01, u10, u11 = u[r, c], u[r, c + 1], u[r + 1, c], u[r + 1, c + 1]
            least = min(
                min(density[r, c], density[r, c + 1]), min(density[r + 1, c], density[r + 1, c + 1])
            )
            # The square's two triangles share the diagonal from (r, c) to (r + 1, c + 1).
            upper = math.hypot((u01 - u00) / width, (u11 - u01) / height)
            lower = math.hypot((u11 - u10) / width, (u10 - u00) / height)
            x = max(upper, lower) / least
            ratio[r, c] = max(ratio[r, c], x)
            ratio[r, c + 1] = max(ratio[r, c + 1], x)
            ratio[r + 1, c] = max(ratio[r + 1, c], x)
            ratio[r + 1, c + 1] = max(ratio[r + 1, c + 1], x)
    return ratio


def _linear(
    u: FloatArray, end: tuple[FloatArray, FloatArray], node_m: tuple[float, float]
) -> float:
    """Interpolate u on the same triangles; beyond the last nodes the edge's value holds."""
    rows, cols = u.shape
    x = min(max(float(end[0]) / node_m[0], 0.0), cols - 1.0)
    y = min(max(float(end[1]) / node_m[1], 0.0), rows - 1.0)
    c, r = min(int(x), cols - 2), min(int(y), rows - 2)
    fx, fy = x - c, y - r
    a, b, d, e = u[r, c], u[r, c + 1], u[r + 1, c], u[r + 1, c + 1]
    if fx >= fy:
        return float(a + fx * (b - a) + fy * (e - b))
    return float(a + fy * (d - a) + fx * (e - d))
