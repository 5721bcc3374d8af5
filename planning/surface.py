"""The map as the planners see it: the least height everywhere, the ground's weight, what is barred.

Local coordinates: x metres east and y metres *south* of the centre of the raster's first cell, so
that column = x / width and row = y / height.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from perception.records import BoolArray, FloatArray, Grid
from planning.cost import CostTerms
from planning.currents import STRONGEST, Currents
from planning.limits import VehicleLimits
from planning.obstacles import Obstacles, raised

# Layers of `Surface.stack`; the last two are there only where there is a current: its share of the
# vehicle's speed along local x (east) and y (south).
LOWER, BOTTOM, WEIGHT, BAR, DRIFT_X, DRIFT_Y = 0, 1, 2, 3, 4, 5


@dataclass(frozen=True, slots=True)
class Surface:
    """Rasters for planning; NaN-free, so that a search may look anywhere.

    Attributes
    ----------
    bottom_m : (rows, cols) sea floor as stored, NaN no data.
    lower_m : (rows, cols) least height of the vehicle: bottom (or the top of an object there) + floor
        + k sigma; NaN no data.
    barred : (rows, cols) True where no route may pass: no data, no-go area, or no water left between
        floor and surface.
    stack : (rows, cols, 4 or 6) float32 layers lower, bottom, weight, bar, drift: filled from the nearest
        cell where there is no data; bar is the distance (m) into barred ground, 0 outside it.
    origin_m : easting and northing of the first cell's centre.
    cell_m : width and height of a cell.
    top_m : height of the water's surface above the datum; infinite on dry stand-ins.
    """

    bottom_m: FloatArray
    lower_m: FloatArray
    barred: BoolArray
    stack: FloatArray
    origin_m: tuple[float, float]
    cell_m: tuple[float, float]
    top_m: float
    limits: VehicleLimits
    terms: CostTerms
    k: float = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        rows, cols = self.bottom_m.shape
        return rows, cols

    @property
    def bottom_most_m(self) -> float:
        """Least height that the depth limit allows."""
        return -self.limits.depth_max_m

    @property
    def drifts(self) -> bool:
        """Whether there is a current."""
        return bool(self.stack.shape[2] > DRIFT_X)

    def reversed(self) -> Surface:
        """Return the surface on which a path costs what its reverse does on this one."""
        if not self.drifts:
            return self
        stack = self.stack.copy()
        stack[..., DRIFT_X:] *= -1.0
        return replace(self, stack=stack)

    def at_least_height(self) -> Surface:
        """Return the surface whose weight holds the price of k sigma too: no route flies lower.

        The grid search and the bound know no altitude; without this they would take the ground under a
        large sigma for as cheap as any.
        """
        if self.k == 0:
            return self
        above = self.lower_m - self.bottom_m - self.limits.floor_m
        stack = self.stack.copy()
        dear = self.terms.altitude_per_m * np.maximum(0.0, np.nan_to_num(above))
        stack[..., WEIGHT] += dear.astype(np.float32)
        return replace(self, stack=stack)

    def local(self, easting_m: FloatArray, northing_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local x, y of map coordinates."""
        return (
            np.asarray(easting_m, float) - self.origin_m[0],
            self.origin_m[1] - np.asarray(northing_m, float),
        )

    def world(self, x_m: FloatArray, y_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return easting and northing of local coordinates."""
        return self.origin_m[0] + np.asarray(x_m), self.origin_m[1] - np.asarray(y_m)


def build_surface(
    grid: Grid,
    limits: VehicleLimits,
    terms: CostTerms,
    weight: FloatArray | None = None,
    sigma_m: FloatArray | None = None,
    k: float = 0.0,
    forbidden: BoolArray | None = None,
    submerged: bool = True,
    currents: Currents | None = None,
    obstacles: Obstacles | None = None,
) -> Surface:
    """Make the planners' rasters from a map.

    Parameters
    ----------
    weight : (rows, cols) `w`; 1 everywhere without.
    sigma_m : (rows, cols) what the clearance must cover `k` times; NaN bars a cell when k > 0.
    forbidden : (rows, cols) True in no-go areas.
    submerged : whether height 0 is the water's surface, which no route may leave.
    currents : of the water; None still.
    obstacles : objects that stand higher than the map; None none.
    """
    bottom = np.asarray(grid.elevation_m, float)
    lower: FloatArray = bottom + limits.floor_m
    if sigma_m is not None and k > 0:
        lower = lower + k * sigma_m
    if obstacles is not None:
        lower = raised(lower, obstacles, limits.floor_m, sigma_m, k)
    top = 0.0 if submerged else np.inf
    with np.errstate(invalid="ignore"):
        barred = ~np.isfinite(lower) | (lower > top)
        barred |= bottom + limits.ceiling_m < np.maximum(lower, -limits.depth_max_m)
    if forbidden is not None:
        barred |= forbidden
    if obstacles is not None:
        barred |= obstacles.barred
    w = np.ones(bottom.shape) if weight is None else np.asarray(weight, float)
    w = np.where(np.isfinite(w), w, 1.0)
    if terms.uncertainty_per_m > 0 and sigma_m is not None:
        w = w + terms.uncertainty_per_m * np.nan_to_num(sigma_m)
    drift: tuple[FloatArray, ...] = ()
    if currents is not None:
        east, north = currents.on(grid)
        drift = (east / limits.speed_m_s, -north / limits.speed_m_s)
        barred |= np.hypot(*drift) > STRONGEST
    return Surface(
        bottom_m=bottom,
        lower_m=lower,
        barred=barred,
        stack=_stack(bottom, lower, w, barred, (grid.cell_m, grid.cell_north_m), drift),
        origin_m=(grid.west_m + 0.5 * grid.cell_m, grid.north_m - 0.5 * grid.cell_north_m),
        cell_m=(grid.cell_m, grid.cell_north_m),
        top_m=top,
        limits=limits,
        terms=terms,
        k=k,
    )


def _stack(
    bottom: FloatArray,
    lower: FloatArray,
    weight: FloatArray,
    barred: BoolArray,
    cell_m: tuple[float, float],
    drift: tuple[FloatArray, ...],
) -> FloatArray:
    stack = np.empty((*bottom.shape, 4 + len(drift)), np.float32)
    stack[..., LOWER], stack[..., BOTTOM], stack[..., WEIGHT] = lower, bottom, weight
    stack[..., BAR] = 0.0
    for layer, values in enumerate(drift, start=DRIFT_X):
        stack[..., layer] = values
    if not barred.any():
        return stack
    missing = ~(np.isfinite(lower) & np.isfinite(bottom))
    if missing.all():
        stack[..., :2] = 0.0
    elif missing.any():
        rows, cols = ndimage.distance_transform_edt(
            missing, return_distances=False, return_indices=True
        )
        stack[..., LOWER] = lower[rows, cols]
        stack[..., BOTTOM] = bottom[rows, cols]
    stack[..., BAR] = ndimage.distance_transform_edt(barred, sampling=(cell_m[1], cell_m[0]))
    return stack


def cautious(surface: Surface, ends: FloatArray) -> Surface:
    """Return the surface with barred ground one cell wider, but for the surroundings of the ends.

    Samples a cell apart can miss the corner of a barred square; with this margin they cannot.

    Parameters
    ----------
    ends : (n, 2) local coordinates that must stay free.
    """
    wide = ndimage.binary_dilation(surface.barred, np.ones((3, 3), bool))
    for x, y in ends:
        r, c = round(float(y) / surface.cell_m[1]), round(float(x) / surface.cell_m[0])
        near = (slice(max(0, r - 2), r + 3), slice(max(0, c - 2), c + 3))
        wide[near] = surface.barred[near]
    stack = surface.stack.copy()
    stack[..., BAR] = ndimage.distance_transform_edt(
        wide, sampling=(surface.cell_m[1], surface.cell_m[0])
    )
    return replace(surface, stack=stack)
