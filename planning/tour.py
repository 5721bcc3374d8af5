"""Missions with several goals: the order that costs least, exactly up to a dozen, by exchanges beyond."""

from __future__ import annotations

import itertools

import numpy as np

from perception.records import FloatArray
from planning.field import search
from planning.surface import Surface

# Held and Karp's table has n 2^n entries: a dozen takes well under a second.
_EXACT = 11


def leg_costs(surface: Surface, nodes: list[tuple[int, int]]) -> FloatArray:
    """Return (n, n) costs of the limit-free grid paths between nodes; infinite where none."""
    out = np.zeros((len(nodes), len(nodes)))
    for i, node in enumerate(nodes):
        field = search(surface, node)
        for j, other in enumerate(nodes):
            out[i, j] = float(field.cost[other])
    return out


def best_order(cost: FloatArray) -> list[int]:
    """Return the cheapest order of nodes that begins with the first and ends with the last.

    Parameters
    ----------
    cost : (n, n) cost of going from row to column.
    """
    n = len(cost)
    if n <= 3:
        return list(range(n))
    if n - 2 <= _EXACT:
        return _held_karp(cost)
    return _exchanges(cost)


def _held_karp(cost: FloatArray) -> list[int]:
    n = len(cost)
    inner = range(1, n - 1)
    best: dict[tuple[int, int], tuple[float, int]] = {
        (1 << i, i): (float(cost[0, i]), 0) for i in inner
    }
    for size in range(2, n - 1):
        for chosen in itertools.combinations(inner, size):
            mask = sum(1 << i for i in chosen)
            for last in chosen:
                rest = mask & ~(1 << last)
                best[mask, last] = min(
                    (best[rest, i][0] + float(cost[i, last]), i) for i in chosen if i != last
                )
    mask = sum(1 << i for i in inner)
    _, last = min((best[mask, i][0] + float(cost[i, n - 1]), i) for i in inner)
    order = [n - 1]
    while last != 0:
        order.append(last)
        mask, last = mask & ~(1 << last), best[mask, last][1]
    return [*order, 0][::-1]


def _exchanges(cost: FloatArray) -> list[int]:
    """Nearest neighbour, then 2-opt reversals and moves of up to three nodes until none gains."""
    n = len(cost)
    left, order = set(range(1, n - 1)), [0]
    while left:
        nearest = min(left, key=lambda j: (float(cost[order[-1], j]), j))
        order.append(nearest)
        left.remove(nearest)
    order.append(n - 1)

    def total(path: list[int]) -> float:
        return float(sum(cost[a, b] for a, b in itertools.pairwise(path)))

    now, gained = total(order), True
    while gained:
        gained = False
        for i in range(1, n - 2):
            for j in range(i + 1, n - 1):
                trials = [order[:i] + order[i : j + 1][::-1] + order[j + 1 :]]
                for length in (1, 2, 3):
                    if i + length <= j:
                        block, rest = order[i : i + length], order[:i] + order[i + length :]
                        trials.append(rest[: j - length + 1] + block + rest[j - length + 1 :])
                for trial in trials:
                    if trial[0] == 0 and trial[-1] == n - 1 and total(trial) < now - 1e-9:
                        order, now, gained = trial, total(trial), True
    return order
