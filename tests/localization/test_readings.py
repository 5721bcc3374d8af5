"""A map's readings: slopes that are the ground's, not the error's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from localization.hypotheses import hypotheses
from localization.readings import expected_ground
from localization.terrain import TerrainMap, terrain_map
from perception.records import FloatArray, Grid

CELL = (5.0, 5.0)


def correlated(shape: tuple[int, int], length_m: float, rng: np.random.Generator) -> FloatArray:
    # A Gaussian kernel of width s gives a Gaussian correlation that falls to 1/e at 2 s.
    field = ndimage.gaussian_filter(rng.standard_normal(shape), length_m / 5.0 / 2.0, mode="wrap")
    return np.asarray(field / field.std())


def slopes(height_m: FloatArray) -> FloatArray:
    return np.concatenate([np.diff(height_m, axis=i).ravel() / 5.0 for i in (0, 1)])


def test_the_ground_s_slopes_are_what_the_reading_has_on_average() -> None:
    rng = np.random.default_rng(0)
    truth = correlated((300, 300), 250.0, rng)
    map_m = truth + 0.3 * correlated((300, 300), 20.0, rng)
    (reading,) = expected_ground(map_m, np.ones_like(map_m), CELL, 0.3, {20.0: 1.0})

    def regression(height_m: FloatArray) -> float:
        g, true = slopes(height_m), slopes(truth)
        return float(g @ true / (g @ g))

    # Of the raw map's slopes a part is error's; regression of truth on the reading's is one.
    assert regression(map_m) < 0.5
    # Octaves are wide beside a narrow error, so some of it stays.
    assert regression(reading.height_m) == pytest.approx(1.0, abs=0.2)
    left = float(np.std(reading.height_m - truth))
    assert left < 0.25 < float(np.std(map_m - truth))
    assert left < 1.25 * reading.shared_m


def test_ground_of_much_more_power_than_the_error_is_left_alone() -> None:
    rng = np.random.default_rng(1)
    truth = 30.0 * correlated((200, 200), 60.0, rng)
    (reading,) = expected_ground(truth, np.ones_like(truth), CELL, 0.1, {50.0: 1.0})
    assert np.std(reading.height_m - truth) < 0.03
    assert reading.shared_m == pytest.approx(0.1, rel=0.1)


def test_a_smooth_valley_beside_a_mountain_is_judged_by_itself() -> None:
    rng = np.random.default_rng(2)
    steep = np.linspace(0, 1, 400)[None, :] ** 4
    truth = 40.0 * steep * correlated((300, 400), 60.0, rng)
    map_m = truth + 0.3 * correlated((300, 400), 20.0, rng)
    (reading,) = expected_ground(map_m, np.ones_like(map_m), CELL, 0.3, {20.0: 1.0})
    valley, mountain = np.s_[:, :100], np.s_[:, 300:]
    bumps = slopes(reading.height_m[valley]).std() / slopes(map_m[valley]).std()
    assert bumps < 0.5
    change = slopes(reading.height_m[mountain] - map_m[mountain]).std()
    assert change < 0.1 * slopes(map_m[mountain]).std()


def test_holes_and_levels_pass_through() -> None:
    rng = np.random.default_rng(3)
    map_m = correlated((80, 90), 40.0, rng)
    map_m[20:30, 40:50] = np.nan
    low, high = (
        expected_ground(map_m + level, np.ones_like(map_m), CELL, 0.2, {15.0: 1.0})[0].height_m
        for level in (0.0, -3000.0)
    )
    np.testing.assert_array_equal(np.isnan(low), np.isnan(map_m))
    # Single precision at 3 km is 0.2 mm.
    np.testing.assert_allclose(high - low, np.where(np.isnan(map_m), np.nan, -3000.0), atol=2e-3)


def unknown(error_m: float, length_m: float | None) -> TerrainMap:
    rng = np.random.default_rng(4)
    height = correlated((200, 200), 150.0, rng) + 0.3 * correlated((200, 200), 30.0, rng)
    grid = Grid(height, 0.0, 1000.0, 5.0, "", np.full((200, 200), error_m))
    return terrain_map(grid, length_m)


def test_an_unknown_length_is_several_hypotheses_and_a_known_one_is_one() -> None:
    several, one = unknown(0.3, None), unknown(0.3, 30.0)
    assert len(several.readings) == 4
    assert several.readings[0].length_m < 10 < 140 < several.readings[-1].length_m
    assert [r.length_m for r in one.readings] == [30.0]
    assert {h.length_m for h in hypotheses(one, None)} == {30.0}
    # A known random walk is the only one.
    assert {h.walk_m2_s for h in hypotheses(several, 3.0)} == {9.0 / 3600}


def test_cells_of_larger_sigma_are_trusted_less() -> None:
    rng = np.random.default_rng(5)
    map_m = correlated((200, 300), 40.0, rng)
    excess = np.where(np.arange(300) < 150, 1.0, 6.0) * np.ones((200, 1))
    (reading,) = expected_ground(map_m, excess, CELL, 0.2, {20.0: 1.0})
    change = np.abs(reading.height_m - map_m)
    assert change[:, 200:].mean() > 3 * change[:, :100].mean()
    assert replace(reading, weight=0.5).length_m == 20.0
