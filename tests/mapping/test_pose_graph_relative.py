"""The relative covariance of two corrections against GTSAM's own joint marginals."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E

import mapping.pose_graph_relative as relative
from mapping.keyframes import choose_keyframes, tie_fixes
from mapping.pose_graph import GraphConfig, build, solve
from mapping.pose_graph_relative import relative_covariance
from perception.records import FloatArray
from tests.mapping.test_pose_graph import end_fixes, flights, true_links


def both_ways(pairs: int = 12) -> tuple[FloatArray, FloatArray]:
    """Return the covariances of some pairs by this module and by GTSAM's joint marginals."""
    rng = np.random.default_rng(3)
    flown = flights(rng)
    strips = [f.strip for f in flown]
    keyframes = choose_keyframes(strips, 15.0)
    fixes = tie_fixes(end_fixes(flown, rng), strips, keyframes, 4.0)
    links = true_links(flown, keyframes, rng)
    config = GraphConfig()
    solution = solve(keyframes, links, fixes, config, robust=False)
    chosen = rng.integers(0, len(keyframes), (pairs, 2))
    ours = relative_covariance(keyframes, solution, links, fixes, (), chosen)
    graph, values, _ = build(keyframes, links, fixes, config)
    marginals = gtsam.Marginals(graph, values)
    theirs = []
    for a, b in chosen:
        if a == b:
            theirs.append(np.zeros((2, 2)))
            continue
        joint = marginals.jointMarginalCovariance([E(int(a)), E(int(b))])
        difference = np.hstack([np.eye(2), -np.eye(2)])
        blocks = [[joint.at(E(int(i)), E(int(j))) for j in (a, b)] for i in (a, b)]
        theirs.append(difference @ np.block(blocks) @ difference.T)
    return ours, np.array(theirs)


def test_it_is_what_the_joint_marginals_of_both_say() -> None:
    ours, theirs = both_ways()
    np.testing.assert_allclose(ours, theirs, atol=1e-4 * theirs.max())


def test_sharing_columns_between_neighbours_never_makes_it_smaller(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(relative, "_MOST_ANCHORS", 6)
    ours, theirs = both_ways(40)
    trace = np.trace(ours, axis1=1, axis2=2), np.trace(theirs, axis1=1, axis2=2)
    assert (trace[0] > 0.8 * trace[1]).all()
    assert np.median(trace[0] / np.maximum(trace[1], 1e-6)) < 3.0
