"""How well the graph knows one keyframe's correction *relative to another's*: what errors in common leave out.

Two passes side by side may both be a hundred metres off and yet known to a metre from each other. How far apart two
looks at one place may lie is that relative uncertainty, and it is what a registration must search.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph import GraphConfig, HeightStep, Link, Solution, build
from perception.records import FloatArray, IntArray

# Keyframes whose columns of the covariance are solved for, at most, and columns solved for together.
_MOST_ANCHORS, _TOGETHER = 400, 64


def relative_covariance(
    keyframes: Keyframes,
    solution: Solution,
    links: Sequence[Link],
    fixes: Sequence[KeyframeFix],
    steps: Sequence[HeightStep],
    pairs: IntArray,
) -> FloatArray:
    """Return the (n, 2, 2) covariance of the difference of two keyframes' corrections, for (n, 2) pairs.

    ``cov(a - b) = C_aa + C_bb - C_ab - C_ba``; the first two are the solution's own, for the others the graph's
    information matrix is factorised once and solved for the columns of each a. Of more than some hundred
    different a, neighbours share the column of one among them, and the walk between is added.

    Parameters
    ----------
    solution : of the graph of exactly these links, fixes and steps, all of them believed.
    """
    if not len(pairs):
        return np.zeros((0, 2, 2))
    graph, values, _ = build(keyframes, links, fixes, solution.config, steps)
    factor = _factor(graph.linearize(values))
    start = 3 * (len(keyframes.starts) - 1)
    anchors = _anchors(keyframes, pairs[:, 0])
    own = solution.covariance_m2
    out: FloatArray = own[anchors] + own[pairs[:, 1]]
    different = np.unique(anchors)
    for begin in range(0, len(different), _TOGETHER):
        group = different[begin : begin + _TOGETHER]
        unit = np.zeros((factor.shape[0], 2 * len(group)))
        unit[
            start + 2 * np.repeat(group, 2) + np.tile([0, 1], len(group)), np.arange(2 * len(group))
        ] = 1.0
        columns = factor.solve(unit)
        for n in np.flatnonzero(np.isin(anchors, group)):
            row, col = start + 2 * int(pairs[n, 1]), 2 * int(np.searchsorted(group, anchors[n]))
            cross = columns[row : row + 2, col : col + 2]
            out[n] -= cross + cross.T
    return out + _walked(keyframes, anchors, pairs[:, 0], solution.config)[:, None, None] * np.eye(
        2
    )


def _factor(linear: Any) -> SuperLU:
    """Return the factorised information matrix of a linear graph, variables in the order of their keys."""
    row, col, value = np.asarray(linear.sparseJacobian_())
    # One-based, and the last column is the right-hand side.
    row, col = row.astype(int) - 1, col.astype(int) - 1
    size = int(col.max())
    left = col < size
    jacobian = sparse.csc_matrix((value[left], (row[left], col[left])), shape=(row.max() + 1, size))
    return splu(
        (jacobian.T @ jacobian).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )


def _anchors(keyframes: Keyframes, wanted: IntArray) -> IntArray:
    """Return for each keyframe itself, or where there are too many one near it in its own pass."""
    if len(np.unique(wanted)) <= _MOST_ANCHORS:
        return wanted
    passes = keyframes.strip[wanted]
    low, high = keyframes.starts[passes], keyframes.starts[passes + 1] - 1
    # As many to each pass, in the middles of equal stretches.
    stretches = max(1, _MOST_ANCHORS // len(np.unique(passes)))
    wide = (high - low) // stretches + 1
    return np.clip(low + (wanted - low) // wide * wide + wide // 2, low, high)


def _walked(
    keyframes: Keyframes, one: IntArray, other: IntArray, config: GraphConfig
) -> FloatArray:
    """Return the variance (m2, an axis) of the walk between keyframes of one pass."""
    along_m = np.cumsum(np.nan_to_num(keyframes.way_m))
    way_m = np.abs(along_m[one] - along_m[other])
    variance: FloatArray = config.walk_m2_per_m * way_m + config.rate2 * way_m**2
    return variance
