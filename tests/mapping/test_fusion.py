"""Fusion: weighted means, honest sigma, outliers out, no holes, edges on multiples of the cell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.fusion import combine, default_cell, fuse
from mapping.gridding import COUNT, HEIGHT, WEIGHT, Spacing, Window, bin_lines
from mapping.mosaic import echo_mosaic
from mapping.objects import merge_objects, write_objects
from mapping.placed import PassRaster
from mapping.quality import crossing_differences, survey_quality
from perception.objects import ObjectTable
from perception.records import ElevationStrip, InputError
from tests.mapping.worlds import CRS, ORIGIN


def a_strip(
    height_m: float = -30.0, sigma_m: float = 0.2, heading_deg: float = 0.0, lines: int = 60,
    east_m: float = 30.0, north_m: float = 10.0,
) -> ElevationStrip:  # fmt: skip
    across = np.arange(-20.0, 20.01, 0.5)
    n, m = lines, len(across)
    heading = np.radians(heading_deg)
    along = np.arange(n) * 0.5
    return ElevationStrip(
        elevation_m=np.full((n, m), height_m),
        sigma_m=np.full((n, m), sigma_m),
        across_m=across,
        echo=np.ones((n, m)),
        shadow=np.zeros((n, m), bool),
        time_s=1.7e9 + along,
        ping=np.arange(n),
        easting_m=ORIGIN[0] + east_m + np.sin(heading) * along,
        northing_m=ORIGIN[1] + north_m + np.cos(heading) * along,
        depth_m=np.full(n, 15.0),
        heading_rad=np.full(n, heading),
        altitude_m=np.full(n, 15.0),
        altitude_sigma_m=np.full(n, 0.1),
        crs=CRS,
    )


def test_passes_are_weighted_by_their_variance() -> None:
    grid = fuse([a_strip(-30.0, 0.1), a_strip(-30.1, 0.2)], 1.0)
    inner = grid.elevation_m[5:-5, 5:-5]
    weights = np.array([1 / 0.01, 1 / 0.04])
    expected = weights @ [-30.0, -30.1] / weights.sum()
    np.testing.assert_allclose(inner, expected, atol=1e-9)
    np.testing.assert_allclose(grid.sigma_m[5:-5, 5:-5], weights.sum() ** -0.5, rtol=1e-6)


def test_many_data_of_one_pass_do_not_make_it_surer() -> None:
    """Four times the lines: the same altitude error in all of them."""
    strip = a_strip(sigma_m=0.3)
    coarse, fine = fuse([strip], 1.0), fuse([strip], 4.0)
    assert np.nanmin(coarse.sigma_m) == pytest.approx(0.3)
    assert np.nanmin(fine.sigma_m) == pytest.approx(0.3)
    assert np.nanmax(fine.count) > 10 * np.nanmax(coarse.count)


def test_passes_that_disagree_make_the_mean_less_sure() -> None:
    grid = fuse([a_strip(-30.0, 0.1), a_strip(-31.0, 0.1)], 1.0)
    np.testing.assert_allclose(grid.elevation_m[5:-5, 5:-5], -30.5)
    # Birge: chi-square of one degree of freedom is 50, sigma 0.1 / sqrt(2) times sqrt(50).
    np.testing.assert_allclose(grid.sigma_m[5:-5, 5:-5], 0.5, rtol=1e-6)


def test_one_wrong_pass_of_four_is_left_out() -> None:
    grid = fuse([a_strip(h, 0.1) for h in (-30.0, -30.05, -29.95, -22.0)], 1.0)
    np.testing.assert_allclose(grid.elevation_m[5:-5, 5:-5], -30.0, atol=1e-9)


@pytest.mark.parametrize("heading_deg", [0.0, 33.0, 90.0])
@pytest.mark.parametrize("cell_m", [0.25, 0.5, 1.3])
def test_no_cell_inside_a_strip_is_empty(heading_deg: float, cell_m: float) -> None:
    """Columns and lines 0.5 m apart, cells half as wide: what lies between samples is interpolated."""
    strip = a_strip(heading_deg=heading_deg)
    grid = fuse([strip], cell_m)
    east, north = strip.positions()
    inner = np.s_[5:-5, 5:-5]
    assert np.isfinite(grid.sample(east[inner], north[inner])).all()
    # Edges lie at multiples of the cell.
    assert (grid.west_m / cell_m) == pytest.approx(round(grid.west_m / cell_m), abs=1e-6)
    assert (grid.north_m / cell_m) == pytest.approx(round(grid.north_m / cell_m), abs=1e-6)


def test_the_position_s_uncertainty_times_the_slope_is_in_the_sigma() -> None:
    from perception.records import Trajectory

    strip = a_strip(sigma_m=0.1)
    east, _ = strip.positions()
    strip = replace(strip, elevation_m=-30.0 + 0.5 * (east - ORIGIN[0]))
    n = len(strip.ping)
    track = Trajectory(
        strip.time_s, strip.easting_m, strip.northing_m, strip.depth_m, strip.heading_rad,
        np.full(n, 0.4), np.full(n, 0.4), np.zeros(n), ping=strip.ping,
    )  # fmt: skip
    grid = fuse([strip], 1.0, trajectory=track)
    np.testing.assert_allclose(grid.sigma_m[5:-5, 5:-5], np.hypot(0.1, 0.5 * 0.4), rtol=1e-6)


def test_binning_equals_bincount() -> None:
    rng = np.random.default_rng(0)
    strip = a_strip(heading_deg=20.0)
    height = strip.elevation_m + rng.normal(size=strip.elevation_m.shape)
    rows, cols = 80, 80
    row0, col0 = int(ORIGIN[1]), int(ORIGIN[0])
    sums = bin_lines(
        height, strip.sigma_m, strip.easting_m, strip.northing_m, strip.heading_rad, strip.across_m,
        np.zeros(len(height)), Spacing(1, 1, 10.0), 1.0, Window(row0, col0, rows, cols), (row0, col0),
    )  # fmt: skip
    e, n = strip.positions()
    index = np.floor(n - ORIGIN[1]).astype(int) * cols + np.floor(e - ORIGIN[0]).astype(int)
    inside = (e - ORIGIN[0] >= 0) & (e - ORIGIN[0] < cols) & (n - ORIGIN[1] >= 0)
    expected = np.bincount(index[inside], height[inside] / 0.04, minlength=rows * cols)
    np.testing.assert_allclose(sums[..., HEIGHT].ravel(), expected, rtol=1e-9)
    number = np.bincount(index[inside], minlength=rows * cols)
    np.testing.assert_allclose(sums[..., COUNT].ravel(), number)
    np.testing.assert_allclose(sums[..., WEIGHT].ravel(), number / 0.04)


def test_the_default_cell_follows_the_resolution() -> None:
    assert default_cell([a_strip()]) == 0.5


def test_strips_of_two_zones_are_refused() -> None:
    with pytest.raises(InputError, match="different coordinate systems"):
        fuse([a_strip(), replace(a_strip(), crs="EPSG:32631")])


def test_strips_without_a_height_are_refused() -> None:
    strip = a_strip()
    with pytest.raises(InputError, match="no strip holds a single height"):
        fuse([replace(strip, elevation_m=np.full_like(strip.elevation_m, np.nan))])


def test_the_mosaic_averages_power() -> None:
    bright = replace(a_strip(), echo=np.full_like(a_strip().echo, 3.0))
    mosaic = echo_mosaic([a_strip(), bright], 1.0)
    np.testing.assert_allclose(mosaic.elevation_m[5:-5, 5:-5], 10 * np.log10(2.0), atol=1e-6)


def test_crossing_statistics_and_orders() -> None:
    north = a_strip(-30.0, 0.1, 0.0)
    east = a_strip(-30.2, 0.1, 90.0, east_m=15.0, north_m=25.2)
    difference, sigma = crossing_differences([north, east])
    np.testing.assert_allclose(difference, [-0.2])
    np.testing.assert_allclose(sigma, [np.hypot(0.1, 0.1)])
    figures = survey_quality([north, east], fuse([north], 1.0))
    assert figures["crossings"] == 1
    # 1.96 x 0.1 = 0.196 m against sqrt(0.25^2 + 0.225^2) and sqrt(0.15^2 + 0.225^2).
    assert figures["s44_exclusive_vertical_share"] == 1.0
    worse = fuse([a_strip(-30.0, 0.25)], 1.0)
    figures = survey_quality([north], worse)
    assert figures["s44_special_vertical_share"] == 0.0
    assert figures["s44_1a_vertical_share"] == 1.0


def a_table(rows: list[tuple[float, float, str, float, float]], which: int) -> ObjectTable:
    n = len(rows)
    east, north, kind, height, sigma = zip(*rows, strict=True)
    zero = np.zeros(n)
    return ObjectTable(
        easting_m=np.array(east), northing_m=np.array(north), kind=tuple(kind),
        height_m=np.array(height), sigma_m=np.array(sigma), slant_range_m=zero,
        shadow_length_m=zero, pass_index=np.full(n, which), ping=np.zeros(n, int), across_m=zero,
        along_m=zero, half_across_m=zero, half_along_m=zero, shape=zero, gain=zero,
        probability=zero + 1, lower_bound=zero > 0, drop_m=zero + 10, floor_sigma_m=zero,
    )  # fmt: skip


def test_looks_at_one_object_become_one_and_contradictions_stay_apart(tmp_path: Path) -> None:
    tables = [
        a_table([(0, 0, "hill", 1.0, 0.1), (50, 0, "crater", 0.5, 0.1)], 0),
        a_table([(1, 0, "hill", 1.2, 0.2), (50, 1, "hill", 0.5, 0.1)], 1),
        a_table([(0, 1, "hill", 1.1, 0.1), (100, 0, "hill", 2.0, 0.1)], 2),
    ]
    merged = merge_objects(tables)
    assert len(merged) == 4
    first = int(np.argmin(np.hypot(merged.easting_m, merged.northing_m)))
    assert merged.looks[first] == merged.passes[first] == 3
    weights = np.array([100.0, 25.0, 100.0])
    assert merged.height_m[first] == pytest.approx(weights @ [1.0, 1.2, 1.1] / 225.0)
    assert merged.disputed.sum() == 2
    assert np.allclose(merged.easting_m[merged.disputed], 50.0)

    path = tmp_path / "objects.gpkg"
    write_objects(path, merged, CRS)
    assert path.stat().st_size > 0


def test_a_least_height_yields_to_a_closed_look_and_is_told_where_there_is_none(
    tmp_path: Path,
) -> None:
    """An open shadow proves 1 m; another pass measures 3 m. A second object has open shadows alone."""
    from mapping.object_layer import read_objects
    from perception.records import Grid

    opened = replace(
        a_table([(0, 0, "hill", 1.0, 0.1), (60, 0, "hill", 2.0, 0.2)], 0),
        lower_bound=np.array([True, True]), half_across_m=np.array([1.5, 2.5]),
    )  # fmt: skip
    closed = a_table([(1, 0, "hill", 3.0, 0.1)], 1)
    again = replace(a_table([(60, 1, "hill", 2.5, 0.2)], 2), lower_bound=np.array([True]))
    merged = merge_objects([opened, closed, again])
    assert len(merged) == 2 and not merged.disputed.any()
    write_objects(tmp_path / "objects.gpkg", merged, CRS)
    grid = Grid(np.zeros((4, 4)), -2.0, 2.0, 0.5, crs=CRS)
    found = read_objects(tmp_path / "objects.gpkg", grid)
    order = np.argsort(found.easting_m)
    np.testing.assert_allclose(found.height_m[order], [3.0, 2.5])
    assert found.least[order].tolist() == [False, True]
    np.testing.assert_allclose(found.radius_m[order], [1.5, 2.5])


def test_two_objects_of_one_pass_never_merge() -> None:
    merged = merge_objects([a_table([(0, 0, "hill", 1.0, 0.1), (0.5, 0, "hill", 1.0, 0.1)], 0)])
    assert len(merged) == 2
    assert len(merge_objects([])) == 0


def test_the_kernels_of_fusion_do_what_their_numpy_twins_do() -> None:
    """Six passes on overlapping windows, two of them wild in places: mean, sigma and count, one by one cell."""
    rng = np.random.default_rng(8)
    shape, rasters = (40, 50), []
    for k in range(6):
        row0, col0 = rng.integers(0, 8, 2)
        size = (40 - row0 - rng.integers(0, 5), 50 - col0 - rng.integers(0, 5))
        height = -30.0 + 0.1 * rng.normal(size=size)
        height[rng.random(size) < 0.1] = np.nan
        if k > 3:
            height[rng.random(size) < 0.3] += 3.0
        variance = np.where(np.isfinite(height), rng.uniform(0.005, 0.02, size), np.nan)
        position = rng.uniform(0, 0.1, size)
        rasters.append(
            PassRaster(
                int(row0), int(col0), height, variance, position, rng.integers(0, 5, size) * 1.0
            )
        )
    mean, _, count = combine(rasters, shape, 1.0)
    for row in range(0, 40, 3):
        for col in range(0, 50, 3):
            here = []
            for r in rasters:
                i, j = row - r.row0, col - r.col0
                inside = 0 <= i < r.height_m.shape[0] and 0 <= j < r.height_m.shape[1]
                if inside and np.isfinite(r.height_m[i, j]):
                    here.append((r.height_m[i, j], r.variance_m2[i, j], r.count[i, j]))
            for _ in range(3):
                ratios = []
                for k, (h, v, _) in enumerate(here):
                    others = here[:k] + here[k + 1 :]
                    w = np.array([1 / o[1] for o in others])
                    rest = (w @ [o[0] for o in others]) / w.sum() if len(others) > 1 else h
                    ratios.append(
                        abs(h - rest) / np.sqrt(v + 1 / w.sum()) if len(others) > 1 else 0.0
                    )
                if not ratios or max(ratios) <= 4.0:
                    break
                here.pop(int(np.argmax(ratios)))
            if here:
                w = np.array([1 / v for _, v, _ in here])
                assert mean[row, col] == pytest.approx((w @ [h for h, _, _ in here]) / w.sum())
                assert count[row, col] == sum(n for _, _, n in here)
            else:
                assert np.isnan(mean[row, col])
