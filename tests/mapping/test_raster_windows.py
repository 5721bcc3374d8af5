"""A map read by windows is the map read whole: bands, signs, sigma, georeference."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_array_equal
from rasterio.transform import from_origin

from mapping.rasters import open_map, read_map
from perception.records import InputError

FRAME = {"width": 30, "height": 20, "transform": from_origin(500_000, 4_100_000, 2.0, 2.0)}


def write(path, bands, names, crs="EPSG:32632"):
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=len(bands),
        dtype="float32",
        nodata=-9999.0,
        crs=crs,
        **FRAME,
    ) as target:
        for i, (band, name) in enumerate(zip(bands, names, strict=True), start=1):
            target.write(band.astype(np.float32), i)
            target.set_band_description(i, name)


@pytest.mark.parametrize("sigma_m", [None, 0.5])
def test_a_window_is_the_same_part_of_the_whole(tmp_path, sigma_m):
    rng = np.random.default_rng(0)
    depth, sigma = rng.uniform(20, 40, (20, 30)), rng.uniform(0.1, 0.3, (20, 30))
    depth[3:5, 4:9] = -9999.0
    write(tmp_path / "m.tif", [sigma, depth], ["uncertainty", "depth"])
    whole = read_map(tmp_path / "m.tif", sigma_m)
    assert np.nanmax(whole.elevation_m) < 0
    with open_map(tmp_path / "m.tif", sigma_m) as opened:
        part = opened.read(slice(2, 12), slice(3, 25))
    assert_array_equal(part.elevation_m, whole.elevation_m[2:12, 3:25])
    assert_array_equal(part.sigma_m, whole.sigma_m[2:12, 3:25])
    easting, northing = whole.centres()
    assert_array_equal(part.centres()[0], easting[3:25])
    assert_array_equal(part.centres()[1], northing[2:12])


def test_a_map_in_degrees_is_refused_before_anything_is_read(tmp_path):
    write(tmp_path / "m.tif", [np.zeros((20, 30))], ["elevation"], crs="EPSG:4326")
    with (
        pytest.raises(InputError, match="cells are in degrees"),
        open_map(tmp_path / "m.tif"),
    ):
        pass
