"""The square root of a linear graph's information, and what can be read off it: covariances and draws.

GTSAM eliminates one variable after the other; what remains of each, given those eliminated later, are a few rows of an
upper triangle R with ``R' R`` the information. Its inverse is dense, but the entries where R itself has any need
nothing outside of those (Takahashi, Fagan & Chin 1973; Kaess & Dellaert 2009), and all covariances of keyframes are
among them: they cost about as much as the elimination. One by one by `gtsam.Marginals` they took longer than
everything else that is done with the graph.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np

from perception.records import FloatArray, IntArray


@dataclass(frozen=True)
class Root:
    """R by rows, in the order of elimination.

    Attributes
    ----------
    begin : (n + 1,) where each row begins in `column` and `value`; its first entry is the diagonal's.
    column, value : positions and entries of R.
    place : first position of each variable, by its key; `size` how many positions it has.
    """

    begin: IntArray
    column: IntArray
    value: FloatArray
    place: dict[int, int]
    size: dict[int, int]

    @classmethod
    def of(cls, net: Any) -> Root:
        """Read a GTSAM Bayes net of one frontal variable each."""
        conditionals = [net.at(i) for i in range(net.size())]
        keys = [c.keys() for c in conditionals]
        uppers = [c.R() for c in conditionals]
        size = {k[0]: len(r) for k, r in zip(keys, uppers, strict=True)}
        ends = np.cumsum(list(size.values()))
        place = dict(zip(size, (ends - list(size.values())).tolist(), strict=True))
        columns: list[FloatArray] = []
        values: list[FloatArray] = []
        length: list[int] = []
        for (own, *parents), conditional, upper in zip(keys, conditionals, uppers, strict=True):
            beyond = np.array([place[p] + d for p in parents for d in range(size[p])], np.int64)
            rest = conditional.S() if parents else np.zeros((len(upper), 0))
            for row in range(len(upper)):
                inner = np.arange(row, len(upper))
                columns.append(np.concatenate([place[own] + inner, beyond]))
                values.append(np.concatenate([upper[row, row:], rest[row]]))
                length.append(len(inner) + len(beyond))
        begin = np.concatenate([[0], np.cumsum(length)])
        return cls(begin, np.concatenate(columns), np.concatenate(values), place, size)

    def positions(self, keys: Iterable[int]) -> IntArray:
        """Return (k, d) the positions of variables of one size."""
        first = [(self.place[key], self.size[key]) for key in keys]
        if not first:
            return np.zeros((0, 1), np.int64)
        return np.array([p for p, _ in first])[:, None] + np.arange(first[0][1])

    def covariances(self, keys: Iterable[int]) -> FloatArray:
        """Return (k, d, d) the covariance of each of some variables of one size."""
        at = self.positions(keys)
        d = at.shape[1]
        out = np.empty((len(at), d, d))
        for i in range(d):
            for j in range(i, d):
                # A variable's own rows hold its own columns first.
                out[:, i, j] = out[:, j, i] = self._inverse[self.begin[at[:, i]] + j - i]
        return out

    @cached_property
    def _inverse(self) -> FloatArray:
        return _selected_inverse(self.begin, self.column, self.value)

    def __len__(self) -> int:
        return len(self.begin) - 1

    def draws(self, white: FloatArray) -> FloatArray:
        """Return (n, m) draws of all unknowns' errors, by position, made of white noise (n, m)."""
        drawn = np.array(white, float)
        _back(self.begin, self.column, self.value, drawn)
        return drawn

    def columns(self, positions: IntArray) -> FloatArray:
        """Return (n, len(positions)) whole columns of the covariance."""
        unit = np.zeros((len(self), len(positions)))
        unit[positions, np.arange(len(positions))] = 1.0
        _forward(self.begin, self.column, self.value, unit)
        _back(self.begin, self.column, self.value, unit)
        return unit


@numba.njit(cache=True, nogil=True)
def _back(begin: IntArray, column: IntArray, value: FloatArray, b: FloatArray) -> None:
    """Solve ``R x = b`` in place, for many columns at once."""
    for i in range(len(begin) - 2, -1, -1):
        for t in range(begin[i] + 1, begin[i + 1]):
            r, k = value[t], column[t]
            for c in range(b.shape[1]):
                b[i, c] -= r * b[k, c]
        r = 1.0 / value[begin[i]]
        for c in range(b.shape[1]):
            b[i, c] *= r


@numba.njit(cache=True, nogil=True)
def _forward(begin: IntArray, column: IntArray, value: FloatArray, b: FloatArray) -> None:
    """Solve ``R' x = b`` in place, for many columns at once."""
    for i in range(len(begin) - 1):
        r = 1.0 / value[begin[i]]
        for c in range(b.shape[1]):
            b[i, c] *= r
        for t in range(begin[i] + 1, begin[i + 1]):
            r, k = value[t], column[t]
            for c in range(b.shape[1]):
                b[k, c] -= r * b[i, c]


@numba.njit(cache=True, nogil=True)
def _selected_inverse(begin: IntArray, column: IntArray, value: FloatArray) -> FloatArray:
    """Return the entries of ``(R' R)^-1`` where R has entries, in their order.

    With r the diagonal of row i and r_k its other entries,
    ``C_ij = -sum_k r_k C_kj / r`` and ``C_ii = (1 / r - sum_k r_k C_ik) / r``; the columns of one row of R all
    meet each other in later rows, so that every C_kj is there.
    """
    n = len(begin) - 1
    out = np.zeros_like(value)
    mark = np.full(n, -1)
    total = np.empty(n)
    for i in range(n - 1, -1, -1):
        first, last = begin[i] + 1, begin[i + 1]
        for t in range(first, last):
            mark[column[t]] = t - first
            total[t - first] = 0.0
        for t in range(first, last):
            k, r = column[t], value[t]
            total[t - first] += r * out[begin[k]]
            inner = 0.0
            for u in range(begin[k] + 1, begin[k + 1]):
                m = mark[column[u]]
                if m >= 0:
                    total[m] += r * out[u]
                    inner += value[first + m] * out[u]
            total[t - first] += inner
        inverse = 1.0 / value[first - 1]
        own = inverse
        for t in range(first, last):
            out[t] = -total[t - first] * inverse
            own -= value[t] * out[t]
            mark[column[t]] = -1
        out[first - 1] = own * inverse
    return out
