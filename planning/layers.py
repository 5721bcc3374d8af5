"""The second guide: a grid search in place *and* altitude that knows pitch and ceiling.

At the floor every wall can be climbed; a vehicle of limited pitch must begin to climb before the wall,
and the ceiling says how much before. States are (row, column, level of altitude above the least
height) on a thinned map; an edge is allowed if its climb or dive is. The path is a guide: what it
promises is made good, or not, by the polish and the proof at full resolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.records import FloatArray
from planning.buckets import make_buckets, put, remove
from planning.field import clear_of, drift_between
from planning.moves import neighbourhood
from planning.surface import BOTTOM, DRIFT_X, LOWER, WEIGHT, Surface
from planning.thinning import NODES, cost_to_go, thinned

# Height of a level as a share of the climb over one thinned cell at the steeper pitch limit: coarse
# levels waste climb in rounding, fine ones waste time.
_LEVEL_SHARE = 0.33
# The floor-following cost to go overrates stretches that fly level over rough ground.
_TRUST = 0.97


@dataclass(frozen=True, slots=True)
class LayeredPath:
    """A guide found in place and altitude.

    Attributes
    ----------
    points : (n, 2) local coordinates of the path; empty where there is none.
    cost : of the search, in the units of the route's cost.
    excess_m : (n,) by how much the path breaks ceiling or pitch per edge; zero unless `soft`.
    """

    points: FloatArray
    cost: float
    excess_m: FloatArray


def layered_path(
    surface: Surface,
    start: tuple[float, float],
    goal: tuple[float, float],
    soft: bool = False,
    nodes: int = NODES,
) -> LayeredPath:
    """Search for a path that keeps pitch and ceiling, on a thinned map.

    Parameters
    ----------
    start, goal : local coordinates.
    soft : allow breaches of ceiling at a price that only a path without alternative pays: the
        place where it pays is the place that blocks.
    nodes : of the thinned map, about.
    """
    thin = thinned(surface, nodes)
    a, b = thin.node(start), thin.node(goal)
    thin.barred[a] = thin.barred[b] = False
    to_go = cost_to_go(thin, b)
    limits = surface.limits
    move_m = max(thin.cell_m)
    slope = min(limits.slope_up, limits.slope_down)
    band = limits.ceiling_m - limits.floor_m
    level = float(np.clip(_LEVEL_SHARE * slope * move_m, band / 40.0, band / 8.0))
    n_levels = int(band / level) + 1
    soft_levels = 4 * n_levels if soft else 0
    rules = np.array(
        [level, n_levels + soft_levels, limits.slope_up, limits.slope_down,
         surface.terms.altitude_per_m, limits.floor_m, float(soft)]
    )  # fmt: skip
    states, cost = _search_levels(
        thin.stack, thin.upper, thin.barred, to_go * _TRUST, *thin.cell_m, *neighbourhood(16), a, b,
        rules,
    )  # fmt: skip
    if len(states) == 0:
        return LayeredPath(np.zeros((0, 2)), math.inf, np.zeros(0))
    at, levels = states[:, :2], states[:, 2]
    points = np.column_stack([at[:, 1] * thin.cell_m[0], at[:, 0] * thin.cell_m[1]])
    points += thin.shift_m
    points[0], points[-1] = start, goal
    height = thin.lower[at[:, 0], at[:, 1]] + levels * level
    excess = np.maximum(0.0, height - thin.upper[at[:, 0], at[:, 1]])
    return LayeredPath(points, float(cost), excess)


# Price per metre of path and metre above the ceiling in a soft search.
_SOFT_PRICE = 100.0
# Buckets of the search: as wide as a tenth of the shortest edge at weight 1.
_BUCKETS, _BUCKET_SHARE = 200_000, 0.1
# What rounding a climb to whole levels may add to it.
_ROUNDING = 0.34


@njit(cache=True)
def _levels_reached(rules, room, run, rise, q):  # type: ignore[no-untyped-def]
    """Return (least, most) level that a move reaches from level q within pitch and ceiling."""
    level, n_levels, up, down, soft = rules[0], int(rules[1]), rules[2], rules[3], rules[6] > 0
    least = math.ceil(q + (-down * run - rise) / level - _ROUNDING)
    most = math.floor(q + (up * run - rise) / level + _ROUNDING)
    highest = n_levels - 1 if soft else min(n_levels - 1, math.floor(room / level))
    return max(0, least), min(most, highest)


@njit(cache=True)
def _rate(stack, upper, r, c, rr, cc, q, p, rules):  # type: ignore[no-untyped-def]
    """Return the cost per metre of a move from level q to level p, breaches of the ceiling priced."""
    level, price, floor, soft = rules[0], rules[4], rules[5], rules[6] > 0
    above = stack[r, c, LOWER] - stack[r, c, BOTTOM] + stack[rr, cc, LOWER] - stack[rr, cc, BOTTOM]
    w = 0.5 * (stack[r, c, WEIGHT] + stack[rr, cc, WEIGHT])
    rate = w + price * (0.5 * (above + (p + q) * level) - floor)
    if soft:
        over = max(0.0, stack[r, c, LOWER] + q * level - upper[r, c])
        over += max(0.0, stack[rr, cc, LOWER] + p * level - upper[rr, cc])
        rate += _SOFT_PRICE * 0.5 * over
    return rate


@njit(cache=True)
def _traced(parent, node, cols, n_levels):  # type: ignore[no-untyped-def]
    """Return the (n, 3) row, column and level from the start to a node."""
    count, at = 0, node
    while at >= 0:
        count += 1
        at = parent[at]
    states = np.empty((count, 3), np.int64)
    for i in range(count - 1, -1, -1):
        cell = node // n_levels
        states[i, 0], states[i, 1], states[i, 2] = cell // cols, cell % cols, node % n_levels
        node = parent[node]
    return states


@njit(cache=True, nogil=True)
def _search_levels(  # type: ignore[no-untyped-def]
    stack, upper, barred, to_go, width, height, moves, passed, first, a, b, rules
):
    """Best-first search over (row, col, level), label-correcting within thin buckets.

    rules : level, number of levels, slopes up and down, price of altitude, floor, 1 for soft.
    """
    rows, cols = barred.shape
    level, n_levels = rules[0], int(rules[1])
    n = rows * cols * n_levels
    base = to_go[a[0], a[1]]
    if not np.isfinite(base):
        return np.zeros((0, 3), np.int64), np.inf
    cost = np.full(n, np.inf, np.float32)
    parent = np.full(n, -1, np.int32)
    queue = make_buckets(n, _BUCKETS)
    run = np.sqrt((moves[:, 0] * height) ** 2 + (moves[:, 1] * width) ** 2)
    bucket_width = _BUCKET_SHARE * min(width, height)
    drifts = stack.shape[2] > DRIFT_X
    waiting, current = 0, 0
    for q in range(n_levels):
        if q == 0 or stack[a[0], a[1], LOWER] + q * level <= upper[a[0], a[1]]:
            node = (a[0] * cols + a[1]) * n_levels + q
            cost[node] = 0.0
            waiting += put(queue, node, 0)
    best, best_cost = -1, np.inf
    while waiting > 0:
        node = queue[1][current % _BUCKETS]
        if node < 0:
            current += 1
            if best_cost - base < current * bucket_width:
                break
            continue
        remove(queue, node)
        waiting -= 1
        q, cell = node % n_levels, node // n_levels
        r, c = cell // cols, cell % cols
        here = cost[node]
        if r == b[0] and c == b[1]:
            if here < best_cost:
                best, best_cost = node, here
            continue
        for m in range(len(moves)):
            rr, cc = r + moves[m, 0], c + moves[m, 1]
            if rr < 0 or cc < 0 or rr >= rows or cc >= cols or barred[rr, cc]:
                continue
            go = to_go[rr, cc]
            if not np.isfinite(go) or not clear_of(barred, r, c, passed, first[m], first[m + 1]):
                continue
            rise = stack[rr, cc, LOWER] - stack[r, c, LOWER]
            room = upper[rr, cc] - stack[rr, cc, LOWER]
            least, most = _levels_reached(rules, room, run[m], rise, q)
            water = drift_between(stack, r, c, rr, cc, width, height) if drifts else 1.0
            for p in range(least, most + 1):
                dz = rise + (p - q) * level
                length = water * math.sqrt(run[m] * run[m] + dz * dz)
                there = np.float32(here + _rate(stack, upper, r, c, rr, cc, q, p, rules) * length)
                other = (rr * cols + cc) * n_levels + p
                if there >= cost[other]:
                    continue
                cost[other] = there
                parent[other] = node
                bucket = max(current, int((there + go - base) / bucket_width))
                bucket = min(bucket, current + _BUCKETS - 1)
                waiting += put(queue, other, bucket % _BUCKETS)
    if best < 0:
        return np.zeros((0, 3), np.int64), np.inf
    return _traced(parent, best, cols, n_levels), best_cost
