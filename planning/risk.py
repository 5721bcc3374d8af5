"""How many sigmas of map error a route must keep to hold its floor with the stated risk."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from perception.records import FloatArray, InputError


def patches_crossed(length_m: float, correlation_m: float) -> float:
    """Return the number of independent patches of map error along a route, at least 1."""
    return max(1.0, length_m / correlation_m)


def clearance_factor(risk: float, patches: float) -> float:
    """Return k such that all of `patches` independent normal errors stay below k sigma.

    ``1 - risk = Phi(k)^patches``: each patch may fail with ``q = 1 - (1 - risk)^(1 / patches)``.

    Parameters
    ----------
    risk : probability that the floor is broken anywhere along the whole route, in (0, 1).
    patches : number of independent patches crossed, at least 1.

    Examples
    --------
    >>> round(clearance_factor(0.01, 100), 2)
    3.72
    """
    if not 0 < risk < 1:
        raise InputError(f"the risk must lie between 0 and 1, got {risk:g}; 0.01 is usual")
    each = -math.expm1(math.log1p(-risk) / max(patches, 1.0))
    return max(0.0, float(-ndtri(each)))


def clearance_sigma(
    elevation_m: FloatArray,
    cell_m: tuple[float, float],
    sigma_map_m: FloatArray | None,
    sigma_position_m: float | FloatArray,
    sigma_depth_m: float,
) -> FloatArray | None:
    """Combine what the clearance does not know, cell by cell.

    ``sigma^2 = sigma_map^2 + |grad z|^2 sigma_position^2 + sigma_depth^2``. A position error matters
    by the slope it moves the vehicle over.

    Parameters
    ----------
    cell_m : width (east) and height (north) of a cell.
    sigma_position_m : 1-sigma per axis, one number or a raster (expected position error).

    Returns
    -------
    (rows, cols) sigma, NaN where the map or its sigma is; None where nothing is uncertain.
    """
    has_map = sigma_map_m is not None and bool(np.isfinite(sigma_map_m).any())
    if not has_map and not np.any(np.asarray(sigma_position_m) > 0) and sigma_depth_m == 0:
        return None
    variance = np.full(elevation_m.shape, float(sigma_depth_m) ** 2)
    if has_map and sigma_map_m is not None:
        variance += np.asarray(sigma_map_m, float) ** 2
    if np.any(np.asarray(sigma_position_m) > 0):
        north, east = np.gradient(elevation_m, cell_m[1], cell_m[0])
        slope2 = np.nan_to_num(north**2 + east**2)
        variance += slope2 * np.asarray(sigma_position_m, float) ** 2
    return np.sqrt(variance)
