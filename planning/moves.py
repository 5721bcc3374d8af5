"""Moves between grid nodes: where they go, what they pass, where they cross grid lines."""

from __future__ import annotations

import math

import numpy as np

from perception.records import FloatArray, IntArray

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
