"""Landforms that compose a sea floor: each adds heights to a frame.

Coordinates are metres east and north of the world's origin, so a landform stands at the same place
at every cell size.
"""

from __future__ import annotations

import numpy as np

from perception.records import FloatArray


def plane(
    east: FloatArray, north: FloatArray, *, slope_deg: float, toward_deg: float
) -> FloatArray:
    """Tilt the floor: it falls by `slope_deg` toward the azimuth `toward_deg` (grid)."""
    azimuth = np.deg2rad(toward_deg)
    along = east * np.sin(azimuth) + north * np.cos(azimuth)
    return -np.tan(np.deg2rad(slope_deg)) * along


def along_and_off(
    east: FloatArray,
    north: FloatArray,
    *,
    east_m: float,
    north_m: float,
    azimuth_deg: float,
    meander_m: float,
    meander_length_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Return distance along an axis and distance off it (to its right), the axis meandering.

    The axis runs through (east_m, north_m) along `azimuth_deg` and swings by `meander_m` to either
    side as a sine of wavelength `meander_length_m`. The distance off a meandering axis is corrected
    to first order by the cosine of its slant, so a canyon keeps its width in the bends.
    """
    azimuth = np.deg2rad(azimuth_deg)
    de, dn = east - east_m, north - north_m
    along = de * np.sin(azimuth) + dn * np.cos(azimuth)
    off = de * np.cos(azimuth) - dn * np.sin(azimuth)
    if meander_m:
        phase = 2 * np.pi * along / meander_length_m
        slant = 2 * np.pi * meander_m / meander_length_m * np.cos(phase)
        off = (off - meander_m * np.sin(phase)) / np.hypot(1.0, slant)
    return along, off


def trough(off: FloatArray, *, width_m: float, wall_m: float) -> FloatArray:
    """Return a unit cross-section: 1 over a flat of `width_m`, down to 0 over `wall_m` at each side.

    The walls are raised cosines; their steepest slope is ``pi / 2 / wall_m`` per unit of height.
    """
    distance = np.clip((np.abs(off) - 0.5 * width_m) / wall_m, 0.0, 1.0)
    return 0.5 * (1.0 + np.cos(np.pi * distance))


def sand_waves(
    off: FloatArray, *, height_m: float, length_m: float, asymmetry: float
) -> FloatArray:
    """Return a train of waves of crest-to-trough `height_m`; `asymmetry` in [0, 1) leans them."""
    phase = 2 * np.pi * off / length_m
    # One step of Newton's iteration on Kepler's equation leans a sine without a corner.
    return 0.5 * height_m * np.cos(phase + asymmetry * np.sin(phase))


def boulder(distance: FloatArray) -> FloatArray:
    """Return a half-ellipsoid of unit height over a footprint of unit radius: steep sides."""
    return np.sqrt(np.clip(1.0 - distance**2, 0.0, None))


def mound(distance: FloatArray) -> FloatArray:
    """Return a smooth hill of unit height over a footprint of unit radius (raised cosine)."""
    return 0.5 * (1.0 + np.cos(np.pi * np.clip(distance, 0.0, 1.0)))


def bowl(distance: FloatArray) -> FloatArray:
    """Return a flat-floored pit of unit depth: floor to 0.45 of the radius, wall, rim at 1."""
    return -0.5 * (1.0 + np.cos(np.pi * np.clip((distance - 0.45) / 0.55, 0.0, 1.0)))
