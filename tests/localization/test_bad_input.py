"""Navigation that no instrument should write, and some does: the navigator answers, and stays honest."""

from __future__ import annotations

import navsets
import numpy as np
import pytest

from localization.estimate import CONVERGED, Estimate
from localization.measurements import Sensors
from localization.navfile import nav_table
from localization.navigator import Navigator
from localization.particles import ParticleFilter
from localization.terrain import terrain_map
from perception.records import FloatArray

# A fix is false when it claims less than this and is off by more than that.
CLAIMED_M, OFF_M = 10.0, 25.0


def estimates(columns: dict[str, FloatArray], sensors: Sensors | None = None) -> list[Estimate]:
    nav = nav_table(columns, sensors)
    terrain = terrain_map(navsets.prior(np.random.default_rng(99)))
    navigator = Navigator(terrain, nav.sensors, np.random.default_rng(0))
    return [navigator.update(m) for m in nav]


def false_fixes(told: list[Estimate], easting: FloatArray, northing: FloatArray) -> int:
    count = 0
    for e, x, y in zip(told, easting, northing, strict=True):
        claimed = float(np.sqrt(np.linalg.eigvalsh(e.covariance_m2)[-1]))
        count += claimed < CLAIMED_M and np.hypot(e.easting_m - x, e.northing_m - y) > OFF_M
    return count


@pytest.mark.parametrize(
    "name", ["time_s", "easting_m", "northing_m", "depth_m", "heading_deg", "beam1_m"]
)
def test_a_row_that_lacks_a_value_is_answered_and_the_place_kept(name: str) -> None:
    columns, easting, northing = navsets.mission(np.random.default_rng(31))
    n = len(columns["time_s"])
    columns[name] = columns[name].copy()
    columns[name][n // 2 : n // 2 + 8] = np.nan
    told = estimates(columns)
    assert len(told) == n
    last = told[-1]
    assert last.status == CONVERGED
    assert np.hypot(last.easting_m - easting[-1], last.northing_m - northing[-1]) < 4.0
    if name != "time_s":
        assert all(np.isfinite([e.easting_m, e.northing_m]).all() for e in told)


def test_beams_that_contradict_each_other_give_no_false_fix() -> None:
    """Two of four beams read a third too long throughout, as a wrong beam table makes them."""
    columns, easting, northing = navsets.mission(np.random.default_rng(32))
    for name in ("beam2_m", "beam4_m"):
        columns[name] = 1.35 * columns[name]
    told = estimates(columns)
    assert false_fixes(told, easting, northing) == 0


@pytest.mark.parametrize("fraction", [1e-5, 1e-4])
def test_ranges_far_noisier_than_stated_give_no_false_fix(fraction: float) -> None:
    """Stated to a millimetre and noisy by half a metre, almost every particle dies at once."""
    columns, easting, northing = navsets.mission(np.random.default_rng(33))
    told = estimates(columns, Sensors(beam_fraction=fraction, beam_floor_m=0.001))
    assert false_fixes(told, easting, northing) == 0
    assert all(np.isfinite(e.covariance_m2).all() for e in told)


def test_a_collapsed_cloud_comes_back_with_a_spread() -> None:
    terrain = terrain_map(navsets.prior(np.random.default_rng(99)))
    search = ParticleFilter(terrain, 500, np.random.default_rng(1))
    search.start(np.zeros(5), np.diag([20.0, 20.0, 0.01, 0.005, 1.0]) ** 2)
    # All weight on one of them.
    search.cloud.log_weight[:] = -1e4
    search.cloud.log_weight[7] = 0.0
    search.take(search.cloud)
    nav = nav_table(navsets.mission(np.random.default_rng(34))[0])
    navigator = Navigator(terrain, nav.sensors, np.random.default_rng(0))
    navigator.search = search
    told = [navigator.update(m) for m, _ in zip(nav, range(20), strict=False)]
    assert all(np.isfinite(e.covariance_m2).all() for e in told)
    _, covariance = navigator.search.moments()
    assert np.all(np.diag(covariance)[:2] > 0)
