"""Vector layers: GeoPackage in the map's CRS, GeoJSON in longitude and latitude."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyogrio.raw
import shapely
from pyproj import CRS, Transformer

from perception.files import existing_file, whole_file
from perception.records import FloatArray, InputError


@dataclass(frozen=True, slots=True)
class Layer:
    """One layer of a vector file: (n,) shapely geometries and an (n,) array for each attribute."""

    geometries: Sequence[Any] | npt.NDArray[Any]
    columns: Mapping[str, npt.NDArray[Any]]
    geometry_type: str


def write_layer(
    path: Path,
    geometries: Sequence[Any] | npt.NDArray[Any],
    columns: Mapping[str, npt.NDArray[Any]],
    crs: str,
    geometry_type: str,
    layer: str | None = None,
) -> None:
    """Write one layer, whole or not at all; the suffix chooses GPKG or GeoJSON.

    Parameters
    ----------
    geometries : (n,) shapely geometries in `crs`.
    columns : attribute to (n,) array.
    geometry_type : "Point", "LineString", "Polygon", "MultiPolygon", with " Z" or "3D " as OGR has it.
    """
    write_layers(path, {layer or path.stem: Layer(geometries, columns, geometry_type)}, crs)


def write_layers(path: Path, layers: Mapping[str, Layer], crs: str) -> None:
    """Write the named layers into one file, whole or not at all; only GPKG holds more than one."""
    driver = {".gpkg": "GPKG", ".geojson": "GeoJSON"}[path.suffix]
    with whole_file(path) as temporary:
        try:
            for number, (name, layer) in enumerate(layers.items()):
                shapes, target_crs = np.asarray(layer.geometries, dtype=object), crs
                if driver == "GeoJSON" and crs:
                    # RFC 7946 knows WGS 84 only.
                    shapes, target_crs = to_lonlat(shapes, crs), "EPSG:4326"
                put_layer(
                    temporary,
                    name,
                    replace(layer, geometries=shapes),
                    target_crs,
                    driver,
                    number > 0,
                )
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise InputError(f"{path}: cannot be written ({error})") from error


def put_layer(
    path: Path, name: str, layer: Layer, crs: str, driver: str = "GPKG", append: bool = False
) -> None:
    """Write one layer into a file that is being made."""
    with warnings.catch_warnings():
        # A map without a CRS is no surprise here: it was told when the map was made.
        warnings.filterwarnings("ignore", message="'crs' was not provided")
        pyogrio.raw.write(
            path,
            shapely.to_wkb(layer.geometries),
            field_data=[np.asarray(v) for v in layer.columns.values()],
            fields=list(layer.columns),
            crs=crs or None,
            geometry_type=layer.geometry_type,
            driver=driver,
            layer=name,
            append=append,
        )


def to_lonlat(shapes: npt.NDArray[Any], crs: str) -> npt.NDArray[Any]:
    """Return shapely geometries of `crs` in WGS 84 longitude and latitude."""
    transformer = Transformer.from_crs(CRS.from_user_input(crs), 4326, always_xy=True)

    def reproject(coordinates: npt.NDArray[Any]) -> npt.NDArray[Any]:
        lon_deg, lat_deg = transformer.transform(coordinates[:, 0], coordinates[:, 1])
        return np.column_stack([lon_deg, lat_deg, *coordinates[:, 2:].T])

    has_z = bool(shapely.has_z(shapes).any())
    moved: npt.NDArray[Any] = shapely.transform(shapes, reproject, include_z=has_z)
    return moved


def _refuse_metres_as_degrees(path: Path, bounds: FloatArray) -> None:
    """Refuse coordinates that are no degrees though the file says so, as GeoJSON without a crs does."""
    if np.nanmax(np.abs(bounds[[0, 2]])) > 360 or np.nanmax(np.abs(bounds[[1, 3]])) > 90:
        raise InputError(
            f"{path}: coordinates up to {np.nanmax(np.abs(bounds)):.0f} are no degrees, but a GeoJSON without "
            "a crs is in degrees of WGS84; name its crs, or save it as a GeoPackage"
        )


def read_polygons(path: Path, crs: str) -> list[Any]:
    """Read every polygon of a vector file, reprojected to `crs`."""
    path = existing_file(path)
    try:
        meta, _, geometry, _ = pyogrio.raw.read(path, columns=[])
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise InputError(
            f"{path}: cannot be read as polygons ({error}); give a GeoPackage or GeoJSON"
        ) from error
    shapes = shapely.from_wkb(geometry)
    if crs and meta["crs"] and CRS.from_user_input(meta["crs"]) != CRS.from_user_input(crs):
        transformer = Transformer.from_crs(meta["crs"], crs, always_xy=True)
        if CRS.from_user_input(meta["crs"]).is_geographic:
            _refuse_metres_as_degrees(path, shapely.total_bounds(shapes))
        shapes = shapely.transform(
            shapes, lambda c: np.column_stack(transformer.transform(c[:, 0], c[:, 1]))
        )
    polygons = [p for p in shapely.get_parts(shapes) if p.geom_type == "Polygon"]
    if not polygons:
        raise InputError(f"{path}: holds no polygon; draw the areas as polygons")
    return polygons
