"""Refuse navigation that cannot be in metres, seconds and degrees, with the value that shows it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from perception.records import BoolArray, FloatArray, InputError

if TYPE_CHECKING:
    from localization.navfile import NavTable

# The deepest place of the oceans is 10,935 m: more is another unit.
_DEEPEST_M = 12_000.0
# No underwater vehicle makes 50 m/s: more is another unit, or another zone's positions.
_FASTEST_M_S = 50.0
# Navigation is logged every few seconds: ten minutes between rows of a vehicle that hardly moves is
# another unit of time.
_LONGEST_PAUSE_S = 600.0


def check_nav(nav: NavTable) -> None:
    """Refuse a table whose values cannot be metres, seconds and degrees, naming the value."""
    placed = np.isfinite(nav.easting_m) & np.isfinite(nav.northing_m) & np.isfinite(nav.time_s)
    if placed.sum() < 2:
        raise InputError(
            f"{nav.source}: has {int(placed.sum())} row(s) with time and position of {len(nav)}; "
            "at least 2 are needed"
        )
    _check_size(nav, "depth_m", nav.depth_m)
    for i in range(nav.slant_range_m.shape[1]):
        _check_size(nav, f"range {i + 1}", nav.slant_range_m[:, i])
    time = nav.time_s[placed]
    steps = np.diff(time)
    backward = int(np.sum(steps < 0))
    if backward > 0.3 * len(steps) and len(steps) > 3:
        raise InputError(
            f"{nav.source}: time_s runs backwards in {backward} of {len(steps)} steps; "
            "sort the rows by time"
        )
    forward = steps > 0
    if not forward.any():
        raise InputError(f"{nav.source}: time_s never advances (it is {time[0]:g} throughout)")
    way = np.hypot(np.diff(nav.easting_m[placed]), np.diff(nav.northing_m[placed]))[forward]
    speed = float(np.median(way / steps[forward]))
    if speed > _FASTEST_M_S:
        raise InputError(
            f"{nav.source}: positions move at {speed:.4g} m/s (median; the limit is "
            f"{_FASTEST_M_S:g}); are they in metres and time_s in seconds?"
        )
    told = float(np.nanmedian(nav.speed_m_s)) if np.isfinite(nav.speed_m_s).any() else np.nan
    if told > 0.05 and speed > 0 and not 1 / 300 < speed / told < 300:
        raise InputError(
            f"{nav.source}: positions move at {speed:.4g} m/s (median) where speed_m_s says "
            f"{told:.4g}; is one of time_s, positions and speed_m_s in thousandths?"
        )
    pause = float(np.median(steps[forward]))
    if pause > _LONGEST_PAUSE_S and speed < 0.05:
        raise InputError(
            f"{nav.source}: time_s advances by {pause:.4g} s a row (median) while positions move at "
            f"{speed:.2g} m/s; is it in milliseconds?"
        )
    _check_headings(nav, placed)


def _check_headings(nav: NavTable, placed: BoolArray) -> None:
    """Refuse headings in radians: as degrees they would all be about north."""
    heading = np.degrees(nav.heading_rad[placed])
    told = heading[np.isfinite(heading)]
    if told.size < 10 or np.ptp(told) < 0.5 or np.abs(told).max() > 2 * np.pi + 0.01:
        return
    step = np.diff(nav.easting_m[placed]), np.diff(nav.northing_m[placed])
    course, heading = np.arctan2(*step), heading[1:]
    use = np.isfinite(heading) & (np.hypot(*step) > 0.2 * np.nanmedian(np.hypot(*step)))

    def off(assumed_rad: FloatArray) -> float:
        turn = (assumed_rad - course + np.pi) % (2 * np.pi) - np.pi
        return float(np.degrees(np.median(np.abs(turn[use]))))

    as_degrees, as_radians = off(np.radians(heading)), off(heading)
    if as_degrees > 20.0 > 2 * as_radians:
        raise InputError(
            f"{nav.source}: heading_deg runs from {told.min():.4g} to {told.max():.4g} and misses the "
            f"course by {as_degrees:.0f} degrees (median); is it in radians?"
        )


def _check_size(nav: NavTable, name: str, values: FloatArray) -> None:
    size = np.abs(values[np.isfinite(values)])
    # A few wild values are outliers, for the filter to reject; half of them are a wrong unit.
    if size.size and np.median(size) > _DEEPEST_M:
        raise InputError(
            f"{nav.source}: {name} is {np.median(size):.4g} m (median), more than any ocean's "
            f"{_DEEPEST_M:g}; is it in millimetres?"
        )


# A unit is told wrong by the map when the bottom misses it by so many of its own spreads as given, and
# lies within so few with the other unit; a spread is at least a tenth of the depth.
_MISSED, _MET, _LEAST_SPREAD = 2.0, 1.0, 0.1
# In metres no depth or range of a voyage is below half a metre throughout, or above the oceans'.
_LEAST_M = 0.5
_OTHER_UNITS = (
    (1000.0, 1.0, "depth_m is {depth:.4g} m (median): is it in kilometres?"),
    (0.001, 1.0, "depth_m is {depth:.4g} m (median): is it in millimetres?"),
    (1.0, 1000.0, "the ranges are {slant:.4g} m (median): are they in kilometres?"),
    (1.0, 0.001, "the ranges are {slant:.4g} m (median): are they in millimetres?"),
    (1000.0, 1000.0, "depth_m is {depth:.4g} m and the ranges {slant:.4g} m (medians): are they in kilometres?"),
    (0.001, 0.001, "depth_m is {depth:.4g} m and the ranges {slant:.4g} m (medians): are they in millimetres?"),
)  # fmt: skip


def check_against_map(nav: NavTable, map_elevation_m: float, relief_m: float = 0.0) -> None:
    """Refuse depths or ranges a thousand times off: compare the bottom they give with the map's.

    Only where another unit makes the bottom meet the map is the unit to blame; a bottom that merely
    misses the map is a wrong map, or a wrong place, and for the navigator to find out.

    Parameters
    ----------
    map_elevation_m, relief_m : median elevation of the map where the vehicle goes, and its spread.
    """
    if nav.slant_range_m.size == 0 or not np.isfinite(nav.slant_range_m).any():
        return
    depth, slant = float(np.nanmedian(nav.depth_m)), float(np.nanmedian(nav.slant_range_m))
    beams = nav.sensors.beams
    down = float(np.mean([math.cos(b.off_nadir_rad) for b in beams])) if beams else 1.0
    chart = -map_elevation_m
    spread = max(relief_m, _LEAST_SPREAD * abs(chart), 1.0)

    def miss(depth_factor: float, range_factor: float) -> float:
        return abs(depth_factor * depth + range_factor * slant * down - chart) / spread

    if not miss(1.0, 1.0) > _MISSED:
        return
    # A factor is possible where it makes sense of the value: 40 m of depth are not 40 km.
    possible = [
        unit
        for unit in _OTHER_UNITS
        if all(
            factor == 1.0 or _LEAST_M < factor * value < _DEEPEST_M
            for factor, value in zip(unit[:2], (depth, slant), strict=True)
        )
    ]
    best = min(possible, key=lambda unit: miss(*unit[:2]), default=None)
    if best is not None and miss(*best[:2]) < _MET:
        words = best[2].format(depth=depth, slant=slant)
        raise InputError(
            f"{nav.source}: {words} As they are, the bottom lies at {depth + slant * down:.4g} m "
            f"where the map has {chart:.4g} m"
        )


# Soundings lie off the map when they are beyond all of its heights by so many spreads of its relief, and
# so many 1-sigmas of the map and of the depth sensor's bias: no place of the map has such heights.
_BEYOND_RELIEFS, _BEYOND_SIGMAS = 3.0, 5.0


def off_the_map(
    nav: NavTable, map_elevation_m: FloatArray, relief_m: float, map_sigma_m: float
) -> str:
    """Return a sentence where the soundings lie far above or below all of the map; empty if not.

    Such soundings are no error of position: a unit, a sign or a datum is another than the map's.

    Parameters
    ----------
    map_elevation_m : heights where the vehicle goes, any shape, NaN unknown.
    relief_m, map_sigma_m : spread of those heights, and their 1-sigma.
    """
    known = map_elevation_m[np.isfinite(map_elevation_m)]
    beams = nav.sensors.beams
    if nav.slant_range_m.size == 0 or not known.size:
        return ""
    down = np.array([math.cos(b.off_nadir_rad) for b in beams]) if beams else np.ones(1)
    sounded = -(nav.depth_m[:, None] + nav.slant_range_m * down)
    if not np.isfinite(sounded).any():
        return ""
    middle = float(np.nanmedian(sounded))
    beyond = max(middle - float(known.max()), float(known.min()) - middle)
    allowed = _BEYOND_RELIEFS * relief_m + _BEYOND_SIGMAS * math.hypot(
        map_sigma_m, nav.sensors.depth_bias_m
    )
    if not beyond > allowed:
        return ""
    apart = middle - float(np.median(known))
    return (
        f"soundings lie {abs(apart):.0f} m {'above' if apart > 0 else 'below'} the map throughout: "
        "units, sign of depth, or datum?"
    )
