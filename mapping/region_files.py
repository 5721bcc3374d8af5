"""Region maps on disk: regions.tif, regions.gpkg, curvature.tif, and the style QGIS opens them with.

`regions.qml` beside the two files carries a raster and a vector renderer at once: QGIS looks for a
style of the file's own name, the two share theirs, and each kind of layer reads its part.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt
import pyogrio.raw
import rasterio
import shapely
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.features import shapes
from rasterio.transform import Affine

from mapping.rasters import write_bands
from mapping.vectors import write_layer
from perception.curvature import Curvature
from perception.files import existing_file, write_text
from perception.records import REGION_CLASSES, Grid, InputError, RegionMap
from perception.region_graph import neighbours
from perception.regions import Segmentation

# Warm is up, cold is down, pale is neither; told apart by lightness too, for those who see no red.
CLASS_COLOURS = {
    1: "#b2182b", 2: "#053061", 3: "#ef8a62", 4: "#4393c3",
    5: "#fddbc7", 6: "#d1e5f0", 7: "#f7f7f7", 8: "#bdbdbd",
}  # fmt: skip


def write_regions(
    out: Path,
    regions: RegionMap,
    curvature: Curvature | None = None,
    parents: npt.NDArray[Any] | None = None,
    name: str = "regions",
) -> None:
    """Write `NAME.tif`, `NAME.gpkg` and `NAME.qml` into `out`, and `curvature.tif` where given.

    Parameters
    ----------
    parents : (n,) region of the next coarser level that holds each region; column `parent`.
    """
    frame = frame_of(regions)
    bands = {"class": regions.class_code, "region": regions.region}
    tags = {f"CLASS_{code}": text for code, text in enumerate(REGION_CLASSES)}
    write_bands(out / f"{name}.tif", bands, frame, dtype="int32", nodata=0, tags=tags)
    write_layer(
        out / f"{name}.gpkg",
        region_polygons(regions),
        _columns(regions, parents),
        regions.crs,
        "Polygon",
    )
    write_text(out / f"{name}.qml", _style())
    if curvature is not None:
        write_curvature(out / "curvature.tif", curvature, frame)


def write_segmentation(out: Path, segmentation: Segmentation) -> None:
    """Write every file of a segmentation; coarser levels as `regions-level-2` and so on."""
    chain = (segmentation.regions, *segmentation.coarser)
    for level, regions in enumerate(chain):
        parents = segmentation.parents[level] if level < len(segmentation.parents) else None
        name = "regions" if level == 0 else f"regions-level-{level + 1}"
        curvature = segmentation.curvature if level == 0 else None
        write_regions(out, regions, curvature, parents, name)


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
    """Read `regions.tif`, and table and graph from the GeoPackage of its name where there is one.

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
    if not beside.exists():
        return regions
    table, edges, border_m = _read_table(beside)
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
    path: Path,
) -> tuple[dict[str, npt.NDArray[Any]], npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    try:
        meta, _, _, values = pyogrio.raw.read(path, read_geometry=False)
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
        if name not in ("region", "class", "neighbours", "borders_m", "axis_deg")
    }
    table["axis_rad"] = np.radians(np.asarray(columns["axis_deg"])[order])
    return table, np.array(edges, np.int64).reshape(-1, 2), np.array(border_m, np.float64)


def _style() -> str:
    """Return a QGIS style with a paletted raster renderer and a categorised vector renderer."""
    entries, categories, symbols = [], [], []
    for code, colour in CLASS_COLOURS.items():
        label = quoteattr(REGION_CLASSES[code])
        entries.append(f'<paletteEntry value="{code}" color="{colour}" label={label} alpha="255"/>')
        categories.append(
            f'<category value="{code}" symbol="{code}" label={label} render="true" type="long"/>'
        )
        red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
        symbols.append(
            f'<symbol name="{code}" type="fill" alpha="1" clip_to_extent="1">'
            '<layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">'
            f'<Option name="color" type="QString" value="{red},{green},{blue},160"/>'
            '<Option name="style" type="QString" value="solid"/>'
            '<Option name="outline_color" type="QString" value="60,60,60,255"/>'
            '<Option name="outline_style" type="QString" value="solid"/>'
            '<Option name="outline_width" type="QString" value="0.1"/>'
            '<Option name="outline_width_unit" type="QString" value="MM"/>'
            "</Option></layer></symbol>"
        )
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.28.0" styleCategories="Symbology">\n'
        '<pipe><rasterrenderer type="paletted" band="1" opacity="1" alphaBand="-1">'
        f"<colorPalette>{''.join(entries)}</colorPalette></rasterrenderer></pipe>\n"
        '<renderer-v2 type="categorizedSymbol" attr="class_code" enableorderby="0" '
        'symbollevels="0" forceraster="0">'
        f"<categories>{''.join(categories)}</categories><symbols>{''.join(symbols)}</symbols>"
        "</renderer-v2>\n</qgis>\n"
    )
