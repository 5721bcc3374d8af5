"""A survey's pose graph for other programs: GTSAM's own serialisation, complete, and g2o, as poses.

GTSAM's text holds every factor as it was solved and the solution: another GTSAM reads it back to the bit. g2o
knows neither a pass's course and scale error nor points of ground, so there they are taken as found and each
relation is written between keyframes: a fair copy of the graph about its solution.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import gtsam as typed_gtsam
import numpy as np

from mapping.graph_files import PoseGraph, write_g2o
from mapping.keyframes import Keyframes
from mapping.pose_graph import Blend, Solution, build, gauss_newton, perpendicular
from mapping.survey_records import CorrectedSurvey
from perception.files import write_text
from perception.records import FloatArray

gtsam: Any = typed_gtsam

# Angles are hardly unknown beside metres: headings enter g2o as measured to a hundredth of a degree.
_HEADING_RAD = np.radians(0.01)
# What is not measured still needs an information matrix that can be inverted.
_NOTHING = 1e-9


def write_graph(folder: Path, corrected: CorrectedSurvey) -> None:
    """Write `graph.g2o`, `graph-factors.txt` and `graph-values.txt` (GTSAM) of a survey to `folder`.

    Factors that were found wrong are left out.
    """
    write_g2o(folder / "graph.g2o", survey_poses(corrected))
    solution = corrected.solution
    links = [x for x, ok in zip(corrected.links, solution.link_used, strict=True) if ok]
    fixes = [x for x, ok in zip(corrected.ties, solution.fix_used, strict=True) if ok]
    steps = [x for x, ok in zip(corrected.steps, solution.step_used, strict=True) if ok]
    graph, start, _ = build(corrected.keyframes, links, fixes, solution.config, steps)
    values = gtsam.GaussNewtonOptimizer(graph, start, gauss_newton()).optimize()
    write_text(folder / "graph-factors.txt", graph.serialize())
    write_text(folder / "graph-values.txt", values.serialize())


def survey_poses(corrected: CorrectedSurvey) -> PoseGraph:
    """Return keyframes as poses (x east, y north, angle from east) and all relations between them.

    Vertex `len(keyframes)` is the origin, held fixed at zero: absolute fixes and compass headings are edges
    from it.
    """
    keyframes, solution = corrected.keyframes, corrected.solution
    place = np.column_stack([keyframes.easting_m, keyframes.northing_m])
    heading = keyframes.heading_rad + solution.pass_errors[keyframes.strip, 2]
    angle = np.pi / 2 - heading
    pose = np.column_stack([place + solution.correction_m, angle])
    origin = len(keyframes)
    relations = [
        *_odometry(keyframes, solution, place),
        *_registrations(corrected, place),
    ]
    edges: list[tuple[int, int]] = []
    measured: list[list[float]] = []
    information: list[FloatArray] = []
    for first, second, step, covariance in relations:
        turn = _rotation(angle[first]).T
        edges.append((first, second))
        turned = np.angle(np.exp(1j * (angle[second] - angle[first])))
        measured.append([*(turn @ step), turned])
        # The angle between two keyframes is told by their own headings.
        information.append(_padded(np.linalg.inv(turn @ covariance @ turn.T), _NOTHING))
    absolute: list[tuple[int, FloatArray, FloatArray, float]] = [
        (k, pose[k, :2], np.eye(2) * _NOTHING, _HEADING_RAD**-2) for k in range(origin)
    ]
    absolute += [
        (k, at, np.linalg.inv(covariance), _NOTHING)
        for k, at, covariance in _absolute(corrected, place)
    ]
    for k, at, known, known_angle in absolute:
        edges.append((origin, k))
        measured.append([*at, angle[k]])
        information.append(_padded(known, known_angle))
    return PoseGraph(
        key=np.arange(origin + 1),
        pose=np.vstack([pose, np.zeros(3)]),
        edge=np.array(edges, np.int64),
        measured=np.array(measured),
        information=np.array(information),
        fixed=np.array([origin]),
    )


Relation = tuple[int, int, FloatArray, FloatArray]


def _absolute(
    corrected: CorrectedSurvey, place: FloatArray
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Return keyframe, position and covariance of the fixes used, and of each dive's own start."""
    config, ties = corrected.solution.config, corrected.ties
    start_m = config.start_with_fixes_m if ties else config.start_m
    starts = np.flatnonzero(~np.isfinite(corrected.keyframes.way_m))
    found: list[tuple[int, FloatArray, FloatArray]] = [
        (int(k), place[k], start_m**2 * np.eye(2)) for k in starts
    ]
    for tie, used in zip(ties, corrected.solution.fix_used, strict=True):
        if used:
            found.append((tie.keyframe, place[tie.keyframe] + tie.correction_m, tie.covariance_m2))
    return found


def _odometry(keyframes: Keyframes, solution: Solution, place: FloatArray) -> list[Relation]:
    """Return each step of the navigation, straightened by its pass's errors, with the walk's covariance."""
    relations: list[Relation] = []
    for k in np.flatnonzero(np.isfinite(keyframes.way_m)):
        step = place[k] - place[k - 1]
        scale, course, _ = solution.pass_errors[keyframes.strip[k - 1]]
        step = step + scale * step + course * perpendicular(step)
        walk = solution.config.walk_m2_per_m * keyframes.way_m[k]
        walk = max(float(walk + keyframes.jump_m[k] ** 2), 1e-6)
        relations.append((int(k) - 1, int(k), step, walk * np.eye(2)))
    return relations


def _registrations(corrected: CorrectedSurvey, place: FloatArray) -> list[Relation]:
    """Return each registration between keyframes, with the misfit that it has in the solution.

    One that holds the mean of two keyframes becomes a relation of each pair, by the product of their shares: all with
    the one misfit, so that they pull as it did and the optimum stays where it is.
    """
    relations: list[Relation] = []
    keyframes, solution = corrected.keyframes, corrected.solution
    moved = place + solution.correction_m
    for link, used in zip(corrected.links, solution.link_used, strict=True):
        if not used:
            continue
        ends = (
            link.first_blend or Blend(link.first, link.first, 0.0),
            link.second_blend or Blend(link.second, link.second, 0.0),
        )
        ground = [
            blend.of(solution.correction_m)
            + solution.pass_errors[keyframes.strip[blend.low], 2] * perpendicular(offset)
            for blend, offset in zip(ends, (link.first_offset_m, link.second_offset_m), strict=True)
        ]
        misfit = ground[1] - ground[0] - link.shift_m
        for (i, part_i), (j, part_j) in product(*(_parts(blend) for blend in ends)):
            step = moved[j] - moved[i] - misfit
            relations.append((i, j, step, link.covariance_m2 / (part_i * part_j)))
    return relations


def _parts(blend: Blend) -> list[tuple[int, float]]:
    """Return the keyframes of a blend that have a share, and the shares."""
    if blend.low == blend.high:
        return [(blend.low, 1.0)]
    both = ((blend.low, 1.0 - blend.share), (blend.high, blend.share))
    return [(k, part) for k, part in both if part > 1e-6]


def _rotation(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _padded(information: FloatArray, angle: float) -> FloatArray:
    full = np.zeros((3, 3))
    full[:2, :2] = 0.5 * (information + information.T)
    full[2, 2] = angle
    return full
