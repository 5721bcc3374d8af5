"""Object layers, for segmentation and planning: read from objects.gpkg or .csv, written with what was lifted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyogrio.raw
import shapely
from pyproj import CRS, Transformer

from mapping.vectors import write_layer
from perception.background import Lifted
from perception.files import existing_file
from perception.records import BoolArray, FloatArray, Grid, InputError, RegionMap

# Names under which a footprint's radius is found, and its width, which is halved.
_RADIUS = ("radius_m", "footprint_radius_m")
_WIDTH = ("width_m", "footprint_m", "diameter_m")


@dataclass(frozen=True, slots=True)
class ObjectLayer:
    """Points with height and footprint, (n,) each, in the CRS of the map they were read for.

    Attributes
    ----------
    height_m : height, or a crater's depth, positive; NaN where the file has none.
    radius_m : of the footprint.
    crater : True for craters; what has no `kind` counts as standing up.
    sigma_m, position_sigma_m : 1-sigma of height and of place per axis; 0 where the file has none.
    least : True where the height is only the least that an open shadow proves.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    height_m: FloatArray
    radius_m: FloatArray
    crater: BoolArray
    sigma_m: FloatArray
    position_sigma_m: FloatArray
    least: BoolArray


def read_objects(path: Path, grid: Grid) -> ObjectLayer:
    """Read objects of any point layer GDAL knows, or a CSV with `easting_m` and `northing_m`.

    Without a footprint in the file the radius is the object's height, at least two cells. What the file marks
    `overruled` is no object and left out (`mapping.overruled`).

    Raises
    ------
    InputError
        Not readable, not points, or without positions.
    """
    path = existing_file(path)
    try:
        meta, _, geometry, values = pyogrio.raw.read(path)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise InputError(
            f"{path}: cannot be read as objects ({error}); give an objects.gpkg or objects.csv"
        ) from error
    columns: Mapping[str, Any] = dict(zip(meta["fields"], values, strict=True))
    if "overruled" in columns:
        stands = ~np.isin(np.array([str(v).lower() for v in columns["overruled"]]), ("1", "true"))
        columns = {name: column[stands] for name, column in columns.items()}
        geometry = None if geometry is None else geometry[stands]
    east, north = _positions(path, meta, geometry, columns, grid)
    nowhere = np.flatnonzero(~(np.isfinite(east) & np.isfinite(north)))
    if len(nowhere):
        raise InputError(
            f"{path}: object {nowhere[0] + 1} of {len(east)} has no position; give it one or remove the row"
        )
    height_m = np.abs(_numbers(path, columns, "height_m", len(east)))
    cell_m = max(grid.cell_m, grid.cell_north_m)
    radius_m = np.full(len(east), np.nan)
    for names, share in ((_RADIUS, 1.0), (_WIDTH, 0.5)):
        for name in names:
            if name in columns:
                radius_m = share * _numbers(path, columns, name, len(east))
    radius_m = np.where(radius_m > 0, radius_m, height_m)
    radius_m = np.maximum(np.where(np.isfinite(radius_m), radius_m, 0.0), 2 * cell_m)
    sigma_m, position_sigma_m = (
        np.nan_to_num(_numbers(path, columns, name, len(east)))
        for name in ("sigma_m", "position_sigma_m")
    )
    return ObjectLayer(
        east, north, height_m, radius_m, _holds(columns, "kind", "crater", len(east)),
        sigma_m, position_sigma_m, _holds(columns, "bound", "lower", len(east)),
    )  # fmt: skip


def _positions(
    path: Path,
    meta: Mapping[str, Any],
    geometry: npt.NDArray[Any] | None,
    columns: Mapping[str, Any],
    grid: Grid,
) -> tuple[FloatArray, FloatArray]:
    shapes = None if geometry is None else shapely.from_wkb(geometry)
    if shapes is None or not all(s is not None for s in shapes):
        if "easting_m" not in columns or "northing_m" not in columns:
            raise InputError(f"{path}: has neither points nor columns easting_m and northing_m")
        n = len(columns["easting_m"])
        return _numbers(path, columns, "easting_m", n), _numbers(path, columns, "northing_m", n)
    centres = shapely.get_coordinates(shapely.centroid(shapes))
    east, north = centres[:, 0], centres[:, 1]
    if (
        grid.crs
        and meta["crs"]
        and CRS.from_user_input(meta["crs"]) != CRS.from_user_input(grid.crs)
    ):
        east, north = Transformer.from_crs(meta["crs"], grid.crs, always_xy=True).transform(
            east, north
        )
    return np.asarray(east, float), np.asarray(north, float)


def _numbers(path: Path, columns: Mapping[str, Any], name: str, n: int) -> FloatArray:
    if name not in columns:
        return np.full(n, np.nan)
    try:
        # A CSV brings its numbers as text, an empty field for none.
        return np.array([float(v) if v not in ("", None) else np.nan for v in columns[name]])
    except ValueError as error:
        raise InputError(f"{path}: column {name}: {error}; mend or remove the row") from error


def _holds(columns: Mapping[str, Any], name: str, word: str, n: int) -> BoolArray:
    if name not in columns:
        return np.zeros(n, bool)
    return np.array([value == word for value in columns[name]], dtype=bool)


def write_lifted(path: Path, objects: ObjectLayer, lifted: Lifted, regions: RegionMap) -> None:
    """Write the lifted objects as points: stated height, height over the filled floor, region below."""
    row, col = lifted.background.fractional_index(objects.easting_m, objects.northing_m)
    i, j = np.rint(row).astype(int), np.rint(col).astype(int)
    rows, cols = regions.region.shape
    inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
    below = np.where(inside, regions.region[i.clip(0, rows - 1), j.clip(0, cols - 1)], 0)
    columns = {
        "easting_m": objects.easting_m,
        "northing_m": objects.northing_m,
        "height_m": objects.height_m,
        "height_over_floor_m": lifted.height_m,
        "radius_m": objects.radius_m,
        "region": below.astype(np.int32),
    }
    points = shapely.points(objects.easting_m, objects.northing_m)
    write_layer(path, points, columns, regions.crs, "Point")
