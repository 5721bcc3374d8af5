"""The lines of a mission: blocks of parallel passes, single lines, the legs of a return."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from perception.records import FloatArray, InputError
from scenarios.sections import Block, MissionSection, WorldSection

Line = tuple[float, float, float, float]


def survey_lines(config: MissionSection) -> list[Line]:
    """Return the survey's lines in flying order, each (east, north, east, north) in metres."""
    lines: list[Line] = []
    for block in config.block:
        lines.extend(_block_lines(block))
    lines.extend(config.lines)
    return lines


def _block_lines(block: Block) -> list[Line]:
    azimuth = np.deg2rad(block.heading_deg)
    along = np.array([np.sin(azimuth), np.cos(azimuth)]) * 0.5 * block.length_m
    across = np.array([np.cos(azimuth), -np.sin(azimuth)]) * block.spacing_m
    centre = np.array([block.east_m, block.north_m])
    lines: list[Line] = []
    for index in range(block.count):
        middle = centre + (index - 0.5 * (block.count - 1)) * across
        ends = (middle - along, middle + along)
        if index % 2:
            ends = (ends[1], ends[0])
        lines.append((*map(float, ends[0]), *map(float, ends[1])))  # type: ignore[arg-type]
    return lines


def refuse_outside(lines: Sequence[Line], world: WorldSection) -> None:
    """Refuse lines that leave the world, before it is built.

    Raises
    ------
    InputError
        Names the size that the lines need.
    """
    ends = np.abs(np.reshape(lines, (-1, 2))).max(axis=0, initial=0.0)
    for axis, reach, size in zip(
        ("east", "north"), ends, (world.size_east_m, world.size_north_m), strict=True
    ):
        if reach > 0.5 * size:
            raise InputError(
                f"world.size_{axis}_m = {size:g}: a line ends {reach:.0f} m {axis} of the world's "
                f"middle; give at least {2 * reach:.0f}, and room for the turns"
            )


@dataclass(frozen=True, slots=True)
class Path:
    """A path over ground at even steps: places (n,) in metres, and the line of each, -1 in turns."""

    east_m: FloatArray
    north_m: FloatArray
    line: FloatArray


def path_along(lines: Sequence[Line], step_m: float) -> Path:
    """Join lines by smooth turns and sample the whole at steps of `step_m`."""
    pieces: list[tuple[FloatArray, int]] = []
    for index, line in enumerate(lines):
        if index:
            pieces.append((_turn(lines[index - 1], line), -1))
        pieces.append((np.array(line, float).reshape(2, 2), index))
    points, marks, left = [], [], 0.0
    for corners, mark in pieces:
        lengths = np.hypot(*np.diff(corners, axis=0).T)
        along = np.concatenate(([0.0], np.cumsum(lengths)))
        at = np.arange(left, along[-1], step_m)
        points.append(np.column_stack([np.interp(at, along, c) for c in corners.T]))
        marks.append(np.full(len(at), mark))
        left = (at[-1] if len(at) else left - step_m) + step_m - along[-1]
    place = np.concatenate(points)
    return Path(place[:, 0], place[:, 1], np.concatenate(marks))


def _turn(before: Line, after: Line) -> FloatArray:
    """Return a curve (n, 2) from the end of one line to the start of the next, tangent to both."""
    start, goal = np.array(before[2:]), np.array(after[:2])
    out, into = _direction(before), _direction(after)
    # A cubic with tangents of twice the gap bulges like a vehicle's turn; at least 20 m of it, or
    # lines that meet end to start would ask for a turn on the spot.
    reach = max(2.0 * float(np.hypot(*(goal - start))), 20.0)
    t = np.linspace(0.0, 1.0, 200)[:, None]
    return (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * out * reach
        + (-2 * t**3 + 3 * t**2) * goal
        + (t**3 - t**2) * into * reach
    )


def _direction(line: Line) -> FloatArray:
    vector = np.array(line[2:]) - np.array(line[:2])
    return vector / max(float(np.hypot(*vector)), 1e-9)


def legs_to_lines(legs: Sequence[tuple[float, float]]) -> list[Line]:
    """Return the legs between waypoints as lines that meet end to start, corners cut by 10 %."""
    lines: list[Line] = []
    for (e0, n0), (e1, n1) in pairwise(legs):
        de, dn = 0.1 * (e1 - e0), 0.1 * (n1 - n0)
        lines.append((e0 + de, n0 + dn, e1 - de, n1 - dn))
    return lines
