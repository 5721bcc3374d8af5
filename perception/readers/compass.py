"""Headings that disagree with the track: told apart from crabbing in a current by the legs' directions.

A cross current turns the bow to one side on one leg and to the other on the way back; a magnetic or turned
compass errs by the same angle on every leg.
"""

from __future__ import annotations

import numpy as np

from perception.readers.repair import course_over_ground
from perception.records import FloatArray, IntArray

# What a survey in a fair current crabs on one leg, and what remains of it over several, in radians.
_ONE_WAY, _CONSTANT = np.radians(10.0), np.radians(6.0)
# Differences that swing about more than this are noise or turning, not an angle.
_STEADY = 0.95
# Legs whose courses are this much alike are one direction.
_ALIKE = 0.9


def heading_offsets(
    time_s: FloatArray,
    easting_m: FloatArray,
    northing_m: FloatArray,
    heading_rad: FloatArray,
    pass_index: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Return each pass's mean course and mean of heading less course, radians; unsteady passes left out."""
    course, offset = [], []
    for index in range(int(pass_index.max(initial=-1)) + 1):
        rows = np.flatnonzero(pass_index == index)
        if len(rows) < 10:
            continue
        along = course_over_ground(time_s[rows], easting_m[rows], northing_m[rows])
        apart = np.exp(1j * (heading_rad[rows] - along))[np.isfinite(along)]
        steady = np.abs(apart.mean()) > _STEADY if len(apart) else False
        way = np.exp(1j * along[np.isfinite(along)])
        if steady and abs(way.mean()) > _ALIKE:
            course.append(float(np.angle(way.mean())))
            offset.append(float(np.angle(apart.mean())))
    return np.array(course), np.array(offset)


def compass_warning(course_rad: FloatArray, offset_rad: FloatArray) -> str | None:
    """Return what is to be told of headings that disagree with the track, or None.

    Over several directions ``offset = c + a sin(course) + b cos(course)``: a and b are a current's, c is the
    compass's. Opposite legs suffice for c; in one direction the two cannot be told apart.
    """
    if not len(offset_rad):
        return None
    if abs(np.exp(1j * course_rad).mean()) > _ALIKE:
        mean = float(np.mean(offset_rad))
        if abs(mean) < _ONE_WAY:
            return None
        return (
            f"headings lie {np.degrees(mean):.0f} deg off the track in the one direction sailed: a "
            "magnetic or turned compass, or a cross current; if the compass, give declination_deg = "
            f"{-np.degrees(mean):.0f} under [compass] in install.toml"
        )
    design = np.stack([np.ones(len(course_rad)), np.sin(course_rad), np.cos(course_rad)], axis=1)
    constant = float(np.linalg.lstsq(design, offset_rad, rcond=1e-3)[0][0])
    if abs(constant) < _CONSTANT:
        return None
    return (
        f"headings lie {np.degrees(constant):.0f} deg off the track on legs of every direction: a "
        f"magnetic or turned compass; give declination_deg = {-np.degrees(constant):.0f} under [compass] "
        "in install.toml"
    )
