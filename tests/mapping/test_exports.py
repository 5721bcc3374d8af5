"""Maps for other programs: the same heights, frame, CRS, nodata and names by GDAL's and by netCDF's door."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import rasterio

from mapping.cog import Frame, write_cog
from mapping.exports import check_frame, export_map
from mapping.rasters import open_map, read_map, write_map
from perception.records import Grid, InputError


def a_grid(rows: int = 700, cols: int = 530) -> Grid:
    rng = np.random.default_rng(0)
    height = -30.0 + rng.normal(size=(rows, cols)).astype(np.float32).astype(float)
    height[3:60, 4:90] = np.nan
    sigma = np.where(np.isfinite(height), 0.125, np.nan)
    return Grid(
        height, 500_000.0, 5_600_040.0, 0.5, "EPSG:32630", sigma, np.full(height.shape, 7.0), "MSL"
    )


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "map.tif"
    write_map(path, a_grid())
    return path


@pytest.mark.parametrize("suffix", [".nc", ".grd", ".bag", ".asc"])
def test_an_exported_map_reads_back_as_it_was(source: Path, tmp_path: Path, suffix: str) -> None:
    export_map(source, tmp_path / f"map{suffix}")
    back, grid = read_map(tmp_path / f"map{suffix}"), a_grid()
    tolerance = 1e-3 if suffix == ".asc" else 0
    np.testing.assert_allclose(back.elevation_m, grid.elevation_m, atol=tolerance)
    assert (back.west_m, back.north_m, back.cell_m) == (500_000.0, 5_600_040.0, 0.5)
    if suffix in (".nc", ".bag"):
        np.testing.assert_allclose(back.sigma_m, grid.sigma_m)
    assert back.crs == "EPSG:32630"
    # By a window as well, as large maps are read.
    with open_map(tmp_path / f"map{suffix}") as opened:
        part = opened.read(slice(50, 70), slice(80, 100))
    np.testing.assert_allclose(part.elevation_m, grid.elevation_m[50:70, 80:100], atol=tolerance)
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_the_netcdf_file_speaks_cf(source: Path, tmp_path: Path) -> None:
    export_map(source, tmp_path / "map.nc")
    with netCDF4.Dataset(tmp_path / "map.nc") as data:
        assert data.Conventions == "CF-1.11" and data.vertical_datum == "MSL"
        assert data["x"].standard_name == "projection_x_coordinate" and data["x"].units == "m"
        assert data["elevation"].grid_mapping == "crs" and data["elevation"].units == "m"
        assert data["crs"].grid_mapping_name == "transverse_mercator"
        assert data["y"][1] > data["y"][0] and data["x"][0] == 500_000.25
        np.testing.assert_allclose(data["elevation"][-1], a_grid().elevation_m[0])


def test_the_gmt_grid_is_one_variable_of_cells(source: Path, tmp_path: Path) -> None:
    export_map(source, tmp_path / "map.grd")
    with netCDF4.Dataset(tmp_path / "map.grd") as data:
        assert data.node_offset == 1 and "z" in data.variables and "sigma" not in data.variables
        # GMT's pixel registration: the range is of the outer edges.
        np.testing.assert_allclose(data["x"].actual_range, [500_000.0, 500_265.0])


def test_another_suffix_is_refused(source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.xyz is no format of a map; give one of \.nc"):
        export_map(source, tmp_path / "map.xyz")


def windows(grid: Grid, step: int = 256):  # type: ignore[no-untyped-def]
    for top in range(0, grid.shape[0], step):
        for left in range(0, grid.shape[1], step):
            where = (slice(top, min(top + step, grid.shape[0])),
                     slice(left, min(left + step, grid.shape[1])))  # fmt: skip
            yield where, {"elevation": grid.elevation_m[where], "sigma": grid.sigma_m[where]}


def test_a_raster_written_by_windows_is_a_valid_cog(tmp_path: Path) -> None:
    """The rules of the format: tiled, overviews each half as wide, IFDs before data, small data first."""
    import tifffile

    grid = a_grid(1500, 1300)
    path = tmp_path / "map.tif"
    write_cog(path, Frame.of(grid), ("elevation", "sigma"), windows(grid))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["map.tif"]
    with rasterio.open(path) as raster:
        np.testing.assert_array_equal(raster.read(1), grid.elevation_m.astype(np.float32))
        assert raster.descriptions == ("elevation", "sigma") and np.isnan(raster.nodata)
        assert raster.crs.to_epsg() == 32630 and raster.tags()["VERTICAL_DATUM"] == "MSL"
        assert raster.overviews(1) == [2, 4] and raster.profile["tiled"]
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        tags = raster.tags(1)
        statistics = raster.stats(indexes=1, approx=False)[0]
    known = grid.elevation_m[np.isfinite(grid.elevation_m)]
    assert float(tags["STATISTICS_MEAN"]) == pytest.approx(known.mean(), rel=1e-6)
    assert float(tags["STATISTICS_STDDEV"]) == pytest.approx(known.std(), rel=1e-5)
    assert statistics.min == pytest.approx(known.min()) and statistics.max == pytest.approx(
        known.max()
    )
    with tifffile.TiffFile(path) as file:
        pages = list(file.pages)
        assert [page.imagewidth for page in pages] == [1300, 650, 325]
        offsets = [page.offset for page in pages]
        first = [min(o for o in page.dataoffsets if o) for page in pages]
        assert offsets == sorted(offsets) and max(offsets) < min(first)
        assert first == sorted(first, reverse=True)


def test_drafts_of_killed_runs_go_and_those_of_running_ones_stay(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (tmp_path / f".map.{gone.pid}.draft.tif").write_bytes(b"a killed run's")
    running = f".map.{os.getppid()}.draft.tif"
    (tmp_path / running).write_bytes(b"another run's")
    grid = a_grid(80, 60)
    write_cog(tmp_path / "map.tif", Frame.of(grid), ("elevation", "sigma"), windows(grid))
    assert sorted(p.name for p in tmp_path.iterdir()) == [running, "map.tif"]


def test_a_bag_without_coordinate_system_is_refused_for_what_it_is(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif", replace(a_grid(80, 60), crs=""))
    for suffix in (".nc", ".grd", ".asc"):
        export_map(tmp_path / "map.tif", tmp_path / f"map{suffix}")
    with pytest.raises(InputError, match=r"map\.bag: a BAG needs a coordinate system"):
        export_map(tmp_path / "map.tif", tmp_path / "map.bag")
    assert not (tmp_path / "map.bag").exists()
    with pytest.raises(InputError, match="--crs EPSG:N"):
        check_frame(["map.nc", "map.bag"], "")
    check_frame(["map.bag"], "EPSG:32630")


def test_a_window_that_is_never_written_is_no_data(tmp_path: Path) -> None:
    grid = a_grid(600, 600)
    write_cog(tmp_path / "map.tif", Frame.of(grid), ("elevation",), list(windows(grid))[:1])
    with rasterio.open(tmp_path / "map.tif") as raster:
        values = raster.read(1)
    assert np.isnan(values[256:, 256:]).all() and np.isfinite(values[100, 100])
