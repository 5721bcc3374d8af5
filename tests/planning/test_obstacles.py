"""Objects that the map smooths are held clear of with their own heights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.object_layer import ObjectLayer, read_objects
from perception.records import Grid, InputError
from planning.limits import VehicleLimits
from planning.obstacles import obstacles_on
from planning.planner import PlanConfig, solve
from planning.problem import Problem
from tests.planning.terrains import flat, grid_of


def layer(
    rows: list[tuple[float, float, float, float]], crater: bool = False, least: bool = False,
    sigma_m: float = 0.0, position_sigma_m: float = 0.0,
) -> ObjectLayer:  # fmt: skip
    easting, northing, height, radius = np.array(rows, float).T
    n = len(rows)
    return ObjectLayer(
        easting, northing, height, radius, np.full(n, crater), np.full(n, sigma_m),
        np.full(n, position_sigma_m), np.full(n, least),
    )  # fmt: skip


@pytest.fixture
def grid() -> Grid:
    return grid_of(flat())


def middle(grid: Grid) -> tuple[float, float]:
    return 0.5 * (grid.west_m + grid.east_m), 0.5 * (grid.south_m + grid.north_m)


def test_every_point_of_a_footprint_is_raised_to_the_top(grid: Grid) -> None:
    e, n = middle(grid)
    e, n = e + 0.3 * grid.cell_m, n - 0.4 * grid.cell_m
    radius = 2.6 * grid.cell_m
    found = obstacles_on(grid, layer([(e, n, 3.0, radius)]))
    tops = replace(grid, elevation_m=np.fmax(grid.elevation_m, found.top_m))
    angle = np.linspace(0, 2 * np.pi, 200)
    for share in (0.0, 0.5, 1.0):
        at = e + share * radius * np.cos(angle), n + share * radius * np.sin(angle)
        assert tops.sample(*at) == pytest.approx(grid.sample(*at) + 3.0, abs=1e-6)
    far = grid.sample(np.array([e + radius + 4 * grid.cell_m]), np.array([n]))
    assert tops.sample(np.array([e + radius + 4 * grid.cell_m]), np.array([n])) == far


def test_on_a_slope_an_object_stands_on_the_floor_beneath_each_cell(grid: Grid) -> None:
    east, _ = np.meshgrid(*grid.centres())
    slope = replace(grid, elevation_m=-50.0 + 0.2 * (east - grid.west_m))
    e, n = middle(grid)
    found = obstacles_on(slope, layer([(e, n, 2.0, 3 * grid.cell_m)]))
    there = np.isfinite(found.top_m)
    assert there.any()
    assert found.top_m[there] == pytest.approx(slope.elevation_m[there] + 2.0, abs=1e-6)


def test_an_object_that_the_map_has_already_raises_it_no_further(grid: Grid) -> None:
    e, n = middle(grid)
    east, north = np.meshgrid(*grid.centres())
    radius = 3 * grid.cell_m
    boulder = np.where(np.hypot(east - e, north - n) <= radius, 2.0, 0.0)
    known = replace(grid, elevation_m=grid.elevation_m + boulder)
    found = obstacles_on(known, layer([(e, n, 2.0, radius)]))
    assert np.nanmax(found.top_m) == pytest.approx(np.nanmax(known.elevation_m), abs=1e-6)


def test_craters_and_objects_without_height_raise_nothing(grid: Grid) -> None:
    e, n = middle(grid)
    assert np.isnan(obstacles_on(grid, layer([(e, n, 3.0, 5.0)], crater=True)).top_m).all()
    assert np.isnan(obstacles_on(grid, layer([(e, n, np.nan, 5.0)])).top_m).all()


def test_an_uncertain_place_widens_the_footprint_and_an_uncertain_height_the_clearance(
    grid: Grid,
) -> None:
    e, n = middle(grid)
    one = layer([(e, n, 3.0, 2 * grid.cell_m)])
    wide = layer([(e, n, 3.0, 2 * grid.cell_m)], position_sigma_m=2 * grid.cell_m)
    found = obstacles_on(grid, one)
    assert np.isfinite(obstacles_on(grid, wide).top_m).sum() > 2 * np.isfinite(found.top_m).sum()
    unsure = obstacles_on(grid, layer([(e, n, 3.0, 2 * grid.cell_m)], sigma_m=0.4))
    sigma = np.full(grid.shape, 0.3)
    problem = Problem(replace(grid, sigma_m=sigma), obstacles=unsure)
    lower = problem.surface(sigma, 2.0).lower_m
    there = np.isfinite(unsure.top_m)
    assert lower[there] == pytest.approx(unsure.top_m[there] + 5.0 + 2.0 * 0.5)
    assert lower[~there] == pytest.approx(grid.elevation_m[~there] + 5.0 + 2.0 * 0.3)


def test_what_is_unknown_to_the_map_stays_unknown_under_an_object(grid: Grid) -> None:
    e, n = middle(grid)
    hole = np.array(grid.elevation_m)
    hole[:, hole.shape[1] // 2] = np.nan
    found = obstacles_on(replace(grid, elevation_m=hole), layer([(e, n, 3.0, 4 * grid.cell_m)]))
    problem = Problem(replace(grid, elevation_m=hole), obstacles=found)
    assert problem.surface(None, 0.0).barred[:, hole.shape[1] // 2].all()


def test_a_route_clears_a_boulder_that_the_map_does_not_show(grid: Grid) -> None:
    e, n = middle(grid)
    reach = 0.35 * (grid.east_m - grid.west_m)
    row = [(e, n + step, 6.0, 4.0) for step in np.arange(-2 * reach, 2 * reach, 4.0)]
    problem = Problem(grid, VehicleLimits(pitch_up_deg=40, pitch_down_deg=40))
    ends = (e - reach, n), (e + reach, n)
    quick = PlanConfig("none")
    plain = solve(problem, *ends, quick).route
    walled = replace(problem, obstacles=obstacles_on(grid, layer(row)))
    over = solve(walled, *ends, quick).route
    assert plain is not None and over is not None
    crossing = np.interp(e, over.easting_m, over.altitude_m)
    assert np.interp(e, plain.easting_m, plain.altitude_m) == pytest.approx(5.0, abs=0.2)
    assert crossing >= 11.0 - 1e-6


def test_ground_under_an_object_of_unknown_height_bars_a_route(grid: Grid) -> None:
    e, n = middle(grid)
    found = obstacles_on(grid, layer([(e, n, 1.0, 3.0)], least=True))
    barred = Problem(grid, obstacles=found).surface(None, 0.0).barred
    assert barred[found.barred].all()
    assert found.barred.any() and not found.barred.all()


def test_an_object_without_a_place_is_refused_by_its_number(tmp_path: Path, grid: Grid) -> None:
    path = tmp_path / "objects.csv"
    path.write_text("easting_m,northing_m,kind,height_m\n10,20,hill,2.5\n,,hill,2\n")
    with pytest.raises(InputError, match="object 2 of 2 has no position"):
        read_objects(path, grid)


def test_a_list_tells_craters_sigmas_and_least_heights(tmp_path: Path, grid: Grid) -> None:
    path = tmp_path / "objects.csv"
    path.write_text(
        "easting_m,northing_m,kind,height_m,sigma_m,bound\n"
        "10,20,hill,2.5,0.3,\n11,21,crater,1.5,,\n12,22,hill,3.5,0.5,lower\n"
    )
    found = read_objects(path, grid)
    assert found.crater.tolist() == [False, True, False]
    assert found.least.tolist() == [False, False, True]
    assert found.sigma_m.tolist() == [0.3, 0.0, 0.5]
    assert found.position_sigma_m.tolist() == [0.0, 0.0, 0.0]
