"""Optimising general pose graphs (SE2, SE3) in GTSAM: from a start that needs no odometry."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import gtsam as typed_gtsam
import numpy as np

from mapping.graph_files import PoseGraph
from perception.records import FloatArray, InputError

gtsam: Any = typed_gtsam

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Optimum:
    """An optimised pose graph and its error (half a chi-square) at the file's start, ours, and the end."""

    graph: PoseGraph
    error_file: float
    error_start: float
    error: float
    iterations: int


def optimise(graph: PoseGraph) -> Optimum:
    """Optimise a pose graph whose first vertex is held.

    Rotations first: a graph whose loops have turned cannot be mended by small steps from
    odometry, but its rotations alone are a nearly linear problem. In the plane lago solves it, in space
    the chordal relaxation of InitializePose3; Levenberg-Marquardt follows from there.
    """
    factors = gtsam_factors(graph)
    given = gtsam_values(graph)
    held = factors.clone()
    # The held vertex takes away the freedom of the whole; its weight changes no edge.
    first, size = int(graph.edge[0, 0]), 3 if graph.planar else 6
    noise = gtsam.noiseModel.Isotropic.Sigma(size, 1e-3)
    if graph.planar:
        held.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(), noise))
        # lago knows diagonal noise alone; a start needs no more.
        diagonal = gtsam_factors(replace(graph, information=_diagonal(graph.information)))
        diagonal.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(), noise))
        start = gtsam.lago.initialize(diagonal, True)
    else:
        held.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(), noise))
        start = gtsam.InitializePose3.initialize(held)
    optimizer = gtsam.LevenbergMarquardtOptimizer(held, start, gtsam.LevenbergMarquardtParams())
    result = optimizer.optimize()
    after = factors.error(result)
    logger.info("pose graph: error %.6g -> %.6g", factors.error(start), after)
    return Optimum(
        graph=_with_poses(graph, result),
        error_file=factors.error(given) if given is not None else float("nan"),
        error_start=factors.error(start),
        error=after,
        iterations=int(optimizer.iterations()),
    )


def gtsam_factors(graph: PoseGraph) -> Any:
    """Return the edges as a NonlinearFactorGraph of native between-factors."""
    factors = gtsam.NonlinearFactorGraph()
    for (a, b), measured, information in zip(
        graph.edge.tolist(), graph.measured, graph.information, strict=True
    ):
        if graph.planar:
            noise = gtsam.noiseModel.Gaussian.Information(information)
            factors.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(*measured), noise))
        else:
            # g2o has translation before rotation, GTSAM rotation before translation.
            order = [3, 4, 5, 0, 1, 2]
            noise = gtsam.noiseModel.Gaussian.Information(information[np.ix_(order, order)])
            factors.add(gtsam.BetweenFactorPose3(a, b, _pose3(measured), noise))
    return factors


def gtsam_values(graph: PoseGraph) -> Any:
    """Return the file's own poses as GTSAM values; None where it holds none."""
    if not len(graph.key):
        return None
    values = gtsam.Values()
    for key, pose in zip(graph.key.tolist(), graph.pose, strict=True):
        values.insert(key, gtsam.Pose2(*pose) if graph.planar else _pose3(pose))
    return values


def _pose3(numbers: FloatArray) -> Any:
    x, y, z, qx, qy, qz, qw = numbers.tolist()
    return gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))


def _diagonal(information: FloatArray) -> FloatArray:
    return np.asarray(information * np.eye(information.shape[1]))


def _with_poses(graph: PoseGraph, values: Any) -> PoseGraph:
    keys = np.unique(graph.edge)
    if graph.planar:
        poses = [values.atPose2(int(k)) for k in keys]
        rows = [[p.x(), p.y(), p.theta()] for p in poses]
    else:
        rows = []
        for k in keys:
            pose = values.atPose3(int(k))
            q = pose.rotation().toQuaternion()
            rows.append([*pose.translation(), q.x(), q.y(), q.z(), q.w()])
    return replace(graph, key=keys, pose=np.array(rows))


def dead_reckoned(graph: PoseGraph) -> PoseGraph:
    """Return the graph with poses chained along the edges from each vertex to one first reached."""
    keys = np.unique(graph.edge)
    place: dict[int, Any] = {int(keys[0]): gtsam.Pose2() if graph.planar else gtsam.Pose3()}
    for (a, b), measured in zip(graph.edge.tolist(), graph.measured, strict=True):
        if a in place and b not in place:
            step = gtsam.Pose2(*measured) if graph.planar else _pose3(measured)
            place[b] = place[a].compose(step)
    missing = [int(k) for k in keys if int(k) not in place]
    if missing:
        raise InputError(
            f"vertex {missing[0]} cannot be reached along the edges from {int(keys[0])}; "
            "order the edges along the way or give the vertices"
        )
    values = gtsam.Values()
    for key, pose in place.items():
        values.insert(key, pose)
    return _with_poses(graph, values)
