"""The relative covariance of two corrections against GTSAM's own joint marginals."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E

import mapping.pose_graph_relative as relative
from mapping.keyframes import choose_keyframes, tie_fixes
from mapping.pose_graph import GraphConfig, build
from mapping.pose_graph_relative import relative_covariance
from mapping.pose_graph_solve import solve
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
    ours = relative_covariance(solution, chosen)
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


def test_of_many_keyframes_draws_tell_it_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """256 draws know a variance to 9 %, 1-sigma; five of those are allowed to the worst of forty pairs."""
    monkeypatch.setattr(relative, "_MOST_COLUMNS", 6)
    ours, theirs = both_ways(40)
    trace = np.trace(ours, axis1=1, axis2=2), np.trace(theirs, axis1=1, axis2=2)
    np.testing.assert_allclose(trace[0], trace[1], rtol=0.45, atol=1e-12)
    assert abs(np.median(trace[0] / np.maximum(trace[1], 1e-12)) - 1.0) < 0.15
