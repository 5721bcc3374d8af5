"""The echo of one ping: facets of the floor, seen or hidden, summed into slant-range bins.

For each direction across the horizontal beam the floor is walked outward in short steps. Each step
is a facet; its echo goes to the slant ranges that it covers, in proportion, so a flat floor gives no
ripple whatever the step, and several facets at one range add up (layover). A facet is seen as far as
it rises above every ray grazed before it (shadow edges fall between steps). The directions follow the
beam's cone on the floor, which pitch bends away from a straight line near the nadir.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.records import FloatArray

# Columns of a pose: position of the sonar (elevation up), attitude, and their rates.
POSE = (
    "easting_m", "northing_m", "elevation_m", "heading_rad", "pitch_rad", "roll_rad",
    "heading_rate", "pitch_rate", "speed_forward", "speed_up",
)  # fmt: skip


@njit(cache=True, inline="always")
def _height_and_slope(heights, row, col, cell, sin_h, cos_h):  # type: ignore[no-untyped-def]
    """Bilinear height, and its slope along the heading; edges extend outward."""
    rows, cols = heights.shape
    row = min(max(row, 0.0), rows - 1.001)
    col = min(max(col, 0.0), cols - 1.001)
    i, j = int(row), int(col)
    fr, fc = row - i, col - j
    a, b = heights[i, j], heights[i, j + 1]
    c, d = heights[i + 1, j], heights[i + 1, j + 1]
    top, bottom = a + (b - a) * fc, c + (d - c) * fc
    east = ((b - a) * (1.0 - fr) + (d - c) * fr) / cell
    north = (top - bottom) / cell
    return top + (bottom - top) * fr, east * sin_h + north * cos_h


@njit(cache=True, inline="always")
def _deposit(power, near_m, far_m, sample_m, energy):  # type: ignore[no-untyped-def]
    """Spread energy evenly over the slant ranges from `near_m` to `far_m`."""
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
        lo, hi = max(near_m, k * sample_m), min(far_m, (k + 1) * sample_m)
        power[k] += density * (hi - lo)


@njit(cache=True)
def side_echo(
    heights, albedo, west_m, north_m, cell_m, pose, side, angles, weights, vertical,
    step_m, sample_m, exponent, lobe, lobe_tan2, turns, sound_speed, power,
):  # type: ignore[no-untyped-def] # fmt: skip
    """Add the echo power of one ping on one side to `power` (samples,), before spreading.

    Parameters
    ----------
    heights, albedo : (rows, cols) floor (elevation up) and scattering strength.
    pose : the ten numbers of `POSE`.
    side : +1 starboard, -1 port.
    angles, weights : nodes across the horizontal beam (rad) and the two-way pattern over each (rad).
    vertical : (361,) two-way vertical pattern at whole degrees of depression in the rolled frame.
    exponent, lobe, lobe_tan2 : Lambert's power; specular lobe (ratio, squared tangent of its width).
    turns : whether the beam turns while the echo is under way.
    """
    x, y, z, heading, pitch, roll = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]
    sin_h, cos_h = np.sin(heading), np.cos(heading)
    sin_p, cos_p = np.sin(pitch), np.cos(pitch)
    sin_r, cos_r = np.sin(roll), np.cos(roll)
    far_m = power.shape[0] * sample_m
    for k in range(angles.shape[0]):
        for outward in (1.0, -1.0):
            _walk(
                heights, albedo, west_m, north_m, cell_m, x, y, z,
                sin_h, cos_h, sin_p, cos_p, sin_r, cos_r, side, outward,
                angles[k], weights[k], angles, vertical, step_m, sample_m, far_m,
                exponent, lobe, lobe_tan2, turns, sound_speed, pose, power,
            )  # fmt: skip


@njit(cache=True)
def _walk(
    heights, albedo, west_m, north_m, cell_m, x, y, z,
    sin_h, cos_h, sin_p, cos_p, sin_r, cos_r, side, outward,
    angle, weight, angles, vertical, step_m, sample_m, far_m,
    exponent, lobe, lobe_tan2, turns, sound_speed, pose, power,
):  # type: ignore[no-untyped-def] # fmt: skip
    """Walk one direction of the beam from below the sonar, outward or inward past the nadir."""
    sin_a = np.sin(angle)
    row0, col0 = (north_m - y) / cell_m - 0.5, (x - west_m) / cell_m - 0.5
    height, slope_u = _height_and_slope(heights, row0, col0, cell_m, sin_h, cos_h)
    drop = max(z - height, 0.05)
    u = drop * sin_p / cos_p
    v, slant, horizon = 0.0, np.hypot(drop, u), -1e30
    # The far side of the nadir matters where roll lets the array see it: to 45 degrees past it.
    limit_v = far_m if outward > 0 else drop
    while v < limit_v:
        v_next = v + step_m
        # Where the cone of this direction meets the floor, with the drop of the last step: the
        # facet is placed there and its own height then decides its range.
        slant_guess = np.sqrt(u * u + v_next * v_next + drop * drop)
        u_next = (slant_guess * sin_a + drop * sin_p) / cos_p
        across = side * outward * v_next
        east, north = u_next * sin_h + across * cos_h, u_next * cos_h - across * sin_h
        row, col = row0 - north / cell_m, col0 + east / cell_m
        height_next, slope_u_next = _height_and_slope(heights, row, col, cell_m, sin_h, cos_h)
        drop_next = z - height_next
        slant_next = np.sqrt(u_next * u_next + v_next * v_next + drop_next * drop_next)
        if slant_next > far_m and slant > far_m and v > 0.0 and v_next * v_next > far_m * far_m:
            return
        rise = -drop_next / v_next
        rise_before = -drop / v if v > 0.0 else -1e30
        if rise > horizon:
            seen = 1.0
            if rise_before < horizon:
                seen = (rise - horizon) / (rise - rise_before)
            near = slant_next + (slant - slant_next) * seen
            slope_v = (height_next - height) / step_m
            slope_u = 0.5 * (slope_u + slope_u_next)
            mid_v, mid_u = 0.5 * (v + v_next), 0.5 * (u + u_next)
            mid_drop = 0.5 * (drop + drop_next)
            mid_slant = np.sqrt(mid_u * mid_u + mid_v * mid_v + mid_drop * mid_drop)
            normal = np.sqrt(1.0 + slope_u * slope_u + slope_v * slope_v)
            cosine = (mid_u * slope_u + mid_v * slope_v + mid_drop) / (mid_slant * normal)
            if cosine > 0.0:
                strength = cosine**exponent
                if lobe > 0.0:
                    tangent2 = 1.0 / (cosine * cosine) - 1.0
                    strength += lobe * np.exp(-0.5 * tangent2 / lobe_tan2)
                side_v = side * outward * mid_v
                down = mid_u * sin_p + mid_drop * cos_p
                across_body = side_v * cos_r + down * sin_r
                down_body = -side_v * sin_r + down * cos_r
                depression = np.arctan2(down_body, side * across_body) * 57.29577951308232 + 180.0
                index = min(int(depression), 359)
                part = depression - index
                pattern = vertical[index] * (1.0 - part) + vertical[index + 1] * part
                shift, received = 0.0, weight
                if turns:
                    delay = 2.0 * mid_slant / sound_speed
                    # The array has moved when the echo comes back: half the difference of the
                    # two ways, and the receive beam looks elsewhere.
                    closing = (mid_u * pose[8] - mid_drop * pose[9]) / mid_slant
                    shift = -0.5 * delay * closing
                    turned = (
                        pose[6] * delay * side_v / mid_slant
                        - pose[7] * delay * mid_drop / mid_slant
                    )
                    received = _received(angle, turned, weight, angles)
                row_mid, col_mid = int(row + 0.5), int(col + 0.5)
                row_mid = min(max(row_mid, 0), albedo.shape[0] - 1)
                col_mid = min(max(col_mid, 0), albedo.shape[1] - 1)
                # du = R d(angle) on the floor; the facet's own area is larger by its normal.
                area = mid_slant * step_m * seen * normal * received
                energy = area * strength * pattern * albedo[row_mid, col_mid]
                _deposit(power, near + shift, slant_next + shift, sample_m, energy)
            horizon = rise
        slope_u = slope_u_next
        v, u, drop, slant, height = v_next, u_next, drop_next, slant_next, height_next


@njit(cache=True, inline="always")
def _received(angle, turned, weight, angles):  # type: ignore[no-untyped-def]
    """Return the node's weight with the receive beam turned by `turned`, one way of two.

    The main lobe is close to a Gaussian of the nodes' span (1.05 widths each side): one-way power
    ``exp(-4 ln 2 (a / width)^2)``; the ratio of the turned to the unturned one corrects the weight.
    """
    width = -angles[0] * angles.shape[0] / max(angles.shape[0] - 1, 1) / 1.05
    if width <= 0.0:
        return weight
    before, after = angle / width, (angle - turned) / width
    return weight * np.exp(-2.772588722239781 * (after * after - before * before))


@njit(cache=True, nogil=True)
def ping_echoes(
    heights, albedo, west_m, north_m, cell_m, poses, angles, weights, vertical,
    step_m, sample_m, exponent, lobe, lobe_tan2, turns, sound_speed, power,
):  # type: ignore[no-untyped-def] # fmt: skip
    """Fill `power` (pings, 2, samples), port first, for poses (pings, 10)."""
    for i in range(poses.shape[0]):
        for s in range(2):
            side_echo(
                heights, albedo, west_m, north_m, cell_m, poses[i], 2.0 * s - 1.0, angles, weights,
                vertical, step_m, sample_m, exponent, lobe, lobe_tan2, turns, sound_speed,
                power[i, s],
            )  # fmt: skip


def floor_power(
    slant_range_m: FloatArray,
    *,
    altitude_m: float,
    sample_m: float,
    beam_rad: float,
    vertical: FloatArray,
    exponent: float,
    lobe: float,
    lobe_tan2: float,
) -> FloatArray:
    """Return what a flat floor sends back to one side, before spreading: the analytic level.

    ``P = beam R cos^n(incidence) B(depression) dv``, with ``dv = R dR / v`` the ground that a bin of
    slant range covers. Zero in the water column; exact at bin edges, so the first bin is finite.
    """
    near = np.sqrt(np.clip((slant_range_m - 0.5 * sample_m) ** 2 - altitude_m**2, 0.0, None))
    far = np.sqrt(np.clip((slant_range_m + 0.5 * sample_m) ** 2 - altitude_m**2, 0.0, None))
    slant = np.hypot(0.5 * (near + far), altitude_m)
    cosine = altitude_m / slant
    depression = np.rad2deg(np.arcsin(np.clip(cosine, 0.0, 1.0)))
    pattern = np.interp(depression, np.arange(-180, 181), vertical)
    strength = cosine**exponent
    if lobe > 0:
        strength = strength + lobe * np.exp(-0.5 * (1.0 / cosine**2 - 1.0) / lobe_tan2)
    return beam_rad * slant * strength * pattern * (far - near)
