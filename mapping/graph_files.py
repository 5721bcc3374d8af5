"""Pose graphs in g2o text, read and written: vertices and edges in two or three dimensions."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from perception.files import existing_file, write_text
from perception.records import FloatArray, InputError, IntArray

# tag -> (vertex?, numbers of a pose, size of the tangent space)
_TAGS = {
    "VERTEX_SE2": (True, 3, 3),
    "EDGE_SE2": (False, 3, 3),
    "VERTEX_SE3:QUAT": (True, 7, 6),
    "EDGE_SE3:QUAT": (False, 7, 6),
}


@dataclass(frozen=True, slots=True)
class PoseGraph:
    """Vertices and relative-pose edges of a pose graph.

    Attributes
    ----------
    key : (v,) number of each vertex; `pose` (v, 3) x, y, angle or (v, 7) x, y, z, qx, qy, qz, qw.
    edge : (e, 2) keys from and to; `measured` (e, 3 or 7) pose of the second in the frame of the first.
    information : (e, 3, 3) or (e, 6, 6) inverse covariance, translation before rotation.
    fixed : keys of vertices that are held where they are.
    """

    key: IntArray
    pose: FloatArray
    edge: IntArray
    measured: FloatArray
    information: FloatArray
    fixed: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def planar(self) -> bool:
        return bool(self.measured.shape[1] == 3)


def read_g2o(path: Path) -> PoseGraph:
    """Read a g2o file of SE2 or SE3 vertices and edges; other tags are passed over.

    Raises
    ------
    InputError
        A line has too few numbers, two and three dimensions are mixed, or there is no edge.
    """
    path = existing_file(path)
    rows: dict[str, list[list[float]]] = {tag: [] for tag in _TAGS}
    fixed: list[int] = []
    with path.open(encoding="utf-8", errors="replace") as stream:
        for number, line in enumerate(stream, start=1):
            tag, *words = line.split() or [""]
            if tag in _TAGS:
                rows[tag].append(_numbers(path, number, tag, words))
            elif tag == "FIX":
                fixed += [int(word) for word in words if word.isdigit()]
    planar = bool(rows["EDGE_SE2"])
    if planar and rows["EDGE_SE3:QUAT"]:
        raise InputError(f"{path}: mixes two and three dimensions; split it into two files")
    suffix = "SE2" if planar else "SE3:QUAT"
    vertices, edges = rows[f"VERTEX_{suffix}"], rows[f"EDGE_{suffix}"]
    if not edges:
        raise InputError(f"{path}: holds no EDGE_SE2 or EDGE_SE3:QUAT; is it a g2o file?")
    v = np.array(vertices, float).reshape(-1, 4 if planar else 8)
    e = np.array(edges, float)
    size, width = (3, 3) if planar else (6, 7)
    return PoseGraph(
        key=v[:, 0].astype(np.int64),
        pose=v[:, 1:],
        edge=e[:, :2].astype(np.int64),
        measured=e[:, 2 : 2 + width],
        information=_symmetric(e[:, 2 + width :], size),
        fixed=np.array(fixed, np.int64),
    )


def _numbers(path: Path, number: int, tag: str, words: list[str]) -> list[float]:
    vertex, width, size = _TAGS[tag]
    wanted = 1 + width if vertex else 2 + width + size * (size + 1) // 2
    try:
        values = [float(word) for word in words[:wanted]]
    except ValueError as error:
        raise InputError(f"{path}: line {number}: {error}; mend or remove the line") from error
    if len(values) < wanted:
        raise InputError(
            f"{path}: line {number}: {tag} needs {wanted} numbers, got {len(values)}; "
            "was the file cut off?"
        )
    return values


def _symmetric(upper: FloatArray, size: int) -> FloatArray:
    """Return (n, size, size) from rows of the upper triangle."""
    full = np.zeros((len(upper), size, size))
    i, j = np.triu_indices(size)
    full[:, i, j] = upper
    full[:, j, i] = upper
    return full


def write_g2o(path: Path, graph: PoseGraph) -> None:
    """Write a pose graph as g2o, with digits enough to read the same numbers back."""
    suffix, size = ("SE2", 3) if graph.planar else ("SE3:QUAT", 6)
    i, j = np.triu_indices(size)
    lines = [
        f"VERTEX_{suffix} {key} {_text(pose)}"
        for key, pose in zip(graph.key.tolist(), graph.pose.tolist(), strict=True)
    ]
    lines += [f"FIX {key}" for key in graph.fixed.tolist()]
    for (a, b), measured, information in zip(
        graph.edge.tolist(),
        graph.measured.tolist(),
        graph.information[:, i, j].tolist(),
        strict=True,
    ):
        lines.append(f"EDGE_{suffix} {a} {b} {_text(measured)} {_text(information)}")
    write_text(path, "\n".join(lines) + "\n")


def _text(values: list[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)
