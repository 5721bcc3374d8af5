"""Tiles: the map made tile by tile is the map made in one piece, by any number of workers, resumed or not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapping.fusion import fuse
from mapping.mosaic import echo_mosaic
from mapping.placed import placed
from mapping.quality import survey_quality
from mapping.tile_figures import map_figures
from mapping.tile_plan import (
    FiledStrip,
    StripFile,
    TilePlan,
    as_planned,
    filed,
    load_plan,
    plan_tiles,
    save_plan,
)
from mapping.tile_run import fuse_tiles
from mapping.tile_store import TileStore
from mapping.tiles import LAYERS
from perception.records import ElevationStrip, InputError, Trajectory
from perception.strip_files import write_strip
from tests.mapping.worlds import CRS, ORIGIN, fractal


def a_survey(rng: np.random.Generator) -> tuple[list[ElevationStrip], Trajectory]:
    """Three crossing, bending passes with holes and a navigation gap over rough ground."""
    strips = []
    ground = fractal(rng, 256, 1.0, 1.6) - 30.0
    for index, (east, north, heading_deg) in enumerate([(20, 5, 10), (90, 80, 250), (40, 60, 100)]):
        n, across = 180, np.arange(-30.0, 30.1, 0.7)
        heading = np.radians(heading_deg) + 0.4 * np.sin(np.arange(n) / 40.0)
        step = np.full(n, 0.5)
        step[90] = 12.0  # a gap, not to be bridged
        e = ORIGIN[0] + east + np.cumsum(step * np.sin(heading))
        n_m = ORIGIN[1] + north + np.cumsum(step * np.cos(heading))
        rows = (n_m[:, None] - np.sin(heading)[:, None] * across - ORIGIN[1]).astype(int) % 256
        cols = (e[:, None] + np.cos(heading)[:, None] * across - ORIGIN[0]).astype(int) % 256
        height = ground[rows, cols] + 0.2 * rng.normal(size=rows.shape)
        height[rng.random(height.shape) < 0.05] = np.nan
        height[40:60, 20:30] = np.nan
        strips.append(
            ElevationStrip(
                elevation_m=height.astype(np.float32),
                sigma_m=(0.1 + 0.01 * np.abs(across) + np.zeros((n, 1))).astype(np.float32),
                across_m=across,
                echo=rng.gamma(4.0, 0.25, height.shape).astype(np.float32),
                shadow=np.zeros(height.shape, bool),
                time_s=1.7e9 + np.arange(n),
                ping=np.arange(n) + 1000 * index,
                easting_m=e,
                northing_m=n_m,
                depth_m=np.full(n, 15.0),
                heading_rad=heading,
                altitude_m=np.full(n, 15.0),
                altitude_sigma_m=np.full(n, 0.1),
                crs=CRS,
                pass_index=index,
            )
        )
    joined = {
        name: np.concatenate([getattr(s, name) for s in strips])
        for name in ("time_s", "easting_m", "northing_m", "depth_m", "heading_rad")
    }
    n = len(joined["time_s"])
    ping = np.concatenate([s.ping for s in strips])
    sigma = rng.uniform(0.1, 0.5, n)
    return strips, Trajectory(
        **joined, sigma_easting_m=sigma, sigma_northing_m=sigma, cov_en_m2=np.zeros(n), ping=ping
    )


def a_plan(
    folder: Path, strips: list[ElevationStrip], track: Trajectory, cell_m: float, tile_cells: int
) -> TilePlan:
    there = []
    for index, strip in enumerate(strips):
        path = folder / f"strip-{index:03d}.nc"
        write_strip(path, strip)
        there.append(filed(StripFile.of(path), placed(strip, track, 0.05), strip.altitude_m))
    return plan_tiles(there, cell_m, CRS, tile_cells=tile_cells)


def whole(store: TileStore, name: str, plan: TilePlan) -> np.ndarray:
    return store.read(name, (slice(0, plan.shape[0]), slice(0, plan.shape[1])))


@pytest.mark.parametrize(("cell_m", "tile_cells"), [(1.0, 37), (0.4, 128), (2.5, 1000)])
def test_the_tiled_map_is_the_map_in_one_piece(
    tmp_path: Path, cell_m: float, tile_cells: int
) -> None:
    """To the last bit of the file's float32, outliers, Birge's ratio and slopes at edges included."""
    strips, track = a_survey(np.random.default_rng(1))
    plan = a_plan(tmp_path, strips, track, cell_m, tile_cells)
    store, figures, new = fuse_tiles(plan, tmp_path / "tiles")
    grid = fuse(strips, cell_m, trajectory=track, height_sigma_m=np.full(3, 0.05))
    assert plan.shape == grid.shape and new == len(plan.tiles())
    assert (plan.west_m, plan.north_m) == (grid.west_m, grid.north_m)
    for name, expected in (
        ("elevation", grid.elevation_m), ("sigma", grid.sigma_m), ("count", grid.count)
    ):  # fmt: skip
        np.testing.assert_array_equal(whole(store, name, plan), expected.astype(np.float32))
    mosaic = echo_mosaic(strips, cell_m)
    echo = whole(store, "echo", plan)
    row = round((plan.north_m - mosaic.north_m) / cell_m)
    col = round((mosaic.west_m - plan.west_m) / cell_m)
    inner = mosaic.elevation_m[-row if row < 0 else 0 :, -col if col < 0 else 0 :]
    inner = inner[: echo.shape[0], : echo.shape[1]].astype(np.float32)
    both = np.isfinite(inner) & np.isfinite(echo[: inner.shape[0], : inner.shape[1]])
    np.testing.assert_array_equal(echo[: inner.shape[0], : inner.shape[1]][both], inner[both])
    quality = survey_quality(strips, grid)
    said = map_figures(figures, plan.shape[0] * plan.shape[1], cell_m)
    for key in ("mapped_m2", "coverage_of_rectangle", "s44_special_vertical_share"):
        assert said[key] == pytest.approx(quality[key])
    assert said["sigma_median_m"] == pytest.approx(np.nanmedian(grid.sigma_m), rel=0.012)


def test_any_number_of_workers_gives_the_same_bits(tmp_path: Path) -> None:
    from distributed import Client, LocalCluster

    strips, track = a_survey(np.random.default_rng(2))
    plan = a_plan(tmp_path, strips, track, 1.0, 50)
    store, figures, _ = fuse_tiles(plan, tmp_path / "alone")
    expected = {name: whole(store, name, plan) for name in LAYERS}
    for workers in (1, 2):
        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):  # fmt: skip
            store, theirs, new = fuse_tiles(plan, tmp_path / f"by-{workers}", client)
        assert new == len(plan.tiles()) and theirs == figures
        for name, values in expected.items():
            np.testing.assert_array_equal(whole(store, name, plan), values)


def test_a_worker_that_is_killed_is_replaced_and_its_tiles_are_made_all_the_same(
    tmp_path: Path,
) -> None:
    import os
    import signal

    from scenarios.cluster import open_cluster

    strips, track = a_survey(np.random.default_rng(2))
    plan = a_plan(tmp_path, strips, track, 1.0, 30)
    store, figures, _ = fuse_tiles(plan, tmp_path / "alone")
    expected = whole(store, "elevation", plan)
    killed: list[int] = []

    def kill_one(label: str, done: int, total: int) -> None:
        """Kill a worker outright once it has made its first tiles."""
        if done >= 2 and not killed:
            killed.extend(client.run(os.getpid).values())
            os.kill(killed[0], signal.SIGKILL)

    with open_cluster(n_workers=2) as client:
        store, theirs, new = fuse_tiles(plan, tmp_path / "struck", client, kill_one)
        after = set(client.run(os.getpid).values())
    assert killed and killed[0] not in after
    assert new == len(plan.tiles()) > 4 and theirs == figures
    np.testing.assert_array_equal(whole(store, "elevation", plan), expected)


def test_a_killed_run_goes_on_and_changed_strips_are_made_anew(tmp_path: Path) -> None:
    strips, track = a_survey(np.random.default_rng(3))
    plan = a_plan(tmp_path, strips, track, 1.0, 40)
    folder = tmp_path / "tiles"
    store, figures, _ = fuse_tiles(plan, folder)
    expected = whole(store, "elevation", plan)
    # Killed: two tiles lack their marks, one of them half written.
    marks = sorted((folder / "marks").glob("*.json"))
    for mark in marks[:2]:
        mark.unlink()
    store.write(plan.slices((0, 0)), None)
    _, again, new = fuse_tiles(plan, folder)
    assert new == 2 and again == figures
    np.testing.assert_array_equal(whole(store, "elevation", plan), expected)
    # A mark that is not whole counts for nothing.
    marks[0].write_text('{"key": ')
    assert fuse_tiles(plan, folder)[2] == 1
    # One strip higher: the tiles that it touches, and no other.
    raised = replace(plan.strips[1], strip=replace(plan.strips[1].strip, height_m=0.5))
    moved = replace(plan, strips=(plan.strips[0], raised, plan.strips[2]))
    _, _, new = fuse_tiles(moved, folder)
    assert new == sum(1 in plan.touching(tile) for tile in plan.tiles()) < len(plan.tiles())
    # Another cell: nothing of the old store is left.
    assert fuse_tiles(plan_tiles(plan.strips, 2.0, CRS, tile_cells=40), folder)[2] > 0
    assert TileStore(folder).read("elevation", (slice(0, 1), slice(0, 1))).shape == (1, 1)


def moved(one: FiledStrip, east_m: float, north_m: float = 0.0, turn: float = 0.0) -> FiledStrip:
    place = replace(
        one.strip,
        easting_m=one.strip.easting_m + east_m,
        northing_m=one.strip.northing_m + north_m,
        heading_rad=one.strip.heading_rad + turn,
    )
    return replace(one, strip=place)


def western_edge(one: FiledStrip) -> float:
    across = np.cos(one.strip.heading_rad)[:, None] * one.strip.reach_m
    return float(np.nanmin(one.strip.easting_m[:, None] + across))


def test_poses_of_a_graph_solved_again_remake_no_tile(tmp_path: Path) -> None:
    """On edges of rounding and of the map's lattice a hair is no move; more than 1e-5 m in all is one."""
    strips, track = a_survey(np.random.default_rng(3))
    first = list(a_plan(tmp_path, strips, track, 1.0, 40).strips)
    edges = np.round(first[1].strip.northing_m, 5) + 0.5e-5
    first[1] = replace(first[1], strip=replace(first[1].strip, northing_m=edges))
    # A hair further west the map has a column more.
    to_edge_m = -(min(western_edge(one) for one in first) % 1.0)
    first = [moved(one, to_edge_m) for one in first]
    folder = tmp_path / "tiles"

    def planned(there: list[FiledStrip]) -> TilePlan:
        return plan_tiles(as_planned(there, folder / "plan.npz"), 1.0, CRS, tile_cells=40)

    plan = planned(first)
    assert fuse_tiles(plan, folder)[2] == len(plan.tiles())
    for hair in (1e-9, -1e-9):
        again = planned([moved(one, hair, -hair, 1e-3 * hair) for one in first])
        assert again.window == plan.window and fuse_tiles(again, folder)[2] == 0
    # Twice six micrometres are beside the first, not beside the one between.
    touched = sum(1 in plan.touching(tile) for tile in plan.tiles())
    for aside, expected in ((6e-6, 0), (1.2e-5, touched)):
        again = planned([first[0], moved(first[1], 0.0, aside), first[2]])
        assert fuse_tiles(again, folder)[2] == expected
    (folder / "plan.npz").write_bytes(b"PK, but no plan")
    assert as_planned(first, folder / "plan.npz") == first


def test_a_run_killed_between_tile_and_mark_leaves_no_mark_of_an_older_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A is done, B (one strip higher) is killed before it marks, A again: no tile of B is taken for A's."""
    from mapping.tile_fill import fill_tiles

    strips, track = a_survey(np.random.default_rng(8))
    plan = a_plan(tmp_path, strips, track, 1.0, 1000)
    folder = tmp_path / "tiles"
    store, _, _ = fuse_tiles(plan, folder)
    fill_tiles(plan, store, 4.0)
    expected = {name: whole(store, name, plan) for name in ("elevation", "fill")}
    raised = replace(plan.strips[1], strip=replace(plan.strips[1].strip, height_m=5.0))
    moved = replace(plan, strips=(plan.strips[0], raised, plan.strips[2]))

    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    for stage in ("marks", "fill-marks"):
        with monkeypatch.context() as patched:
            if stage == "fill-marks":
                fuse_tiles(moved, folder)
            patched.setattr(TileStore, "mark", killed)
            with pytest.raises(KeyboardInterrupt):
                if stage == "marks":
                    fuse_tiles(moved, folder)
                else:
                    fill_tiles(moved, store, 4.0)
        _, _, new = fuse_tiles(plan, folder)
        fill_tiles(plan, store, 4.0)
        assert new == len(plan.tiles())
        for name, values in expected.items():
            np.testing.assert_array_equal(whole(store, name, plan), values)


def test_a_plan_comes_back_as_it_was(tmp_path: Path) -> None:
    strips, track = a_survey(np.random.default_rng(4))
    plan = a_plan(tmp_path, strips, track, 1.0, 64)
    save_plan(tmp_path / "plan.npz", plan)
    back = load_plan(tmp_path / "plan.npz")
    assert [back.key(tile) for tile in back.tiles()] == [plan.key(tile) for tile in plan.tiles()]


def test_a_strip_file_that_went_away_is_named(tmp_path: Path) -> None:
    strips, track = a_survey(np.random.default_rng(5))
    plan = a_plan(tmp_path, strips, track, 1.0, 64)
    (tmp_path / "strip-001.nc").unlink()
    with pytest.raises(InputError, match=r"strip-001\.nc"):
        fuse_tiles(plan, tmp_path / "tiles")


def test_the_store_opens_as_a_labelled_data_set(tmp_path: Path) -> None:
    import xarray

    strips, track = a_survey(np.random.default_rng(6))
    plan = a_plan(tmp_path, strips, track, 1.0, 64)
    fuse_tiles(plan, tmp_path / "tiles")
    data = xarray.open_zarr(tmp_path / "tiles" / "map.zarr", consolidated=False)
    assert data["elevation"].dims == ("y", "x") and data["elevation"].attrs["units"] == "m"
    assert float(data["x"][1] - data["x"][0]) == 1.0 and float(data["y"][0]) > float(data["y"][1])
    assert data["crs"].attrs["grid_mapping_name"] == "transverse_mercator"
    assert json.dumps(data.attrs["frame"])


def test_gaps_are_filled_in_tiles_as_in_one_piece(tmp_path: Path) -> None:
    from mapping.fill import fill_gaps, learn_variogram
    from mapping.tile_fill import fill_tiles

    strips, track = a_survey(np.random.default_rng(7))
    plan = a_plan(tmp_path, strips, track, 0.5, 1000)
    store, _, _ = fuse_tiles(plan, tmp_path / "one")
    height, sigma = whole(store, "elevation", plan), whole(store, "sigma", plan)
    number = fill_tiles(plan, store, 4.0)
    variogram = learn_variogram([height], 0.5, 4.0)
    expected = fill_gaps(height.astype(float), sigma.astype(float), 0.5, 4.0, variogram)
    one = whole(store, "fill", plan)
    np.testing.assert_array_equal(one, expected[0].astype(np.float32))
    assert (
        number == np.isfinite(one).sum() > 100
        and not (np.isfinite(one) & np.isfinite(height)).any()
    )
    # Small tiles learn from the same cells but those at their edges: nearly the same variogram.
    many = replace(plan, tile_cells=100)
    store, _, _ = fuse_tiles(many, tmp_path / "many")
    fill_tiles(many, store, 4.0)
    part = whole(store, "fill", many)
    np.testing.assert_array_equal(np.isfinite(part), np.isfinite(one))
    spread = whole(store, "fill_sigma", many)
    assert np.nanmax(np.abs(part - one) / spread) < 0.25
    assert fill_tiles(many, store, 4.0) == number
