"""The navigator on planted worlds: it finds the place, and says so when it cannot."""

from __future__ import annotations

import navsets
import numpy as np
import pytest

from localization.estimate import CONVERGED, LOST, Estimate
from localization.mission import Navigation, _pieces, navigate
from localization.navfile import nav_table
from localization.navigator import Navigator
from localization.terrain import terrain_map
from perception.records import FloatArray


def run(
    columns: dict[str, FloatArray], relief_m: float = 8.0, seed: int = 1, phase: float = 0.0
) -> Navigation:
    rng = np.random.default_rng(seed)
    nav = nav_table(columns)
    terrain = terrain_map(navsets.prior(rng, relief_m, phase=phase))
    return navigate(Navigator(terrain, nav.sensors, rng), nav)


def errors(result: Navigation, easting: FloatArray, northing: FloatArray) -> FloatArray:
    t = result.trajectory
    return np.hypot(t.easting_m - easting, t.northing_m - northing)


def false_fixes(result: Navigation, error: FloatArray) -> int:
    t = result.trajectory
    sigma = np.maximum(t.sigma_easting_m, t.sigma_northing_m)
    return int(np.sum((sigma < 10) & (error > 25)))


def test_a_planted_offset_is_found_within_a_minute_and_kept() -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(3))
    result = run(columns)
    error = errors(result, easting, northing)
    status = np.array(result.trajectory.status)
    assert error[0] > 10
    assert np.flatnonzero(status == CONVERGED)[0] <= 20
    # Four beams of 0.6 m on slopes of 0.1: metres after a minute, below two after a few.
    assert np.sqrt(np.mean(error[75:] ** 2)) < 2.0
    assert false_fixes(result, error) == 0


def test_the_depth_bias_comes_back_from_the_soundings() -> None:
    columns, _, _ = navsets.mission(np.random.default_rng(4), bias_m=-1.3)
    state = run(columns).estimates[-1].state
    # The bias is positive where the soundings lie above the map: depth read too small.
    assert state[4] == pytest.approx(1.3, abs=0.3)


def test_smoothing_knows_the_start_that_the_causal_filter_could_not() -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(5))
    result = run(columns)
    start = np.hypot(
        result.smoothed.easting_m[0] - easting[0], result.smoothed.northing_m[0] - northing[0]
    )
    assert start < 4.0 < 10.0 < errors(result, easting, northing)[0]


def test_smoothing_does_not_reach_across_a_place_taken_up_anew() -> None:
    def told(afresh: bool) -> Estimate:
        return Estimate(
            0.0, 0.0, 0.0, np.eye(2), CONVERGED, 1.0, np.zeros(5), np.eye(5), afresh=afresh
        )

    rows = [told(afresh) for afresh in (False, False, True, False, False)]
    assert [list(piece) for piece in _pieces(np.arange(5), rows)] == [[0, 1], [2, 3, 4]]


def test_a_reset_and_a_loss_are_told_as_a_state_taken_up_afresh() -> None:
    columns, _, _ = navsets.mission(np.random.default_rng(16))
    middle = len(columns["time_s"]) // 2
    columns["easting_m"][middle:] += 400.0
    afresh = [e.afresh for e in run(columns).estimates]
    assert afresh[middle]
    assert not any(afresh[:middle])


def test_featureless_ground_gives_no_fix_and_sigma_does_not_shrink() -> None:
    columns, _, _ = navsets.mission(np.random.default_rng(6), relief_m=0.0)
    result = run(columns, relief_m=0.0)
    t = result.trajectory
    assert CONVERGED not in (t.status or ())
    assert not any(fix.accepted for fix in result.fixes)
    assert "no fix" in result.fixes[-1].reason
    # Nothing is learnt of the place: sigma stays that of the start, a tenth allowed for sampling.
    assert t.sigma_easting_m.min() > 45


@pytest.mark.parametrize("relief_m", [8.0, 0.5])
@pytest.mark.parametrize("phase", [1.3, 2.9])
def test_a_map_of_other_ground_never_gives_a_confident_wrong_position(
    relief_m: float, phase: float
) -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(7), relief_m=relief_m)
    result = run(columns, relief_m, phase=phase)
    assert false_fixes(result, errors(result, easting, northing)) == 0
    assert (result.trajectory.status or ())[-1] != CONVERGED


def test_a_start_eight_sigmas_off_is_recovered() -> None:
    columns, easting, northing = navsets.mission(
        np.random.default_rng(7), rows=220, offset_m=(-400.0, 0.0)
    )
    result = run(columns)
    error = errors(result, easting, northing)
    assert false_fixes(result, error) == 0
    assert error[-20:].max() < 5.0


def test_a_depth_step_is_taken_up_without_losing_the_place() -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(8))
    columns["depth_m"] = columns["depth_m"] + np.where(np.arange(150) >= 90, 10.0, 0.0)
    result = run(columns)
    error = errors(result, easting, northing)
    assert error[90:].max() < 6.0
    assert any("depth stepped" in e.reason for e in result.estimates)


def test_a_silence_is_dead_reckoning_and_ends_with_the_next_soundings() -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(9))
    for b in range(1, 5):
        columns[f"beam{b}_m"][60:110] = np.nan
    result = run(columns)
    status = np.array(result.trajectory.status)
    assert set(status[70:110]) == {"dead-reckoning"}
    assert status[-1] == CONVERGED
    assert errors(result, easting, northing)[-20:].max() < 5.0
    # Sigma grows without soundings.
    sigma = result.trajectory.sigma_easting_m
    assert sigma[109] > sigma[60]


def test_one_wild_beam_in_ten_does_no_harm() -> None:
    rng = np.random.default_rng(10)
    columns, easting, northing = navsets.mission(rng)
    for b in range(1, 5):
        wild = rng.random(150) < 0.1
        columns[f"beam{b}_m"] = np.where(wild, rng.uniform(5, 150, 150), columns[f"beam{b}_m"])
    result = run(columns)
    assert LOST not in (result.trajectory.status or ())
    assert np.sqrt(np.mean(errors(result, easting, northing)[75:] ** 2)) < 2.5


def test_repeated_and_late_rows_are_answered_one_to_one() -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(11))
    order = list(range(150))
    order[60:60] = [59, 59]  # repeated
    order[100], order[101] = order[101], order[100]  # late
    shuffled = {name: values[order] for name, values in columns.items()}
    result = run(shuffled)
    assert len(result.trajectory.time_s) == len(order)
    error = errors(result, easting[order], northing[order])
    assert error[60:].max() < 5.0


def test_a_reset_of_dead_reckoning_is_followed() -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(12))
    columns["easting_m"] = columns["easting_m"] + np.where(np.arange(150) >= 80, 300.0, 0.0)
    result = run(columns)
    assert errors(result, easting, northing)[100:].max() < 6.0


def test_moving_world_and_vehicle_together_moves_the_answer_with_them() -> None:
    columns, _, _ = navsets.mission(np.random.default_rng(13), rows=60)
    nav = nav_table(columns)
    moved = nav_table({**columns, "easting_m": columns["easting_m"] + 5e5})
    grid = navsets.prior(np.random.default_rng(1))
    there = type(grid)(grid.elevation_m, 5e5, grid.north_m, grid.cell_m, grid.crs, grid.sigma_m)
    ends = [
        navigate(Navigator(terrain_map(g), n.sensors, np.random.default_rng(2)), n)
        for g, n in ((grid, nav), (there, moved))
    ]
    gap = ends[1].trajectory.easting_m - ends[0].trajectory.easting_m
    # Rounding at 5e5 m is 1e-10; the search amplifies it by resampling at other particles.
    np.testing.assert_allclose(gap[30:], 5e5, atol=1.5)
