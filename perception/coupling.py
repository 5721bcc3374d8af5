"""What ties the gains to the fields of one grid: a sparse matrix of nodes by knots, in single precision."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import sparse

from perception.bands import in_threads, over_bands
from perception.records import FloatArray, IntArray

# Rows of nodes whose ties are gathered at once: some megabytes for a grid of a thousand columns.
_BAND = 32


# Blocks of nodes whose pull on the gains is summed apart: the same sums however many threads share them.
_BLOCKS = 32


@dataclass(frozen=True, slots=True)
class Coupling:
    """Normal matrix between the nodes' z and a and the gains.

    Attributes
    ----------
    shape : of the grid.
    matrix : (nodes, knots) in single precision: heights the real part, albedo the imaginary one. One index serves both.
    """

    shape: tuple[int, int]
    matrix: sparse.csr_matrix

    @classmethod
    def none(cls, shape: tuple[int, int], knots: int) -> Coupling:
        """Return a coupling that ties nothing."""
        return cls(shape, sparse.csr_matrix((shape[0] * shape[1], knots), dtype=np.complex64))

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
        line = (rows[0] // ((shape[1] - 1) * fold)).astype(
            np.int16 if nodes[0] < 2**15 else np.int32
        )
        order = np.argsort(line, kind="stable").astype(np.int32)

        def one(first: int) -> sparse.csr_matrix:
            # A node hears the cells before and after it.
            count = min(_BAND, nodes[0] - first)
            edge = np.searchsorted(line, [first - 1, first + count], sorter=order)
            dense = np.zeros((count, nodes[1], knots, 2), np.float32)
            gather_coupling(
                order[edge[0] : edge[1]], *rows, knot, share, shape[1] - 1, cell_m, depth, first,
                dense,
            )  # fmt: skip
            return _sparse(dense.reshape(-1, knots, 2))

        bands = in_threads(one, list(range(0, nodes[0], _BAND)))
        return cls(nodes, sparse.csr_matrix(sparse.vstack(bands, "csr")))

    def coarser(self, prolongation: sparse.csr_matrix) -> Coupling:
        """Return the coupling of the grid that `prolongation` interpolates to this one."""
        turned = sparse.csr_matrix(prolongation.T, dtype=np.float32)
        nodes = self.shape[0] // 2 + 1, self.shape[1] // 2 + 1
        return Coupling(nodes, sparse.csr_matrix(turned @ self.matrix))

    def gains_of(self, z: FloatArray, a: FloatArray) -> FloatArray:
        """Return what fields add to the gains' equations (knots,)."""
        parts = np.zeros((_BLOCKS, self.matrix.shape[1]))
        over_bands(
            gather, _BLOCKS, self.matrix.nnz, *self._arrays(), z.reshape(-1), a.reshape(-1), parts
        )
        total: FloatArray = parts.sum(axis=0)
        return total

    def fields_of(
        self, gain: FloatArray, precision: type[np.floating] = np.float64
    ) -> tuple[FloatArray, FloatArray]:
        """Return what gains add to the equations of heights and albedo."""
        z, a = np.empty(self.shape, precision), np.empty(self.shape, precision)
        over_bands(
            scatter, z.size, self.matrix.nnz, *self._arrays(), gain, z.reshape(-1), a.reshape(-1)
        )
        return z, a

    def dense(self) -> FloatArray:
        """Return the coupling as (2 nodes, knots)."""
        both = self.matrix.toarray()
        return np.concatenate([both.real, both.imag]).astype(float)

    def _arrays(self) -> tuple[IntArray, IntArray, FloatArray]:
        pairs = self.matrix.data.view(np.float32).reshape(-1, 2)
        return self.matrix.indptr, self.matrix.indices, pairs


def _sparse(dense: FloatArray) -> sparse.csr_matrix:
    start = np.zeros(len(dense) + 1, np.int32)
    start[1:] = np.cumsum(count_entries(dense))
    column, value = np.empty(start[-1], np.int32), np.empty((start[-1], 2), np.float32)
    take_entries(dense, column, value)
    return sparse.csr_matrix((value.view(np.complex64)[:, 0], column, start), shape=dense.shape[:2])


@njit(cache=True, nogil=True)
def count_entries(dense):
    """Return the number of pairs of each row that are not zero."""
    out = np.zeros(dense.shape[0], np.int32)
    for i in range(dense.shape[0]):
        for j in range(dense.shape[1]):
            out[i] += dense[i, j, 0] != 0 or dense[i, j, 1] != 0
    return out


@njit(cache=True, nogil=True)
def take_entries(dense, column, value):
    """Write column and values of all pairs that are not zero, row by row."""
    k = 0
    for i in range(dense.shape[0]):
        for j in range(dense.shape[1]):
            if dense[i, j, 0] != 0 or dense[i, j, 1] != 0:
                column[k] = j
                value[k, 0], value[k, 1] = dense[i, j, 0], dense[i, j, 1]
                k += 1


@njit(cache=True, nogil=True)
def gather(first, last, start, column, value, z, a, out):
    """Write blocks of nodes' part in the transpose of a coupling applied to `z` and `a` (nodes,)."""
    blocks, size = out.shape[0], len(z)
    for b in range(first, last):
        for i in range(size * b // blocks, size * (b + 1) // blocks):
            for k in range(start[i], start[i + 1]):
                out[b, column[k]] += value[k, 0] * z[i] + value[k, 1] * a[i]


@njit(cache=True, nogil=True)
def scatter(first, last, start, column, value, gain, z, a):
    """Write nodes of a coupling applied to `gain`."""
    for i in range(first, last):
        of_z, of_a = 0.0, 0.0
        for k in range(start[i], start[i + 1]):
            of_z += value[k, 0] * gain[column[k]]
            of_a += value[k, 1] * gain[column[k]]
        z[i], a[i] = of_z, of_a


@njit(cache=True, nogil=True)
def gather_coupling(
    chosen, cell, weight, c_east, c_north, c_level, knot, share, cols, cell_m, depth, first, out
):
    """Add to `out` (rows, cols, knots, 2) what ties nodes of a grid 2^depth wider, from row `first`, to the gains."""
    step = 1 << depth
    for i in chosen:
        r, c = cell[i] // cols, cell[i] % cols
        y, x = ((r % step) + 0.5) / step, ((c % step) + 0.5) / step
        for k in range(4):
            up, right = k // 2, k % 2
            row, col = r // step + up - first, c // step + right
            # The band's neighbours gather their own.
            if row < 0 or row >= out.shape[0]:
                continue
            fy = y if up else 1 - y
            fx = x if right else 1 - x
            z = (c_east[i] * (fy if right else -fy) + c_north[i] * (fx if up else -fx)) / (
                step * cell_m
            ) + c_level[i] * fx * fy
            for m in range(knot.shape[1]):
                v = weight[i] * share[i, m]
                out[row, col, knot[i, m], 0] += v * z
                out[row, col, knot[i, m], 1] += v * fx * fy
