"""The relative covariance of two corrections against GTSAM's own joint marginals."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E

import mapping.pose_graph_relative as relative
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.pose_graph import GraphConfig, Link, build
from mapping.pose_graph_relative import relative_covariance
from mapping.pose_graph_solve import solve
from mapping.sharing import solve_shared
from perception.records import FloatArray
from tests.mapping.test_pose_graph import end_fixes, flights, true_links


def flown(rng: np.random.Generator) -> tuple[Keyframes, list[KeyframeFix], list[Link]]:
    """Return a survey's keyframes, the fixes at its ends and its true registrations."""
    passes = flights(rng)
    strips = [f.strip for f in passes]
    keyframes = choose_keyframes(strips, 15.0)
    fixes = tie_fixes(end_fixes(passes, rng), strips, keyframes, 4.0)
    return keyframes, fixes, true_links(passes, keyframes, rng)


def both_ways(pairs: int = 12) -> tuple[FloatArray, FloatArray]:
    """Return the covariances of some pairs by this module and by GTSAM's joint marginals."""
    rng = np.random.default_rng(3)
    keyframes, fixes, links = flown(rng)
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
    """254 draws know a variance to 9 %, 1-sigma; five of those are allowed to the worst of forty pairs."""
    monkeypatch.setattr(relative, "_MOST_COLUMNS", 6)
    ours, theirs = both_ways(40)
    trace = np.trace(ours, axis1=1, axis2=2), np.trace(theirs, axis1=1, axis2=2)
    np.testing.assert_allclose(trace[0], trace[1], rtol=0.45, atol=1e-12)
    assert abs(np.median(trace[0] / np.maximum(trace[1], 1e-12)) - 1.0) < 0.15


def test_noise_that_is_not_random_is_white() -> None:
    noise = relative._white(40_000)
    np.testing.assert_allclose((noise**2).mean(axis=1), 1.0)
    assert len(np.unique(noise.round(6), axis=0)) == len(noise)
    near = noise[: relative._WAVES]
    np.testing.assert_allclose(near @ near.T / noise.shape[1], np.eye(len(near)), atol=1e-12)
    pairs = np.random.default_rng(0).permutation(len(noise)).reshape(-1, 2)
    alike = (noise[pairs[:, 0]] * noise[pairs[:, 1]]).mean(axis=1)
    assert np.sqrt((alike**2).mean()) < 1.1 * noise.shape[1] ** -0.5
    assert np.abs(alike).max() <= 2.0 * relative._WAVES**-0.5


def test_columns_and_draws_hold_the_same_of_a_range_scale_in_common(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a scale that all but makes the claim, draws know nothing to err in: both agree to 1 %."""
    rng = np.random.default_rng(4)
    keyframes, fixes, links = flown(rng)
    solution = solve_shared(keyframes, links, fixes, GraphConfig(range_scale=1.0))
    # Far from each other, where the scale drew them apart.
    pairs = rng.integers(0, len(keyframes), (40, 2))
    effect = solution.range_effect_m
    assert effect is not None
    far = np.hypot(*(effect[pairs[:, 0]] - effect[pairs[:, 1]]).T) > 20.0
    pairs = pairs[far]
    assert len(pairs) > 5
    plain = replace(solution, range_effect_m=None)
    columns, without = (relative_covariance(s, pairs) for s in (solution, plain))
    monkeypatch.setattr(relative, "_MOST_COLUMNS", 1)
    draws = relative_covariance(solution, pairs)
    trace = [np.trace(c, axis1=1, axis2=2) for c in (columns, draws, without)]
    assert (trace[2] < 0.05 * trace[0]).all()
    np.testing.assert_allclose(trace[0], trace[1], rtol=0.02)
