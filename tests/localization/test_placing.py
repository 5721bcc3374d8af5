"""A patch placed anywhere in a map: where, which way round, how sure, and when not at all."""

from __future__ import annotations

from dataclasses import replace

import navsets
import numpy as np
import pytest
from scipy import ndimage

from localization import correlation
from localization.compact import CompactMap
from localization.constellation import Constellation, ConstellationMatch, Placement
from localization.placing import Placing, place_on_compact, place_on_raster
from localization.rescaled import in_cells
from perception.records import Grid, InputError

CENTRE_M = (612.5, 587.0)
TURN = 2.2


def prior(error_m: float = 0.1) -> Grid:
    return navsets.prior(np.random.default_rng(1), error_m=error_m)


def patch(
    side_m: float = 305.0,
    cell_m: float = 5.0,
    noise_m: float = 0.4,
    seed: int = 2,
    centre_m: tuple[float, float] = CENTRE_M,
) -> Grid:
    """Heights of a turned square in its own axes, from the analytic floor, three metres too high."""
    n = round(side_m / cell_m)
    at = (np.arange(n) - (n - 1) / 2) * cell_m
    x, y = np.meshgrid(at, at[::-1])
    east = centre_m[0] + np.cos(TURN) * x + np.sin(TURN) * y
    north = centre_m[1] + np.cos(TURN) * y - np.sin(TURN) * x
    noise = noise_m * np.random.default_rng(seed).standard_normal((n, n))
    return Grid(navsets.floor_m(east, north) + 3.0 + noise, 0.0, 0.0, cell_m)


def assert_placed(placing: Placing, near_m: float) -> None:
    best = placing.places[0]
    assert placing.accepted, placing.reason
    assert np.hypot(best.easting_m - CENTRE_M[0], best.northing_m - CENTRE_M[1]) < near_m
    assert abs(best.turn_rad - TURN) < np.radians(1.0)


@pytest.mark.parametrize("cell_m", [5.0, 2.0])
def test_a_patch_of_any_cell_is_placed_with_its_heading(cell_m: float) -> None:
    placing = place_on_raster(prior(), patch(cell_m=cell_m))
    assert_placed(placing, 2.0)
    assert placing.ambiguity < 1e-6


def test_errors_are_as_large_as_claimed() -> None:
    squares = []
    for seed in range(8):
        given = TURN + np.radians(0.5) * np.random.default_rng(seed).standard_normal()
        placing = place_on_raster(prior(0.3), patch(seed=seed, noise_m=1.0), given)
        best = placing.places[0]
        apart = np.array(
            [best.easting_m - CENTRE_M[0], best.northing_m - CENTRE_M[1], given - TURN]
        )
        squares.append(apart @ np.linalg.solve(best.covariance, apart))
        assert np.hypot(*apart[:2]) < best.protection_m
    # Chi-square of 24 degrees of freedom lies within 8 and 51 but for one time in a thousand.
    assert 8.0 < sum(squares) < 51.0


def test_a_heading_given_is_as_sure_as_a_compass_and_the_place_moves_by_its_lever() -> None:
    """A patch whose relief lies all on one side moves sideways when it is turned about its centre."""
    one_sided = patch(side_m=505.0, noise_m=0.05)
    one_sided.elevation_m[:, :50] = np.nan
    off = np.radians(0.5)
    placings = [place_on_raster(prior(), one_sided, TURN + k * off) for k in (-1, 0, 1)]
    assert all(p.accepted for p in placings)
    places = [p.places[0] for p in placings]
    moved = np.array([p.easting_m for p in places]), np.array([p.northing_m for p in places])
    slope = np.array([(m[2] - m[0]) / (2 * off) for m in moved])
    covariance = places[1].covariance
    assert np.sqrt(covariance[2, 2]) == pytest.approx(off)
    # The known part's centre is 125 m from the patch's: half a degree there is 1.1 m.
    assert np.hypot(*slope) * off > 0.5
    np.testing.assert_allclose(covariance[:2, 2] / covariance[2, 2], slope, atol=10.0)
    assert np.trace(covariance[:2, :2]) > 0.8 * np.sum((slope * off) ** 2)


def test_a_patch_partly_off_the_map_is_placed_on_what_is_left_of_it() -> None:
    whole = prior()
    first = 105
    cut = replace(
        whole,
        elevation_m=whole.elevation_m[:, first:],
        west_m=whole.west_m + first * whole.cell_m,
        sigma_m=None,
    )
    assert_placed(place_on_raster(cut, patch()), 3.0)


def test_ground_that_the_map_lacks_is_no_fix() -> None:
    rng = np.random.default_rng(3)
    other = rng.standard_normal((61, 61)).cumsum(axis=0).cumsum(axis=1) / 20
    placing = place_on_raster(prior(), Grid(other, 0.0, 0.0, 5.0), TURN)
    assert not placing.accepted
    assert "no place fits" in placing.reason


def test_a_survey_s_map_of_low_relief_that_errs_in_long_waves_is_placed() -> None:
    """All that the right place leaves is smooth, as ground is; no other place comes near, and it is told apart."""
    rng = np.random.default_rng(13)
    floor = ndimage.gaussian_filter(rng.standard_normal((120, 140)), 2.0) * 4.0
    drift = ndimage.gaussian_filter(rng.standard_normal((90, 90)), 10.0) * 3.0
    whole = Grid(floor, 0.0, 120.0, 1.0)
    placing = place_on_raster(whole, Grid(floor[20:110, 30:120] + drift, 0.0, 90.0, 1.0), 0.0)
    best = placing.places[0]
    assert placing.accepted, placing.reason
    assert np.hypot(best.easting_m - 75.0, best.northing_m - 55.0) < 1.0


def test_smooth_steep_ground_that_the_map_lacks_is_no_fix_whatever_its_octaves_say() -> None:
    other = np.random.default_rng(3).standard_normal((61, 61)).cumsum(axis=0).cumsum(axis=1)
    placing = place_on_raster(
        prior(), Grid(20.0 * ndimage.gaussian_filter(other, 6.0), 0.0, 0.0, 5.0), TURN
    )
    assert not placing.accepted


def test_flat_ground_is_no_fix() -> None:
    flat = Grid(0.2 * np.random.default_rng(4).standard_normal((60, 60)), 0.0, 0.0, 5.0)
    assert not place_on_raster(prior(), flat, TURN).accepted


def test_a_map_that_repeats_itself_is_ambiguous() -> None:
    once = prior().elevation_m[:150, :100]
    twice = Grid(np.concatenate([once, once], axis=1), 0.0, 1000.0, 5.0)
    part = Grid(once[40:100, 20:80].copy(), 0.0, 0.0, 5.0)
    placing = place_on_raster(twice, part, 0.0)
    assert not placing.accepted
    assert "ambiguous" in placing.reason
    assert placing.ambiguity > 0.01


def test_a_hundredth_of_the_map_places_a_patch() -> None:
    carried = CompactMap.of(prior())
    data = carried.packed()
    assert (
        len(data) < 0.015 * 4 * prior().elevation_m.size
    )  # 0.01 on a map of a thousand cells a side
    assert_placed(place_on_compact(CompactMap.unpacked(data), patch(side_m=500.0)), 25.0)


def test_a_hundredth_of_the_map_does_not_place_what_is_not_there() -> None:
    rng = np.random.default_rng(5)
    other = rng.standard_normal((100, 100)).cumsum(axis=0).cumsum(axis=1) / 20
    assert not place_on_compact(CompactMap.of(prior()), Grid(other, 0.0, 0.0, 5.0)).accepted


@pytest.mark.parametrize("surplus", [1.0, 20.0])
def test_landmarks_that_the_thumbnail_cannot_check_must_be_surer(
    surplus: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A patch of three wide cells a side has no evidence on the thumbnail, for or against."""
    place = Placement(*CENTRE_M, TURN, 30.0, 6, np.diag([25.0, 25.0, 1e-3]))
    sure = ConstellationMatch((place,), True, "")
    if surplus > 10:
        sure = replace(sure, surplus=surplus)
    monkeypatch.setattr(Constellation, "match", lambda *_: sure)
    placing = place_on_compact(CompactMap.of(prior()), patch(side_m=105.0))
    assert placing.accepted is (surplus > 10)
    assert "not checked on the thumbnail" in placing.reason


@pytest.mark.filterwarnings("error")
def test_a_patch_with_no_wide_cell_at_all_is_no_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    """One cell in nine has a height: too few for the thumbnail; the landmarks say they know."""
    place = Placement(*CENTRE_M, TURN, 30.0, 6, np.diag([25.0, 25.0, 1e-3]))
    sure = ConstellationMatch((place,), True, "")
    monkeypatch.setattr(Constellation, "match", lambda *_: sure)
    sparse = np.full((100, 100), np.nan)
    sparse[::3, ::3] = np.random.default_rng(8).standard_normal((34, 34)).cumsum(axis=0)
    placing = place_on_compact(CompactMap.of(prior()), Grid(sparse, 0.0, 0.0, 5.0))
    assert not placing.accepted
    assert "not checked on the thumbnail" in placing.reason


def test_scattered_holes_cost_no_wide_cell_and_a_large_hole_stays_one() -> None:
    rng = np.random.default_rng(6)
    whole = prior(0.0)
    for share in (0.02, 0.1, 0.3):
        height = np.where(rng.random(whole.shape) < share, np.nan, whole.elevation_m)
        height[100:150, 100:150] = np.nan
        wide = in_cells(replace(whole, elevation_m=height, sigma_m=None), 35.0)
        expected = in_cells(whole, 35.0).elevation_m
        known = np.isfinite(wide.elevation_m)
        # 50 cells of 240 a side are a hole: 4.3 % of the area.
        assert 0.03 < 1 - known.mean() < 0.055
        assert np.std((wide.elevation_m - expected)[known]) < 0.05 * np.std(expected)


def test_a_small_patch_on_a_large_map_is_searched_on_no_finer_cells_than_the_map_s(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Half cells are four times the memory of a map's cells: 2.5 GB on 2,000 cells a side."""
    shapes, told = [], []

    class Counted(correlation.Spectra):
        def __init__(self, values: np.ndarray, patch_shape: tuple[int, int]) -> None:
            shapes.append(values.shape)
            super().__init__(values, patch_shape)

    monkeypatch.setattr(correlation, "Spectra", Counted)
    rng = np.random.default_rng(7)
    large = ndimage.gaussian_filter(rng.standard_normal((400, 420)), 2.0) * 30.0
    part = large[150:170, 200:220] + 0.02 * rng.standard_normal((20, 20))
    found = correlation.match_patch(large, part, 0.0, progress=lambda *at: told.append(at))
    assert shapes == [(400, 420)]
    assert told[-1] == ("headings tried", 1, 1)
    assert np.hypot(found.best.row - 159.5, found.best.col - 209.5) < 0.2
    correlation.match_patch(large[100:300, 100:300], part, 0.0)
    assert shapes[-1] == (400, 400)


def test_the_coarse_search_leaves_enough_of_a_small_patch_to_know_it_by() -> None:
    rng = np.random.default_rng(9)
    long = ndimage.gaussian_filter(rng.standard_normal((300, 2100)), 0.8) * 30.0
    part = long[61:91, 1203:1233] + 0.02 * rng.standard_normal((30, 30))
    found = correlation.match_patch(long, part, None, step_rad=np.pi / 2)
    assert found.accepted, found.reason
    assert np.hypot(found.best.row - 75.5, found.best.col - 1217.5) < 0.2


@pytest.mark.parametrize(
    ("grid", "words"),
    [
        (Grid(np.zeros((8, 8)), 0.0, 0.0, 5.0), "holds 64 heights"),
        (Grid(np.zeros((2000, 20)), 0.0, 0.0, 5.0), "are they swapped"),
    ],
)
def test_a_patch_that_cannot_be_placed_is_refused_with_the_value(grid: Grid, words: str) -> None:
    with pytest.raises(InputError, match=words):
        place_on_raster(prior(), grid)


@pytest.mark.parametrize("cell_m", [2.5, 12.0])
def test_resampling_keeps_a_plane_where_it_is(cell_m: float) -> None:
    east, north = np.meshgrid((np.arange(60) + 0.5) * 4.0, 240.0 - (np.arange(60) + 0.5) * 4.0)
    grid = Grid(0.1 * east - 0.3 * north, 0.0, 240.0, 4.0)
    out = in_cells(grid, cell_m)
    e, n = np.meshgrid(*out.centres())
    inner = (slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(
        out.elevation_m[inner], (0.1 * e - 0.3 * n)[inner], atol=0.02 * cell_m
    )
