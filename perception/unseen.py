"""Sigma of ground that no sound reached: anywhere below the ray that hides it."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.records import BoolArray, FloatArray

# Ground may leave the last height seen by half a metre a metre, until the ray limits it.
_STEEPNESS = 0.5


def hidden_sigma(shadow: BoolArray, across_m: FloatArray, altitude_m: FloatArray) -> FloatArray:
    """Return the 1-sigma (n, m) that being in shadow adds to a strip's heights; zero outside.

    A shadow that ends at ground range x_end hides what lies below the ray, whose height over the floor is
    ``altitude (1 - x / x_end)``; half of it is taken as 1-sigma. Inward from the seen ground in front it
    grows with half the distance, for the ground cannot leave a seen height at once.

    Parameters
    ----------
    shadow : (n, m) columns in shadow; across_m : (m,) rising, starboard positive; altitude_m : (n,).
    """
    out = np.zeros(shadow.shape, np.float32)
    starboard = np.flatnonzero(across_m > 0)
    port = np.flatnonzero(across_m < 0)[::-1]
    for columns in (starboard, port):
        if len(columns) > 1:
            side = np.ascontiguousarray(shadow[:, columns])
            out[:, columns] = _hidden(
                side, np.abs(across_m[columns]), np.asarray(altitude_m, float)
            )
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _hidden(shadow, x, altitude):  # type: ignore[no-untyped-def]
    n, m = shadow.shape
    out = np.zeros((n, m), np.float32)
    cell = x[1] - x[0]
    for i in range(n):
        k = 0
        while k < m:
            if not shadow[i, k]:
                k += 1
                continue
            end = k
            while end < m and shadow[i, end]:
                end += 1
            # Past the swath's edge the shadow goes on: the ray is only known to be no lower.
            x_end = x[end - 1] + 0.5 * cell if end < m else 2.0 * x[m - 1]
            for j in range(k, end):
                below = altitude[i] * max(1.0 - x[j] / x_end, 0.0)
                out[i, j] = min(0.5 * below, _STEEPNESS * (x[j] - x[k] + cell))
            k = end
    return out
