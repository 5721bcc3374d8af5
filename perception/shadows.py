"""Heights from shadows: the founding paper's relation, its counterpart for craters, and their errors.

All lengths in metres; slant ranges throughout unless a name says otherwise. docs/shadow-heights.md
derives each relation and says which one holds where.
"""

from __future__ import annotations

import numpy as np

from perception.records import FloatArray


def hill_height(
    shadow_m: FloatArray | float,
    range_m: FloatArray | float,
    sonar_height_m: FloatArray | float,
    end_elevation_m: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the height of the grazing point above the floor from the shadow it throws.

    ``Ht = (Ls Hf + z_end Rs) / (Rs + Ls)``; with the shadow's end on the reference floor
    (``z_end = 0``) it is ``Ht = Ls Hf / (Ls + Rs)`` of Cuschieri & Hebert. Exact in slant range: grazing
    point and shadow's end lie on one ray, so the triangles are similar.

    Parameters
    ----------
    shadow_m : slant length Ls of the shadow.
    range_m : slant range Rs of the grazing point, where the shadow starts.
    sonar_height_m : height Hf of the sonar above the reference floor.
    end_elevation_m : height of the floor at the shadow's end above the reference floor.

    Examples
    --------
    The paper's worked example: a shadow of 36 m behind an object at 60 m, sonar 20 m up.

    >>> float(hill_height(36.0, 60.0, 20.0))
    7.5
    """
    shadow, range_, sonar = (np.asarray(v, float) for v in (shadow_m, range_m, sonar_height_m))
    return (shadow * sonar + np.asarray(end_elevation_m) * range_) / (range_ + shadow)


def crater_depth(
    shadow_m: FloatArray | float,
    range_m: FloatArray | float,
    sonar_height_m: FloatArray | float,
) -> FloatArray:
    """Return the depth below the near rim at which the shadow of a crater ends, ``Hf Ls / Rs``.

    The ray that grazes the rim keeps descending over the shadow. It is a lower bound of the
    crater's depth: the shadow may end on the far wall.

    >>> float(crater_depth(36.0, 60.0, 20.0))
    12.0
    """
    shadow, range_, sonar = (np.asarray(v, float) for v in (shadow_m, range_m, sonar_height_m))
    return sonar * shadow / range_


def thin_object_height(
    foot_ground_m: FloatArray | float,
    end_ground_m: FloatArray | float,
    sonar_height_m: FloatArray | float,
) -> FloatArray:
    """Return the height of a thin steep object, whose visible shadow starts at its foot.

    Its top echoes before its foot (layover), so the foot bounds the shadow: ``Hf (1 - x_foot/x_end)`` in
    *ground* ranges.

    >>> round(float(thin_object_height(60.0, 96.0, 20.0)), 2)
    7.5
    """
    foot, end = np.asarray(foot_ground_m, float), np.asarray(end_ground_m, float)
    return np.asarray(sonar_height_m) * (1 - foot / end)


def hill_sigma(
    shadow_m: FloatArray | float,
    range_m: FloatArray | float,
    sonar_height_m: FloatArray | float,
    edge_sigma_m: FloatArray | float,
    sonar_height_sigma_m: FloatArray | float,
    floor_sigma_m: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the 1-sigma of `hill_height` by its partial derivatives.

    ``dH/dLs = Hf Rs / (Rs+Ls)^2``, ``dH/dRs = -Hf Ls / (Rs+Ls)^2`` (both edges independent, the shadow's
    length is their difference), ``dH/dHf = Ls / (Ls+Rs)``, ``dH/dz_end = Rs / (Rs+Ls)``.

    Parameters
    ----------
    edge_sigma_m : 1-sigma of each edge of the shadow, slant.
    sonar_height_sigma_m : of the altitude.
    floor_sigma_m : of the floor's height at the shadow's end against the object's foot: the slope.
    """
    shadow, range_, sonar = (np.asarray(v, float) for v in (shadow_m, range_m, sonar_height_m))
    whole = shadow + range_
    # Start edge: moves Rs up and Ls down by as much; end edge: Ls alone.
    by_end = sonar * range_ / whole**2
    by_start = -sonar * range_ / whole**2 - sonar * shadow / whole**2
    return np.sqrt(
        (by_end * edge_sigma_m) ** 2
        + (by_start * edge_sigma_m) ** 2
        + (shadow / whole * sonar_height_sigma_m) ** 2
        + (range_ / whole * floor_sigma_m) ** 2
    )


def crater_sigma(
    shadow_m: FloatArray | float,
    range_m: FloatArray | float,
    sonar_height_m: FloatArray | float,
    edge_sigma_m: FloatArray | float,
    sonar_height_sigma_m: FloatArray | float,
) -> FloatArray:
    """Return the 1-sigma of `crater_depth`; arguments as `hill_sigma`."""
    shadow, range_, sonar = (np.asarray(v, float) for v in (shadow_m, range_m, sonar_height_m))
    return np.sqrt(
        (sonar / range_ * edge_sigma_m) ** 2
        + ((sonar / range_ + sonar * shadow / range_**2) * edge_sigma_m) ** 2
        + (shadow / range_ * sonar_height_sigma_m) ** 2
    )
