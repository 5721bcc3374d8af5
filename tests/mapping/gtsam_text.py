"""A survey's graph read back by GTSAM itself, as another program would."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam as typed_gtsam

gtsam: Any = typed_gtsam


def read_graph(folder: Path) -> tuple[Any, Any]:
    """Return the factors and values of `graph-factors.txt` and `graph-values.txt`."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.deserialize((folder / "graph-factors.txt").read_text(encoding="utf-8"))
    values.deserialize((folder / "graph-values.txt").read_text(encoding="utf-8"))
    return graph, values


def solved_anew(graph: Any, values: Any) -> Any:
    """Return the optimum of a graph from a start at zero, by GTSAM's own Gauss-Newton with QR."""
    start = gtsam.Values()
    keys = values.keys()
    for key in keys:
        start.insert(key, 0.0 * values.atVector(key))
    parameters = gtsam.GaussNewtonParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    return gtsam.GaussNewtonOptimizer(graph, start, parameters).optimize()
