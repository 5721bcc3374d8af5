"""What an installation and the water do to the poses of pings; each effect by itself.

Every function takes a record of poses (a `Swath` or a survey's `PingTable`) and returns a new one. Body
axes are forward, starboard, down; grid axes north, east, down; `R = Rz(heading) Ry(pitch) Rx(roll)`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from perception.readers.raw import PingFlag
from perception.readers.survey import PingTable
from perception.records import FloatArray, InputError, IntArray, Swath

Poses = TypeVar("Poses", Swath, PingTable)
Arm = tuple[float, float, float]

_TRACK_SMOOTHING_S = 10.0


@dataclass(frozen=True, slots=True)
class Table:
    """A function of time or depth, by its corners (n,)."""

    at: FloatArray
    value: FloatArray
    source: str = ""


def without_latency(
    poses: Poses,
    navigation_s: float = 0.0,
    depth_s: float = 0.0,
    attitude_s: float = 0.0,
    compass_s: float = 0.0,
) -> Poses:
    """Move positions, depths and angles to the pings' times.

    A value that a sensor gives `latency_s` late is stored with a ping that is so much younger than it:
    value(t) = stored(t + latency).
    """
    lag_s = {
        "easting_m": navigation_s,
        "northing_m": navigation_s,
        "depth_m": depth_s,
        "pitch_rad": attitude_s,
        "roll_rad": attitude_s,
        "heading_rad": compass_s,
    }
    moved: dict[str, Any] = {}
    for name, lag in lag_s.items():
        if lag != 0.0:
            values = getattr(poses, name)
            if name == "heading_rad":
                values = np.unwrap(values)
            moved[name] = _shifted(poses.time_s, values, lag)
    if "heading_rad" in moved:
        moved["heading_rad"] = moved["heading_rad"] % (2 * np.pi)
    return replace(poses, **moved)


def _shifted(time_s: FloatArray, values: FloatArray, lag_s: float) -> FloatArray:
    """Return values(t + lag) by linear interpolation, extended at the ends by the ends' own slope."""
    out = np.array(values, float)
    breaks = np.flatnonzero((np.diff(time_s) < 0) | (np.diff(time_s) > 60.0)) + 1
    for a, b in pairwise([0, *breaks.tolist(), len(time_s)]):
        t, v = time_s[a:b] + 1e-9 * np.arange(b - a), values[a:b]
        if b - a < 2:
            continue
        wanted = t + lag_s
        shifted = np.interp(wanted, t, v)
        few = slice(max(b - a - 10, 0), b - a) if lag_s > 0 else slice(0, 10)
        span = t[few][-1] - t[few][0]
        if span > 0:
            slope = (v[few][-1] - v[few][0]) / span
            beyond = np.where(wanted > t[-1], wanted - t[-1], np.minimum(wanted - t[0], 0.0))
            shifted = shifted + slope * beyond
        out[a:b] = shifted
    return out


def with_declination(poses: Poses, declination_deg: float) -> Poses:
    """Turn magnetic headings to true ones; headings taken from the track are true already."""
    if declination_deg == 0.0:
        return poses
    flags = poses.flags if poses.flags is not None else np.zeros(len(poses.time_s), np.int64)
    from_track = (flags & int(PingFlag.HEADING_FILLED)) != 0
    # A few filled headings are interpolated between magnetic ones; all filled means the track.
    turn = 0.0 if from_track.all() else np.radians(declination_deg)
    return replace(poses, heading_rad=(poses.heading_rad + turn) % (2 * np.pi))


def _body_axes(poses: Swath | PingTable) -> Rotation:
    """Return rotations from body (forward, starboard, down) to (north, east, down) axes."""
    angles = np.stack([poses.heading_rad, poses.pitch_rad, poses.roll_rad], axis=1)
    return Rotation.from_euler("ZYX", np.nan_to_num(angles))


def with_lever_arm(poses: Poses, navigation_m: Arm, sonar_m: Arm) -> Poses:
    """Carry positions and depth from the navigation's point to the sonar.

    `p_sonar = p_nav + R(heading, pitch, roll) (arm_sonar - arm_nav)`, arms from the vehicle's reference.
    """
    arm = np.subtract(sonar_m, navigation_m)
    if not arm.any():
        return poses
    north, east, down = _body_axes(poses).apply(arm).T
    return replace(
        poses,
        easting_m=poses.easting_m + east,
        northing_m=poses.northing_m + north,
        depth_m=poses.depth_m + down,
    )


def with_mounting(
    poses: Poses, heading_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0
) -> Poses:
    """Turn the vehicle's attitude into the sonar's: R_sonar = R_vehicle R_mount."""
    turn_deg = (heading_deg, pitch_deg, roll_deg)
    if not any(turn_deg):
        return poses
    turned = _body_axes(poses) * Rotation.from_euler("ZYX", turn_deg, degrees=True)
    heading, pitch, roll = turned.as_euler("ZYX").T
    return replace(poses, heading_rad=heading % (2 * np.pi), pitch_rad=pitch, roll_rad=roll)


def with_tow(
    poses: Poses, layback_m: FloatArray, point_m: Arm, navigation_m: Arm, follow_track: bool = False
) -> Poses:
    """Put a towed sonar on the ship's track, one layback (n,) behind the tow point.

    A fish follows the ship's track rather than cutting its corners: right for a long cable and gentle
    turns, which are the ones that stay in a pass. Before the first position the track is
    prolonged straight back. `follow_track` gives the fish the track's course as heading, for one
    without a compass; its depth stays as recorded.
    """
    point = with_lever_arm(poses, navigation_m, point_m)
    ends: IntArray = (
        np.flatnonzero((np.diff(poses.time_s) < 0) | (np.diff(poses.time_s) > 600.0)) + 1
    )
    east, north = poses.easting_m.copy(), poses.northing_m.copy()
    heading = poses.heading_rad.copy()
    for a, b in pairwise([0, *ends.tolist(), len(poses.time_s)]):
        east[a:b], north[a:b], course = _behind(
            poses.time_s[a:b], point.easting_m[a:b], point.northing_m[a:b], layback_m[a:b]
        )
        if follow_track:
            heading[a:b] = course
    return replace(poses, easting_m=east, northing_m=north, heading_rad=heading % (2 * np.pi))


def straight_layback(cable_out_m: float, depth_m: FloatArray, point_depth_m: float) -> FloatArray:
    """Return the horizontal layback (n,) of a straight cable: sqrt(cable^2 - depth^2)."""
    below_m = np.nan_to_num(depth_m) - point_depth_m
    return np.asarray(np.sqrt(np.maximum(cable_out_m**2 - below_m**2, 0.0)))


def _behind(
    time_s: FloatArray, easting_m: FloatArray, northing_m: FloatArray, layback_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return easting, northing and course (n,) of a track `layback_m` behind each of its points.

    Lengths are run along the track smoothed by straight lines over ten seconds: noise of a metre a
    ping would make the run several times too long.
    """
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    width = round(_TRACK_SMOOTHING_S / step_s) if step_s > 0 else 3
    width = min(width, len(time_s) // 4) // 2 * 2 + 1
    if width >= 3:
        easting_m = savgol_filter(easting_m, width, 1)
        northing_m = savgol_filter(northing_m, width, 1)
    run = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(easting_m), np.diff(northing_m)))])
    back_m = max(float(layback_m.max(initial=0.0)), 1.0)
    first = int(np.searchsorted(run, 0.1 * run[-1], side="right"))
    lead = np.array([axis[min(first, len(axis) - 1)] - axis[0] for axis in (easting_m, northing_m)])
    lead = lead / (float(np.hypot(*lead)) or 1.0)
    # A nanometre a knot keeps the run rising where the ship stands.
    knots = np.concatenate([[-back_m - 2.0], run]) + 1e-9 * np.arange(len(run) + 1)
    east = np.concatenate([[easting_m[0] - (back_m + 2.0) * lead[0]], easting_m])
    north = np.concatenate([[northing_m[0] - (back_m + 2.0) * lead[1]], northing_m])
    wanted = run - layback_m
    ahead = [
        np.interp(wanted + 1.0, knots, axis) - np.interp(wanted - 1.0, knots, axis)
        for axis in (east, north)
    ]
    return np.interp(wanted, knots, east), np.interp(wanted, knots, north), np.arctan2(*ahead)


def with_tide(poses: Poses, tide: Table) -> Poses:
    """Refer depths to the vertical datum: depth below datum = depth below surface - tide height.

    Raises
    ------
    InputError
        The tide table does not cover the survey.
    """
    begin, end = float(np.min(poses.time_s)), float(np.max(poses.time_s))
    if begin < tide.at[0] or end > tide.at[-1]:
        raise InputError(
            f"{tide.source}: covers {_iso(tide.at[0])} to {_iso(tide.at[-1])}, the survey runs from "
            f"{_iso(begin)} to {_iso(end)}; give a tide file that covers it"
        )
    height_m = np.interp(poses.time_s, tide.at, tide.value)
    return replace(poses, depth_m=poses.depth_m - height_m)


def with_sound_speed(poses: Poses, true_m_s: FloatArray) -> Poses:
    """Rescale ranges made with the recorder's sound speed: range_true = range c_true / c_recorder."""
    assumed = np.where(poses.sound_speed_m_s > 0, poses.sound_speed_m_s, 1500.0)
    ratio = true_m_s / assumed
    changed: dict[str, Any] = {"sample_m": poses.sample_m * ratio, "sound_speed_m_s": true_m_s}
    if isinstance(poses, PingTable):
        changed["start_m"] = poses.start_m * ratio
    return replace(poses, **changed)


def column_speed(poses: Swath | PingTable, profile: Table) -> FloatArray:
    """Return the harmonic mean sound speed (n,) of the water between each ping and the bottom.

    ``c = (z2 - z1) / integral dz / c(z)`` from the sonar's depth to depth + altitude hint, to the
    profile's end where no altitude is known. Rays are taken straight: at side-scan ranges the
    bending moves a return by far less than the mean speed does.
    """
    top = np.nan_to_num(np.maximum(poses.depth_m, 0.0))
    # At least a metre of water, or the mean of nothing would be asked for.
    bottom = np.maximum(top + np.nan_to_num(poses.altitude_hint_m, nan=np.inf), top + 1.0)
    bottom = np.minimum(bottom, np.maximum(profile.at[-1], top + 1.0))
    deepest = max(float(bottom.max()), float(profile.at[-1])) + 1.0
    depth = np.unique(np.concatenate([np.linspace(0.0, deepest, 2001), profile.at]))
    slowness = 1.0 / np.interp(depth, profile.at, profile.value)
    steps = np.diff(depth) * (slowness[1:] + slowness[:-1]) / 2
    travel = np.concatenate([[0.0], np.cumsum(steps)])
    taken = np.interp(bottom, depth, travel) - np.interp(top, depth, travel)
    return np.asarray((bottom - top) / taken)


def _iso(time_s: float) -> str:
    return datetime.fromtimestamp(float(time_s), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
