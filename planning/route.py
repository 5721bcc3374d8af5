"""A route, and the files that people and vehicles take it by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from mapping.vectors import write_layer
from perception.files import write_text
from perception.geodesy import convergence
from perception.records import FloatArray
from planning.finish import (
    DEPTH_DIGITS,
    POSITION_DIGITS,
    Waypoints,
    exact_cost,
    travel_time_s,
)
from planning.stand_off import stand_off
from planning.surface import Surface


@dataclass(frozen=True, slots=True)
class Route:
    """Waypoints joined by straight lines, proved clear of the bottom.

    Attributes
    ----------
    easting_m, northing_m, depth_m, altitude_m, heading_rad, distance_m : (n,), as printed;
        `distance_m` runs along the path in space.
    cost : of the path, with the units of `planning.cost`.
    min_clearance_margin_m : exact least of altitude - floor - k sigma along the path.
    min_altitude_m, max_altitude_m : exact extremes.
    worst : (easting, northing, depth) where the margin is least.
    travel_time_s : at the vehicle's speed through the water, currents included.
    min_stand_off_m : least slant distance to the ground.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    altitude_m: FloatArray
    heading_rad: FloatArray
    distance_m: FloatArray
    cost: float
    min_clearance_margin_m: float
    min_altitude_m: float
    max_altitude_m: float
    worst: tuple[float, float, float]
    crs: str = ""
    travel_time_s: float = math.nan
    min_stand_off_m: float = math.nan

    @property
    def length_m(self) -> float:
        return float(self.distance_m[-1])

    @property
    def mean_altitude_m(self) -> float:
        """Altitude averaged over the length of the path."""
        legs = np.diff(self.distance_m)
        if legs.sum() == 0:
            return float(self.altitude_m[0])
        middle = 0.5 * (self.altitude_m[1:] + self.altitude_m[:-1])
        return float((legs * middle).sum() / legs.sum())


def route_of(surface: Surface, w: Waypoints, crs: str) -> Route:
    """Make the record of waypoints proved on a surface that is held whole."""
    return Route(
        w.easting_m, w.northing_m, w.depth_m, w.altitude_m, w.heading_rad, w.distance_m,
        exact_cost(surface, w), w.least_margin_m, w.least_altitude_m, w.greatest_altitude_m, w.worst,
        crs, travel_time_s(surface, w), stand_off(surface, w),
    )  # fmt: skip


def true_headings(route: Route) -> FloatArray:
    """Return the headings clockwise from true north (rad), as files have them; grid north without a CRS."""
    if not route.crs:
        return route.heading_rad
    turn = convergence(route.easting_m, route.northing_m, route.crs)
    return np.asarray(np.mod(route.heading_rad + np.nan_to_num(turn), 2 * np.pi))


def route_csv(route: Route) -> str:
    """Return `route.csv`: headings from true north, altitudes rounded down.

    Depths were rounded before the proof.
    """
    scale = 10.0**DEPTH_DIGITS
    altitude = np.floor(route.altitude_m * scale + 1e-9) / scale
    # Rounded before it is wrapped: no 360.0000 in the file.
    heading_deg = np.mod(np.round(np.degrees(true_headings(route)), 4), 360.0)
    lines = ["easting_m,northing_m,depth_m,altitude_m,heading_deg,distance_m"]
    lines += [
        f"{e:.{POSITION_DIGITS}f},{n:.{POSITION_DIGITS}f},{d:.{DEPTH_DIGITS}f},"
        f"{a:.{DEPTH_DIGITS}f},{h:.4f},{s:.4f}"
        for e, n, d, a, h, s in zip(
            route.easting_m, route.northing_m, route.depth_m, altitude,
            heading_deg, route.distance_m, strict=True,
        )
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def write_route(out: Path, route: Route) -> None:
    """Write route.csv, route.gpkg and route.geojson; the line's z is height (minus depth)."""
    write_text(out / "route.csv", route_csv(route))
    line = shapely.linestrings(np.column_stack([route.easting_m, route.northing_m, -route.depth_m]))
    columns = {
        "length_m": np.array([route.length_m]),
        "cost": np.array([route.cost]),
        "mean_altitude_m": np.array([route.mean_altitude_m]),
        "min_margin_m": np.array([route.min_clearance_margin_m]),
    }
    for name in ("route.gpkg", "route.geojson"):
        write_layer(out / name, [line], columns, route.crs, "LineString Z", layer="route")
