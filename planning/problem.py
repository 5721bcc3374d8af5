"""What is asked: a map, a vehicle, a cost, and the risk that the clearance may take."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from perception.records import BoolArray, FloatArray, Grid
from planning.cost import CostTerms
from planning.currents import Currents
from planning.limits import VehicleLimits
from planning.obstacles import Obstacles
from planning.risk import clearance_factor, clearance_sigma, patches_crossed
from planning.surface import Surface, build_surface

# Without a word on it the map's errors hold over so many cells.
_CORRELATION_CELLS = 10.0


@dataclass(frozen=True, slots=True)
class Problem:
    """Everything about the ground and the vehicle that planning must know but the ends.

    Attributes
    ----------
    weight : (rows, cols) `w` of the cost; 1 everywhere without.
    forbidden : (rows, cols) True in no-go areas.
    position_sigma_m : (rows, cols) expected position error, 1-sigma per axis.
    currents : of the water; None still.
    risk : probability that the floor is broken anywhere along the route.
    correlation_m : distance over which the map's errors are independent; NaN 10 cells.
    submerged : whether height 0 is the water's surface; None asks the grid (`under_water`).
    obstacles : objects that stand higher than the map; None none.
    """

    grid: Grid
    limits: VehicleLimits = field(default_factory=VehicleLimits)
    terms: CostTerms = field(default_factory=CostTerms)
    weight: FloatArray | None = None
    forbidden: BoolArray | None = None
    position_sigma_m: FloatArray | None = None
    currents: Currents | None = None
    risk: float = 0.01
    correlation_m: float = math.nan
    submerged: bool | None = None
    obstacles: Obstacles | None = None

    def under_water(self) -> bool:
        """Tell whether height 0 is the water's surface, which no route may leave.

        A dry terrain model, all of it above its zero, stands in for a sea floor: its zero is none.
        """
        if self.submerged is not None:
            return self.submerged
        return not float(np.fmin.reduce(self.grid.elevation_m, axis=None)) > 0

    def clearance_sigma_m(self) -> FloatArray | None:
        """Return (rows, cols) sigma that the clearance must cover; None where nothing is uncertain."""
        grid, limits = self.grid, self.limits
        return clearance_sigma(
            grid.elevation_m, (grid.cell_m, grid.cell_north_m), grid.sigma_m,
            limits.sigma_position_m if self.position_sigma_m is None else self.position_sigma_m,
            limits.sigma_depth_m,
        )  # fmt: skip

    def factor(self, length_m: float) -> tuple[float, float]:
        """Return k for a route of that length, and the independent patches that it crosses."""
        correlation = self.correlation_m
        if not math.isfinite(correlation):
            correlation = _CORRELATION_CELLS * max(self.grid.cell_m, self.grid.cell_north_m)
        patches = patches_crossed(length_m, correlation)
        return clearance_factor(self.risk, patches), patches

    def surface(self, sigma_m: FloatArray | None, k: float) -> Surface:
        """Return the planners' rasters under a clearance of k sigma."""
        weight = self.weight
        if self.terms.position_per_m > 0 and self.position_sigma_m is not None:
            dear = self.terms.position_per_m * np.nan_to_num(self.position_sigma_m)
            weight = dear + (1.0 if weight is None else weight)
        return build_surface(
            self.grid, self.limits, self.terms, weight, sigma_m, k, self.forbidden,
            self.under_water(), self.currents, self.obstacles,
        )  # fmt: skip

    def surface_for(self, length_m: float) -> tuple[Surface, float]:
        """Return the rasters for a route of that length, and the patches that it crosses."""
        sigma = self.clearance_sigma_m()
        k, patches = self.factor(length_m)
        return self.surface(sigma, 0.0 if sigma is None else k), patches
