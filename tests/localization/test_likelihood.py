"""The likelihood and the filters of the search."""

from __future__ import annotations

import navsets
import numpy as np
import pytest

from localization.likelihood import bias_marginal, sounding_noise
from localization.measurements import Beam, beam_vectors, default_beams, soundings_of
from localization.navfile import nav_table
from localization.particles import ParticleFilter, weigh
from localization.pointmass import PointMassFilter
from localization.terrain import TerrainMap, terrain_map


def ground() -> TerrainMap:
    return terrain_map(navsets.prior(np.random.default_rng(0)))


def test_the_vector_kernel_agrees_with_the_plain_likelihood() -> None:
    rng = np.random.default_rng(1)
    terrain = ground()
    n = 300
    east, north = rng.normal(0, 300, (2, n))  # some off the map
    turn, bias = rng.normal(0, 0.01, n), rng.normal(0, 1, n)
    variance, log_weight = rng.uniform(0.2, 2, n), np.zeros(n)
    oe, on = np.array([30.0, 30, -30, -30]), np.array([30.0, -30, -30, 30])
    z, r = -100 + rng.normal(0, 5, 4), np.full(4, 0.4)
    expected = [
        bias_marginal(
            terrain.height_m, terrain.frame, east[i], north[i], turn[i], bias[i], variance[i],
            600.0, 600.0, oe, on, z, r, 1e-3,
        )
        for i in range(n)
    ]  # fmt: skip
    work = np.empty((7, n), np.float32)
    weigh(
        terrain.height_m, terrain.frame, east, north, turn, bias, variance, log_weight, 600.0,
        600.0, oe, on, z, r, 1e-3, work,
    )  # fmt: skip
    value = np.array([e[0] for e in expected])
    # Single precision: heights to 1e-5 m of 0.6 m, gates may flip at their very edge.
    close = np.isclose(log_weight, value - value.max(), atol=5e-3)
    assert close.mean() > 0.98
    np.testing.assert_allclose(bias[close], np.array([e[1] for e in expected])[close], atol=2e-3)


def test_the_depth_bias_is_marginalised_exactly_on_level_ground() -> None:
    grid = navsets.prior(np.random.default_rng(0), relief_m=0.0, error_m=0.0)
    terrain = terrain_map(grid, error_length_m=100.0)
    z, r = np.array([-99.0, -98.6, -99.2, -98.9]), np.full(4, 0.25)
    gain, m, v, fitting = bias_marginal(
        terrain.height_m, terrain.frame, 0.0, 0.0, 0.0, 0.0, 1.0, 600.0, 600.0, np.zeros(4),
        np.zeros(4), z, r, 0.0,
    )  # fmt: skip
    covariance = 0.25 * np.eye(4) + 1.0
    y = z + 100.0
    joint = -0.5 * (y @ np.linalg.solve(covariance, y) + np.linalg.slogdet(covariance)[1])
    np.testing.assert_allclose(gain, joint, atol=1e-4)
    np.testing.assert_allclose([m, v], [np.sum(y) / 0.25 / 17, 1 / 17], atol=1e-4)
    assert fitting == 4


def test_standing_still_over_one_spot_does_not_add_up() -> None:
    terrain = ground()
    columns, _, _ = navsets.mission(np.random.default_rng(2), rows=3)
    nav = nav_table(columns)
    soundings = soundings_of(nav.row(0), beam_vectors(nav.sensors.beams), np.full(4, 0.01), 0.02)
    moving = sounding_noise(soundings, terrain, 0.1, 5.0).inflated_m2
    still = sounding_noise(soundings, terrain, 0.1, 0.0).inflated_m2
    assert np.all(still > 10 * moving)


def test_particles_and_point_masses_agree_on_where_the_vehicle_is() -> None:
    terrain = ground()
    columns, _, _ = navsets.mission(np.random.default_rng(3), rows=25, offset_m=(20.0, -15.0))
    nav = nav_table(columns)
    vectors = beam_vectors(nav.sensors.beams)
    start = np.diag([30.0, 30.0, 0.0087, 0.005, 1.0]) ** 2
    filters = (
        ParticleFilter(terrain, 4000, np.random.default_rng(4)),
        PointMassFilter(terrain, 121),
    )
    for f in filters:
        f.start(np.zeros(5), start)
        before = nav.row(0)
        for m in nav:
            f.predict(m.easting_m - before.easting_m, m.northing_m - before.northing_m, 1e-3)
            s = soundings_of(m, vectors, np.full(4, 0.01), 0.02)
            f.update(s, m.easting_m, m.northing_m, 4.5, 1e-6)
            before = m
    (one, cov_one), (two, cov_two) = (f.moments() for f in filters)
    np.testing.assert_allclose(one[:2], two[:2], atol=3.0)
    truth = np.array([20.0, -15.0])
    for mean, covariance in ((one, cov_one), (two, cov_two)):
        d = mean[:2] - truth
        # Four sigmas: chi-square of two degrees of freedom.
        assert d @ np.linalg.solve(covariance[:2, :2], d) < 16


def test_default_beams_are_a_janus_and_a_single_beam_looks_down() -> None:
    np.testing.assert_allclose(
        np.degrees([b.azimuth_rad for b in default_beams(4)]), [45, 135, 225, 315]
    )
    assert default_beams(1) == (Beam(0.0, 0.0),)


def test_a_pitched_beam_lands_ahead_and_a_rolled_one_to_port() -> None:
    from localization.measurements import body_axes

    down = np.array([0.0, 0.0, 1.0])
    # Bow up tilts the belly's normal ahead; starboard down tilts it to port (west on heading north).
    assert (body_axes(0.0, 0.1, 0.0) @ down)[1] > 0.09
    assert (body_axes(0.0, 0.0, 0.1) @ down)[0] < -0.09


@pytest.mark.parametrize("columns", [100, 40_000])
def test_a_sounding_on_the_last_cell_meets_no_map_however_wide_the_map_is(columns: int) -> None:
    """Between the last cell and the one after it there is nothing to read: memory ends there."""
    heights = np.zeros((2, columns), np.float32)
    single = np.zeros((4, 1))
    work, log_weight = np.empty((7, 1), np.float32), np.zeros(1)
    fitting = [
        weigh(
            heights, np.array([0.0, 0.0, 1.0, 1.0]), single[0], single[1], single[2], single[3],
            np.ones(1), log_weight, float(at), -0.5, np.zeros(1), np.zeros(1), np.zeros(1),
            np.ones(1), 0.0, work,
        )[1]
        for at in (columns - 1.5, columns - 1)
    ]  # fmt: skip
    assert fitting == [1, 0]
