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
# Of more, the covariances are those of so many draws: each sigma is then known to 4 %.
_DRAWS = 256
# Pairs whose draws are held at once.
_TOGETHER = 2000


def relative_covariance(solution: Solution, pairs: IntArray) -> FloatArray:
    """Return the (n, 2, 2) covariance of the difference of two keyframes' corrections, for (n, 2) pairs.

    ``cov(a - b) = C_aa + C_bb - C_ab - C_ba``. The columns C of some hundred a cost little, those of thousands more than
    the solution itself; there it is the mean square of the same differences in draws from the
    solution's distribution (from a fixed seed: a survey's answer repeats). NaN where the graph knows nothing.
    """
    if solution.root is None or not len(pairs):
        return np.full((len(pairs), 2, 2), np.nan)
    root = solution.root
    at = root.positions(E(k) for k in range(len(solution.correction_m)))
    different = np.unique(pairs[:, 0])
    if len(different) <= _MOST_COLUMNS:
        return _by_columns(root, at, solution.covariance_m2, pairs, different)
    drawn = root.draws(_DRAWS, np.random.default_rng(0))[at]
    out = np.empty((len(pairs), 2, 2))
    for begin in range(0, len(pairs), _TOGETHER):
        chosen = pairs[begin : begin + _TOGETHER]
        apart = drawn[chosen[:, 0]] - drawn[chosen[:, 1]]
        out[begin : begin + _TOGETHER] = apart @ apart.transpose(0, 2, 1) / _DRAWS
    return out


def _by_columns(
    root: Root, at: IntArray, own: FloatArray, pairs: IntArray, different: IntArray
) -> FloatArray:
    columns = root.columns(at[different].ravel()).reshape(-1, len(different), 2)
    which = np.searchsorted(different, pairs[:, 0])
    # (n, 2, 2): the rows of b in the columns of a.
    cross = columns[at[pairs[:, 1]], which[:, None]]
    covariance: FloatArray = own[pairs[:, 0]] + own[pairs[:, 1]] - cross - np.swapaxes(cross, 1, 2)
    return covariance
