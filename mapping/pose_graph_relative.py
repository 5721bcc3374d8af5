"""How well the graph knows one keyframe's correction *relative to another's*: what errors in common leave out.

Two passes side by side may both be a hundred metres off and yet known to a metre from each other. How far apart two
looks at one place may lie is that relative uncertainty, and it is what a registration must search.
"""

from __future__ import annotations

import numpy as np
from gtsam.symbol_shorthand import E

from mapping.pose_graph import Solution
from mapping.pose_graph_root import Root
from perception.records import FloatArray, IntArray

# Of so many different keyframes whole columns of the covariance are taken.
_MOST_COLUMNS = 200
# Of more, the covariances are those of twice as many draws: each sigma is then known to 4 %. A prime and its
# primitive root (`_white`).
_WAVES, _ROOT = 127, 3
# Pairs whose draws are held at once.
_TOGETHER = 2000


def relative_covariance(solution: Solution, pairs: IntArray) -> FloatArray:
    """Return the (n, 2, 2) covariance of the difference of two keyframes' corrections, for (n, 2) pairs.

    ``cov(a - b) = C_aa + C_bb - C_ab - C_ba``. The columns C of some hundred a cost little, those of thousands more than
    the solution itself; there it is the mean square of the same differences in draws from the
    solution's distribution. What a range scale in common does to the difference is part of it where it is part of the
    solution's covariances. NaN where the graph knows nothing.
    """
    if solution.root is None or not len(pairs):
        return np.full((len(pairs), 2, 2), np.nan)
    root = solution.root
    at = root.positions(E(k) for k in range(len(solution.correction_m)))
    out = (
        _by_columns(root, at, pairs)
        if len(np.unique(pairs[:, 0])) <= _MOST_COLUMNS
        else _by_draws(root, at, pairs)
    )
    if solution.range_effect_m is not None:
        apart = solution.range_effect_m[pairs[:, 0]] - solution.range_effect_m[pairs[:, 1]]
        out += apart[:, :, None] * apart[:, None, :]
    return out


def _by_columns(root: Root, at: IntArray, pairs: IntArray) -> FloatArray:
    different, which = np.unique(pairs[:, 0], return_inverse=True)
    columns = root.columns(at[different].ravel()).reshape(-1, len(different), 2)
    own = root.covariances(E(k) for k in range(len(at)))
    # (n, 2, 2): the rows of b in the columns of a.
    cross = columns[at[pairs[:, 1]], which[:, None]]
    covariance: FloatArray = own[pairs[:, 0]] + own[pairs[:, 1]] - cross - np.swapaxes(cross, 1, 2)
    return covariance


def _by_draws(root: Root, at: IntArray, pairs: IntArray) -> FloatArray:
    drawn = root.draws(_white(len(root)))[at]
    out = np.empty((len(pairs), 2, 2))
    for begin in range(0, len(pairs), _TOGETHER):
        chosen = pairs[begin : begin + _TOGETHER]
        apart = drawn[chosen[:, 0]] - drawn[chosen[:, 1]]
        out[begin : begin + _TOGETHER] = apart @ apart.transpose(0, 2, 1) / drawn.shape[2]
    return out


def _white(unknowns: int) -> FloatArray:
    """Return (unknowns, 2 p) noise of variance one whose rows are nearly orthogonal.

    A survey's answer must repeat, and no generator belongs to it: so the noise is no random one. A row is the chirp
    ``exp(2 pi i (a t + b t^2 + c t^3) / p)`` over the residues t of the prime p, real and imaginary parts apart. The
    rows of one (b, c) are orthogonal, and any two others correlate by at most 2 / sqrt(p) (Weil 1948), typically by
    the 1 / sqrt(2 p) of random ones. Within them a goes by the powers of a root: one after the other, chirps
    would add up where the covariance varies slowly along the rows.
    """
    powers = [pow(_ROOT, k, _WAVES) for k in range(_WAVES - 1)]
    a, b, c = (np.arange(unknowns) // _WAVES**digit % _WAVES for digit in range(3))
    a, t = np.array([*powers, 0])[a], np.arange(_WAVES)
    turn = (((c[:, None] * t + b[:, None]) * t + a[:, None]) * t) % _WAVES
    wave = np.sqrt(2.0) * np.exp(2j * np.pi * t / _WAVES)
    return np.concatenate([wave.real[turn], wave.imag[turn]], axis=1)
