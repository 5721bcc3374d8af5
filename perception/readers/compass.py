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


def compass_warning(
    course_rad: FloatArray, offset_rad: FloatArray, declination_deg: float = 0.0
) -> str | None:
    """Return what is to be told of headings that disagree with the track, or None.

    Over several directions ``offset = c + a sin(course) + b cos(course)``: a and b are a current's, c is the
    compass's. Opposite legs suffice for c; in one direction the two cannot be told apart.

    Parameters
    ----------
    declination_deg : what install.toml adds to the headings already; the suggested value takes its place.
    """
    if not len(offset_rad):
        return None
    # About their circular mean offsets do not jump: a compass mounted backwards gives 179 and -179 degrees.
    mean = float(np.angle(np.exp(1j * offset_rad).mean()))
    about_mean = np.angle(np.exp(1j * (offset_rad - mean)))
    if abs(np.exp(1j * course_rad).mean()) > _ALIKE:
        if abs(mean) < _ONE_WAY:
            return None
        return (
            f"headings lie {np.degrees(mean):.0f} deg off the track in the one direction sailed: a "
            "magnetic or turned compass, or a cross current; if the compass, give declination_deg = "
            f"{_declination(declination_deg, mean):.0f} under [compass] in install.toml"
        )
    design = np.stack([np.ones(len(course_rad)), np.sin(course_rad), np.cos(course_rad)], axis=1)
    beside_mean = float(np.linalg.lstsq(design, about_mean, rcond=1e-3)[0][0])
    constant = float(np.angle(np.exp(1j * (mean + beside_mean))))
    if abs(constant) < _CONSTANT:
        return None
    return (
        f"headings lie {np.degrees(constant):.0f} deg off the track on legs of every direction: a "
        f"magnetic or turned compass; give declination_deg = "
        f"{_declination(declination_deg, constant):.0f} under [compass] in install.toml"
    )


def _declination(given_deg: float, error_rad: float) -> float:
    """Return the declination, in (-180, 180], that takes an error away which was left by the one given."""
    return 180.0 - (180.0 - given_deg + np.degrees(error_rad)) % 360.0
