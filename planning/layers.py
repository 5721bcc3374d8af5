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
from scipy import ndimage

from perception.records import BoolArray, FloatArray
from planning.field import neighbourhood, search
from planning.surface import BOTTOM, LOWER, WEIGHT, Surface

# Nodes of the thinned map, about; the search's time goes with it.
_NODES = 90_000
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
    nodes: int = _NODES,
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
    moves, passed, first = neighbourhood(16)
    states, cost = _search_levels(
        thin.lower, thin.bottom, thin.upper, thin.weight, thin.barred, to_go * _TRUST,
        thin.cell_m[0], thin.cell_m[1], moves, passed, first, a, b, level, n_levels + soft_levels,
        limits.slope_up, limits.slope_down, surface.terms.altitude_per_m, limits.floor_m,
        soft_levels > 0,
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


@dataclass(frozen=True, slots=True)
class Thin:
    """The thinned map; nodes lie at `shift_m` plus multiples of `cell_m`."""

    lower: FloatArray
    bottom: FloatArray
    upper: FloatArray
    weight: FloatArray
    barred: BoolArray
    stack: FloatArray
    cell_m: tuple[float, float]
    shift_m: FloatArray
    surface: Surface

    def node(self, point: tuple[float, float]) -> tuple[int, int]:
        """Return the node nearest to a local position."""
        rows, cols = self.lower.shape
        col = round((point[0] - self.shift_m[0]) / self.cell_m[0])
        row = round((point[1] - self.shift_m[1]) / self.cell_m[1])
        return min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)


def thinned(surface: Surface, nodes: int = _NODES) -> Thin:
    """Return the map thinned to about so many nodes: means of blocks, barred if half is."""
    rows, cols = surface.shape
    block = max(1, math.ceil(math.sqrt(rows * cols / nodes)))
    lower = np.maximum(_blocks(surface.stack[..., LOWER], block), surface.bottom_most_m)
    bottom = _blocks(surface.stack[..., BOTTOM], block)
    weight = _blocks(surface.stack[..., WEIGHT], block)
    # A thin wall must not leak in the mean: any line of barred cells that parts the block bars it.
    barred = _blocks(_walls(surface.barred, block).astype(np.float32), block) > 0.5 / block
    if block == 1:
        barred = surface.barred.copy()
    upper = np.minimum(bottom + surface.limits.ceiling_m, surface.top_m)
    stack = np.stack([lower, bottom, weight, np.zeros_like(lower)], axis=-1).astype(np.float32)
    cell = (block * surface.cell_m[0], block * surface.cell_m[1])
    shift = 0.5 * (block - 1) * np.array(surface.cell_m)
    return Thin(lower, bottom, upper, weight, barred, stack, cell, shift, surface)


@njit(cache=True)
def _blocks(values, block):  # type: ignore[no-untyped-def]
    """Return means of block x block cells; the last row and column of blocks may be partial."""
    rows, cols = values.shape
    out = np.empty((-(-rows // block), -(-cols // block)))
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total, n = 0.0, 0
            for r in range(i * block, min((i + 1) * block, rows)):
                for c in range(j * block, min((j + 1) * block, cols)):
                    total += values[r, c]
                    n += 1
            out[i, j] = total / n
    return out


def _walls(barred: BoolArray, block: int) -> BoolArray:
    if block == 1 or not barred.any():
        return barred
    return np.asarray(ndimage.binary_closing(barred, iterations=1) | barred)


def cost_to_go(thin: Thin, goal: tuple[int, int]) -> FloatArray:
    """Return the limit-free cost from every thinned node to the goal."""
    return search(thin_surface(thin), goal, None, 16).cost


def thin_surface(thin: Thin) -> Surface:
    """Return the thinned map as a surface of its own, its first node at the origin."""
    return Surface(
        bottom_m=thin.bottom, lower_m=thin.lower, barred=thin.barred, stack=thin.stack,
        origin_m=(0.0, 0.0), cell_m=thin.cell_m, top_m=thin.surface.top_m,
        limits=thin.surface.limits, terms=thin.surface.terms,
    )  # fmt: skip


# Price per metre of path and metre above the ceiling in a soft search.
_SOFT_PRICE = 100.0


@njit(cache=True, nogil=True)
def _search_levels(  # type: ignore[no-untyped-def]
    lower,
    bottom,
    upper,
    weight,
    barred,
    to_go,
    width,
    height,
    moves,
    passed,
    first,
    a,
    b,
    level,
    n_levels,
    up,
    down,
    price,
    floor,
    soft,
):
    """Best-first search over (row, col, level), label-correcting within thin buckets."""
    rows, cols = lower.shape
    n = rows * cols * n_levels
    nothing = np.zeros((0, 3), np.int64)
    if not np.isfinite(to_go[a[0], a[1]]):
        return nothing, np.inf
    cost = np.full(n, np.inf, np.float32)
    parent = np.full(n, -1, np.int32)
    after = np.full(n, -1, np.int32)
    before = np.full(n, -1, np.int32)
    bucket_of = np.full(n, -1, np.int32)
    run = np.empty(len(moves))
    for m in range(len(moves)):
        run[m] = math.hypot(moves[m, 0] * height, moves[m, 1] * width)
    bucket_width = 0.1 * min(width, height)
    n_buckets = 200_000
    head = np.full(n_buckets, -1, np.int32)
    base = to_go[a[0], a[1]]
    waiting = 0
    for q in range(n_levels):
        if lower[a[0], a[1]] + q * level <= upper[a[0], a[1]] or q == 0:
            node = (a[0] * cols + a[1]) * n_levels + q
            cost[node] = 0.0
            after[node], before[node] = head[0], -1
            if head[0] >= 0:
                before[head[0]] = node
            head[0] = node
            bucket_of[node] = 0
            waiting += 1
    current = 0
    best, best_cost = -1, np.inf
    while waiting > 0:
        slot = current % n_buckets
        node = head[slot]
        if node < 0:
            current += 1
            if best_cost - base < current * bucket_width:
                break
            continue
        q_next = after[node]
        head[slot] = q_next
        if q_next >= 0:
            before[q_next] = -1
        bucket_of[node] = -1
        waiting -= 1
        q = node % n_levels
        cell = node // n_levels
        r, c = cell // cols, cell % cols
        here = cost[node]
        if r == b[0] and c == b[1]:
            if here < best_cost:
                best, best_cost = node, here
            continue
        lo = lower[r, c]
        above_floor = lo - bottom[r, c] - floor
        over = max(0.0, lo + q * level - upper[r, c])
        for m in range(len(moves)):
            rr, cc = r + moves[m, 0], c + moves[m, 1]
            if rr < 0 or cc < 0 or rr >= rows or cc >= cols or barred[rr, cc]:
                continue
            go = to_go[rr, cc]
            if not np.isfinite(go):
                continue
            free = True
            for k in range(first[m], first[m + 1]):
                if barred[r + passed[k, 0], c + passed[k, 1]]:
                    free = False
                    break
            if not free:
                continue
            rise = lower[rr, cc] - lo
            least = math.ceil(q + (-down * run[m] - rise) / level - 0.34)
            most = math.floor(q + (up * run[m] - rise) / level + 0.34)
            room = math.floor((upper[rr, cc] - lower[rr, cc]) / level)
            if soft:
                room = n_levels - 1
            least, most = max(0, least), min(most, min(room, n_levels - 1))
            other_floor = lower[rr, cc] - bottom[rr, cc] - floor
            w = 0.5 * (weight[r, c] + weight[rr, cc])
            for p in range(least, most + 1):
                dz = rise + (p - q) * level
                length = math.sqrt(run[m] * run[m] + dz * dz)
                rate = w + price * 0.5 * (above_floor + other_floor + (p + q) * level)
                if soft:
                    there_over = max(0.0, lower[rr, cc] + p * level - upper[rr, cc])
                    rate += _SOFT_PRICE * 0.5 * (over + there_over)
                there = np.float32(here + rate * length)
                other = (rr * cols + cc) * n_levels + p
                if there >= cost[other]:
                    continue
                cost[other] = there
                parent[other] = node
                key = there + go - base
                bucket = max(current, int(key / bucket_width))
                bucket = min(bucket, current + n_buckets - 1) % n_buckets
                if bucket_of[other] >= 0:
                    if bucket_of[other] == bucket:
                        continue
                    p0, p1 = before[other], after[other]
                    if p0 >= 0:
                        after[p0] = p1
                    else:
                        head[bucket_of[other]] = p1
                    if p1 >= 0:
                        before[p1] = p0
                else:
                    waiting += 1
                bucket_of[other] = bucket
                old = head[bucket]
                after[other], before[other] = old, -1
                if old >= 0:
                    before[old] = other
                head[bucket] = other
    if best < 0:
        return nothing, np.inf
    count, node = 0, best
    while node >= 0:
        count += 1
        node = parent[node]
    states = np.empty((count, 3), np.int64)
    node = best
    for i in range(count - 1, -1, -1):
        cell = node // n_levels
        states[i, 0], states[i, 1], states[i, 2] = cell // cols, cell % cols, node % n_levels
        node = parent[node]
    return states, best_cost
