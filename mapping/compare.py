"""How two maps differ: statistics, the difference raster, and the places that changed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio.features
import shapely
from pyproj import CRS
from rasterio.transform import Affine
from scipy import ndimage

from mapping.vectors import write_layer
from perception.records import BoolArray, FloatArray, Grid, InputError, NoOverlapError


@dataclass(frozen=True, slots=True)
class Difference:
    """Second map minus first, on the first one's cells where both have data.

    Attributes
    ----------
    grid : difference as `elevation_m`; `sigma_m` the two maps' combined, NaN where neither states one.
    changed : (rows, cols) True where the difference is beyond `beyond_sigma` combined sigma over a
        patch of cells.
    statistics : flat, units in the names.
    """

    grid: Grid
    changed: BoolArray
    statistics: dict[str, float | int | None]


def difference(
    first: Grid, second: Grid, beyond_sigma: float = 3.0, least_cells: int = 9
) -> Difference:
    """Compare two maps.

    The second is interpolated bilinearly to the centres of the first's cells. A cell counts as changed
    where the mean difference of its 3 x 3 neighbourhood exceeds `beyond_sigma` combined sigma and at least
    `least_cells` such cells touch: single outliers are noise. Where no map states a sigma, 1.4826
    times the median absolute deviation of the difference stands in.

    Raises
    ------
    InputError
        The maps lie in different coordinate systems or refer to different vertical datums.
    NoOverlapError
        No cell in which both hold a height.
    """
    same_frame(first, second)
    easting_m, northing_m = np.meshgrid(*first.centres())
    d = second.sample(easting_m, northing_m) - first.elevation_m
    both = np.isfinite(d)
    if not both.any():
        raise NoOverlapError(
            "the two maps have no cell in common: "
            f"A spans E {first.west_m:.0f} to {first.east_m:.0f}, N {first.south_m:.0f} to "
            f"{first.north_m:.0f}; B spans E {second.west_m:.0f} to {second.east_m:.0f}, "
            f"N {second.south_m:.0f} to {second.north_m:.0f}; give maps of one area"
        )
    sigma = _combined_sigma(first, second, easting_m, northing_m)
    spread = 1.4826 * float(np.median(np.abs(d[both] - np.median(d[both]))))
    yardstick = np.where(np.isfinite(sigma), sigma, max(spread, 1e-6))
    changed = _patches(d, both, yardstick, beyond_sigma, least_cells)
    grid = Grid(
        elevation_m=d,
        west_m=first.west_m,
        north_m=first.north_m,
        cell_m=first.cell_m,
        cell_height_m=first.cell_height_m,
        crs=first.crs or second.crs,
        sigma_m=sigma,
    )
    return Difference(grid, changed, _statistics(first, second, d, both, sigma, changed))


def same_frame(first: Grid, second: Grid) -> None:
    if first.crs and second.crs:
        a, b = CRS.from_user_input(first.crs), CRS.from_user_input(second.crs)
        if not a.equals(b, ignore_axis_order=True):
            raise InputError(
                f"the maps lie in different coordinate systems ({a.name} and {b.name}); "
                f"warp one: gdalwarp -t_srs {first.crs} B.tif B-warped.tif"
            )
    if first.datum and second.datum and first.datum != second.datum:
        raise InputError(
            f"the maps refer to different vertical datums ({first.datum} and {second.datum}); "
            "bring one to the other's before comparing"
        )


def _combined_sigma(
    first: Grid, second: Grid, easting_m: FloatArray, northing_m: FloatArray
) -> FloatArray:
    """Return the root of both maps' variances; a map without a sigma adds nothing."""
    variance = np.zeros(first.shape)
    stated = False
    if first.sigma_m is not None and np.isfinite(first.sigma_m).any():
        variance, stated = variance + first.sigma_m**2, True
    if second.sigma_m is not None and np.isfinite(second.sigma_m).any():
        sigma = Grid(
            second.sigma_m,
            second.west_m,
            second.north_m,
            second.cell_m,
            cell_height_m=second.cell_height_m,
        )
        variance, stated = variance + sigma.sample(easting_m, northing_m) ** 2, True
    return np.sqrt(variance) if stated else np.full(first.shape, np.nan)


def _patches(
    d: FloatArray, both: BoolArray, sigma: FloatArray, beyond_sigma: float, least_cells: int
) -> BoolArray:
    share = ndimage.uniform_filter(both.astype(float), 3, mode="constant")
    mean = ndimage.uniform_filter(np.where(both, d, 0.0), 3, mode="constant")
    mean = mean / np.maximum(share, 1e-9)
    beyond = both & (np.abs(mean) > beyond_sigma * sigma)
    label, _ = ndimage.label(beyond, structure=np.ones((3, 3)))
    size = np.bincount(label.ravel())
    size[0] = 0
    patches: BoolArray = size[label] >= least_cells
    return patches


def _statistics(
    first: Grid, second: Grid, d: FloatArray, both: BoolArray, sigma: FloatArray, changed: BoolArray
) -> dict[str, float | int | None]:
    values = d[both]
    low, q1, median, q3, high = np.percentile(values, [5, 25, 50, 75, 95])
    ratio = np.abs(d / sigma)[both & (sigma > 0)]
    area = first.cell_m * first.cell_north_m
    return {
        "cells_compared": int(both.sum()),
        "overlap_m2": float(both.sum() * area),
        "overlap_of_first": float(both.sum() / max(np.isfinite(first.elevation_m).sum(), 1)),
        "bias_m": float(values.mean()),
        "mae_m": float(np.abs(values).mean()),
        "rms_m": float(np.sqrt((values**2).mean())),
        "std_m": float(values.std()),
        "median_m": float(median),
        "nmad_m": float(1.4826 * np.median(np.abs(values - median))),
        "p05_m": float(low),
        "p25_m": float(q1),
        "p75_m": float(q3),
        "p95_m": float(high),
        "largest_m": float(np.abs(values).max()),
        "beyond_1_sigma": float((ratio > 1).mean()) if len(ratio) else None,
        "beyond_2_sigma": float((ratio > 2).mean()) if len(ratio) else None,
        "beyond_3_sigma": float((ratio > 3).mean()) if len(ratio) else None,
        "changed_m2": float(changed.sum() * area),
        "first_cell_m": float(first.cell_m),
        "second_cell_m": float(second.cell_m),
    }


def write_changes(path: Path, result: Difference) -> int:
    """Write the changed places as polygons with area, mean and largest difference; return how many."""
    label, count = ndimage.label(result.changed, structure=np.ones((3, 3)))
    grid = result.grid
    transform = Affine(grid.cell_m, 0, grid.west_m, 0, -grid.cell_north_m, grid.north_m)
    parts: dict[int, list[object]] = {}
    shapes = rasterio.features.shapes(
        label.astype(np.int32), mask=result.changed, transform=transform, connectivity=8
    )
    for shape, value in shapes:
        parts.setdefault(int(value), []).append(shapely.geometry.shape(shape))
    number = np.arange(1, count + 1)
    d = np.nan_to_num(grid.elevation_m)
    size = np.bincount(label.ravel(), minlength=count + 1)[1:]
    columns = {
        "area_m2": size * grid.cell_m * grid.cell_north_m,
        "mean_m": np.asarray(ndimage.mean(d, label, number), float).reshape(-1),
        "largest_m": np.asarray(
            ndimage.labeled_comprehension(
                d, label, number, lambda v: v[np.argmax(np.abs(v))], float, 0.0
            )
            if count
            else np.zeros(0)
        ),
    }
    polygons = [shapely.MultiPolygon(parts[k]) for k in number]
    write_layer(path, polygons, columns, grid.crs, "MultiPolygon")
    return count
