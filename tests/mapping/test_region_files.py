"""Region maps on disk: what is written is read back, and other programs find what they expect."""

import sqlite3
from xml.etree import ElementTree

import numpy as np
import pyogrio
import pyogrio.raw
import pytest
import rasterio
import shapely

from mapping.object_layer import read_objects
from mapping.region_files import read_regions, region_polygons, write_segmentation
from perception.records import REGION_CLASSES, Grid, InputError
from perception.regions import RegionConfig, segment


@pytest.fixture(scope="module")
def grid():
    y, x = np.mgrid[:60, :80].astype(float)
    z = 4 * np.exp(-((x - 30) ** 2 + (y - 30) ** 2) / 200) - 0.02 * y - 30
    z += np.random.default_rng(1).normal(0, 0.03, z.shape)
    z[40:50, 60:70] = np.nan
    return Grid(z, 500000.0, 7000060.0, 1.0, crs="EPSG:32602")


@pytest.fixture(scope="module")
def result(grid):
    return segment(grid, RegionConfig(levels=2))


@pytest.fixture(scope="module")
def folder(result, tmp_path_factory):
    out = tmp_path_factory.mktemp("regions")
    write_segmentation(out, result)
    return out


def test_regions_come_back_as_written(folder, result):
    regions, found = result.regions, read_regions(folder / "regions.tif")
    np.testing.assert_array_equal(found.class_code, regions.class_code)
    np.testing.assert_array_equal(found.region, regions.region)
    np.testing.assert_array_equal(found.edges, regions.edges)
    np.testing.assert_allclose(found.border_m, regions.border_m)
    for name in ("area_m2", "relief_m", "axis_rad", "mean_H", "class_code", "class_probability"):
        np.testing.assert_allclose(found.table[name], regions.table[name], rtol=1e-9, atol=1e-12)
    assert (found.west_m, found.north_m, found.cell_m) == (500000.0, 7000060.0, 1.0)
    assert found.crs == "EPSG:32602"


def test_the_raster_is_as_the_contract_has_it(folder):
    with rasterio.open(folder / "regions.tif") as source:
        assert source.descriptions == ("class", "region")
        assert source.dtypes == ("int32", "int32")
        assert source.nodata == 0
    with rasterio.open(folder / "curvature.tif") as source:
        assert source.descriptions == ("H", "K", "sigma_H", "sigma_K", "scale")
        assert set(source.dtypes) == {"float32"}
        mean = source.read(1)
    assert np.isnan(mean[40:50, 60:70]).all()


def test_the_polygons_cover_their_cells(folder, result):
    meta, _, geometry, values = pyogrio.raw.read(folder / "regions.gpkg", layer="regions")
    columns = dict(zip(meta["fields"], values, strict=True))
    shapes = shapely.from_wkb(geometry)
    np.testing.assert_allclose(shapely.area(shapes), columns["area_m2"])
    assert shapely.is_valid(shapes).all()
    assert set(columns["class"]) <= set(REGION_CLASSES[1:])
    assert {"class_probability", "relief_m", "neighbours", "parent"} <= set(columns)


def test_the_levels_are_a_tree_in_one_file(folder, result):
    path = folder / "regions.gpkg"
    names = [name for name, kind in pyogrio.list_layers(path) if kind is not None]
    assert names == [
        "regions",
        "regions-level-2",
        "graph",
    ]  # the first is what a program reads unasked
    meta, _, _, values = pyogrio.raw.read(path, layer="regions")
    parent = dict(zip(meta["fields"], values, strict=True))["parent"]
    np.testing.assert_array_equal(parent, result.parents[0])
    coarse = read_regions(folder / "regions-level-2.tif")
    np.testing.assert_array_equal(coarse.edges, result.coarser[0].edges)
    np.testing.assert_allclose(coarse.table["area_m2"], result.coarser[0].table["area_m2"])


def test_the_graph_is_lines_from_region_to_region(folder, result):
    meta, _, geometry, values = pyogrio.raw.read(folder / "regions.gpkg", layer="graph")
    columns = dict(zip(meta["fields"], values, strict=True))
    np.testing.assert_array_equal(
        np.column_stack([columns["region_a"], columns["region_b"]]), result.regions.edges
    )
    np.testing.assert_allclose(columns["border_m"], result.regions.border_m)
    ends = shapely.get_coordinates(shapely.from_wkb(geometry))[::2]
    table = result.regions.table
    np.testing.assert_allclose(ends[:, 0], table["easting_m"][columns["region_a"] - 1])


def test_other_programs_find_names_and_colours(folder):
    """Read back as QGIS and GDAL do: the GeoPackage's table of styles, the raster's side file."""
    with sqlite3.connect(folder / "regions.gpkg") as file:
        rows = file.execute(
            "SELECT f_table_name, f_geometry_column, styleQML, useAsDefault FROM layer_styles"
        ).fetchall()
        geometry = dict(file.execute("SELECT table_name, column_name FROM gpkg_geometry_columns"))
    assert [row[0] for row in rows] == ["regions", "regions-level-2"]
    for name, column, style, default in rows:
        assert default
        assert geometry[name] == column
        assert ElementTree.fromstring(style.split("\n", 1)[1]).find("renderer-v2") is not None
    table = ElementTree.parse(folder / "regions.tif.aux.xml").find(".//GDALRasterAttributeTable")
    named = {int(row[0].text): row[1].text for row in table.findall("Row")}
    assert named == dict(list(enumerate(REGION_CLASSES))[1:])
    with rasterio.open(folder / "regions.tif") as source:  # the side file is no obstacle
        assert source.nodata == 0


def test_polygons_of_cells_that_are_not_square_have_the_right_area():
    z = np.random.default_rng(2).normal(size=(20, 24)).cumsum(0)
    regions = segment(Grid(z, 0.0, 0.0, 2.0, cell_height_m=3.0)).regions
    np.testing.assert_allclose(shapely.area(region_polygons(regions)), regions.table["area_m2"])


def test_the_style_names_every_class_for_raster_and_polygons(folder):
    root = ElementTree.parse(folder / "regions.qml").getroot()
    entries = root.findall("./pipe/rasterrenderer/colorPalette/paletteEntry")
    categories = root.findall("./renderer-v2/categories/category")
    for found in (entries, categories):
        assert [(int(e.get("value")), e.get("label")) for e in found] == list(
            enumerate(REGION_CLASSES)
        )[1:]


def test_a_raster_without_the_bands_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="lacks the bands class and region"):
        read_regions(folder / "curvature.tif")
    bad = tmp_path / "bad.tif"
    bad.write_text("no raster")
    with pytest.raises(InputError, match="cannot read"):
        read_regions(bad)


def test_objects_are_read_from_a_table(tmp_path, grid):
    path = tmp_path / "objects.csv"
    path.write_text(
        "easting_m,northing_m,kind,height_m\n500030,7000030,hill,3\n500010,7000010,hill,\n"
    )
    objects = read_objects(path, grid)
    np.testing.assert_allclose(objects.easting_m, [500030, 500010])
    np.testing.assert_allclose(objects.radius_m, [3, 2])  # the height, at least two cells
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="easting_m"):
        read_objects(path, grid)
