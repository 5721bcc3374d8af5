"""Eight classes from the signs of H and K, with the probability of each under their errors.

A value within the tolerance counts as zero. With z up (Besl & Jain 1986):

              K > 0     K = 0     K < 0
    H < 0     peak      ridge     saddle ridge
    H = 0     (flat)    flat      minimal
    H > 0     pit       valley    saddle valley

H^2 >= K always, so H = 0 with K > 0 is an artefact of the tolerances and counts as flat.
"""

from __future__ import annotations

from math import erf
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from perception.records import REGION_CLASSES, FloatArray, RegionMap

N_CLASSES = len(REGION_CLASSES)

# The paper's reading at a sonar's resolution: three classes are told apart (hill, valley, ridge). Our
# grouping of the eight; flat and minimal ground is none of them.
THREE_CLASSES = ("none", "hill", "valley", "ridge")
THREE_OF_EIGHT = np.array([0, 1, 2, 3, 2, 3, 2, 0, 0], np.int32)


def three_classes(regions: RegionMap) -> npt.NDArray[np.int32]:
    """Return the paper's three-class reading, (rows, cols) indices into `THREE_CLASSES`.

    Peaks are hills; ridges and saddle ridges are ridges; pits, valleys and saddle valleys are valleys.
    """
    return THREE_OF_EIGHT[regions.class_code]


# The Gaussian distribution function to eight sigma, tabled: interpolated it is right to 1e-6, and erf is
# ten times dearer.
_CLEAR = 8.0
_NODES_PER_SIGMA = 256
_TABLE = np.array(
    [0.5 * (1 + erf(k / _NODES_PER_SIGMA / np.sqrt(2))) for k in range(-2048, 2050)], np.float64
)


@njit(cache=True)
def _below(x: float) -> float:
    """Return the probability that a standard Gaussian is below x."""
    if x <= -_CLEAR:
        return 0.0
    if x >= _CLEAR:
        return 1.0
    place = (x + _CLEAR) * _NODES_PER_SIGMA
    k = int(place)
    value: float = _TABLE[k] + (place - k) * (_TABLE[k + 1] - _TABLE[k])
    return value


@njit(cache=True)
def _sign_probabilities(
    value: float, sigma: float, tolerance: float, out: npt.NDArray[np.float64]
) -> None:
    """Write P(below -tolerance), P(within), P(above) of a Gaussian value."""
    if sigma <= 0:
        out[0] = 1.0 if value < -tolerance else 0.0
        out[2] = 1.0 if value > tolerance else 0.0
    else:
        out[0] = _below((-tolerance - value) / sigma)
        out[2] = _below((value - tolerance) / sigma)
    out[1] = max(1 - out[0] - out[2], 0.0)


@njit(cache=True)
def _probabilities(
    h: npt.NDArray[np.float64], k: npt.NDArray[np.float64], out: npt.NDArray[np.float64]
) -> None:
    """Combine the sign probabilities of H and K into the nine classes' (0 is no data)."""
    out[0] = 0.0
    out[1], out[2] = h[0] * k[2], h[2] * k[2]
    out[3], out[4] = h[0] * k[1], h[2] * k[1]
    out[5], out[6] = h[0] * k[0], h[2] * k[0]
    out[7], out[8] = h[1] * (k[1] + k[2]), h[1] * k[0]


@njit(cache=True, parallel=True)
def _classify(
    curvature: tuple[Any, Any, Any, Any],
    k_sigma: float,
    least_h: float,
    least_k: float,
    class_code: npt.NDArray[np.uint8],
    certainty: npt.NDArray[np.float32],
    probability: npt.NDArray[np.float32],
) -> None:
    mean, gauss, sigma_h, sigma_k = curvature
    rows, cols = mean.shape
    keep = probability.shape[1] == rows
    for i in prange(rows):
        h, k, p = np.empty(3), np.empty(3), np.empty(9)
        for j in range(cols):
            if np.isnan(mean[i, j]):
                class_code[i, j] = 0
                certainty[i, j] = 0.0
                if keep:
                    probability[:, i, j] = np.nan
                continue
            sh, sk = sigma_h[i, j], sigma_k[i, j]
            _sign_probabilities(mean[i, j], sh, max(k_sigma * sh, least_h), h)
            _sign_probabilities(gauss[i, j], sk, max(k_sigma * sk, least_k), k)
            _probabilities(h, k, p)
            best = 1
            for c in range(2, 9):
                if p[c] > p[best]:
                    best = c
            class_code[i, j] = best
            certainty[i, j] = p[best]
            if keep:
                for c in range(9):
                    probability[c, i, j] = p[c]


def classify(
    curvature: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    k_sigma: float,
    least_h: float = 0.0,
    least_k: float = 0.0,
    keep_probability: bool = True,
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32], npt.NDArray[np.float32] | None]:
    """Choose the most probable class per cell.

    Parameters
    ----------
    curvature : H, K, sigma_H, sigma_K, (rows, cols) each; NaN in H is no data.
    k_sigma : a value within this many sigma of zero counts as zero.
    least_h, least_k : tolerances never fall below these (1/m, 1/m^2).

    Returns
    -------
    class_code : (rows, cols) index into `REGION_CLASSES`.
    certainty : (rows, cols) probability of that class.
    probability : (9, rows, cols), or None where not kept. H and K are taken as independent.
    """
    shape = curvature[0].shape
    class_code = np.empty(shape, np.uint8)
    certainty = np.empty(shape, np.float32)
    probability = np.empty((N_CLASSES, *(shape if keep_probability else (0, 0))), np.float32)
    _classify(curvature, k_sigma, least_h, least_k, class_code, certainty, probability)
    return class_code, certainty, probability if keep_probability else None
