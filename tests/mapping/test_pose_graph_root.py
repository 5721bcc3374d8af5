"""Covariances from one elimination, and who is doubted, against GTSAM's own answers on the unreduced graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam as typed_gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, E, H

from mapping import pose_graph_solve
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.pose_graph import GraphConfig, HeightStep, Link, build, gauss_newton
from mapping.pose_graph_root import Root
from mapping.pose_graph_solve import LinearGraph, consistent, solve, with_range_scale
from tests.mapping.test_pose_graph import end_fixes, flights, true_links

gtsam: Any = typed_gtsam

Survey = tuple[Keyframes, list[Link], list[KeyframeFix], list[HeightStep]]


def survey(seed: int, wrong: float = 0.0) -> Survey:
    rng = np.random.default_rng(seed)
    flown = flights(rng)
    strips = [f.strip for f in flown]
    keyframes = choose_keyframes(strips, 15.0)
    links = true_links(flown, keyframes, rng)
    for i in rng.choice(len(links), int(wrong * len(links)), replace=False):
        links[i] = replace(links[i], shift_m=links[i].shift_m + rng.uniform(3.0, 15.0, 2))
    ties = tie_fixes(end_fixes(flown, rng), strips, keyframes, 4.0)
    return keyframes, links, ties, [HeightStep(0, 3, 0.1, 0.05), HeightStep(1, 4, -0.1, 0.05)]


def test_answer_and_covariances_are_those_of_the_unreduced_graph() -> None:
    keyframes, links, ties, steps = survey(1)
    config = GraphConfig(shared=0.8)
    ours = solve(keyframes, links, ties, config, robust=False, steps=steps)
    graph, start, _ = build(keyframes, links, ties, config, steps)
    result = gtsam.GaussNewtonOptimizer(graph, start, gauss_newton()).optimize()
    marginals = gtsam.Marginals(graph, result)
    for k in range(len(keyframes)):
        np.testing.assert_allclose(ours.correction_m[k], result.atVector(E(k)), atol=1e-7)
        np.testing.assert_allclose(
            ours.covariance_m2[k], marginals.marginalCovariance(E(k)), rtol=1e-6, atol=1e-9
        )
    for p in range(6):
        sigma = np.sqrt(np.diag(marginals.marginalCovariance(B(p))))
        np.testing.assert_allclose(ours.pass_sigma[p], sigma, rtol=1e-6)
        sigma = np.sqrt(np.diag(marginals.marginalCovariance(H(p))))
        np.testing.assert_allclose(ours.height_sigma_m[p], sigma[0], rtol=1e-6)
    assert ours.error_after == pytest.approx(graph.error(result), rel=1e-6)


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.4])
def test_the_same_registrations_are_doubted_as_by_gtsam_on_the_unreduced_graph(
    wrong: float,
) -> None:
    keyframes, links, ties, steps = survey(2, wrong)
    config = GraphConfig()
    ours = consistent(LinearGraph(keyframes, links, ties, config, steps), config)
    graph, start, doubtful = build(keyframes, links, ties, config, steps)
    start = gtsam.GaussNewtonOptimizer(graph, start, gauss_newton()).optimize()
    parameters = gtsam.GncGaussNewtonParams(gauss_newton())
    parameters.setAllowNonNoiseModelFactors(True)
    parameters.setKnownInliers([f for f in range(graph.size()) if f not in set(doubtful)])
    peer = gtsam.GncGaussNewtonOptimizer(graph, start, parameters)
    peer.setInlierCostThresholdsAtProbability(1.0 - config.outlier_probability)
    peer.optimize()
    theirs = np.asarray(peer.getWeights())[doubtful] > 0.5
    assert (ours != theirs).sum() <= 0.01 * len(ours)


def test_columns_draws_and_the_selected_inverse_are_one_covariance() -> None:
    keyframes, links, ties, steps = survey(3)
    linear = LinearGraph(keyframes, links, ties, GraphConfig(), steps)
    net, _ = linear.net(linear.graph(np.ones(len(linear.doubtful))))
    root = Root.of(net)
    n = len(root.begin) - 1
    dense = np.zeros((n, n))
    dense[np.repeat(np.arange(n), np.diff(root.begin)), root.column] = root.value
    covariance = np.linalg.inv(dense.T @ dense)
    np.testing.assert_allclose(root.columns(np.arange(n)), covariance, rtol=1e-6, atol=1e-9)
    keys = [E(k) for k in range(len(keyframes))]
    at = root.positions(keys)
    expected = covariance[at[:, :, None], at[:, None, :]]
    np.testing.assert_allclose(root.covariances(keys), expected, rtol=1e-6, atol=1e-9)
    drawn = root.draws(np.random.default_rng(0).normal(size=(n, 4000)))[at[:, 0]]
    np.testing.assert_allclose((drawn**2).mean(axis=1), expected[:, 0, 0], rtol=0.12)


def test_a_range_scale_in_common_widens_the_claim_by_what_it_does_to_the_answer() -> None:
    """Every registration of a survey drawn 1 % too wide: the answer moves as far as 1 % claims."""
    keyframes, links, ties, steps = survey(4)
    config = GraphConfig(range_scale=0.01)
    here = solve(keyframes, links, ties, config, robust=False, steps=steps)
    drawn = []
    for link in links:
        ends = ((link.first, link.first_offset_m), (link.second, link.second_offset_m))
        shift = link.shift_m.copy()
        for (k, offset), sign in zip(ends, (1.0, -1.0), strict=True):
            heading = keyframes.heading_rad[k]
            starboard = np.array([np.cos(heading), -np.sin(heading)])
            shift += sign * 0.01 * (offset @ starboard) * starboard
        drawn.append(replace(link, shift_m=shift))
    there = solve(keyframes, drawn, ties, config, robust=False, steps=steps)
    moved = there.correction_m - here.correction_m
    wider = with_range_scale(here, keyframes, links, ties)
    assert np.hypot(*moved.T).max() > 0.1
    np.testing.assert_allclose(
        wider.covariance_m2 - here.covariance_m2,
        moved[:, :, None] * moved[:, None, :],
        atol=1e-8,
    )


class Fails:
    """A graph whose elimination fails, by Cholesky alone or at all."""

    def __init__(self, graph: Any, at_all: bool) -> None:
        self._graph, self._at_all = graph, at_all

    def eliminateMultifrontal(self, *how: Any) -> Any:
        if self._at_all or len(how) == 1:
            raise RuntimeError("Indeterminant linear system")
        return self._graph.eliminateMultifrontal(*how)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._graph, name)


@pytest.mark.parametrize("at_all", [False, True])
def test_where_cholesky_fails_doubt_is_decided_by_qr_or_the_answer_is_indeterminate(
    at_all: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyframes, links, ties, steps = survey(2, wrong=0.1)
    config = GraphConfig(range_scale=0.01)
    expected = with_range_scale(
        solve(keyframes, links, ties, config, steps=steps), keyframes, links, ties
    )
    plain = LinearGraph.graph
    monkeypatch.setattr(LinearGraph, "graph", lambda self, w: Fails(plain(self, w), at_all))
    ours = solve(keyframes, links, ties, config, steps=steps)
    assert ours.indeterminate == at_all and np.isnan(ours.covariance_m2).all() == at_all
    if at_all:
        # A scale whose effect cannot be had leaves the claim as it was.
        ours = with_range_scale(replace(expected, range_effect_m=None), keyframes, links, ties)
        assert ours.range_effect_m is None
    else:
        ours = with_range_scale(ours, keyframes, links, ties)
        np.testing.assert_array_equal(ours.link_used, expected.link_used)
        np.testing.assert_allclose(ours.correction_m, expected.correction_m, atol=1e-6)
    np.testing.assert_allclose(ours.covariance_m2, expected.covariance_m2, rtol=1e-5, atol=1e-8)


def test_doubt_that_is_not_decided_in_time_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    keyframes, links, ties, steps = survey(2, wrong=0.1)
    monkeypatch.setattr(pose_graph_solve, "_MOST_STEPS", 1)
    consistent(LinearGraph(keyframes, links, ties, GraphConfig(), steps), GraphConfig())
    assert "undecided after 1 steps" in caplog.text
