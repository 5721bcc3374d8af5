"""Where a pitched sonar looks: its fan leaves the plumb line, and the ground it hears lies ahead or astern.

A side-scan array hears the plane square to itself. Pitched by p it hears ground ``a tan p`` ahead, port and
starboard alike, with a the height above the floor: at 15 m and 4 degrees a whole metre, more than
any registration leaves. In that plane all goes on as if a level sonar hung at the slant distance ``r``
of the first return straight above the place where the plane meets the floor.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perception.records import FloatArray, Swath

# No survey is run at this pitch for long: such a column holds something else than pitch.
_STEEPEST_RAD = np.radians(30.0)


def usable_pitch(pitch_rad: FloatArray) -> FloatArray:
    """Return pitch (n,) with zero where it is not known; all zero where the column cannot be pitch."""
    pitch = np.nan_to_num(np.asarray(pitch_rad, float), nan=0.0, posinf=0.0, neginf=0.0)
    steep = np.abs(pitch) > _STEEPEST_RAD
    return np.zeros_like(pitch) if steep.mean() > 0.05 else np.where(steep, 0.0, pitch)


def levelled(swath: Swath, first_return_m: FloatArray) -> tuple[Swath, FloatArray]:
    """Return the swath of the level sonar that would have heard the same, and its lead (n,) in metres.

    With pitch p (bow up) and first return r the sonar moves forward by ``r sin p``, the lead, and up by
    ``r (1 - cos p)``. Exact on a level floor; ground h above it is off by ``h tan p`` along the
    track. The result's pitch is zero, so that nothing is applied twice.
    """
    pitch = usable_pitch(swath.pitch_rad)
    known = np.isfinite(first_return_m)
    if not known.any() or not pitch.any():
        return replace(swath, pitch_rad=np.zeros_like(pitch)), np.zeros(len(pitch))
    index = np.arange(len(pitch))
    slant = np.interp(index, index[known], np.asarray(first_return_m, float)[known])
    lead = slant * np.sin(pitch)
    return (
        replace(
            swath,
            easting_m=swath.easting_m + lead * np.sin(swath.heading_rad),
            northing_m=swath.northing_m + lead * np.cos(swath.heading_rad),
            depth_m=swath.depth_m - slant * (1.0 - np.cos(pitch)),
            pitch_rad=np.zeros_like(pitch),
        ),
        lead,
    )
