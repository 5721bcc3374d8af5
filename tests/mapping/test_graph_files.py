"""g2o files: there and back, refusals, and public sets brought to their optimum."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from mapping.graph_files import PoseGraph, read_g2o, write_g2o
from mapping.pose_graph_sets import dead_reckoned, gtsam_factors, gtsam_values, optimise
from perception.records import InputError

SETS = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "pose_graphs"


def a_square() -> PoseGraph:
    """Four sides of 10 m with a loop that closes exactly."""
    turn = np.pi / 2
    return PoseGraph(
        key=np.arange(4),
        pose=np.array([[0, 0, 0], [10, 0, turn], [10, 10, 2 * turn], [0, 10, -turn]], float),
        edge=np.array([[0, 1], [1, 2], [2, 3], [3, 0]]),
        measured=np.tile([10.0, 0.0, turn], (4, 1)),
        information=np.tile(np.diag([4.0, 4.0, 100.0]), (4, 1, 1)),
    )


def test_a_graph_comes_back_to_the_last_digit(tmp_path: Path) -> None:
    write_g2o(tmp_path / "g.g2o", a_square())
    back = read_g2o(tmp_path / "g.g2o")
    for name in ("key", "pose", "edge", "measured", "information"):
        np.testing.assert_array_equal(getattr(back, name), getattr(a_square(), name))


def test_gtsam_reads_what_we_write(tmp_path: Path) -> None:
    write_g2o(tmp_path / "g.g2o", a_square())
    factors, values = gtsam.readG2o(str(tmp_path / "g.g2o"), False)
    assert factors.size() == 4 and values.size() == 4
    assert factors.error(values) == pytest.approx(0.0, abs=1e-12)


def test_a_closed_square_is_its_own_optimum() -> None:
    optimum = optimise(a_square())
    assert optimum.error == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(optimum.graph.pose[:, :2], a_square().pose[:, :2], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("VERTEX_SE2 0 0 0 0\n", "holds no EDGE"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0\n", "line 1: EDGE_SE2 needs 11 numbers"),
        ("EDGE_SE2 0 1 1 x 0 1 0 0 1 0 1\n", "line 1"),
    ],
)
def test_a_broken_file_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "g.g2o"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_g2o(path)


@pytest.mark.parametrize("name", ["intel", "smallGrid3D", "kitti_00"])
def test_public_sets_reach_the_optimum_that_gtsam_s_own_optimizer_finds(name: str) -> None:
    """No worse than Levenberg-Marquardt from the file's start (or dead reckoning where it has none)."""
    path = SETS / f"{name}.g2o"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    graph = read_g2o(path)
    optimum = optimise(graph)
    given = graph if len(graph.key) else dead_reckoned(graph)
    factors = gtsam_factors(graph)
    first = int(graph.edge[0, 0])
    values = gtsam_values(given)
    if graph.planar:
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
        factors.add(gtsam.PriorFactorPose2(first, values.atPose2(first), noise))
    else:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
        factors.add(gtsam.PriorFactorPose3(first, values.atPose3(first), noise))
    theirs = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    assert optimum.error <= factors.error(theirs) * (1 + 1e-4)
