"""Heights of objects once the floor around them is known: what a pass took for level, the map tells.

A pass measures an object on a floor level with that below the sonar. A floor that leans evenly from there does no
harm: heights above it shrink along a ray as heights above a level one do. What bends it does. With the floor
at z_foot under a hill and z_end at its shadow's end, or at z_rim where the ray grazes a crater and z_end where it ends
(the floor as it would be without the crater), all over the floor below the sonar, similar triangles give

    hill:    dH = z_end Rs / (Rs + Ls) - z_foot
    crater:  dD = z_end - z_rim (Rs + Ls) / Rs

The floor under an object is the plane through the map's heights around it. The map errs too, there, at the end and below
the sonar, which counts (1 - Rs / (Rs + Ls)) times for a hill and ((Rs + Ls) / Rs - 1) times for a crater: the correction
counts by its variance against that of the floor as the pass knew it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perception.geometry import ground_range
from perception.object_table import ObjectTable
from perception.records import BoolArray, FloatArray, Grid

# Places around a footprint where its floor is read, how far out, in footprints, and half the sector of the shadow:
# the object's own slopes and shadow are not floor.
_RING, _OUT = 16, 1.3
_SHADOWED = np.deg2rad(50.0)


def on_floor(
    table: ObjectTable, grid: Grid, sonar_east_m: FloatArray, sonar_north_m: FloatArray
) -> ObjectTable:
    """Return the objects of one pass with heights and sigma as a map's floor makes them.

    Objects whose shadow runs out of the swath, or for which the map has no floor or no sigma, stay as they are.

    Parameters
    ----------
    table : objects in the map's place.
    sonar_east_m, sonar_north_m : (n,) where the sonar was abeam of each.
    """
    if grid.sigma_m is None or not len(table):
        return table
    floors = _floors(table, grid, sonar_east_m, sonar_north_m)
    hill = np.array([kind == "hill" for kind in table.kind])
    share = table.slant_range_m / np.maximum(table.slant_range_m + table.shadow_length_m, 1e-9)
    correction = np.where(
        hill, floors.end_m * share - floors.foot_m, floors.inside_m - floors.rim_m / share
    )
    # A crater's correction is (Rs + Ls) / Rs - 1 times what the plane rises or falls from its middle to the sonar's place.
    variance = np.where(
        hill,
        floors.end_m2 * share**2 + floors.foot_m2 + floors.below_m2 * (1 - share) ** 2,
        (floors.foot_m2 + floors.below_m2 + floors.fall_m2) * (1 / share - 1) ** 2,
    )
    before = np.square(table.floor_sigma_m)
    known = floors.known
    known &= ~table.lower_bound & (before > 0) & np.isfinite(correction + variance)
    # The floor was taken for level within `before`: the map's word against that.
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.where(known, before / (before + variance), 0.0)
        after = np.where(known, before * variance / (before + variance), before)
    height = table.height_m + part * np.where(known, correction, 0.0)
    # No correction makes a hill of a crater; what would is a map that shows something else there.
    kept = height > 0.3 * table.height_m
    rest = np.maximum(np.square(table.sigma_m) - before, 0.0)
    return replace(
        table,
        height_m=np.where(kept, height, table.height_m),
        sigma_m=np.where(kept, np.sqrt(rest + after), table.sigma_m),
        floor_sigma_m=np.where(kept, np.sqrt(after), table.floor_sigma_m),
    )


@dataclass(frozen=True, slots=True)
class _Floors:
    """The map's floor over that below the sonar, (n,) each: `end_m` at the shadow's end by the map, the others by the
    plane around the footprint: under its middle, where the ray grazes it, and at the shadow's end.

    `foot_m2`, `end_m2`, `below_m2`: variances of these and of the floor below the sonar; `fall_m2` of what the plane
    falls from the footprint to there. `known`: whether the map holds them.
    """

    foot_m: FloatArray
    rim_m: FloatArray
    inside_m: FloatArray
    end_m: FloatArray
    foot_m2: FloatArray
    end_m2: FloatArray
    below_m2: FloatArray
    fall_m2: FloatArray
    known: BoolArray


def _floors(
    table: ObjectTable, grid: Grid, sonar_east_m: FloatArray, sonar_north_m: FloatArray
) -> _Floors:
    """Read the floors that a correction needs off the map."""
    assert grid.sigma_m is not None
    sigma = replace(grid, elevation_m=grid.sigma_m)
    east, north = table.easting_m - sonar_east_m, table.northing_m - sonar_north_m
    bearing, away = np.arctan2(east, north), np.hypot(east, north)
    below = grid.sample(sonar_east_m, sonar_north_m)
    last = table.slant_range_m + table.shadow_length_m
    reach, end = ground_range(last, table.drop_m), np.zeros(len(table))
    # Where the end lies depends on the floor there; the second round is within a cell. A cell farther out is
    # floor seen again.
    for _ in range(2):
        place = (
            sonar_east_m + np.sin(bearing) * (reach + grid.cell_m),
            sonar_north_m + np.cos(bearing) * (reach + grid.cell_m),
        )
        end = grid.sample(*place) - below
        reach = ground_range(
            last, np.maximum(table.drop_m - np.nan_to_num(end), 0.1 * table.drop_m)
        )
    plane, (plane_m2, lean_m2), known = _planes(table, grid, sigma, bearing)
    foot, lean = plane[:, 0] - below, plane[:, 1]
    rim = ground_range(table.slant_range_m, table.drop_m)
    inside = rim * last / np.maximum(table.slant_range_m, 1e-9)
    return _Floors(
        foot_m=foot,
        rim_m=foot + lean * (rim - away),
        inside_m=foot + lean * (inside - away),
        end_m=end,
        foot_m2=plane_m2,
        end_m2=np.square(sigma.sample(*place)),
        below_m2=np.square(sigma.sample(sonar_east_m, sonar_north_m)),
        fall_m2=lean_m2 * np.square(away),
        known=known & np.isfinite(below) & np.isfinite(end),
    )


def _planes(
    table: ObjectTable, grid: Grid, sigma: Grid, bearing: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray], BoolArray]:
    """Return the plane around each footprint: height at its middle and rise outward (n, 2), variances, and where known."""
    radius = _OUT * np.maximum(table.half_across_m, table.half_along_m) + grid.cell_m
    plane = np.full((len(table), 2), np.nan)
    variance, lean = np.full(len(table), np.nan), np.full(len(table), np.nan)
    around = np.arange(_RING) * 2 * np.pi / _RING
    # Outward and beside, in radii; the sector of the shadow is not floor seen.
    outward, beside = np.cos(around), np.sin(around)
    lit = outward < np.cos(_SHADOWED)
    terms = np.column_stack([np.ones(_RING), outward, beside])
    for i in range(len(table)):
        east = table.easting_m[i] + radius[i] * np.sin(bearing[i] + around)
        north = table.northing_m[i] + radius[i] * np.cos(bearing[i] + around)
        height, spread = grid.sample(east, north), sigma.sample(east, north)
        seen = lit & np.isfinite(height) & np.isfinite(spread)
        if seen.sum() >= _RING // 2:
            found = np.linalg.lstsq(terms[seen], height[seen], rcond=None)[0]
            plane[i] = found[0], found[1] / radius[i]
            # Errors of a map run over many cells: those around one object err together.
            variance[i] = np.mean(np.square(spread[seen]))
            # A common error tilts nothing; what may tilt the plane is taken at its worst, from place to place.
            part = np.linalg.inv(terms[seen].T @ terms[seen])[1, 1]
            lean[i] = variance[i] * part / radius[i] ** 2
    return plane, (variance, lean), np.isfinite(variance)
