"""Errors against truth. Estimators never import it; it runs after they have written their results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from perception.records import FloatArray, Grid, NoOverlapError, Trajectory


@dataclass(frozen=True, slots=True)
class MapError:
    """Errors of a map's cells against the mean truth in each cell.

    `within_one_sigma` and `within_two_sigma` are shares of cells (0 to 1), NaN without a sigma.
    """

    mean_absolute_m: float
    rms_m: float
    bias_m: float
    percentile_95_m: float
    within_one_sigma: float
    within_two_sigma: float
    cells: int

    def flat(self, prefix: str) -> dict[str, float]:
        """Return flat metrics keys with units in their names."""
        return {
            f"{prefix}_mae_m": self.mean_absolute_m,
            f"{prefix}_rms_m": self.rms_m,
            f"{prefix}_bias_m": self.bias_m,
            f"{prefix}_p95_m": self.percentile_95_m,
            f"{prefix}_within_1sigma": self.within_one_sigma,
            f"{prefix}_within_2sigma": self.within_two_sigma,
            f"{prefix}_cells": self.cells,
        }


def cell_means(truth: Grid, frame: Grid) -> FloatArray:
    """Average a finer truth over the cells of `frame`; NaN where no truth sample falls."""
    easting_m, northing_m = truth.centres()
    rows, cols = frame.shape
    col = np.floor((easting_m - frame.west_m) / frame.cell_m).astype(np.int64)
    row = np.floor((frame.north_m - northing_m) / frame.cell_north_m).astype(np.int64)
    keep_r, keep_c = (row >= 0) & (row < rows), (col >= 0) & (col < cols)
    values = truth.elevation_m[np.ix_(keep_r, keep_c)]
    index = (row[keep_r][:, None] * cols + col[keep_c]).ravel()
    good = np.isfinite(values).ravel()
    index, values = index[good], values.ravel()[good]
    total = np.bincount(index, weights=values, minlength=rows * cols)
    number = np.bincount(index, minlength=rows * cols)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (total / number).reshape(rows, cols)


def map_error(grid: Grid, truth: Grid, where: FloatArray | None = None) -> MapError:
    """Compare a map with the truth in its cells.

    Parameters
    ----------
    where : (rows, cols) compare only where this is finite, to score two maps on the same cells.

    Raises
    ------
    NoOverlapError
        No cell of the map has truth under it.
    """
    error_m = grid.elevation_m - cell_means(truth, grid)
    if where is not None:
        error_m = np.where(np.isfinite(where), error_m, np.nan)
    good = np.isfinite(error_m)
    if not good.any():
        raise NoOverlapError("map and truth share no cell; are they in one CRS?")
    error = error_m[good]
    one = two = float("nan")
    if grid.sigma_m is not None:
        sigma = grid.sigma_m[good]
        one = float(np.mean(np.abs(error) <= sigma))
        two = float(np.mean(np.abs(error) <= 2 * sigma))
    return MapError(
        mean_absolute_m=float(np.mean(np.abs(error))),
        rms_m=float(np.sqrt(np.mean(error**2))),
        bias_m=float(np.mean(error)),
        percentile_95_m=float(np.percentile(np.abs(error), 95)),
        within_one_sigma=one,
        within_two_sigma=two,
        cells=int(good.sum()),
    )


def interpolated_soundings(
    easting_m: FloatArray, northing_m: FloatArray, elevation_m: FloatArray, frame: Grid
) -> Grid:
    """Interpolate soundings linearly onto the frame: the simpler method that a map must beat.

    Cells outside the soundings' convex hull are NaN.
    """
    good = np.isfinite(easting_m) & np.isfinite(northing_m) & np.isfinite(elevation_m)
    # Centred coordinates: Qhull loses digits on UTM northings.
    origin = np.array([frame.west_m, frame.south_m])
    points = np.column_stack([easting_m[good], northing_m[good]]) - origin
    e, n = frame.centres()
    try:
        interpolator = LinearNDInterpolator(points, elevation_m[good])
        surface = interpolator((e - origin[0])[None, :], (n - origin[1])[:, None])
    except QhullError:  # fewer than three soundings, or all on one line: nothing lies between them
        surface = np.full(frame.shape, np.nan)
    return Grid(
        surface, frame.west_m, frame.north_m, frame.cell_m, frame.crs,
        cell_height_m=frame.cell_height_m,
    )  # fmt: skip


def track_rms_m(track: Trajectory, truth: Trajectory) -> float:
    """Return the rms horizontal distance between two tracks, matched by time."""
    e = np.interp(track.time_s, truth.time_s, truth.easting_m)
    n = np.interp(track.time_s, truth.time_s, truth.northing_m)
    inside = (track.time_s >= truth.time_s[0]) & (track.time_s <= truth.time_s[-1])
    squared = (track.easting_m - e) ** 2 + (track.northing_m - n) ** 2
    squared = squared[inside & np.isfinite(squared)]
    if not squared.size:
        raise NoOverlapError("track and truth share no time")
    return float(np.sqrt(np.mean(squared)))


def normalised_error_squared(track: Trajectory, truth: Trajectory) -> FloatArray:
    """Return (n,) squared position error over its claimed covariance; expected value 2."""
    de = track.easting_m - np.interp(track.time_s, truth.time_s, truth.easting_m)
    dn = track.northing_m - np.interp(track.time_s, truth.time_s, truth.northing_m)
    see, snn, sen = track.sigma_easting_m**2, track.sigma_northing_m**2, track.cov_en_m2
    determinant = see * snn - sen**2
    with np.errstate(invalid="ignore", divide="ignore"):
        squared: FloatArray = (snn * de**2 - 2 * sen * de * dn + see * dn**2) / determinant
    return squared


def percent_cut(before: float, after: float) -> float:
    """Return by how many per cent an error was cut."""
    return 100.0 * (1.0 - after / before) if before > 0 else float("nan")
