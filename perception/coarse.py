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

from perception.records import FloatArray


@dataclass(slots=True)
class CoarseSolver:
    """Heights, albedo and gains on the coarsest grid of the hierarchy, factorised once."""

    fields: linalg.SuperLU
    answer: FloatArray
    gain_inverse: FloatArray

    @classmethod
    def build(
        cls, matrix: sparse.csr_matrix, border: FloatArray, gain_block: FloatArray
    ) -> CoarseSolver:
        """Factorise.

        Parameters
        ----------
        matrix : of heights and albedo, from `level_matrix`.
        border : (2 nodes, knots) what ties them to the gains.
        gain_block : normal matrix of the gains alone, data and prior.
        """
        factor = linalg.splu(matrix.tocsc(), options={"SymmetricMode": True},
                             diag_pivot_thresh=0.0, permc_spec="MMD_AT_PLUS_A")  # fmt: skip
        # Gains that no datum ties to the fields have nothing to solve for.
        tied = np.flatnonzero(border.any(axis=0))
        answer = np.zeros_like(border)
        if len(tied):
            answer[:, tied] = factor.solve(border[:, tied])
        return cls(factor, answer, np.linalg.inv(gain_block - border.T @ answer))

    def solve(
        self, z: FloatArray, a: FloatArray, gain: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the solution for a right-hand side on the grid."""
        right = np.concatenate([z.ravel(), a.ravel()]).astype(float)
        gain = self.gain_inverse @ (gain - self.answer.T @ right)
        both = self.fields.solve(right) - self.answer @ gain
        half = z.size
        return both[:half].reshape(z.shape), both[half:].reshape(z.shape), gain


def level_matrix(
    local: FloatArray,
    height: tuple[float, float, float],
    albedo: tuple[float, float, float],
    rows: sparse.csr_matrix,
    row_weight: FloatArray,
) -> sparse.csr_matrix:
    """Return the operator of a grid on (heights, albedo) as a matrix.

    Parameters
    ----------
    local : (36, r, c) the cells' matrices on their corners.
    height, albedo : weights of squared value, first and second difference.
    rows, row_weight : equations on heights.
    """
    shape = local.shape[1] + 1, local.shape[2] + 1
    size = shape[0] * shape[1]
    nodes = np.arange(size).reshape(shape)
    corners = np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]], axis=-1)
    corners = np.concatenate([corners, corners + size], axis=-1).reshape(-1, 8)
    first, second = np.triu_indices(8)
    packed = np.asarray(local, float).reshape(36, -1).T
    # Where nothing echoed there is nothing to assemble.
    lit = packed[:, -1] != 0
    packed, corners = packed[lit], corners[lit]
    upper = sparse.coo_matrix(
        (packed.ravel(), (corners[:, first].ravel(), corners[:, second].ravel())),
        shape=(2 * size, 2 * size),
    ).tocsr()
    own = sparse.coo_matrix(
        (packed[:, first == second].ravel(), (corners.ravel(), corners.ravel())), shape=upper.shape
    ).tocsr()
    both = upper + upper.T - own
    z_prior = prior_matrix(shape, height)
    if rows.shape[0]:
        z_prior = z_prior + rows.T @ sparse.diags_array(row_weight) @ rows
    return sparse.csr_matrix(both + sparse.block_diag([z_prior, prior_matrix(shape, albedo)]))


def prior_matrix(shape: tuple[int, int], weights: tuple[float, float, float]) -> sparse.csr_matrix:
    """Return the operator of `perception.level_kernels.prior_rows` as a matrix."""
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
