"""Map files: heights, sigma and frame come back; depth turns over; what cannot be used is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from mapping.rasters import read_map, write_map
from perception.records import Grid, InputError

BATHYMETRY = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "bathymetry"


def a_grid() -> Grid:
    rng = np.random.default_rng(0)
    height = -30.0 + rng.normal(size=(40, 60))
    height[3:6, 4:9] = np.nan
    return Grid(
        height, 500_000.0, 5_600_040.0, 1.0, "EPSG:32630", np.full((40, 60), 0.1),
        np.full((40, 60), 7.0), "MSL",
    )  # fmt: skip


def test_a_map_comes_back_with_bands_frame_and_datum(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif", a_grid(), {"MADE_BY": "test"})
    back = read_map(tmp_path / "map.tif")
    np.testing.assert_allclose(back.elevation_m, a_grid().elevation_m, atol=1e-5)
    np.testing.assert_allclose(back.sigma_m, 0.1, atol=1e-6)
    np.testing.assert_allclose(back.count, 7.0)
    assert (back.west_m, back.north_m, back.cell_m) == (500_000.0, 5_600_040.0, 1.0)
    assert back.crs == "EPSG:32630" and back.datum == "MSL"


def test_the_file_is_a_cloud_optimised_geotiff_of_named_bands(tmp_path: Path) -> None:
    write_map(tmp_path / "map.tif", a_grid())
    with rasterio.open(tmp_path / "map.tif") as raster:
        assert raster.descriptions == ("elevation", "sigma", "count")
        assert raster.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert np.isnan(raster.nodata) and raster.dtypes[0] == "float32"


def write_raw(
    path: Path, values: np.ndarray, transform: Affine, crs: str | None, name: str = "", **more: object
) -> Path:  # fmt: skip
    with rasterio.open(
        path, "w", driver="GTiff", dtype="float32", count=1, width=values.shape[1],
        height=values.shape[0], transform=transform, crs=crs, **more,
    ) as target:  # fmt: skip
        target.write(values.astype("float32"), 1)
        if name:
            target.set_band_description(1, name)
    return path


NORTH_UP = Affine(2.0, 0.0, 500_000.0, 0.0, -2.0, 5_600_000.0)


def test_a_band_of_depth_is_turned_over_and_nodata_is_nan(tmp_path: Path) -> None:
    values = np.full((10, 12), 25.0)
    values[2, 3] = -9999.0
    path = write_raw(tmp_path / "d.tif", values, NORTH_UP, "EPSG:32630", "depth", nodata=-9999.0)
    grid = read_map(path, sigma_m=0.3)
    assert np.isnan(grid.elevation_m[2, 3]) and grid.elevation_m[0, 0] == -25.0
    assert np.isnan(grid.sigma_m[2, 3]) and grid.sigma_m[0, 0] == 0.3


@pytest.mark.parametrize("value", [-9999.0, -32768.0, 3.4e38])
def test_a_value_for_no_data_that_the_file_does_not_declare_is_no_height(
    tmp_path: Path, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    values = np.full((10, 12), -25.0)
    values[2:4, 3] = value
    grid = read_map(write_raw(tmp_path / "m.tif", values, NORTH_UP, "EPSG:32630"))
    assert np.isnan(grid.elevation_m[2:4, 3]).all() and np.isfinite(grid.elevation_m).sum() == 118
    assert len(caplog.messages) == 1 and "taken for no data" in caplog.text


def test_a_usual_number_for_no_data_among_heights_of_its_size_is_a_height(tmp_path: Path) -> None:
    """In centimetres 9,999 is a depth of 99.99 m: among depths of a hundred metres it is one."""
    values = -10_000.0 + np.random.default_rng(0).integers(-300, 300, (10, 12))
    values[2:4, 3] = -9999.0
    path = write_raw(tmp_path / "cm.tif", values, NORTH_UP, "EPSG:32630")
    with rasterio.open(path, "r+") as target:
        target.set_band_unit(1, "cm")
    np.testing.assert_allclose(read_map(path).elevation_m[2:4, 3], -99.99)
    shallow = write_raw(
        tmp_path / "s.tif", np.where(values == -9999.0, values, values / 8), NORTH_UP, "EPSG:32630"
    )
    with rasterio.open(shallow, "r+") as target:
        target.set_band_unit(1, "cm")
    assert np.isnan(read_map(shallow).elevation_m[2:4, 3]).all()


@pytest.mark.parametrize("value", [0.0, 100.0])
def test_a_rim_of_one_value_far_from_the_ground_is_told_and_kept(
    tmp_path: Path, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    values = -40.0 + np.random.default_rng(0).normal(size=(30, 40))
    whole = read_map(write_raw(tmp_path / "whole.tif", values, NORTH_UP, "EPSG:32630"))
    assert np.isfinite(whole.elevation_m).all() and not caplog.messages
    values[:3] = values[:, :4] = value
    grid = read_map(write_raw(tmp_path / "m.tif", values, NORTH_UP, "EPSG:32630"))
    assert (grid.elevation_m == value).sum() == 3 * 40 + 27 * 4
    assert f"228 cells hold exactly {value:g}" in caplog.text
    assert f"-a_nodata {value:g} m.tif" in caplog.text


def test_an_unknown_unit_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_raw(tmp_path / "m.tif", np.full((4, 5), -100.0), NORTH_UP, "EPSG:32630")
    with rasterio.open(path, "r+") as target:
        target.set_band_unit(1, "cubits")
    np.testing.assert_allclose(read_map(path).elevation_m, -100.0)
    assert "'cubits', is not known: read as metres" in caplog.text


def test_a_raster_cut_short_is_told_as_such(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(300, 300))
    path = write_raw(tmp_path / "m.tif", values, NORTH_UP, "EPSG:32630")
    path.write_bytes(path.read_bytes()[:100_000])
    with pytest.raises(InputError, match="cut short or damaged"):
        read_map(path)


@pytest.mark.parametrize(
    ("unit", "crs", "metres"),
    [
        ("ft", "EPSG:32630", 0.3048),
        ("US survey foot", "EPSG:32630", 1200 / 3937),
        ("m", "EPSG:32630", 1.0),
        ("", "EPSG:32630+6360", 1200 / 3937),  # NAVD88 height (ftUS)
        ("", "EPSG:32630+5703", 1.0),
    ],
)
def test_heights_in_feet_are_turned_to_metres_and_told_of(
    tmp_path: Path, unit: str, crs: str, metres: float, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_raw(tmp_path / "m.tif", np.full((4, 5), -100.0), NORTH_UP, crs)
    if unit:
        with rasterio.open(path, "r+") as target:
            target.set_band_unit(1, unit)
    grid = read_map(path)
    np.testing.assert_allclose(grid.elevation_m, -100.0 * metres)
    assert ("turned to metres" in caplog.text) == (metres != 1.0)


@pytest.mark.parametrize(
    ("transform", "crs", "said"),
    [
        (Affine.identity(), None, "no georeference"),
        (Affine(1.0, 0.2, 0.0, 0.2, -1.0, 0.0), "EPSG:32630", "north to south"),
        (Affine(0.001, 0.0, -3.0, 0.0, -0.001, 50.0), "EPSG:4326", "in degrees"),
        (NORTH_UP, "EPSG:2225", "foot"),
    ],
)
def test_a_frame_that_is_no_map_in_metres_is_refused(
    tmp_path: Path, transform: Affine, crs: str | None, said: str
) -> None:
    path = write_raw(tmp_path / "m.tif", np.zeros((5, 5)), transform, crs)
    with pytest.raises(InputError, match=said):
        read_map(path)


def test_files_that_are_no_raster_are_refused(tmp_path: Path) -> None:
    (tmp_path / "noise.tif").write_bytes(np.random.default_rng(0).bytes(4096))
    (tmp_path / "empty.tif").write_bytes(b"")
    with pytest.raises(InputError, match="cannot read it as a raster"):
        read_map(tmp_path / "noise.tif")
    with pytest.raises(InputError, match="is empty"):
        read_map(tmp_path / "empty.tif")
    with pytest.raises(InputError, match="no such file"):
        read_map(tmp_path / "missing.tif")


def test_an_asc_grid_is_read(tmp_path: Path) -> None:
    (tmp_path / "g.asc").write_text(
        "ncols 3\nnrows 2\nxllcorner 500000\nyllcorner 5600000\ncellsize 10\nNODATA_value -9999\n"
        "-20 -21 -22\n-23 -9999 -25\n"
    )
    grid = read_map(tmp_path / "g.asc")
    np.testing.assert_allclose(grid.elevation_m, [[-20, -21, -22], [-23, np.nan, -25]])
    assert grid.north_m == 5_600_020.0 and grid.cell_m == 10.0


@pytest.mark.parametrize(
    ("name", "uncertain"), [("JD211_public_Release_1-4_UTM.bag", True), ("bdb_01.bag", False)]
)
def test_public_bags_hold_heights_and_the_uncertainty_they_have(name: str, uncertain: bool) -> None:
    """The second one's uncertainty layer is empty: that is no sigma, not a sigma of NaN."""
    path = BATHYMETRY / name
    if not path.exists():
        pytest.skip(f"{path} is not there")
    grid = read_map(path)
    assert np.isfinite(grid.elevation_m).any() and np.nanmedian(grid.elevation_m) < 0
    assert (grid.sigma_m is not None) == uncertain


def test_the_public_netcdf_grid_is_read_or_refused_with_a_way_out() -> None:
    path = BATHYMETRY / "tut_bathy.nc"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    with pytest.raises(InputError, match="gdalwarp"):
        read_map(path)
