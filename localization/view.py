"""The terrain under an update's soundings, linearised once and shared by all filters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localization.measurements import Soundings
from localization.terrain import TerrainMap, linearise
from perception.records import FloatArray, IntArray

# Components of a state: offset of the true position from dead reckoning, heading bias, scale, and
# depth bias.
EAST, NORTH, TURN, SCALE, DEPTH = range(5)


@dataclass(frozen=True, slots=True)
class View:
    """Soundings that meet the map, (n,) each, seen from the state `centre` (5,).

    Attributes
    ----------
    east_m, north_m : places of the soundings.
    elevation_m, height_m : sounded, and of the map there.
    jacobian : (n, 5) of the predicted elevation.
    left_m2 : what the fitted plane leaves of the terrain, as variance.
    range_m2 : variance of the elevation from the range noise.
    unplaced_m2 : variance from not knowing the position.
    beam : index of the beam.
    """

    centre: FloatArray
    east_m: FloatArray
    north_m: FloatArray
    elevation_m: FloatArray
    height_m: FloatArray
    jacobian: FloatArray
    left_m2: FloatArray
    range_m2: FloatArray
    unplaced_m2: FloatArray
    beam: IntArray


def view_of(
    terrain: TerrainMap,
    soundings: Soundings,
    place_m: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    reading: int = 0,
) -> View:
    """Linearise the terrain under the soundings of one update.

    Parameters
    ----------
    reading : index of the map's reading.
    place_m : (2,) dead-reckoned position.
    mean, covariance : (5,) and (5, 5), the state before the update.
    """
    s = soundings
    # Below half a cell the nodes would all lie on one bilinear patch, whose slope is noise.
    least = (0.5 * terrain.cell_m) ** 2 * np.eye(2)
    root = np.linalg.cholesky(covariance[:2, :2] + least)
    out_east = s.east_m + mean[TURN] * s.north_m
    out_north = s.north_m - mean[TURN] * s.east_m
    east = place_m[0] + mean[EAST] + out_east
    north = place_m[1] + mean[NORTH] + out_north
    plane = linearise(terrain.readings[reading].height_m, terrain.frame, east, north, root)
    on = np.isfinite(plane[:, 0])
    height, slope_e, slope_n, left = plane[on].T
    jacobian = np.zeros((len(height), 5))
    jacobian[:, EAST], jacobian[:, NORTH] = slope_e, slope_n
    jacobian[:, TURN] = slope_e * out_north[on] - slope_n * out_east[on]
    jacobian[:, DEPTH] = 1.0
    tilt = s.down[on] + slope_e * s.out_east[on] + slope_n * s.out_north[on]
    return View(
        centre=mean,
        east_m=east[on],
        north_m=north[on],
        elevation_m=s.elevation_m[on],
        height_m=height,
        jacobian=jacobian,
        left_m2=left,
        range_m2=(s.range_sigma_m[on] * tilt) ** 2,
        unplaced_m2=np.einsum("ni,ij,nj->n", jacobian[:, :2], covariance[:2, :2], jacobian[:, :2]),
        beam=s.beam[on],
    )
