"""The normal equations of the joint inversion, matrix-free, and their solution by multigrid.

Unknowns: height z and log-albedo a on the nodes of one grid, and gains. A datum belongs to a dual
cell (the square between four nodes) and sees four features of the fields there: the mean gradient
(east, north) of z, the mean of z, the mean of a. The data of a cell therefore enter as one symmetric
4x4 matrix (ten numbers), whatever the number of looks; a coarser grid's matrix is the sum over its
four children, which makes a multigrid preconditioner cheap.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
from scipy import linalg, sparse

from perception.bands import over_bands
from perception.coupling import Coupling
from perception.level_kernels import prior_rows
from perception.multigrid import Fields, Hierarchy, Spectrum, Tie, add_times, can_halve, dot
from perception.records import FloatArray, IntArray
from perception.stencils import (
    accumulate_moments,
    dual_features,
    gain_normal,
    gain_to_features,
    rows_and_gain,
    spread_features,
)

logger = logging.getLogger(__name__)

# Nodes of a map whose error is judged as a whole; a larger one is so many patches.
_PATCH = 50_000
# The cycle leaves long waves and gains this slow at best; the first few steps cannot know, and would stop too soon.
_SLOW = 0.05
# Blocks of data rows whose pull on the gains is summed apart: the same sums however many threads share them.
_BLOCKS = 32


def add_prior_noise(
    b: FloatArray, weights: tuple[float, float, float], rng: np.random.Generator
) -> None:
    """Add noise whose covariance is the operator of `prior_rows`."""
    rows, cols = b.shape
    k0, k1, k2 = np.sqrt(weights)
    b += k0 * rng.standard_normal((rows, cols))
    east = k1 * rng.standard_normal((rows, cols - 1))
    b[:, 1:] += east
    b[:, :-1] -= east
    north = k1 * rng.standard_normal((rows - 1, cols))
    b[1:] += north
    b[:-1] -= north
    bend = k2 * rng.standard_normal((rows, cols - 2))
    b[:, 2:] += bend
    b[:, 1:-1] -= 2 * bend
    b[:, :-2] += bend
    bend = k2 * rng.standard_normal((rows - 2, cols))
    b[2:] += bend
    b[1:-1] -= 2 * bend
    b[:-2] += bend
    twist = np.sqrt(2) * k2 * rng.standard_normal((rows - 1, cols - 1))
    b[1:, 1:] += twist
    b[1:, :-1] -= twist
    b[:-1, 1:] -= twist
    b[:-1, :-1] += twist


@dataclass(slots=True)
class Problem:
    """One linearised problem: data rows, equality rows on heights, priors, gain.

    The datum of a row: ``c . features + gain(knot) = value + noise``.
    """

    cell_m: float
    shape: tuple[int, int]
    cell: IntArray
    weight: FloatArray
    c_east: FloatArray
    c_north: FloatArray
    c_level: FloatArray
    value: FloatArray
    knot: IntArray
    share: FloatArray
    gain_precision: FloatArray
    rows: sparse.csr_matrix
    row_weight: FloatArray
    row_value: FloatArray
    height: Spectrum
    albedo: Spectrum
    mean_height: FloatArray
    blocks: tuple[IntArray, IntArray] = field(init=False)
    hierarchy: Hierarchy = field(init=False)
    gain_block: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.blocks = self._blocks()
        block = self.gain_precision.copy()
        gain_normal(self.knot, self.share, self.weight, block)
        self.gain_block = block
        # Gathering the second grid's from the rows is quicker than adding up the first one's.
        couplings = [
            Coupling.of_rows(
                self.shape, self.cell_m, depth,
                (self.cell, self.weight, self.c_east, self.c_north, self.c_level),
                self.knot, self.share, len(block),
            )
            for depth in range(2 if can_halve(self.shape) else 1)
        ]  # fmt: skip
        self.hierarchy = self._hierarchy(couplings)

    def _blocks(self) -> tuple[IntArray, IntArray]:
        """Return the data rows in the order of their cells' rows, and where blocks of them begin and end."""
        line = self.cell // max(self.shape[1] - 1, 1)
        # Sixteen bits are sorted by digits, in a tenth of the time.
        order = np.argsort(
            line.astype(np.uint16 if self.shape[0] < 2**16 else np.int64), kind="stable"
        )
        edge = np.linspace(0, self.shape[0], _BLOCKS + 1).astype(np.int64)
        return order.astype(np.int32), np.searchsorted(line, edge, sorter=order)

    def _hierarchy(self, couplings: list[Coupling]) -> Hierarchy:
        rows, cols = self.shape
        moments = np.zeros((10, (rows - 1) * (cols - 1)), np.float32)
        accumulate_moments(self.cell, self.weight, self.c_east, self.c_north, self.c_level, moments)
        return Hierarchy.build(
            self.cell_m, moments.reshape(10, rows - 1, cols - 1), self.height, self.albedo,
            Tie.of(self.rows, self.row_weight), couplings, self.gain_block,
        )  # fmt: skip

    def _untied(self) -> Hierarchy:
        """Return grids that solve fields and gains apart: slower, but positive however the ties are rounded."""
        return self._hierarchy([Coupling.none(self.shape, len(self.gain_block))])

    def apply(self, z: FloatArray, a: FloatArray, gain: FloatArray) -> Fields:
        out_z, out_a = self.hierarchy.levels[0].apply(z, a)
        out_g = self.gain_block @ gain
        if len(self.cell):
            rows, cols = self.shape
            q = np.zeros((4, (rows - 1) * (cols - 1)))
            parts = np.zeros((_BLOCKS, len(out_g)))
            over_bands(
                rows_and_gain, _BLOCKS, 4 * len(self.cell), *self.blocks, self.cell, self.weight,
                self.c_east, self.c_north, self.c_level, self.knot, self.share,
                self._features(z, a), gain, q, parts,
            )  # fmt: skip
            out_g += parts.sum(axis=0)
            spread_features(q.reshape(4, rows - 1, cols - 1), self.cell_m, out_z, out_a)
        return out_z, out_a, out_g

    def _features(self, z: FloatArray, a: FloatArray) -> FloatArray:
        rows, cols = self.shape
        features = np.empty((4, rows - 1, cols - 1))
        dual_features(z, a, self.cell_m, features)
        return features.reshape(4, -1)

    def _spread(self, value: FloatArray, out_z: FloatArray, out_a: FloatArray) -> None:
        rows, cols = self.shape
        q = np.zeros((4, (rows - 1) * (cols - 1)))
        gain_to_features(self.cell, value, self.c_east, self.c_north, self.c_level, q)
        spread_features(q.reshape(4, rows - 1, cols - 1), self.cell_m, out_z, out_a)

    def right_side(self) -> Fields:
        b_z = np.zeros(self.shape)
        b_a = np.zeros(self.shape)
        self._spread(self.weight * self.value, b_z, b_a)
        of_mean = np.empty(self.shape)
        over_bands(
            prior_rows, self.shape[0], b_z.size, np.asarray(self.mean_height, float),
            self.height.coefficients(self.cell_m), of_mean,
        )  # fmt: skip
        b_z += of_mean
        if self.rows.shape[0]:
            b_z += (self.rows.T @ (self.row_weight * self.row_value)).reshape(self.shape)
        v = self.weight * self.value
        n = len(self.gain_precision)
        b_g: FloatArray = np.bincount(
            self.knot.ravel(), (v[:, None] * self.share).ravel(), n
        ).astype(float)
        return b_z, b_a, b_g

    def perturbation(self, rng: np.random.Generator) -> Fields:
        """Draw a right-hand side whose solution is a sample of the posterior about zero.

        Every squared term of the cost, data and prior, gives its own derivative times unit noise.
        """
        b_z = np.zeros(self.shape)
        b_a = np.zeros(self.shape)
        noise = np.sqrt(self.weight) * rng.standard_normal(len(self.weight))
        self._spread(noise, b_z, b_a)
        for b, spectrum in ((b_z, self.height), (b_a, self.albedo)):
            add_prior_noise(b, spectrum.coefficients(self.cell_m), rng)
        if self.rows.shape[0]:
            draw = np.sqrt(self.row_weight) * rng.standard_normal(len(self.row_weight))
            b_z += (self.rows.T @ draw).reshape(self.shape)
        n = len(self.gain_precision)
        b_g: FloatArray = np.bincount(
            self.knot.ravel(), (noise[:, None] * self.share).ravel(), n
        ).astype(float)
        b_g = b_g + np.linalg.cholesky(self.gain_precision) @ rng.standard_normal(n)
        return b_z, b_a, b_g

    def solve(
        self,
        start: Fields,
        right: Fields,
        tolerance: float = 0.5,
        most: int = 100,
    ) -> tuple[Fields, int]:
        """Solve by conjugate gradients, preconditioned by a multigrid cycle.

        Stops where the error is `tolerance` posterior sigmas in all: no combination of heights is then further from the
        solution than that, however the data scale. On a map of more than `_PATCH` nodes that is asked of its patches,
        whose errors add up in square: of the whole it would cost three times the steps and change heights by a
        hundredth of their sigma. The cycle measures the error squared short by its least
        eigenvalue, a hundredth where one pass is all there is; the steps so far tell it (Lanczos).

        What is tied in single precision may round to a cycle that is not positive, with which no step can be trusted:
        the rest is then solved with fields and gains apart, which a warning tells, as it does where `most` steps
        do not get there.
        """
        x: Fields = (start[0].copy(), start[1].copy(), start[2].copy())
        tolerance *= np.sqrt(max(self.shape[0] * self.shape[1] / _PATCH, 1.0))
        # The cycle's least eigenvalue is hardly below this in the best of cases.
        steps, positive = self._descend(self.hierarchy, x, right, tolerance, most, 0.2)
        if not positive:
            logger.warning(
                "joint inversion: the preconditioner is not positive after %d steps; "
                "going on with fields and gains apart", steps,
            )  # fmt: skip
            more, positive = self._descend(self._untied(), x, right, tolerance, most, 0.0)
            steps += more
            if not positive:
                logger.warning("joint inversion: ended short of its tolerance, not positive again")
        return x, steps

    def _descend(
        self, grids: Hierarchy, x: Fields, right: Fields, tolerance: float, most: int, least: float
    ) -> tuple[int, bool]:
        """Step `x` towards the solution, in place; return the steps and whether the cycle proved positive.

        `grids` : whose cycle is the preconditioner; `least` : eigenvalue it is taken to have before any step tells.
        """
        r: Fields = (right[0].copy(), right[1].copy(), right[2].copy())
        add_times(r, -1.0, self.apply(*x))
        # Below this a residual is rounding, and so is its sign in the cycle.
        rounding = 1e-20 * dot(right, right)
        p = grids.cycle(*r)
        rs = dot(r, p)
        if rs <= max(least * tolerance**2, 0.0):
            return 0, rs > 0 or dot(r, r) <= rounding
        alphas: list[float] = []
        betas: list[float] = []
        for k in range(most):
            y = self.apply(*p)
            alphas.append(rs / dot(p, y))
            add_times(x, alphas[-1], p)
            add_times(r, -alphas[-1], y)
            s = grids.cycle(*r)
            following = dot(r, s)
            if following <= 0 and dot(r, r) > rounding:
                return k + 1, False
            if following <= tolerance**2 * min(_least_eigenvalue(alphas, betas), _SLOW):
                return k + 1, True
            betas.append(following / rs)
            add_times(s, betas[-1], p)
            p, rs = s, following
        logger.warning(
            "joint inversion: %d steps did not reach the tolerance, half a sigma; solutions that follow "
            "go on from there", most,
        )  # fmt: skip
        return most, True


def _least_eigenvalue(alphas: list[float], betas: list[float]) -> float:
    """Return the least eigenvalue of the preconditioned operator as the steps of conjugate gradients know it."""
    a, b = np.array(alphas), np.array(betas)
    on = 1 / a
    on[1:] += b / a[:-1]
    return float(linalg.eigvalsh_tridiagonal(on, np.sqrt(b) / a[:-1])[0])
