"""The grid stage: shortest paths over the least height, limit-free, with 8, 16 or 32 neighbours.

It gives planning its yardstick (`grid_cost`), its first guide, and the first word on whether a way
exists at all. Buckets instead of a heap: with buckets no wider than the shortest edge, everything in
the lowest bucket is final, so the search is linear in the number of edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.records import FloatArray, IntArray
from planning.surface import LOWER, WEIGHT, Surface

_RINGS = {
    8: ((0, 1), (1, 1)),
    16: ((0, 1), (1, 1), (1, 2)),
    32: ((0, 1), (1, 1), (1, 2), (1, 3), (2, 3)),
}


def neighbourhood(n: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return moves (n, 2) as (row, col) and the nodes that each move passes between.

    Returns
    -------
    moves : (n, 2).
    passed : (m, 2) nodes whose squares the moves cross, move by move.
    first : (n + 1,) start of each move's nodes in `passed`.
    """
    moves: list[tuple[int, int]] = []
    for a, b in _RINGS[n]:
        for r, c in {(a, b), (b, a)}:
            moves += sorted({(r, c), (-r, c), (r, -c), (-r, -c)})
    passed: list[tuple[int, int]] = []
    first = [0]
    for r, c in moves:
        passed += _squares(r, c)
        first.append(len(passed))
    return np.array(moves), np.array(passed or [(0, 0)]), np.array(first)


def crossings(moves: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Return where each straight move crosses grid lines between its ends.

    Without them a knight's move would average its two ends and not see the ground it passes: on patchy
    weights that undercuts the true integral by ten per cent and more.

    Returns
    -------
    nodes : (m, 4) the two nodes (row, col, row, col) beside each crossing.
    parts : (m, 2) share of the second node, and the crossing's place along the move in (0, 1).
    first : (n + 1,) start of each move's crossings.
    """
    nodes: list[tuple[int, int, int, int]] = []
    parts: list[tuple[float, float]] = []
    first = [0]
    for r, c in moves:
        places = {k / abs(int(n)) for n in (r, c) if n for k in range(1, abs(int(n)))}
        for t in sorted(places):
            y, x = round(t * int(r), 9), round(t * int(c), 9)
            i, j = math.floor(y), math.floor(x)
            on_row = y == i
            nodes.append((i, j, i, j + 1) if on_row else (i, j, i + 1, j))
            parts.append((x - j if on_row else y - i, t))
        first.append(len(nodes))
    return (
        np.array(nodes or [(0, 0, 0, 0)]),
        np.array(parts or [(0.0, 0.0)]),
        np.array(first),
    )


def _squares(r: int, c: int) -> list[tuple[int, int]]:
    """Return the nodes, ends apart, whose bilinear squares the straight move (r, c) crosses."""
    nodes: set[tuple[int, int]] = set()
    steps = 12 * max(abs(r), abs(c))
    for k in range(1, steps):
        y, x = r * k / steps, c * k / steps
        for i in {math.floor(y), math.ceil(y)}:
            for j in {math.floor(x), math.ceil(x)}:
                nodes.add((i, j))
    return sorted(nodes - {(0, 0), (r, c)})


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
def _unlink(node, bucket_of, head, after, before):  # type: ignore[no-untyped-def]
    p, q = before[node], after[node]
    if p >= 0:
        after[p] = q
    else:
        head[bucket_of[node]] = q
    if q >= 0:
        before[q] = p


@njit(cache=True)
def _link(node, bucket, bucket_of, head, after, before):  # type: ignore[no-untyped-def]
    bucket_of[node] = bucket
    old = head[bucket]
    after[node], before[node] = old, -1
    if old >= 0:
        before[old] = node
    head[bucket] = node


@njit(cache=True)
def _greatest_edge(stack, width, height, reach):  # type: ignore[no-untyped-def]
    """Return (least weight, an upper bound of any edge's cost)."""
    rows, cols = stack.shape[0], stack.shape[1]
    least_w, greatest_w, drop = np.inf, 0.0, 0.0
    for r in range(rows):
        for c in range(cols):
            w = stack[r, c, WEIGHT]
            least_w, greatest_w = min(least_w, w), max(greatest_w, w)
            if r + 1 < rows:
                drop = max(drop, abs(stack[r + 1, c, LOWER] - stack[r, c, LOWER]))
            if c + 1 < cols:
                drop = max(drop, abs(stack[r, c + 1, LOWER] - stack[r, c, LOWER]))
    run = reach * max(width, height) * 1.4143
    # Between grid lines an edge may climb and fall again: five pieces at most.
    return least_w, greatest_w * math.hypot(run, 5.0 * reach * drop)


@njit(cache=True)
def _near_bars(barred, reach):  # type: ignore[no-untyped-def]
    """Return True where a move of `reach` cells may touch a barred node."""
    rows, cols = barred.shape
    near = np.zeros((rows, cols), np.bool_)
    for r in range(rows):
        for c in range(cols):
            if barred[r, c]:
                near[
                    max(0, r - reach) : min(rows, r + reach + 1),
                    max(0, c - reach) : min(cols, c + reach + 1),
                ] = True
    return near


@njit(cache=True, nogil=True)
def _search(  # type: ignore[no-untyped-def]
    stack, barred, width, height, moves, passed, first, nodes, parts, cut, source, target
):
    rows, cols = barred.shape
    reach = 0
    for m in range(len(moves)):
        reach = max(reach, abs(moves[m, 0]), abs(moves[m, 1]))
    least_w, greatest = _greatest_edge(stack, width, height, reach)
    bucket_width = least_w * min(width, height)
    aimed = target[0] >= 0
    if aimed:
        # Keys that hold an estimate of what is left grow by as little as nothing along an edge: a node
        # may be taken again from its own bucket, and thin buckets keep that rare.
        bucket_width *= 0.05
    n_buckets = int(min(2.0 * greatest / bucket_width + 3.0, 4.0e6))
    near = _near_bars(barred, reach)
    run = np.empty(len(moves))
    for m in range(len(moves)):
        run[m] = (moves[m, 0] * height) ** 2 + (moves[m, 1] * width) ** 2

    cost = np.full((rows, cols), np.inf, np.float32)
    move = np.full((rows, cols), -1, np.int8)
    after = np.empty(rows * cols, np.int32)
    before = np.empty(rows * cols, np.int32)
    bucket_of = np.full(rows * cols, -1, np.int32)
    head = np.full(n_buckets, -1, np.int32)
    if barred[source[0], source[1]]:
        return cost, move
    cost[source[0], source[1]] = 0.0
    _link(source[0] * cols + source[1], 0, bucket_of, head, after, before)
    current, waiting, base = 0, 1, 0.0
    if aimed:
        base = least_w * math.hypot(
            (source[0] - target[0]) * height, (source[1] - target[1]) * width
        )
    while waiting > 0:
        slot = current % n_buckets
        node = head[slot]
        if node < 0:
            if aimed and cost[target[0], target[1]] - base < current * bucket_width:
                break
            current += 1
            continue
        _unlink(node, bucket_of, head, after, before)
        bucket_of[node] = -1
        waiting -= 1
        r, c = node // cols, node % cols
        here, z, w = cost[r, c], stack[r, c, LOWER], stack[r, c, WEIGHT]
        check = near[r, c]
        for m in range(len(moves)):
            rr, cc = r + moves[m, 0], c + moves[m, 1]
            if rr < 0 or cc < 0 or rr >= rows or cc >= cols or barred[rr, cc]:
                continue
            # Most neighbours are settled: no edge is shorter than its run over the best ground.
            if here + least_w * math.sqrt(run[m]) >= cost[rr, cc]:
                continue
            edge, t0, w0, z0 = 0.0, 0.0, w, z
            for k in range(cut[m], cut[m + 1]):
                a = stack[r + nodes[k, 0], c + nodes[k, 1]]
                b = stack[r + nodes[k, 2], c + nodes[k, 3]]
                share, t1 = parts[k, 0], parts[k, 1]
                w1 = a[WEIGHT] + share * (b[WEIGHT] - a[WEIGHT])
                z1 = a[LOWER] + share * (b[LOWER] - a[LOWER])
                flat = (t1 - t0) * (t1 - t0) * run[m]
                edge += 0.5 * (w0 + w1) * math.sqrt(flat + (z1 - z0) * (z1 - z0))
                t0, w0, z0 = t1, w1, z1
            w1, z1 = stack[rr, cc, WEIGHT], stack[rr, cc, LOWER]
            flat = (1.0 - t0) * (1.0 - t0) * run[m]
            edge += 0.5 * (w0 + w1) * math.sqrt(flat + (z1 - z0) * (z1 - z0))
            there = np.float32(here + edge)
            if there >= cost[rr, cc]:
                continue
            if check:
                free = True
                for k in range(first[m], first[m + 1]):
                    if barred[r + passed[k, 0], c + passed[k, 1]]:
                        free = False
                        break
                if not free:
                    continue
            cost[rr, cc] = there
            move[rr, cc] = m
            key = there
            if aimed:
                key = (
                    there
                    - base
                    + least_w * math.hypot((rr - target[0]) * height, (cc - target[1]) * width)
                )
            bucket = max(current, int(key / bucket_width))
            bucket = min(bucket, current + n_buckets - 1) % n_buckets
            other = rr * cols + cc
            if bucket_of[other] >= 0:
                if bucket_of[other] == bucket:
                    continue
                _unlink(other, bucket_of, head, after, before)
            else:
                waiting += 1
            _link(other, bucket, bucket_of, head, after, before)
    return cost, move
