"""The echo of one ping: facets of the floor, seen or hidden, summed into slant-range bins.

For each direction across the horizontal beam the floor is walked outward in short steps. Each step
is a facet; its echo goes to the slant ranges that it covers, in proportion, so a flat floor gives no
ripple whatever the step, and several facets at one range add up (layover). A facet is seen as far as
it rises above every ray grazed before it (shadow edges fall between steps). The directions follow the
beam's cone on the floor, which pitch bends away from a straight line near the nadir.

Inside a walk, u is forward, v across (outward positive) and drop down from the sonar, all level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from perception.records import FloatArray

# Columns of a pose: position of the sonar (elevation up), attitude, and their rates.
POSE = (
    "easting_m", "northing_m", "elevation_m", "heading_rad", "pitch_rad", "roll_rad",
    "heading_rate", "pitch_rate", "speed_forward", "speed_up",
)  # fmt: skip

_DEGREES = 180.0 / np.pi
_FOUR_LN_2 = 2.772588722239781


class Floor(NamedTuple):
    """The true floor as plain arrays: heights and scattering strength (rows, cols), outer edges."""

    heights: FloatArray
    albedo: FloatArray
    west_m: float
    north_m: float
    cell_m: float


class Beam(NamedTuple):
    """The sonar's constants.

    `angles`, `weights` are nodes across the horizontal beam (rad) and the two-way pattern's integral
    over each (rad), `width` the one-way -3 dB width; `vertical` (361,) is the two-way vertical
    pattern at whole degrees of depression from -180 in the rolled frame; `exponent` Lambert's power,
    `lobe` and `lobe_tan2` the specular lobe's ratio and squared tangent of its width; `turns` tells
    whether the beam moves while the echo is under way.
    """

    angles: FloatArray
    weights: FloatArray
    width: float
    vertical: FloatArray
    exponent: float
    lobe: float
    lobe_tan2: float
    turns: bool
    sound_speed: float
    sample_m: float
    step_m: float


class _Attitude(NamedTuple):
    sin_h: float
    cos_h: float
    sin_p: float
    cos_p: float
    sin_r: float
    cos_r: float


@njit(cache=True, nogil=True)
def ping_echoes(floor: Floor, beam: Beam, poses: FloatArray, power: FloatArray) -> None:
    """Add each ping's echo power before spreading to `power` (pings, 2, samples), port first.

    `poses` (pings, 10) has the columns of `POSE`.
    """
    for i in range(poses.shape[0]):
        for s in range(2):
            side_echo(floor, beam, poses[i], 2.0 * s - 1.0, power[i, s])


@njit(cache=True, nogil=True)
def side_echo(floor: Floor, beam: Beam, pose: FloatArray, side: float, power: FloatArray) -> None:
    """Add the echo of one ping on one side (+1 starboard, -1 port) to `power` (samples,)."""
    attitude = _Attitude(
        np.sin(pose[3]), np.cos(pose[3]), np.sin(pose[4]), np.cos(pose[4]),
        np.sin(pose[5]), np.cos(pose[5]),
    )  # fmt: skip
    for k in range(beam.angles.shape[0]):
        _walk(floor, beam, pose, attitude, side, 1.0, k, power)
        # The far side of the nadir matters where roll lets the array see it.
        _walk(floor, beam, pose, attitude, side, -1.0, k, power)


@njit(cache=True, nogil=True)
def _walk(
    floor: Floor,
    beam: Beam,
    pose: FloatArray,
    attitude: _Attitude,
    side: float,
    outward: float,
    k: int,
    power: FloatArray,
) -> None:
    """Walk direction `k` of the beam from below the sonar, outward or inward past the nadir."""
    step, sin_a = beam.step_m, np.sin(beam.angles[k])
    row0 = (floor.north_m - pose[1]) / floor.cell_m - 0.5
    col0 = (pose[0] - floor.west_m) / floor.cell_m - 0.5
    height, slope_u = _height_and_slope(floor, row0, col0, attitude)
    u = (pose[2] - height) * attitude.sin_p / attitude.cos_p
    row, col = row0 - u * attitude.cos_h / floor.cell_m, col0 + u * attitude.sin_h / floor.cell_m
    height, slope_u = _height_and_slope(floor, row, col, attitude)
    drop = max(pose[2] - height, 0.05)
    v, slant, horizon = 0.0, np.hypot(drop, u), -1e30
    # Inward it is walked to 45 degrees past the nadir, outward until no slant range can be shorter.
    limit = power.shape[0] * beam.sample_m if outward > 0 else drop
    while v < limit:
        v_next = v + step
        # Where this direction's cone meets the floor, with the drop of the last step: the facet is
        # placed there and its own height then decides its range.
        slant_guess = np.sqrt(u * u + v_next * v_next + drop * drop)
        u_next = (slant_guess * sin_a + drop * attitude.sin_p) / attitude.cos_p
        across = side * outward * v_next
        row = row0 - (u_next * attitude.cos_h - across * attitude.sin_h) / floor.cell_m
        col = col0 + (u_next * attitude.sin_h + across * attitude.cos_h) / floor.cell_m
        height_next, slope_next = _height_and_slope(floor, row, col, attitude)
        drop_next = pose[2] - height_next
        slant_next = np.sqrt(u_next * u_next + v_next * v_next + drop_next * drop_next)
        rise = -drop_next / v_next
        if rise > horizon:
            rise_before = -drop / v if v > 0.0 else horizon
            seen = 1.0
            if rise_before < horizon:
                seen = (rise - horizon) / (rise - rise_before)
            energy, shift = _facet(
                beam, pose, attitude, side, side * outward, k,
                0.5 * (u + u_next), 0.5 * (v + v_next), 0.5 * (drop + drop_next),
                0.5 * (slope_u + slope_next), (height_next - height) / step,
            )  # fmt: skip
            if energy > 0.0:
                near = slant_next + (slant - slant_next) * seen
                energy *= seen * _nearest(floor.albedo, row, col)
                _deposit(power, near + shift, slant_next + shift, beam.sample_m, energy)
            horizon = rise
        v, u, drop, slant = v_next, u_next, drop_next, slant_next
        height, slope_u = height_next, slope_next


@njit(cache=True, nogil=True)
def _facet(
    beam: Beam,
    pose: FloatArray,
    attitude: _Attitude,
    side: float,
    direction: float,
    k: int,
    u: float,
    v: float,
    drop: float,
    slope_u: float,
    slope_v: float,
) -> tuple[float, float]:
    """Return a facet's echo before spreading, and how much nearer motion makes it appear (m).

    Its area on the map is ``slant d(angle) dv``: on a level plane the cone's lines lie
    ``du = slant d(angle)`` apart whatever the range, which holds at the nadir too.
    """
    slant = np.sqrt(u * u + v * v + drop * drop)
    normal = np.sqrt(1.0 + slope_u * slope_u + slope_v * slope_v)
    cosine = (u * slope_u + v * slope_v + drop) / (slant * normal)
    if cosine <= 0.0:
        return 0.0, 0.0
    # Squaring is many times faster than a power, and two is Lambert's law.
    strength = cosine * cosine if beam.exponent == 2.0 else cosine**beam.exponent
    steepness = 0.5 * (1.0 / (cosine * cosine) - 1.0) / beam.lobe_tan2
    if beam.lobe > 0.0 and steepness < 20.0:
        strength += beam.lobe * np.exp(-steepness)
    across = direction * v
    down = u * attitude.sin_p + drop * attitude.cos_p
    across_body = across * attitude.cos_r + down * attitude.sin_r
    down_body = -across * attitude.sin_r + down * attitude.cos_r
    depression = np.arctan2(down_body, side * across_body) * _DEGREES + 180.0
    index = min(int(depression), 359)
    part = depression - index
    pattern = beam.vertical[index] * (1.0 - part) + beam.vertical[index + 1] * part
    weight, shift = beam.weights[k], 0.0
    if beam.turns:
        # The receive beam looks from where the array has come to when the echo is back: a turn to
        # starboard brings forward what lies to starboard, way leaves everything behind.
        delay = 2.0 * slant / beam.sound_speed
        angle = beam.angles[k]
        received = angle + delay * (
            pose[6] * across / slant - pose[7] * drop / slant - pose[8] / slant
        )
        # One way of two: the main lobe is close to a Gaussian, exp(-4 ln 2 (a / width)^2).
        weight *= np.exp(-_FOUR_LN_2 * (received * received - angle * angle) / beam.width**2)
        shift = -0.5 * delay * (u * pose[8] - drop * pose[9]) / slant
    return slant * beam.step_m * normal * weight * strength * pattern, shift


@njit(cache=True, inline="always")
def _height_and_slope(
    floor: Floor, row: float, col: float, attitude: _Attitude
) -> tuple[float, float]:
    """Return the bilinear height, and its slope along the heading; edges extend outward."""
    heights = floor.heights
    row = min(max(row, 0.0), heights.shape[0] - 1.001)
    col = min(max(col, 0.0), heights.shape[1] - 1.001)
    i, j = int(row), int(col)
    fr, fc = row - i, col - j
    a, b = heights[i, j], heights[i, j + 1]
    c, d = heights[i + 1, j], heights[i + 1, j + 1]
    top, bottom = a + (b - a) * fc, c + (d - c) * fc
    east = ((b - a) * (1.0 - fr) + (d - c) * fr) / floor.cell_m
    north = (top - bottom) / floor.cell_m
    return top + (bottom - top) * fr, east * attitude.sin_h + north * attitude.cos_h


@njit(cache=True, inline="always")
def _nearest(values: FloatArray, row: float, col: float) -> float:
    i = min(max(int(row + 0.5), 0), values.shape[0] - 1)
    j = min(max(int(col + 0.5), 0), values.shape[1] - 1)
    return values[i, j]


@njit(cache=True, inline="always")
def _deposit(
    power: FloatArray, near_m: float, far_m: float, sample_m: float, energy: float
) -> None:
    """Spread energy evenly over the slant ranges from one to the other."""
    if near_m > far_m:
        near_m, far_m = far_m, near_m
    first, last = int(near_m / sample_m), int(far_m / sample_m)
    count = power.shape[0]
    if first >= count:
        return
    if last == first:
        power[first] += energy
        return
    density = energy / (far_m - near_m)
    for k in range(first, min(last, count - 1) + 1):
        inside = min(far_m, (k + 1) * sample_m) - max(near_m, k * sample_m)
        power[k] += density * inside


def floor_power(slant_range_m: FloatArray, altitude_m: float, beam: Beam) -> FloatArray:
    """Return what a flat floor sends back to one side, before spreading: the analytic level.

    ``P = beam R cos^n(incidence) B(depression) dv``, with dv the ground that a bin of slant range
    covers, from its edges: finite in the bin of the first return. Zero in the water column.
    """
    half = 0.5 * beam.sample_m
    near = np.sqrt(np.clip((slant_range_m - half) ** 2 - altitude_m**2, 0.0, None))
    far = np.sqrt(np.clip((slant_range_m + half) ** 2 - altitude_m**2, 0.0, None))
    slant = np.hypot(0.5 * (near + far), altitude_m)
    cosine = altitude_m / slant
    depression = np.rad2deg(np.arcsin(np.clip(cosine, 0.0, 1.0)))
    pattern = np.interp(depression, np.arange(-180, 181), beam.vertical)
    strength = cosine**beam.exponent
    if beam.lobe > 0:
        strength = strength + beam.lobe * np.exp(-0.5 * (1.0 / cosine**2 - 1.0) / beam.lobe_tan2)
    level: FloatArray = beam.weights.sum() * slant * strength * pattern * (far - near)
    return level
