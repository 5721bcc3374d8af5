"""What ties the gains to the fields of one grid: a sparse matrix of nodes by knots, in single precision."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import sparse

from perception.bands import over_bands
from perception.records import FloatArray, IntArray

# Rows of nodes whose ties are gathered at once: some megabytes for a grid of a thousand columns.
_BAND = 32


@dataclass(frozen=True, slots=True)
class Coupling:
    """Normal matrix between the nodes' (z, then a) and the gains.

    Attributes
    ----------
    shape : of the grid.
    height, albedo : (nodes, knots) single precision.
    """

    shape: tuple[int, int]
    height: sparse.csr_matrix
    albedo: sparse.csr_matrix

    @classmethod
    def of_rows(
        cls,
        shape: tuple[int, int],
        cell_m: float,
        depth: int,
        rows: tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray],
        knot: IntArray,
        share: FloatArray,
        knots: int,
    ) -> Coupling:
        """Gather the coupling of the grid `depth` halvings above that of the data rows.

        Parameters
        ----------
        shape, cell_m : of the grid of the data.
        rows : cell, weight, c_east, c_north, c_level of the data.
        """
        fold = 1 << depth
        nodes = (shape[0] - 1) // fold + 1, (shape[1] - 1) // fold + 1
        row = rows[0] // (shape[1] - 1)
        order = np.argsort(row // (fold * _BAND), kind="stable").astype(np.int32)
        parts: tuple[list[sparse.csr_matrix], list[sparse.csr_matrix]] = ([], [])
        carried = np.zeros((2, nodes[1], knots), np.float32)
        for first in range(0, nodes[0], _BAND):
            # A band's cells reach one row of nodes beyond it, which is the next band's first.
            dense = np.zeros((2, _BAND + 1, nodes[1], knots), np.float32)
            dense[:, 0] = carried
            edge = np.searchsorted(row, [first * fold, (first + _BAND) * fold], sorter=order)
            gather_coupling(
                order[edge[0] : edge[1]], *rows, knot, share, shape[1] - 1, cell_m, depth, first,
                dense,
            )  # fmt: skip
            carried = dense[:, _BAND].copy()
            for kind, part in enumerate(parts):
                own = dense[kind, : min(_BAND, nodes[0] - first)]
                part.append(_sparse(own.reshape(-1, knots)))
        return cls(nodes, *(sparse.csr_matrix(sparse.vstack(part, "csr")) for part in parts))

    def coarser(self, prolongation: sparse.csr_matrix) -> Coupling:
        """Return the coupling of the grid that `prolongation` interpolates to this one."""
        turned = sparse.csr_matrix(prolongation.T, dtype=np.float32)
        nodes = self.shape[0] // 2 + 1, self.shape[1] // 2 + 1
        return Coupling(nodes, turned @ self.height, turned @ self.albedo)

    def gains_of(self, z: FloatArray, a: FloatArray) -> FloatArray:
        """Return what fields add to the gains' equations (knots,)."""
        out = np.zeros(self.height.shape[1])
        for matrix, values in ((self.height, z), (self.albedo, a)):
            gather(matrix.indptr, matrix.indices, matrix.data, values.reshape(-1), out)
        return out

    def fields_of(self, gain: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what gains add to the equations of heights and albedo."""
        out = []
        for matrix in (self.height, self.albedo):
            values = np.empty(self.shape[0] * self.shape[1])
            over_bands(
                scatter, len(values), matrix.nnz, matrix.indptr, matrix.indices, matrix.data, gain,
                values,
            )  # fmt: skip
            out.append(values.reshape(self.shape))
        return out[0], out[1]

    def dense(self) -> FloatArray:
        """Return the coupling as (2 nodes, knots)."""
        return np.asarray(sparse.vstack([self.height, self.albedo]).toarray(), float)


def _sparse(dense: FloatArray) -> sparse.csr_matrix:
    start = np.zeros(len(dense) + 1, np.int32)
    start[1:] = np.cumsum(count_entries(dense))
    column, value = np.empty(start[-1], np.int32), np.empty(start[-1], dense.dtype)
    take_entries(dense, column, value)
    return sparse.csr_matrix((value, column, start), shape=dense.shape)


@njit(cache=True, nogil=True)
def count_entries(dense):
    """Return the number of entries of each row that are not zero."""
    out = np.zeros(dense.shape[0], np.int32)
    for i in range(dense.shape[0]):
        for j in range(dense.shape[1]):
            out[i] += dense[i, j] != 0
    return out


@njit(cache=True, nogil=True)
def take_entries(dense, column, value):
    """Write column and value of all entries that are not zero, row by row."""
    k = 0
    for i in range(dense.shape[0]):
        for j in range(dense.shape[1]):
            if dense[i, j] != 0:
                column[k], value[k] = j, dense[i, j]
                k += 1


@njit(cache=True, nogil=True)
def gather(start, column, value, x, out):
    """Add the transpose of a sparse matrix applied to `x` (rows,)."""
    for i in range(len(x)):
        for k in range(start[i], start[i + 1]):
            out[column[k]] += value[k] * x[i]


@njit(cache=True, nogil=True)
def scatter(first, last, start, column, value, gain, out):
    """Write rows of a sparse matrix applied to `gain`."""
    for i in range(first, last):
        total = 0.0
        for k in range(start[i], start[i + 1]):
            total += value[k] * gain[column[k]]
        out[i] = total


@njit(cache=True, nogil=True)
def gather_coupling(
    chosen, cell, weight, c_east, c_north, c_level, knot, share, cols, cell_m, depth, first, out
):
    """Add to `out` (2, rows, cols, knots) what ties nodes of a grid 2^depth wider, from row `first`, to the gains."""
    step = 1 << depth
    for i in chosen:
        r, c = cell[i] // cols, cell[i] % cols
        y, x = ((r % step) + 0.5) / step, ((c % step) + 0.5) / step
        for k in range(4):
            up, right = k // 2, k % 2
            fy = y if up else 1 - y
            fx = x if right else 1 - x
            z = (c_east[i] * (fy if right else -fy) + c_north[i] * (fx if up else -fx)) / (
                step * cell_m
            ) + c_level[i] * fx * fy
            for m in range(knot.shape[1]):
                v = weight[i] * share[i, m]
                out[0, r // step + up - first, c // step + right, knot[i, m]] += v * z
                out[1, r // step + up - first, c // step + right, knot[i, m]] += v * fx * fy
