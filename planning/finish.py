"""From a polished curve to printed waypoints whose clearance is proved.

What is proved is what is written: the digits are rounded first, the depth profile is then made for the
rounded positions and rounded to the shallower side, and lifted until the exact least clearance of every
segment is positive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from perception.records import FloatArray, bilinear
from planning.curve import waypoints
from planning.ground import Ground, SurfaceGround
from planning.polish import PITCH_RESERVE, RADIUS_RESERVE
from planning.profile import bridge_troughs, cone_envelope, water_per_ground
from planning.surface import WEIGHT, Surface

POSITION_DIGITS = 5
DEPTH_DIGITS = 4
# The proof asks for this much more than nothing (m), so that a reader's own rounding of the last bit
# of a double cannot turn a touch into a breach.
_PROOF_M = 1e-6
_LIFTS = 80
# A vehicle holds its depth to about this (m): a start this much deeper is where it is.
_START_M = 0.05


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Printed waypoints with the proof of their clearance.

    Attributes
    ----------
    easting_m, northing_m, depth_m : (n,) as printed.
    altitude_m : (n,) above the bilinear bottom.
    heading_rad : (n,) clockwise from grid north, along the path.
    distance_m : (n,) along the path in space.
    least_margin_m : exact least of altitude - floor - k sigma along the continuous path.
    greatest_altitude_m, least_altitude_m : exact extremes of altitude.
    worst : (easting, northing, depth) where the margin is least.
    problem : what is broken, empty where every limit is kept.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    altitude_m: FloatArray
    heading_rad: FloatArray
    distance_m: FloatArray
    least_margin_m: float
    least_altitude_m: float
    greatest_altitude_m: float
    worst: tuple[float, float, float]
    problem: str = ""


def waypoint_spacing(surface: Surface, length_m: float) -> float:
    """Return the distance between waypoints: about a cell, fine enough to show an arc as one."""
    spacing = min(surface.cell_m)
    radius = surface.limits.turn_radius_m
    if radius > 0:
        spacing = float(np.clip(spacing, radius / 16.0, radius / 8.0))
    return max(spacing, length_m / 200_000.0)


def finish(
    surface: Surface,
    points: FloatArray,
    spacing: float | None = None,
    start_height_m: float | None = None,
) -> Waypoints:
    """Print a control polygon as waypoints and prove their clearance.

    Parameters
    ----------
    points : (n, 2) control polygon, local coordinates.
    spacing : between waypoints; chosen by `waypoint_spacing` without.
    start_height_m : where the vehicle is now; the profile begins there.
    """
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    step = waypoint_spacing(surface, length) if spacing is None else spacing
    xy = waypoints(points, surface.limits.turn_radius_m * RADIUS_RESERVE, step)
    easting, northing = surface.world(xy[:, 0], xy[:, 1])
    easting = np.round(easting, POSITION_DIGITS)
    northing = np.round(northing, POSITION_DIGITS)
    return prove(surface, easting, northing, start_height_m)


def prove(
    surface: Surface,
    easting_m: FloatArray,
    northing_m: FloatArray,
    start_height_m: float | None = None,
    ground: Ground | None = None,
) -> Waypoints:
    """Give printed positions their best profile, lift it clear, and prove it.

    Parameters
    ----------
    ground : what the proof is over; the surface itself without.
    """
    ground = SurfaceGround(surface) if ground is None else ground
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(easting_m), np.diff(northing_m)))])
    least_height, bottom, weight = ground.at(easting_m, northing_m)
    lower = np.maximum(least_height, surface.bottom_most_m)
    if not np.isfinite(lower).all():
        bad = int(np.flatnonzero(~np.isfinite(lower))[0])
        return _problem(easting_m, northing_m, bad)
    upper = np.minimum(bottom + surface.limits.ceiling_m, surface.top_m)
    lower = lower + _PROOF_M
    if start_height_m is not None:
        lower[0] = max(lower[0], start_height_m)
    bend = surface.terms.altitude_per_m / float(weight.mean())
    z: FloatArray = lower.copy()
    for _ in range(_LIFTS):
        z = _profile(surface, s, lower, upper, bend)
        margin, _ = ground.extremes(easting_m, northing_m, z)
        if np.isnan(margin.least_m).any():
            return _problem(easting_m, northing_m, int(np.flatnonzero(np.isnan(margin.least_m))[0]))
        short = _PROOF_M / 2 - margin.least_m
        if (short <= 0).all():
            break
        lift = np.where(short > 0, short + _PROOF_M, -np.inf)
        # Lifting both ends of a segment lifts all of it.
        lower[:-1] = np.maximum(lower[:-1], z[:-1] + lift)
        lower[1:] = np.maximum(lower[1:], z[1:] + lift)
    proved = _verdict(surface, ground, easting_m, northing_m, s, z, bottom)
    if start_height_m is not None and z[0] > start_height_m + _START_M and not proved.problem:
        late = f"the vehicle is {z[0] - start_height_m:.2f} m too deep to clear what lies ahead"
        return replace(proved, problem=late)
    return proved


def _profile(
    surface: Surface, s: FloatArray, lower: FloatArray, upper: FloatArray, bend: float
) -> FloatArray:
    """Return the best profile, rounded to the shallower side at the printed digits."""
    n = len(s)
    z = np.empty(n)
    limits = surface.limits
    cone_envelope(
        s, lower, n, limits.slope_up * PITCH_RESERVE, limits.slope_down * PITCH_RESERVE, z
    )
    bridge_troughs(s, z, upper, n, bend, np.empty(n, np.int64))
    scale = 10.0**DEPTH_DIGITS
    return np.round(np.ceil(z * scale - 1e-9) / scale, DEPTH_DIGITS)


def _verdict(
    surface: Surface,
    ground: Ground,
    easting_m: FloatArray,
    northing_m: FloatArray,
    s: FloatArray,
    z: FloatArray,
    bottom: FloatArray,
) -> Waypoints:
    limits = surface.limits
    margin, altitude = ground.extremes(easting_m, northing_m, z)
    at, v = margin.worst()
    slope = np.diff(z) / np.maximum(np.diff(s), 1e-12)
    problem = ""
    least = float(np.min(margin.least_m))
    highest = float(np.max(altitude.greatest_m))
    if not least >= 0:
        problem = f"clearance short by {-least:.3f} m"
    elif highest > limits.ceiling_m:
        at = int(np.argmax(altitude.greatest_m))
        v = float(altitude.greatest_at[at])
        problem = f"altitude {highest:.2f} m above the ceiling of {limits.ceiling_m:g} m"
    elif slope.max(initial=0.0) > limits.slope_up:
        at, v = int(np.argmax(slope)), 0.5
        problem = f"climb of {math.degrees(math.atan(slope.max())):.1f} deg too steep"
    elif slope.min(initial=0.0) < -limits.slope_down:
        at, v = int(np.argmin(slope)), 0.5
        problem = f"dive of {math.degrees(math.atan(-slope.min())):.1f} deg too steep"
    elif z.max() > surface.top_m:
        at, v = int(np.argmax(z)), 0.0
        problem = f"{z.max() - surface.top_m:.2f} m above the water's surface"
    elif surface.limits.turn_radius_m > 0:
        radius, at = least_radius(easting_m, northing_m)
        if radius < limits.turn_radius_m:
            v = 0.0
            problem = f"turn of radius {radius:.2f} m tighter than {limits.turn_radius_m:g} m"
    nxt = min(at + 1, len(z) - 1)
    worst = tuple(float(a[at] + v * (a[nxt] - a[at])) for a in (easting_m, northing_m, -z))
    return Waypoints(
        easting_m, northing_m, -z + 0.0, z - bottom,
        headings(easting_m, northing_m),
        np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(s), np.diff(z)))]),
        least, float(np.min(altitude.least_m)), highest,
        (worst[0], worst[1], worst[2]), problem,
    )  # fmt: skip


def _problem(easting_m: FloatArray, northing_m: FloatArray, at: int) -> Waypoints:
    nothing = np.full(len(easting_m), np.nan)
    worst = (float(easting_m[at]), float(northing_m[at]), math.nan)
    return Waypoints(
        easting_m, northing_m, nothing, nothing, nothing, nothing,
        math.nan, math.nan, math.nan, worst, "the path meets barred ground or no data",
    )  # fmt: skip


def headings(easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
    """Return the path's heading at each waypoint, clockwise from grid north, in [0, 2 pi)."""
    if len(easting_m) < 2:
        return np.zeros(len(easting_m))
    de, dn = np.diff(easting_m), np.diff(northing_m)
    length = np.maximum(np.hypot(de, dn), 1e-12)
    de, dn = de / length, dn / length
    east = np.concatenate([de[:1], de[:-1] + de[1:], de[-1:]])
    north = np.concatenate([dn[:1], dn[:-1] + dn[1:], dn[-1:]])
    return np.asarray(np.mod(np.arctan2(east, north), 2 * np.pi))


def least_radius(easting_m: FloatArray, northing_m: FloatArray) -> tuple[float, int]:
    """Return the least radius of turn, mean leg over change of heading, and its waypoint."""
    de, dn = np.diff(easting_m), np.diff(northing_m)
    legs = np.hypot(de, dn)
    if len(legs) < 2:
        return math.inf, 0
    turn = np.abs(
        np.arctan2(de[:-1] * dn[1:] - dn[:-1] * de[1:], de[:-1] * de[1:] + dn[:-1] * dn[1:])
    )
    radius = 0.5 * (legs[:-1] + legs[1:]) / np.maximum(turn, 1e-12)
    at = int(np.argmin(radius))
    return float(radius[at]), at + 1


def exact_cost(surface: Surface, w: Waypoints, parts: int = 8) -> float:
    """Integrate the cost along printed waypoints, each segment by the midpoints of `parts` pieces."""
    v = (np.arange(parts) + 0.5) / parts
    z = -w.depth_m
    lengths = np.sqrt(np.diff(w.easting_m) ** 2 + np.diff(w.northing_m) ** 2 + np.diff(z) ** 2)

    def between(values: FloatArray) -> FloatArray:
        return values[:-1, None] + np.diff(values)[:, None] * v

    x, y = surface.local(between(w.easting_m), between(w.northing_m))
    row, col = y / surface.cell_m[1], x / surface.cell_m[0]
    above = between(z) - bilinear(surface.bottom_m, row, col) - surface.limits.floor_m
    rate = bilinear(surface.stack[..., WEIGHT], row, col)
    rate = rate + surface.terms.altitude_per_m * np.maximum(0.0, above)
    return float((rate.mean(axis=1) * lengths * water_along(surface, w)).sum())


def travel_time_s(surface: Surface, w: Waypoints) -> float:
    """Return how long the vehicle takes at its speed through the water, currents included."""
    legs = np.diff(w.distance_m) * water_along(surface, w)
    return float(legs.sum() / surface.limits.speed_m_s)


def water_along(surface: Surface, w: Waypoints) -> FloatArray:
    """Return (n - 1,) metres of water per metre of each segment."""
    x, y = surface.local(w.easting_m, w.northing_m)
    if not surface.drifts:
        return np.ones(len(x) - 1)
    width, height = surface.cell_m
    return np.array(
        [
            water_per_ground(surface.stack, width, height, x[i], y[i], x[i + 1], y[i + 1])
            for i in range(len(x) - 1)
        ]
    )
