"""The prior map as the estimator sees it: heights to look up, slopes, and how wrong they may be.

A map's error is what makes terrain navigation dishonest: it is shared by neighbouring beams and by
successive pings, and on flat ground its own bumps look like terrain. `TerrainMap` therefore carries
a map whose *white* error has been filtered out as far as the map's spectrum allows
(`localization.maperror`), and the variance and correlation length of what is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from localization.maperror import MapError, filter_map, map_error_lengths
from localization.readings import Reading, expected_ground
from perception.records import FloatArray, Grid, InputError, NoOverlapError

# Three-point Gauss-Hermite rule, the nodes in sigmas: exact for terrain up to a quintic along an axis.
_NODE = math.sqrt(3.0)
_WEIGHTS = (1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0)


@dataclass(frozen=True, slots=True)
class TerrainMap:
    """Heights of the sea floor on a grid, ready for the numba kernels.

    Attributes
    ----------
    height_m : (rows, cols) float32 elevation, NaN no data; row 0 is the northernmost. It is the
        reading that a search uses, `readings[middle].height_m`.
    sigma_m : (rows, cols) float32 1-sigma of `height_m`.
    west_m, north_m : *centre* of the first cell (not its edge: one subtraction less per lookup).
    cell_m, cell_north_m : size of a cell.
    error : what is known of the map's error.
    readings : the ground as it is expected under each correlation length of the map's error.
    structure : lags (m) and mean square difference of height (m^2) over them.
    """

    height_m: FloatArray
    sigma_m: FloatArray
    west_m: float
    north_m: float
    cell_m: float
    cell_north_m: float
    error: MapError
    structure: tuple[FloatArray, FloatArray]
    readings: tuple[Reading, ...]

    @property
    def middle(self) -> int:
        """Index of the reading that a search uses: the second shortest, whose filter is heaviest."""
        return min(1, len(self.readings) - 1)

    @property
    def frame(self) -> tuple[float, float, float, float]:
        """West, north, cell and cell height: the kernels' argument."""
        return self.west_m, self.north_m, self.cell_m, self.cell_north_m

    @property
    def relief_m(self) -> float:
        """Standard deviation of the heights."""
        return float(np.nanstd(self.height_m))

    def structure_m2(self, lag_m: FloatArray) -> FloatArray:
        """Mean square difference of height between points `lag_m` apart, a power law between lags."""
        lags, squares = self.structure
        low, high = np.log(lags[0]), np.log(squares[0] + 1e-12)
        # Below a cell the ground is smooth at worst like a plane, so the square falls as lag^2.
        rise = (np.log(squares[1] + 1e-12) - high) / (np.log(lags[1]) - low) if len(lags) > 1 else 2
        log_lag = np.log(np.maximum(np.asarray(lag_m, float), 1e-6))
        inside = np.interp(log_lag, np.log(lags), np.log(squares + 1e-12))
        below = high + np.clip(rise, 0.5, 2.0) * (log_lag - low)
        return np.asarray(np.exp(np.where(log_lag < low, below, inside)))

    def heights(self, easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
        """Interpolate heights bilinearly; NaN outside and beside no data."""
        easting, northing = np.broadcast_arrays(
            np.asarray(easting_m, float), np.asarray(northing_m, float)
        )
        out = lookup_many(self.height_m, self.frame, easting.ravel(), northing.ravel())
        return out.reshape(easting.shape)

    def sigmas(self, easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
        """Interpolate the heights' 1-sigma; where the map has none, its median."""
        out = lookup_many(
            self.sigma_m,
            self.frame,
            np.asarray(easting_m, float).ravel(),
            np.asarray(northing_m, float).ravel(),
        )
        return np.where(np.isfinite(out), out, self.error.total_m).reshape(np.shape(easting_m))


def terrain_map(
    grid: Grid,
    error_length_m: float | None = None,
    bounds: tuple[float, float, float, float] | None = None,
) -> TerrainMap:
    """Prepare a prior map for navigation.

    Parameters
    ----------
    grid : the prior; its `sigma_m` must be set (`localization.maperror.assumed_sigma` where it is
        not known).
    error_length_m : correlation length of the map's error; None estimates what can be estimated.
    bounds : west, south, east, north of the part that the vehicle can reach; the rest is left out.

    Raises
    ------
    NoOverlapError
        `bounds` does not touch the map, or touches cells without data only.
    InputError
        The grid has no sigma.
    """
    if grid.sigma_m is None:
        raise InputError("the prior map has no sigma; give one with --map-sigma METRES")
    part = grid if bounds is None else _crop(grid, bounds)
    assert part.sigma_m is not None
    height, sigma, error = filter_map(
        part.elevation_m, part.sigma_m, part.cell_m, part.cell_north_m, error_length_m
    )
    readings = _readings(height, part.sigma_m, (part.cell_m, part.cell_north_m), error)
    return TerrainMap(
        height_m=readings[min(1, len(readings) - 1)].height_m,
        sigma_m=np.ascontiguousarray(sigma, np.float32),
        west_m=part.west_m + part.cell_m / 2,
        north_m=part.north_m - part.cell_north_m / 2,
        cell_m=part.cell_m,
        cell_north_m=part.cell_north_m,
        error=error,
        structure=_structure(height, part.cell_m),
        readings=readings,
    )


def _readings(
    height_m: FloatArray, sigma_m: FloatArray, cell_m: tuple[float, float], error: MapError
) -> tuple[Reading, ...]:
    """Read the map under every correlation length that its error may have, shortest first."""
    lengths = map_error_lengths(error, max(cell_m))
    shared = float(np.hypot(error.filtered_m, error.correlated_m))
    if error.correlated_m == 0:
        # White or no error at all: filtered already.
        height = np.ascontiguousarray(height_m, np.float32)
        return tuple(Reading(length, w, shared, height) for length, w in lengths.items())
    excess = sigma_m / max(error.stated_m, 1e-9)
    found = expected_ground(height_m, excess, cell_m, shared, lengths)
    return tuple(sorted(found, key=lambda reading: reading.length_m))


def _structure(height_m: FloatArray, cell_m: float) -> tuple[FloatArray, FloatArray]:
    lags, squares = [], []
    lag = 1
    while lag < min(max(height_m.shape) // 2, 257):
        parts = [
            difference[np.isfinite(difference)]
            for difference in (
                height_m[lag:] - height_m[:-lag], height_m[:, lag:] - height_m[:, :-lag]
            )
        ]  # fmt: skip
        both = np.concatenate(parts)
        if both.size:
            lags.append(lag * cell_m)
            squares.append(float(np.mean(both**2)))
        lag *= 2
    return np.array(lags or [cell_m]), np.array(squares or [0.0])


def _crop(grid: Grid, bounds: tuple[float, float, float, float]) -> Grid:
    west, south, east, north = bounds
    rows, cols = grid.shape
    first_col = max(0, math.floor((west - grid.west_m) / grid.cell_m))
    last_col = min(cols, math.ceil((east - grid.west_m) / grid.cell_m))
    first_row = max(0, math.floor((grid.north_m - north) / grid.cell_north_m))
    last_row = min(rows, math.ceil((grid.north_m - south) / grid.cell_north_m))
    if first_col + 1 >= last_col or first_row + 1 >= last_row:
        raise NoOverlapError(
            f"the navigation (easting {west:.0f} to {east:.0f} m, northing {south:.0f} to "
            f"{north:.0f} m, its uncertainty included) does not meet the prior map (easting "
            f"{grid.west_m:.0f} to {grid.east_m:.0f} m, northing {grid.south_m:.0f} to "
            f"{grid.north_m:.0f} m); are both in one projected CRS, in metres?"
        )
    window = (slice(first_row, last_row), slice(first_col, last_col))
    if not np.isfinite(grid.elevation_m[window]).any():
        raise NoOverlapError(
            "the prior map holds no data where the navigation goes (easting "
            f"{west:.0f} to {east:.0f} m, northing {south:.0f} to {north:.0f} m)"
        )
    assert grid.sigma_m is not None
    return Grid(
        elevation_m=grid.elevation_m[window],
        sigma_m=grid.sigma_m[window],
        west_m=grid.west_m + first_col * grid.cell_m,
        north_m=grid.north_m - first_row * grid.cell_north_m,
        cell_m=grid.cell_m,
        cell_height_m=grid.cell_height_m,
        crs=grid.crs,
        datum=grid.datum,
    )


@numba.njit(cache=True, inline="always")
def lookup(values, frame, easting_m, northing_m):  # type: ignore[no-untyped-def]
    """Interpolate one point bilinearly; NaN outside the outermost centres or beside a NaN."""
    col = (easting_m - frame[0]) / frame[2]
    row = (frame[1] - northing_m) / frame[3]
    rows, cols = values.shape
    if not (row >= 0.0 and col >= 0.0 and row < rows - 1 and col < cols - 1):
        return np.nan
    r = int(row)
    c = int(col)
    fr = row - r
    fc = col - c
    top = values[r, c] + fc * (values[r, c + 1] - values[r, c])
    bottom = values[r + 1, c] + fc * (values[r + 1, c + 1] - values[r + 1, c])
    return top + fr * (bottom - top)


@numba.njit(cache=True)
def lookup_many(values, frame, easting_m, northing_m):  # type: ignore[no-untyped-def]
    """Interpolate at (n,) points; see `lookup`."""
    out = np.empty(easting_m.size)
    for i in range(easting_m.size):
        out[i] = lookup(values, frame, easting_m[i], northing_m[i])
    return out


@numba.njit(cache=True)
def linearise(values, frame, easting_m, northing_m, root):  # type: ignore[no-untyped-def]
    """Fit a plane to the terrain under an uncertain position (statistical linearisation).

    For each point the terrain is read at the nine nodes of a Gauss-Hermite rule on the Gaussian of
    square root `root` (2, 2, lower triangular, m): the plane's height and slope are the weighted
    regression, and what the plane leaves over is a variance that the filter adds to its noise. So a
    filter that knows little sees the slope at the scale of what it does not know.

    Returns
    -------
    (n, 4) : mean height, slope east, slope north, left-over variance; NaN where a node has no data.
    """
    out = np.empty((easting_m.size, 4))
    for i in range(easting_m.size):
        mean = 0.0
        slope_0 = 0.0
        slope_1 = 0.0
        square = 0.0
        for a in range(3):
            u = (a - 1) * _NODE
            for b in range(3):
                v = (b - 1) * _NODE
                weight = _WEIGHTS[a] * _WEIGHTS[b]
                height = lookup(
                    values,
                    frame,
                    easting_m[i] + root[0, 0] * u,
                    northing_m[i] + root[1, 0] * u + root[1, 1] * v,
                )
                mean += weight * height
                slope_0 += weight * height * u
                slope_1 += weight * height * v
                square += weight * height * height
        # In whitened axes the nodes have unit variance, so the sums are the slopes; h = root^-T s.
        north = slope_1 / root[1, 1]
        out[i, 0] = mean
        out[i, 1] = (slope_0 - root[1, 0] * north) / root[0, 0]
        out[i, 2] = north
        out[i, 3] = max(square - mean * mean - slope_0 * slope_0 - slope_1 * slope_1, 0.0)
    return out
