"""Objects lifted off the surface, so that a boulder does not pass for the shape of the sea floor.

The paper separates objects from background before it looks at curvature. The cells of an object's
footprint are replaced by the quadratic fitted to the ring around it; the object stays in its own layer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from perception.records import FloatArray, Grid

# Terms of a full quadratic; a ring needs several cells for each.
_TERMS = 6
_LEAST_CELLS = 3 * _TERMS


@dataclass(frozen=True, slots=True)
class Lifted:
    """A surface without its objects.

    Attributes
    ----------
    background : the grid with the objects' footprints filled from their surroundings.
    footprint : (rows, cols) number of the object, from 1, whose footprint a cell belongs to; 0 none.
    height_m : (n,) extreme of the surface over the background inside each footprint, negative
        for a crater; NaN where the object lies off the map or its ring holds too little.
    """

    background: Grid
    footprint: npt.NDArray[np.int32]
    height_m: FloatArray


def lift_objects(
    grid: Grid, easting_m: FloatArray, northing_m: FloatArray, radius_m: FloatArray
) -> Lifted:
    """Replace objects by the floor around them.

    Parameters
    ----------
    easting_m, northing_m, radius_m : (n,) centre and footprint radius of each object.

    Notes
    -----
    The ring reaches from the footprint to twice its radius, at least three cells wide, and leaves
    out other objects' footprints. An object whose ring holds fewer than 18 cells is left in place.
    """
    footprint = np.zeros(grid.shape, np.int32)
    for n, disc in enumerate(zip(easting_m, northing_m, radius_m, strict=True), start=1):
        window, distance_m = _window(grid, *disc, reach_m=disc[2])
        footprint[window][distance_m <= disc[2]] = n
    filled = np.array(grid.elevation_m, dtype=np.float64)
    height_m = np.full(len(easting_m), np.nan)
    for n, disc in enumerate(zip(easting_m, northing_m, radius_m, strict=True), start=1):
        height_m[n - 1] = _fill(grid, filled, footprint, n, *disc)
    return Lifted(replace(grid, elevation_m=filled), footprint, height_m)


def _window(
    grid: Grid, easting_m: float, northing_m: float, radius_m: float, reach_m: float
) -> tuple[tuple[slice, slice], FloatArray]:
    """Return the rows and columns within reach of a point, and the distances of their cells."""
    row, col = grid.fractional_index(np.array(easting_m), np.array(northing_m))
    down, across = reach_m / grid.cell_north_m, reach_m / grid.cell_m
    rows = slice(max(int(np.floor(row - down)), 0), max(int(np.ceil(row + down)) + 1, 0))
    cols = slice(max(int(np.floor(col - across)), 0), max(int(np.ceil(col + across)) + 1, 0))
    east, north = grid.centres()
    return (rows, cols), np.hypot(east[None, cols] - easting_m, north[rows, None] - northing_m)


def _fill(
    grid: Grid,
    filled: npt.NDArray[np.float64],
    footprint: npt.NDArray[np.int32],
    number: int,
    easting_m: float,
    northing_m: float,
    radius_m: float,
) -> float:
    """Fill one footprint from its ring in place and return the object's height over the fill."""
    reach_m = max(2 * radius_m, radius_m + 3 * max(grid.cell_m, grid.cell_north_m))
    window, distance_m = _window(grid, easting_m, northing_m, radius_m, reach_m)
    z = filled[window]
    inside = (footprint[window] == number) & np.isfinite(z)
    ring = (footprint[window] == 0) & (distance_m <= reach_m) & np.isfinite(z)
    if not inside.any() or ring.sum() < _LEAST_CELLS:
        return float("nan")
    east, north = grid.centres()
    x = (east[None, window[1]] - easting_m + 0 * distance_m) / reach_m
    y = (north[window[0], None] - northing_m + 0 * distance_m) / reach_m
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    floor = design[inside] @ np.linalg.lstsq(design[ring], z[ring], rcond=None)[0]
    above = z[inside] - floor
    z[inside] = floor
    return float(above[np.argmax(np.abs(above))])
