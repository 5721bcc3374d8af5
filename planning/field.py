"""The grid stage: shortest paths over the least height, limit-free, with 8, 16 or 32 neighbours.

It gives planning its yardstick (`grid_cost`), its first guide, and the first word on whether a way
exists at all. Buckets instead of a heap (`planning.buckets`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.records import FloatArray, IntArray
from planning.buckets import make_buckets, put, remove
from planning.currents import LEAST_GOOD, through_water
from planning.moves import crossings, neighbourhood
from planning.surface import DRIFT_X, DRIFT_Y, LOWER, WEIGHT, Surface


@dataclass(frozen=True, slots=True)
class Field:
    """Costs of the best grid paths from one node.

    Attributes
    ----------
    cost : (rows, cols) float32, infinite where not reached (or not needed).
    move : (rows, cols) int8 index of the move that led there, -1 none.
    moves : (n, 2) the moves.
    source : (row, col).
    """

    cost: FloatArray
    move: IntArray
    moves: IntArray
    source: tuple[int, int]

    def path(self, row: int, col: int) -> IntArray:
        """Return the (n, 2) nodes from the source to (row, col)."""
        nodes = [(row, col)]
        while (row, col) != self.source:
            r, c = self.moves[self.move[row, col]]
            row, col = row - int(r), col - int(c)
            nodes.append((row, col))
        return np.array(nodes[::-1])


def search(
    surface: Surface,
    source: tuple[int, int],
    target: tuple[int, int] | None = None,
    neighbours: int = 32,
) -> Field:
    """Search from `source` at the floor, without limits of pitch, turn or ceiling.

    An edge costs the integral of the weight over its length in space along the least heights, both
    linear between the grid lines that it crosses.

    Parameters
    ----------
    target : stop there, looking towards it first; None searches the whole map.
    neighbours : 8, 16 or 32.
    """
    moves, passed, first = neighbourhood(neighbours)
    cost, move = _search(
        surface.stack, surface.barred, surface.cell_m[0], surface.cell_m[1],
        moves, passed, first, *crossings(moves), source,
        target if target is not None else (-1, -1),
    )  # fmt: skip
    return Field(cost, move, moves, source)


@njit(cache=True)
def _edge_range(stack, barred, width, height, reach):  # type: ignore[no-untyped-def]
    """Return (least cost per metre, an upper bound of any edge's cost) over open ground."""
    rows, cols = barred.shape
    drifts = stack.shape[2] > DRIFT_X
    least_w, greatest_w, drop, drift = np.inf, 0.0, 0.0, 0.0
    for r in range(rows):
        for c in range(cols):
            if barred[r, c]:
                continue
            w, z = stack[r, c, WEIGHT], stack[r, c, LOWER]
            least_w, greatest_w = min(least_w, w), max(greatest_w, w)
            if r + 1 < rows and not barred[r + 1, c]:
                drop = max(drop, abs(stack[r + 1, c, LOWER] - z))
            if c + 1 < cols and not barred[r, c + 1]:
                drop = max(drop, abs(stack[r, c + 1, LOWER] - z))
            if drifts:
                drift = max(drift, math.hypot(stack[r, c, DRIFT_X], stack[r, c, DRIFT_Y]))
    run = reach * max(width, height) * 1.4143
    # Between grid lines an edge may climb and fall again: five pieces at most.
    greatest = greatest_w * math.hypot(run, 5.0 * reach * drop)
    if drifts:
        return least_w / (1.0 + drift), greatest / LEAST_GOOD
    return least_w, greatest


@njit(cache=True)
def _near_bars(barred, reach):  # type: ignore[no-untyped-def]
    """Return True where a move of `reach` cells may touch a barred node."""
    rows, cols = barred.shape
    across = np.zeros((rows, cols), np.bool_)
    for r in range(rows):
        last = -reach - 1
        for c in range(cols + reach):
            if c < cols and barred[r, c]:
                last = c
            if c >= reach and last >= c - 2 * reach:
                across[r, c - reach] = True
    near = np.zeros((rows, cols), np.bool_)
    last_of = np.full(cols, -reach - 1)
    for r in range(rows + reach):
        for c in range(cols):
            if r < rows and across[r, c]:
                last_of[c] = r
            if r >= reach and last_of[c] >= r - 2 * reach:
                near[r - reach, c] = True
    return near


@njit(cache=True)
def _edge(stack, r, c, rr, cc, nodes, parts, begin, end, run2):  # type: ignore[no-untyped-def]
    """Integrate the weight over the length in space of one straight move, piece by piece."""
    edge, t0, w0, z0 = 0.0, 0.0, stack[r, c, WEIGHT], stack[r, c, LOWER]
    for k in range(begin, end):
        r1, c1, r2, c2 = r + nodes[k, 0], c + nodes[k, 1], r + nodes[k, 2], c + nodes[k, 3]
        share, t1 = parts[k, 0], parts[k, 1]
        w1 = stack[r1, c1, WEIGHT] + share * (stack[r2, c2, WEIGHT] - stack[r1, c1, WEIGHT])
        z1 = stack[r1, c1, LOWER] + share * (stack[r2, c2, LOWER] - stack[r1, c1, LOWER])
        edge += 0.5 * (w0 + w1) * math.sqrt((t1 - t0) * (t1 - t0) * run2 + (z1 - z0) * (z1 - z0))
        t0, w0, z0 = t1, w1, z1
    w1, z1 = stack[rr, cc, WEIGHT], stack[rr, cc, LOWER]
    flat2 = (1.0 - t0) * (1.0 - t0) * run2
    return edge + 0.5 * (w0 + w1) * math.sqrt(flat2 + (z1 - z0) * (z1 - z0))


@njit(cache=True)
def drift_between(stack, r, c, rr, cc, width, height):  # type: ignore[no-untyped-def]
    """Return metres of water per metre of ground of a move between two nodes."""
    ux = 0.5 * (stack[r, c, DRIFT_X] + stack[rr, cc, DRIFT_X])
    uy = 0.5 * (stack[r, c, DRIFT_Y] + stack[rr, cc, DRIFT_Y])
    return through_water((cc - c) * width, (rr - r) * height, ux, uy)


@njit(cache=True)
def clear_of(barred, r, c, passed, begin, end):  # type: ignore[no-untyped-def]
    """Return whether a move from (r, c) passes between open nodes only."""
    for k in range(begin, end):  # noqa: SIM110  (numba knows no generator)
        if barred[r + passed[k, 0], c + passed[k, 1]]:
            return False
    return True


@njit(cache=True, nogil=True)
def _search(  # type: ignore[no-untyped-def]
    stack, barred, width, height, moves, passed, first, nodes, parts, cut, source, target
):
    rows, cols = barred.shape
    cost = np.full((rows, cols), np.inf, np.float32)
    move = np.full((rows, cols), -1, np.int8)
    if barred[source[0], source[1]]:
        return cost, move
    reach = np.abs(moves).max()
    least_w, greatest = _edge_range(stack, barred, width, height, reach)
    bucket_width = least_w * min(width, height)
    aimed = target[0] >= 0
    base = 0.0
    if aimed:
        # Keys that hold an estimate of what is left grow by as little as nothing along an edge: a node
        # may be taken again from its own bucket, and thin buckets keep that rare.
        bucket_width *= 0.05
        away = math.hypot((source[0] - target[0]) * height, (source[1] - target[1]) * width)
        base = least_w * away
    n_buckets = int(min(2.0 * greatest / bucket_width + 3.0, 4.0e6))
    near = _near_bars(barred, reach)
    run2 = (moves[:, 0] * height) ** 2 + (moves[:, 1] * width) ** 2
    drifts = stack.shape[2] > DRIFT_X
    queue = make_buckets(rows * cols, n_buckets)
    cost[source[0], source[1]] = 0.0
    waiting = put(queue, source[0] * cols + source[1], 0)
    current = 0
    while waiting > 0:
        node = queue[1][current % n_buckets]
        if node < 0:
            if aimed and cost[target[0], target[1]] - base < current * bucket_width:
                break
            current += 1
            continue
        remove(queue, node)
        waiting -= 1
        r, c = node // cols, node % cols
        here = cost[r, c]
        for m in range(len(moves)):
            rr, cc = r + moves[m, 0], c + moves[m, 1]
            if rr < 0 or cc < 0 or rr >= rows or cc >= cols or barred[rr, cc]:
                continue
            # Most neighbours are settled: no edge is cheaper than its run over the best ground.
            if here + least_w * math.sqrt(run2[m]) >= cost[rr, cc]:
                continue
            edge = _edge(stack, r, c, rr, cc, nodes, parts, cut[m], cut[m + 1], run2[m])
            if drifts:
                edge *= drift_between(stack, r, c, rr, cc, width, height)
            there = np.float32(here + edge)
            if there >= cost[rr, cc]:
                continue
            if near[r, c] and not clear_of(barred, r, c, passed, first[m], first[m + 1]):
                continue
            cost[rr, cc] = there
            move[rr, cc] = m
            key = there - base
            if aimed:
                left = math.hypot((rr - target[0]) * height, (cc - target[1]) * width)
                key += least_w * left
            bucket = min(max(current, int(key / bucket_width)), current + n_buckets - 1)
            waiting += put(queue, rr * cols + cc, bucket % n_buckets)
    return cost, move
