"""Objects on the floor: hills and craters with a known height and place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perception.records import FloatArray, Grid, InputError
from scenarios.world import shapes


@dataclass(frozen=True, slots=True)
class SeaObject:
    """One hill or crater of the truth.

    Attributes
    ----------
    kind : "hill" or "crater".
    easting_m, northing_m : centre of the footprint, in the world's CRS.
    height_m : height (depth for a crater) of its extreme above the surrounding floor, positive.
    radius_m : radius of the footprint; half the longer side of a box.
    shape : "boulder", "mound", "pockmark" or "box".
    """

    kind: str
    easting_m: float
    northing_m: float
    height_m: float
    radius_m: float
    shape: str


_PROFILES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "boulder": shapes.boulder,
    "mound": shapes.mound,
    "pockmark": shapes.bowl,
}


def add_round(elevation_m: FloatArray, frame: Grid, item: SeaObject) -> None:
    """Add a round object to the heights, in place."""
    rows, cols = _window(frame, item)
    east, north = frame.centres()
    de = east[cols] - item.easting_m
    dn = north[rows] - item.northing_m
    distance = np.hypot(de[None, :], dn[:, None]) / item.radius_m
    elevation_m[rows, cols] += item.height_m * _PROFILES[item.shape](distance)


def add_box(
    elevation_m: FloatArray,
    frame: Grid,
    item: SeaObject,
    *,
    length_m: float,
    width_m: float,
    azimuth_deg: float,
) -> None:
    """Add a box with its long side along `azimuth_deg`; each wall is one cell wide."""
    rows, cols = _window(frame, item)
    east, north = frame.centres()
    de = (east[cols] - item.easting_m)[None, :]
    dn = (north[rows] - item.northing_m)[:, None]
    azimuth = np.deg2rad(azimuth_deg)
    along = np.abs(de * np.sin(azimuth) + dn * np.cos(azimuth))
    off = np.abs(de * np.cos(azimuth) - dn * np.sin(azimuth))
    # Cells cut by a wall hold the covered part of their width: the volume stays right.
    inside = np.clip((0.5 * length_m - along) / frame.cell_m + 0.5, 0.0, 1.0)
    inside = inside * np.clip((0.5 * width_m - off) / frame.cell_m + 0.5, 0.0, 1.0)
    elevation_m[rows, cols] += item.height_m * inside


def _window(frame: Grid, item: SeaObject) -> tuple[slice, slice]:
    reach = 1.5 * item.radius_m + 2 * frame.cell_m
    row, col = frame.fractional_index(np.array(item.easting_m), np.array(item.northing_m))
    half = reach / frame.cell_m
    rows = slice(max(int(row - half), 0), max(int(row + half) + 2, 0))
    cols = slice(max(int(col - half), 0), max(int(col + half) + 2, 0))
    return rows, cols


def scatter(
    *,
    count: int,
    centre_m: tuple[float, float],
    size_m: tuple[float, float],
    spacing_m: float,
    taken: list[tuple[float, float]],
    rng: np.random.Generator,
) -> list[tuple[float, float]]:
    """Throw `count` places into a rectangle, none nearer than `spacing_m` to another or to `taken`.

    Raises
    ------
    InputError
        They do not fit.
    """
    others = np.full((len(taken) + count, 2), np.inf)
    others[: len(taken)] = np.reshape(taken, (-1, 2))
    placed = 0
    # A crowded area refuses most throws; two hundred for each object fill it to what fits.
    for throw in rng.random((200 * count, 2)):
        if placed == count:
            break
        place = np.array(centre_m) + np.array(size_m) * (throw - 0.5)
        used = len(taken) + placed
        if (np.hypot(*(others[:used] - place).T) >= spacing_m).all():
            others[used] = place
            placed += 1
    if placed == count:
        return [(float(e), float(n)) for e, n in others[len(taken) :]]
    raise InputError(
        f"world.terrain: only {placed} of {count} objects fit into "
        f"{size_m[0]:g} x {size_m[1]:g} m at {spacing_m:g} m from each other; "
        "lower count or spacing_m, or widen the area"
    )
