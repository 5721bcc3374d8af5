"""The pose graph: planted drift is found, wrong loops are refused, covariances are honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from mapping.fixes import PositionFix
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.pose_graph import GraphConfig, HeightStep, Link, Solution, perpendicular
from mapping.pose_graph_solve import solve
from perception.records import FloatArray
from tests.mapping.worlds import Drift, Flight, crossed_legs, fly, make_world


def flights(rng: np.random.Generator, drift: Drift | None = None) -> list[Flight]:
    world = make_world(rng, size=64)
    return fly(world, crossed_legs(), rng, drift, step_m=2.0, across_step_m=25.0)


def true_corrections(flown: list[Flight], keyframes: Keyframes) -> FloatArray:
    rows = []
    for strip, line in zip(keyframes.strip, keyframes.line, strict=True):
        f = flown[strip]
        rows.append(
            [
                f.true_easting_m[line] - f.strip.easting_m[line],
                f.true_northing_m[line] - f.strip.northing_m[line],
            ]
        )
    return np.array(rows)


def true_links(
    flown: list[Flight], keyframes: Keyframes, rng: np.random.Generator, sigma_m: float = 0.2
) -> list[Link]:
    """Links where passes come within 40 m of each other, with honest noise."""
    truth = true_corrections(flown, keyframes)
    place = np.column_stack([keyframes.easting_m, keyframes.northing_m]) + truth
    links = []
    for i in range(0, len(keyframes), 4):
        for j in range(i + 1, len(keyframes), 4):
            if keyframes.strip[i] == keyframes.strip[j]:
                continue
            if np.hypot(*(place[i] - place[j])) > 40.0:
                continue
            middle = 0.5 * (place[i] + place[j])
            ground, offsets = [], []
            for k in (i, j):
                f = flown[keyframes.strip[k]]
                turn = f.true_heading_rad[0] - f.strip.heading_rad[0]
                offsets.append(middle - place[k])
                ground.append(truth[k] + turn * perpendicular(middle - place[k]))
            shift = ground[1] - ground[0] + sigma_m * rng.normal(size=2)
            links.append(Link(i, j, offsets[0], offsets[1], shift, sigma_m**2 * np.eye(2)))
    return links


def end_fixes(
    flown: list[Flight], rng: np.random.Generator, sigma_m: float = 0.4
) -> list[PositionFix]:
    fixes = []
    for f, line in ((flown[0], 0), (flown[-1], -1)):
        e, n = sigma_m * rng.normal(size=2)
        fixes.append(
            PositionFix(
                f.strip.time_s[line], f.true_easting_m[line] + e, f.true_northing_m[line] + n,
                sigma_m**2, 0.0, sigma_m**2, "gps",
            )
        )  # fmt: skip
    return fixes


def solve_survey(
    seed: int, wrong: float = 0.0, robust: bool = True
) -> tuple[Solution, FloatArray, FloatArray, int]:
    """Return solution, true corrections, which links were good, and the number of passes."""
    rng = np.random.default_rng(seed)
    flown = flights(rng)
    strips = [f.strip for f in flown]
    keyframes = choose_keyframes(strips, 8.0)
    links = true_links(flown, keyframes, rng)
    count = len(links)
    # Injected: so many more that they make the given part of all.
    for old in rng.choice(count, int(count * wrong / (1.0 - wrong))):
        shift = links[old].shift_m + rng.uniform(3, 15, 2) * rng.choice([-1, 1], 2)
        links.append(replace(links[old], shift_m=shift))
    good = np.arange(len(links)) < count
    ties = tie_fixes(end_fixes(flown, rng), strips, keyframes, 4.0)
    config = GraphConfig(heading_bias_deg=0.4, scale=0.004, sonar_heading_deg=0.05)
    solution = solve(keyframes, links, ties, config, robust)
    return solution, true_corrections(flown, keyframes), good, len(strips)


def rms(x: FloatArray) -> float:
    return float(np.sqrt((x**2).sum(axis=1).mean()))


def test_three_and_three_crossed_passes_lose_most_of_their_drift() -> None:
    """What is left is the fixes' own 0.4 m an axis and the turn that two fixes 250 m apart leave open."""
    cuts = []
    for seed in range(4):
        solution, truth, _, _ = solve_survey(seed)
        cuts.append(1.0 - rms(solution.correction_m - truth) / rms(truth))
    assert np.mean(cuts) >= 0.7


def test_forty_percent_wrong_registrations_change_the_track_by_less_than_a_tenth() -> None:
    clean, spoilt = [], []
    for seed in range(4):
        solution, truth, _, _ = solve_survey(seed)
        clean.append(rms(solution.correction_m - truth))
        solution, truth, good, _ = solve_survey(seed, wrong=0.4)
        spoilt.append(rms(solution.correction_m - truth))
        assert not solution.link_used[~good].any()
        # The threshold refuses one in a hundred good ones; twice that is luck, ten times a fault.
        assert solution.link_used[good].mean() > 0.9
    assert np.mean(spoilt) < 1.1 * np.mean(clean)


def test_the_covariance_is_that_of_the_errors_over_twenty_seeds() -> None:
    """NEES of one keyframe per run (errors within a run are one draw) within 95 % of chi-square."""
    values = []
    for seed in range(20):
        solution, truth, _, _ = solve_survey(seed)
        k = (7 * seed) % len(truth)
        e = solution.correction_m[k] - truth[k]
        values.append(e @ np.linalg.solve(solution.covariance_m2[k], e))
    low, high = stats.chi2.ppf([0.025, 0.975], df=2 * len(values))
    assert low < np.sum(values) < high


def test_without_anything_to_go_by_the_navigation_stands_and_its_uncertainty_grows() -> None:
    rng = np.random.default_rng(3)
    keyframes = choose_keyframes([f.strip for f in flights(rng)], 8.0)
    solution = solve(keyframes)
    np.testing.assert_allclose(solution.correction_m, 0.0, atol=1e-9)
    sigma = np.sqrt(solution.covariance_m2[:, 0, 0])
    assert sigma[0] == pytest.approx(GraphConfig().start_m)
    assert sigma[-1] > 5.0
    assert not solution.indeterminate and not solution.worsened


def test_a_fix_far_from_the_start_moves_the_whole_track_there() -> None:
    """With fixes the start is free: 80 m of offset are no outlier but the datum."""
    rng = np.random.default_rng(4)
    strips = [f.strip for f in flights(rng, Drift(0.0, 0.0, 0.0))]
    keyframes = choose_keyframes(strips, 8.0)
    fix = KeyframeFix(3, np.array([80.0, -30.0]), 0.16 * np.eye(2))
    solution = solve(keyframes, fixes=[fix])
    np.testing.assert_allclose(solution.correction_m[3], [80.0, -30.0], atol=0.01)
    np.testing.assert_allclose(solution.correction_m[-1], [80.0, -30.0], atol=0.1)


def test_contradictory_fixes_are_said() -> None:
    rng = np.random.default_rng(5)
    strips = [f.strip for f in flights(rng, Drift(0.0, 0.0, 0.0))]
    keyframes = choose_keyframes(strips, 8.0)
    ties = [KeyframeFix(k, np.zeros(2), 0.16 * np.eye(2)) for k in (0, 20, 60, 100, 140)]
    ties.append(KeyframeFix(61, np.array([200.0, 0.0]), 0.16 * np.eye(2)))
    solution = solve(keyframes, fixes=ties)
    assert solution.fix_used.tolist() == [True] * 5 + [False]


def test_a_height_offset_between_strips_is_found() -> None:
    rng = np.random.default_rng(6)
    flown = flights(rng)
    keyframes = choose_keyframes([f.strip for f in flown], 8.0)
    planted = np.array([0.0, 0.2, -0.1, 0.3, 0.1, -0.2])
    steps = [
        HeightStep(i, j, float(planted[j] - planted[i]), 0.02)
        for i in range(3)
        for j in range(3, 6)
    ]
    solution = solve(keyframes, steps=steps)
    found = solution.height_m - solution.height_m.mean()
    np.testing.assert_allclose(found, planted - planted.mean(), atol=0.01)


def test_a_jump_of_the_navigation_is_no_motion() -> None:
    """A strip whose positions jump by 50 m is bent there, instead of dragging its neighbours."""
    rng = np.random.default_rng(7)
    flown = flights(rng, Drift(0.0, 0.0, 0.0))
    strip = flown[0].strip
    strip.easting_m[75:] += 50.0
    keyframes = choose_keyframes([strip], 8.0)
    after = int(np.argmax(keyframes.line >= 75))
    assert keyframes.jump_m[after] > 40.0
    ties = [
        KeyframeFix(0, np.zeros(2), 0.01 * np.eye(2)),
        KeyframeFix(len(keyframes) - 1, np.array([-50.0, 0.0]), 0.01 * np.eye(2)),
    ]
    solution = solve(keyframes, fixes=ties, robust=False)
    np.testing.assert_allclose(solution.correction_m[: after - 1, 0], 0.0, atol=1.0)
    np.testing.assert_allclose(solution.correction_m[after:, 0], -50.0, atol=1.0)
