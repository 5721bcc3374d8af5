"""Corrections of keyframes carried to every line of the strips, with what the way between leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapping.keyframes import Keyframes
from mapping.pose_graph import Solution
from perception.records import ElevationStrip, FloatArray


def on_track(
    strips: Sequence[ElevationStrip], keyframes: Keyframes, solution: Solution
) -> list[ElevationStrip]:
    """Return the strips on the corrected track."""
    moved = []
    for index, strip in enumerate(strips):
        correction = at_lines(strip, index, keyframes, solution.correction_m)
        moved.append(
            replace(
                strip,
                easting_m=strip.easting_m + correction[:, 0],
                northing_m=strip.northing_m + correction[:, 1],
                heading_rad=(strip.heading_rad + solution.pass_errors[index, 2]) % (2 * np.pi),
                elevation_m=strip.elevation_m + solution.height_m[index],
            )
        )
    return moved


def at_lines(
    strip: ElevationStrip, index: int, keyframes: Keyframes, values: FloatArray
) -> FloatArray:
    """Interpolate per-keyframe values (k, ...) to the lines of one strip (n, ...)."""
    part = slice(int(keyframes.starts[index]), int(keyframes.starts[index + 1]))
    lines = np.arange(len(strip.time_s))
    flat = values[part].reshape(part.stop - part.start, -1)
    columns = [np.interp(lines, keyframes.line[part], column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(len(lines), *values.shape[1:])


def bridge(strip: ElevationStrip, index: int, keyframes: Keyframes) -> FloatArray:
    """Return (n,) the variance per (m of way x q^2) that a walk has between two known ends."""
    part = slice(int(keyframes.starts[index]), int(keyframes.starts[index + 1]))
    marks = keyframes.line[part]
    lines = np.arange(len(strip.time_s))
    after = np.clip(np.searchsorted(marks, lines, side="right"), 1, max(len(marks) - 1, 1))
    if len(marks) < 2:
        return np.zeros(len(lines))
    span = marks[after] - marks[after - 1]
    f = (lines - marks[after - 1]) / np.maximum(span, 1)
    return f * (1 - f) * keyframes.way_m[part][after]
