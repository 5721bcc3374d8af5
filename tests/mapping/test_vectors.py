"""Vector layers: what is written comes back, in the map's frame and in degrees."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

from mapping.vectors import read_polygons, write_layer
from perception.records import InputError

CRS = "EPSG:32630"
BOX = shapely.box(500_000.0, 5_600_000.0, 500_100.0, 5_600_050.0)


def test_polygons_come_back_from_a_geopackage(tmp_path: Path) -> None:
    write_layer(tmp_path / "a.gpkg", [BOX], {"area_m2": np.array([5000.0])}, CRS, "Polygon")
    (back,) = read_polygons(tmp_path / "a.gpkg", CRS)
    assert back.equals(BOX)


def test_geojson_is_in_longitude_and_latitude_and_comes_back_in_metres(tmp_path: Path) -> None:
    write_layer(tmp_path / "a.geojson", [BOX], {"name": np.array(["x"], object)}, CRS, "Polygon")
    record = json.loads((tmp_path / "a.geojson").read_text())
    lon, lat = record["features"][0]["geometry"]["coordinates"][0][0]
    assert -3.01 < lon < -2.9 and 50.0 < lat < 51.0
    (back,) = read_polygons(tmp_path / "a.geojson", CRS)
    assert back.hausdorff_distance(BOX) < 0.01


def test_a_file_without_polygons_is_refused(tmp_path: Path) -> None:
    point = shapely.Point(500_000.0, 5_600_000.0)
    write_layer(tmp_path / "p.gpkg", [point], {"n": np.array([1])}, CRS, "Point")
    with pytest.raises(InputError, match="holds no polygon"):
        read_polygons(tmp_path / "p.gpkg", CRS)
    (tmp_path / "noise.gpkg").write_bytes(b"not a geopackage at all")
    with pytest.raises(InputError, match="cannot be read as polygons"):
        read_polygons(tmp_path / "noise.gpkg", CRS)


def test_metres_in_a_geojson_without_a_crs_are_not_taken_for_degrees(tmp_path: Path) -> None:
    feature = {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(BOX))}
    path = tmp_path / "metres.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    with pytest.raises(InputError, match="no degrees"):
        read_polygons(path, CRS)


@pytest.mark.filterwarnings("error")
def test_a_layer_without_a_crs_is_written_without_a_word(tmp_path: Path) -> None:
    write_layer(tmp_path / "a.gpkg", [shapely.Point(1, 2)], {"n": np.array([1])}, "", "Point")
    assert pyogrio.read_info(tmp_path / "a.gpkg")["crs"] is None
