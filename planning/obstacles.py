"""Objects that stand on the sea floor, held clear of with their own height and sigma.

A map is of the cells' mean heights: it smooths a boulder narrower than its resolution, while the object
list has it with the height that its shadow measured. What stands there is the higher of the two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapping.object_layer import ObjectLayer
from perception.background import lift_objects
from perception.records import BoolArray, FloatArray, Grid

# How far from its stated place an object is held to stand, in sigmas of that place.
_PLACE_SIGMAS = 2.0


@dataclass(frozen=True, slots=True)
class Obstacles:
    """What stands on the cells of one grid.

    Attributes
    ----------
    top_m : (rows, cols) height of the object's top; NaN where none stands.
    sigma_m : (rows, cols) 1-sigma of that object's height; 0 where none stands.
    barred : (rows, cols) True where an object stands of which only the least height is known.
    """

    top_m: FloatArray
    sigma_m: FloatArray
    barred: BoolArray


def obstacles_on(grid: Grid, objects: ObjectLayer) -> Obstacles:
    """Return the tops of the objects that stand up, over the floor around each.

    Parameters
    ----------
    objects : craters are left out, and what has no height; `least` bars its ground, for no height is
        proved to clear it.

    Notes
    -----
    A footprint is widened by two sigmas of its place and by a cell's diagonal: then all four cells around
    any point of it are raised, and so is the bilinear surface between them. The floor under an object is
    the quadratic fitted to the ring around its wide footprint (`perception.background`); where that ring
    lies off the map the object stands on the map's own height.
    """
    top_m, sigma_m = np.full(grid.shape, np.nan), np.zeros(grid.shape)
    barred = np.zeros(grid.shape, bool)
    standing = np.flatnonzero(~objects.crater & (objects.height_m > 0))
    reach_m = objects.radius_m + _PLACE_SIGMAS * objects.position_sigma_m
    reach_m = reach_m + np.hypot(grid.cell_m, grid.cell_north_m)
    discs = objects.easting_m[standing], objects.northing_m[standing], reach_m[standing]
    floor_m = lift_objects(grid, *discs).background.elevation_m
    easting_m, northing_m = grid.centres()
    for n in standing:
        rows = np.flatnonzero(np.abs(northing_m - objects.northing_m[n]) <= reach_m[n])
        cols = np.flatnonzero(np.abs(easting_m - objects.easting_m[n]) <= reach_m[n])
        away_m = np.hypot(
            easting_m[None, cols] - objects.easting_m[n],
            northing_m[rows, None] - objects.northing_m[n],
        )
        where = np.ix_(rows, cols)
        inside = away_m <= reach_m[n]
        if objects.least[n]:
            barred[where] |= inside
        top = floor_m[where] + objects.height_m[n]
        higher = inside & ~(top_m[where] >= top)
        top_m[where] = np.where(higher, top, top_m[where])
        sigma_m[where] = np.where(higher, objects.sigma_m[n], sigma_m[where])
    return Obstacles(top_m, sigma_m, barred)


def raised(
    lower_m: FloatArray, obstacles: Obstacles, floor_m: float, sigma_m: FloatArray | None, k: float
) -> FloatArray:
    """Return the least height of a vehicle that clears the objects too; NaN stays NaN.

    Parameters
    ----------
    lower_m : (rows, cols) least height over the map alone.
    sigma_m : (rows, cols) what the clearance over the map covers `k` times.
    """
    sigma = obstacles.sigma_m if sigma_m is None else np.hypot(sigma_m, obstacles.sigma_m)
    over = obstacles.top_m + floor_m + k * sigma
    # maximum, not fmax: ground that is unknown to the map stays so under an object.
    return np.where(np.isfinite(obstacles.top_m), np.maximum(lower_m, over), lower_m)
