"""Pass by pass or all at once: one answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.pose_graph import Blend, GraphConfig, HeightStep, Link, Solution
from mapping.pose_graph_incremental import IncrementalGraph
from mapping.pose_graph_solve import solve
from tests.mapping.test_pose_graph import end_fixes, flights, true_links

CONFIG = GraphConfig(shared=0.8)


def survey(seed: int) -> tuple[Keyframes, list[Keyframes], list[Link], list[KeyframeFix]]:
    rng = np.random.default_rng(seed)
    flown = flights(rng)
    strips = [f.strip for f in flown]
    so_far = [choose_keyframes(strips[: n + 1], 15.0) for n in range(len(strips))]
    links = true_links(flown, so_far[-1], rng)
    ties = tie_fixes(end_fixes(flown, rng), strips, so_far[-1], 4.0)
    return so_far[-1], so_far, links, ties


def grown(seed: int, steps: list[HeightStep]) -> tuple[IncrementalGraph, list[Link], Keyframes]:
    keyframes, so_far, links, ties = survey(seed)
    graph = IncrementalGraph(CONFIG, absolute=True)
    for number, keys in enumerate(so_far):
        graph.add_passes(keys)
        graph.hold(
            [x for x in links if keyframes.strip[x.second] <= number],
            [t for t in ties if keyframes.strip[t.keyframe] <= number],
            [s for s in steps if s.second <= number],
        )
    return graph, links, keyframes


def same(a: Solution, b: Solution) -> None:
    np.testing.assert_allclose(a.correction_m, b.correction_m, atol=1e-6)
    np.testing.assert_allclose(a.covariance_m2, b.covariance_m2, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(a.pass_errors, b.pass_errors, atol=1e-8)
    np.testing.assert_allclose(a.height_m, b.height_m, atol=1e-8)


def test_pass_by_pass_gives_what_all_at_once_gives() -> None:
    steps = [HeightStep(0, 3, 0.2, 0.05), HeightStep(1, 4, -0.1, 0.05)]
    graph, order, keyframes = grown(3, steps)
    ties = survey(3)[3]
    batch = solve(keyframes, order, ties, CONFIG, robust=False, steps=steps)
    same(graph.solution(), batch)
    assert graph.solution().error_after == np.float64(batch.error_after).round(12) or np.isclose(
        graph.solution().error_after, batch.error_after, rtol=1e-6
    )


def test_a_registration_taken_out_again_leaves_no_trace() -> None:
    steps = [HeightStep(0, 3, 0.2, 0.05), HeightStep(1, 4, -0.1, 0.05)]
    graph, links, keyframes = grown(4, steps)
    ties = survey(4)[3]
    gone = {2, 7, len(links) - 1}
    kept = [x for n, x in enumerate(links) if n not in gone]
    graph.hold(kept, ties[:1], steps[1:])
    same(graph.solution(), solve(keyframes, kept, ties[:1], CONFIG, robust=False, steps=steps[1:]))
    assert graph.solution().link_used.sum() == len(kept)
    graph.hold(links, ties, steps)
    same(graph.solution(), solve(keyframes, links, ties, CONFIG, robust=False, steps=steps))


def test_what_is_said_twice_counts_twice() -> None:
    """Two fixes alike, and two registrations that differ in their blends alone."""
    keyframes, _, links, ties = survey(6)
    blended = replace(links[0], first_blend=Blend(links[0].first - 1, links[0].first, 0.5))
    graph = IncrementalGraph(CONFIG, absolute=True)
    graph.add_passes(keyframes)
    for more in (
        ([*links, blended, links[1]], [*ties, ties[-1]]),
        (links, ties),
        ([*links, links[1]], [ties[0], *ties]),
    ):
        graph.hold(*more)
        same(graph.solution(), solve(keyframes, *more, CONFIG, robust=False))


def test_a_graph_goes_on_only_under_the_assumptions_that_it_began_with() -> None:
    keyframes, so_far, _, _ = survey(5)
    graph = IncrementalGraph(CONFIG, absolute=True)
    graph.add_passes(so_far[1])
    assert graph.goes_on(keyframes, CONFIG, absolute=True)
    assert not graph.goes_on(keyframes, CONFIG, absolute=False)
    assert not graph.goes_on(keyframes, replace(CONFIG, shared=0.0), absolute=True)
    moved = replace(keyframes, line=keyframes.line + 1)
    assert not graph.goes_on(moved, CONFIG, absolute=True)
