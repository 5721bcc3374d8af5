"""The long waves of the joint problem, solved exactly together with the gains.

A gain by angle and a dome between the tracks explain nearly the same echoes, so an iteration that
improves the fields and the gains in turn creeps along that direction for hundreds of steps. On a grid
coarse enough for a direct solution both are unknowns of one system.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from perception.multigrid import CornerData, Hierarchy, Level, prolong, restrict
from perception.records import FloatArray, IntArray
from perception.stencils import couple_gain, local_of_moments

# Nodes that a direct factorisation takes in a fraction of a second.
_NODES = 5000


@dataclass(slots=True)
class CoarseSolver:
    """Heights, albedo and gains on a coarse level of the hierarchy, factorised once.

    Attributes
    ----------
    depth : number of halvings from the finest grid.
    """

    depth: int
    shape: tuple[int, int]
    fields: linalg.SuperLU
    border: FloatArray
    answer: FloatArray
    gain_inverse: FloatArray

    @classmethod
    def build(
        cls,
        hierarchy: Hierarchy,
        rows: tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray],
        knot: IntArray,
        share: FloatArray,
        gain_block: FloatArray,
    ) -> CoarseSolver:
        """Assemble and factorise.

        Parameters
        ----------
        rows : cell, weight, c_east, c_north, c_level of the data.
        gain_block : normal matrix of the gains alone, data and prior.
        """
        sizes = [level.shape[0] * level.shape[1] for level in hierarchy.levels]
        depth = next((i for i, size in enumerate(sizes) if size <= _NODES), len(sizes) - 1)
        level = hierarchy.levels[depth]
        coupling = np.zeros((2, *level.shape, len(gain_block)))
        fine = hierarchy.levels[0]
        couple_gain(*rows, knot, share, fine.shape[1] - 1, fine.cell_m, depth, coupling)
        border = coupling.reshape(-1, len(gain_block))
        factor = linalg.splu(level_matrix(level).tocsc(), options={"SymmetricMode": True},
                             diag_pivot_thresh=0.0, permc_spec="MMD_AT_PLUS_A")  # fmt: skip
        answer = factor.solve(border)
        return cls(depth, level.shape, factor, border, answer,
                   np.linalg.inv(gain_block - border.T @ answer))  # fmt: skip

    def correct(
        self, z: FloatArray, a: FloatArray, gain: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the coarse solution for a residual of the finest grid."""
        for _ in range(self.depth):
            z, a = restrict(z), restrict(a)
        right = np.concatenate([z.ravel(), a.ravel()])
        gain = self.gain_inverse @ (gain - self.answer.T @ right)
        both = self.fields.solve(right) - self.answer @ gain
        half = len(both) // 2
        z, a = both[:half].reshape(self.shape), both[half:].reshape(self.shape)
        for _ in range(self.depth):
            z, a = prolong(z), prolong(a)
        return z, a, gain


def level_matrix(level: Level) -> sparse.csr_matrix:
    """Return the operator of a level on (heights, albedo) as a matrix."""
    rows, cols = level.shape
    nodes = np.arange(rows * cols).reshape(rows, cols)
    corners = np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]], axis=-1)
    corners = np.concatenate([corners, corners + rows * cols], axis=-1).reshape(-1, 8)
    first, second = np.triu_indices(8)
    data = level.data
    local = (
        data.local if isinstance(data, CornerData) else local_of_moments(data.moments, data.cell_m)
    )
    packed = local.reshape(-1, 36)
    upper = sparse.coo_matrix(
        (packed.ravel(), (corners[:, first].ravel(), corners[:, second].ravel())),
        shape=(2 * rows * cols, 2 * rows * cols),
    ).tocsr()
    own = sparse.coo_matrix(
        (packed[:, first == second].ravel(), (corners.ravel(), corners.ravel())), shape=upper.shape
    ).tocsr()
    both = upper + upper.T - own
    height = prior_matrix(level.shape, level.height.coefficients(level.cell_m))
    if level.rows.shape[0]:
        height = height + level.rows.T @ sparse.diags_array(level.row_weight) @ level.rows
    albedo = prior_matrix(level.shape, level.albedo.coefficients(level.cell_m))
    return sparse.csr_matrix(both + sparse.block_diag([height, albedo]))


def prior_matrix(shape: tuple[int, int], weights: tuple[float, float, float]) -> sparse.csr_matrix:
    """Return the operator of `perception.stencils.apply_prior` as a matrix."""
    rows, cols = shape
    first = [sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(n - 1, n)) for n in shape]
    second = [
        sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(n - 2, n)) for n in shape
    ]
    along = sparse.eye_array(rows), sparse.eye_array(cols)
    out = weights[0] * sparse.eye_array(rows * cols)
    for k, part in (
        (weights[1], sparse.kron(along[0], first[1])),
        (weights[1], sparse.kron(first[0], along[1])),
        (weights[2], sparse.kron(along[0], second[1])),
        (weights[2], sparse.kron(second[0], along[1])),
        (2 * weights[2], sparse.kron(first[0], first[1])),
    ):
        out = out + k * (part.T @ part)
    return sparse.csr_matrix(out)
