"""Region maps on disk: regions.tif, regions.gpkg, curvature.tif; their looks are in `mapping.region_style`.

`regions.gpkg` holds a layer of polygons for each level of detail, finest first, each region with the number of
its parent on the next level: a tree. The neighbourhoods of the first level are a layer `graph` of lines.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyogrio.raw
import rasterio
import shapely
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.features import shapes
from rasterio.transform import Affine

from mapping.rasters import write_bands
from mapping.region_style import CLASS_COLOURS as CLASS_COLOURS
from mapping.region_style import qgis_style, raster_attributes, style_layers
from mapping.vectors import Layer, put_layer
from perception.curvature import Curvature
from perception.files import existing_file, whole_file, write_text
from perception.records import REGION_CLASSES, Grid, InputError, RegionMap
from perception.region_classes import THREE_CLASSES, THREE_OF_EIGHT
from perception.region_graph import neighbours
from perception.regions import Segmentation


def write_segmentation(out: Path, segmentation: Segmentation) -> None:
    """Write `regions.tif` (coarser levels `regions-level-2.tif` ...), `regions.gpkg` and `curvature.tif`.

    Beside them go `regions.qml` and the rasters' attribute tables: names and colours of the classes.
    """
    chain = (segmentation.regions, *segmentation.coarser)
    names = ["regions", *(f"regions-level-{level}" for level in range(2, len(chain) + 1))]
    for name, regions in zip(names, chain, strict=True):
        _write_raster(out / f"{name}.tif", regions)
        write_text(out / f"{name}.qml", qgis_style())
    parents = [*segmentation.parents, None]
    _write_layers(out / "regions.gpkg", names, chain, parents)
    write_curvature(out / "curvature.tif", segmentation.curvature, frame_of(segmentation.regions))


def _write_raster(path: Path, regions: RegionMap) -> None:
    bands = {"class": regions.class_code, "region": regions.region}
    tags = {f"CLASS_{code}": text for code, text in enumerate(REGION_CLASSES)}
    write_bands(path, bands, frame_of(regions), dtype="int32", nodata=0, tags=tags)
    write_text(path.with_name(f"{path.name}.aux.xml"), raster_attributes())


def _write_layers(
    path: Path,
    names: Sequence[str],
    chain: Sequence[RegionMap],
    parents: Sequence[npt.NDArray[Any] | None],
) -> None:
    """Write the polygons of every level, the graph of the first and the layers' style, in one file."""
    layers = [
        (name, "Polygon", region_polygons(regions), _columns(regions, above))
        for name, regions, above in zip(names, chain, parents, strict=True)
    ]
    layers.append(("graph", "LineString", *_graph(chain[0])))
    with whole_file(path) as temporary:
        try:
            for k, (name, kind, geometries, columns) in enumerate(layers):
                layer = Layer(geometries, columns, kind)
                put_layer(temporary, name, layer, chain[0].crs, append=k > 0)
            style_layers(temporary, names)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise InputError(f"{path}: cannot be written ({error})") from error


def _graph(regions: RegionMap) -> tuple[npt.NDArray[Any], dict[str, npt.NDArray[Any]]]:
    """Return the neighbourhoods as lines from centre to centre, with the length of the border."""
    table, edges = regions.table, np.asarray(regions.edges)
    centres = np.column_stack([table["easting_m"], table["northing_m"]])
    lines: npt.NDArray[Any] = np.empty(0, object)
    if len(edges):
        lines = shapely.linestrings(centres[edges - 1])
    columns: dict[str, npt.NDArray[Any]] = {
        "region_a": edges[:, 0].astype(np.int32),
        "region_b": edges[:, 1].astype(np.int32),
        "border_m": np.asarray(regions.border_m, np.float64),
    }
    return lines, columns


def write_curvature(path: Path, curvature: Curvature, frame: Grid) -> None:
    """Write `curvature.tif`: float32 bands H, K, sigma_H, sigma_K, scale, unthresholded."""
    bands = {
        "H": curvature.H,
        "K": curvature.K,
        "sigma_H": curvature.sigma_H,
        "sigma_K": curvature.sigma_K,
        "scale": curvature.scale_m,
    }
    write_bands(path, bands, frame)


def frame_of(regions: RegionMap) -> Grid:
    """Return a grid with a region map's georeference; its heights mean nothing."""
    # A broadcast zero costs no memory whatever the map's size.
    return Grid(
        elevation_m=np.broadcast_to(np.float32(0), regions.region.shape),
        west_m=regions.west_m,
        north_m=regions.north_m,
        cell_m=regions.cell_m,
        crs=regions.crs,
        cell_height_m=regions.cell_height_m,
    )


def region_polygons(regions: RegionMap) -> npt.NDArray[Any]:
    """Return one polygon per region along the cells' sides, in the order of the region numbers."""
    frame = frame_of(regions)
    transform = Affine(frame.cell_m, 0, frame.west_m, 0, -frame.cell_north_m, frame.north_m)
    polygons = np.empty(int(regions.region.max()), dtype=object)
    labels = np.ascontiguousarray(regions.region, dtype=np.int32)
    for outline, number in shapes(labels, mask=labels > 0, connectivity=4, transform=transform):
        rings = outline["coordinates"]
        polygons[int(number) - 1] = shapely.Polygon(rings[0], rings[1:])
    return polygons


def _columns(regions: RegionMap, parents: npt.NDArray[Any] | None) -> dict[str, npt.NDArray[Any]]:
    table = regions.table
    count = int(regions.region.max())
    code = np.asarray(table["class_code"], np.int32)
    columns: dict[str, npt.NDArray[Any]] = {
        "region": np.arange(1, count + 1, dtype=np.int32),
        "class": np.array([REGION_CLASSES[c] for c in code], dtype=object),
        "class_code": code,
        "landform": np.array([THREE_CLASSES[c] for c in THREE_OF_EIGHT[code]], dtype=object),
    }
    for name, values in table.items():
        if name == "axis_rad":
            columns["axis_deg"] = np.degrees(values)
        elif name != "class_code":
            columns[name] = np.asarray(values, np.float64)
    columns["neighbours"], columns["borders_m"] = _neighbour_columns(regions, count)
    if parents is not None:
        columns["parent"] = np.asarray(parents, np.int32)
    return columns


def _neighbour_columns(regions: RegionMap, count: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the neighbours' numbers and border lengths as lists in text: GeoPackage has no lists."""
    length = {
        (int(a), int(b)): f"{metres:g}"
        for (a, b), metres in zip(regions.edges, regions.border_m, strict=True)
    }
    numbers = neighbours(regions.edges, count)
    borders = [
        ",".join(length[min(r, n), max(r, n)] for n in row)
        for r, row in enumerate(numbers, start=1)
    ]
    return (
        np.array([",".join(map(str, row)) for row in numbers], dtype=object),
        np.array(borders, dtype=object),
    )


def read_regions(path: Path) -> RegionMap:
    """Read `regions.tif`, and table and graph from the GeoPackage beside it where there is one.

    Raises
    ------
    InputError
        Not a raster, lacking the bands `class` and `region`, or classes outside 0 to 8.
    """
    path = existing_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                regions = _read_bands(path, source)
    except RasterioError as error:
        raise InputError(
            f"{path}: GDAL cannot read it as a raster ({error}); give a regions.tif"
        ) from error
    beside = path.with_suffix(".gpkg")
    together = path.with_name("regions.gpkg")  # levels share one file, a layer each
    if beside.exists():
        table, edges, border_m = _read_table(beside, 0)
    elif together.exists():
        table, edges, border_m = _read_table(together, path.stem)
    else:
        return regions
    return RegionMap(
        regions.class_code, regions.region, regions.west_m, regions.north_m, regions.cell_m,
        regions.crs, regions.cell_height_m, None, table, edges, border_m,
    )  # fmt: skip


def _read_bands(path: Path, source: Any) -> RegionMap:
    names = [(d or "").lower() for d in source.descriptions]
    if "class" not in names or "region" not in names:
        raise InputError(
            f"{path}: lacks the bands class and region (it has {', '.join(names) or 'none'}); "
            "make it with bathynav regions"
        )
    code = source.read(names.index("class") + 1)
    if code.min() < 0 or code.max() >= len(REGION_CLASSES):
        raise InputError(
            f"{path}: band class holds {code.min()} to {code.max()}; classes are 0 to 8"
        )
    transform = source.transform
    square = np.isclose(transform.a, -transform.e, rtol=1e-9)
    return RegionMap(
        class_code=code.astype(np.uint8),
        region=source.read(names.index("region") + 1).astype(np.int32),
        west_m=transform.c,
        north_m=transform.f,
        cell_m=transform.a,
        cell_height_m=None if square else -transform.e,
        crs=source.crs.to_string() if source.crs else "",
    )


def _read_table(
    path: Path, layer: str | int
) -> tuple[dict[str, npt.NDArray[Any]], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    try:
        meta, _, _, values = pyogrio.raw.read(path, layer=layer, read_geometry=False)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); make it with bathynav regions"
        ) from error
    columns: Mapping[str, Any] = dict(zip(meta["fields"], values, strict=True))
    if "region" not in columns or "neighbours" not in columns:
        raise InputError(f"{path}: is no region layer; make it with bathynav regions")
    order = np.argsort(columns["region"])
    edges, border_m = [], []
    for row in order:
        text, lengths = columns["neighbours"][row] or "", columns["borders_m"][row] or ""
        here = int(columns["region"][row])
        for other, metres in zip(text.split(","), lengths.split(","), strict=True):
            if other and int(other) > here:
                edges.append((here, int(other)))
                border_m.append(float(metres))
    table = {
        name: np.asarray(column)[order]
        for name, column in columns.items()
        if name
        not in ("region", "class", "landform", "parent", "neighbours", "borders_m", "axis_deg")
    }
    table["axis_rad"] = np.radians(np.asarray(columns["axis_deg"])[order])
    return table, np.array(edges, np.int64).reshape(-1, 2), np.array(border_m, np.float64)
