"""How far the first return of a rough floor precedes that of our estimate of the floor.

Below the sonar the echoes tell nothing of slope, so the map there is smoother than the floor, and the
nearest point of the floor is nearer than the map's. By how much follows from the roughness learned
from the soundings: random floors are sounded and mapped in the way the survey is, and the mean error
below the track is the lead.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse

from perception.multigrid import Spectrum
from perception.posterior import Problem
from perception.rays import Soundings
from perception.records import FloatArray
from perception.roughness import first_returns, random_floor
from perception.soundings import bilinear_rows, sounding_equations

# A strip of this many cells to each side of the track and along it is mapped.
_ALONG = 128
_REPEATS = 4
# The shading beside the nadir gap knows heights about so well.
_BESIDE_M = 0.1
# Slope across the track that other passes' echoes give a cell: two looks of sensitivity 6 with an error
# of 0.35 in log power.
_SLOPE_SIGMA = 0.2


def first_return_lead(
    roughness: Spectrum,
    altitude_m: float,
    gap_m: float,
    sounding_sigma_m: float,
    cell_m: float,
    seen: bool,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return mean and 1-sigma (metres) of how far first returns precede the estimate's.

    Parameters
    ----------
    roughness : spectrum of the floor.
    gap_m : half width of the strip below the track that the pass's own echoes do not resolve.
    seen : whether other passes' echoes resolve it, at grazing angles across the track.
    """
    fine = 0.5 * cell_m
    floor = random_floor(roughness, fine, 2 * 4 * _ALONG, rng)
    smooth = ndimage.gaussian_filter(floor, 0.5 * gap_m / fine, mode="wrap")
    early = first_returns(smooth, altitude_m, fine) - first_returns(floor, altitude_m, fine)
    spread = float(np.std(early))
    side = int(np.ceil(gap_m / cell_m / 8) + 1) * 8
    error = [
        _mapping_error(floor, column, side, roughness, altitude_m, gap_m,
                       float(np.hypot(sounding_sigma_m, spread)), cell_m, seen, rng)
        for column in np.linspace(0, floor.shape[1], _REPEATS, endpoint=False).astype(int)
    ]  # fmt: skip
    return float(np.mean(error)), spread


def _mapping_error(
    floor: FloatArray,
    column: int,
    side: int,
    roughness: Spectrum,
    altitude_m: float,
    gap_m: float,
    sigma_m: float,
    cell_m: float,
    seen: bool,
    rng: np.random.Generator,
) -> float:
    """Sound and map one strip of a random floor; return the mean error below the track, metres."""
    turned = np.roll(floor, floor.shape[1] // 2 - column, axis=1)
    middle = turned.shape[1] // 2
    reach = int(0.6 * altitude_m / cell_m) * 2
    nearest = np.min(
        [
            np.hypot(0.5 * cell_m * k, altitude_m - turned[:, middle + k])
            for k in range(-min(reach, middle - 1), min(reach, middle - 1) + 1)
        ],
        axis=0,
    )
    truth = ndimage.uniform_filter(turned, 2, mode="wrap")[::2, :][: 8 * _ALONG]
    truth = truth[:, middle - 2 * side : middle + 2 * side + 1 : 2]
    shape = (truth.shape[0] // 2 // 8 * 8 + 1, 2 * side + 1)
    truth = truth[: shape[0]]
    along = np.arange(shape[0]) * cell_m
    bottom = Soundings(
        np.full(shape[0], side * cell_m), along, np.full(shape[0], altitude_m),
        np.zeros(shape[0]), nearest[::2][: shape[0]], np.full(shape[0], sigma_m),
    )  # fmt: skip
    rows, cols = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    beside = (np.abs(cols - side) * cell_m >= gap_m) & (not seen)
    known = bilinear_rows(
        rows[beside].astype(float), cols[beside].astype(float), np.ones(int(beside.sum())), shape
    )
    slope = (np.diff(truth, axis=1)[1:] + np.diff(truth, axis=1)[:-1]) / (2 * cell_m)
    slope = slope + _SLOPE_SIGMA * rng.standard_normal(slope.shape)
    surface = np.zeros(shape)
    for step in range(4):
        found = sounding_equations(surface, 0.0, 0.0, cell_m, bottom, below=step == 0)
        surface = _solve_strip(
            shape, cell_m, roughness,
            sparse.csr_matrix(sparse.vstack([found.matrix, known])),
            np.concatenate([found.weight, np.full(known.shape[0], _BESIDE_M**-2.0)]),
            np.concatenate([found.value, truth[beside]]),
            slope.ravel() if seen else np.zeros(0),
        )  # fmt: skip
    return float(np.mean(surface[:, side] - truth[:, side]))


def _solve_strip(
    shape: tuple[int, int],
    cell_m: float,
    roughness: Spectrum,
    matrix: sparse.csr_matrix,
    weight: FloatArray,
    value: FloatArray,
    slope: FloatArray,
) -> FloatArray:
    n = len(slope)
    problem = Problem(
        cell_m=cell_m, shape=shape, cell=np.arange(n), weight=np.full(n, _SLOPE_SIGMA**-2.0),
        c_east=np.ones(n), c_north=np.zeros(n), c_level=np.zeros(n), value=slope,
        knot=np.zeros((n, 1), np.int64), share=np.zeros((n, 1)), gain_precision=np.eye(1),
        rows=matrix, row_weight=weight, row_value=value, height=roughness,
        # An albedo that hardly moves: only heights are at stake here.
        albedo=Spectrum(1e6, 1e6, 1e6), mean_height=np.zeros(shape),
    )  # fmt: skip
    start = (np.zeros(shape), np.zeros(shape), np.zeros(1))
    solution, _ = problem.solve(start, problem.right_side())
    return solution[0]
