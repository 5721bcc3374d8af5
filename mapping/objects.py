"""Objects over passes: looks at one object become one, with a joint height, position and uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import shapely
from scipy.spatial import cKDTree

from mapping.vectors import write_layer
from perception.records import FloatArray, IntArray

# How well a look places an object's centre: its shape is guessed from highlight and shadow. [m]
_CENTRE_SIGMA_M = 1.5
# Looks agree in height up to three of their combined sigmas.
_AGREE_SIGMA = 3.0


class Looks(Protocol):
    """What is needed of a table of objects of one pass (`perception.objects.ObjectTable` fits)."""

    @property
    def easting_m(self) -> FloatArray: ...
    @property
    def northing_m(self) -> FloatArray: ...
    @property
    def kind(self) -> Sequence[str]: ...
    @property
    def height_m(self) -> FloatArray: ...
    @property
    def sigma_m(self) -> FloatArray: ...
    @property
    def pass_index(self) -> IntArray: ...


@dataclass(frozen=True, slots=True)
class MergedObjects:
    """One row per object: position and height with sigma, looks and passes, and whether it is disputed.

    `radius_m` is the footprint's, NaN where no look has one; `least` marks heights that are only the least that open
    shadows prove. `disputed` marks an object beside which another pass saw something else: the other kind, or a height
    that differs by more than the sigmas allow. Both are kept. `look` gives the object of each look of
    the tables, one after the other. `overruled` marks a least height at whose place other passes saw plain ground
    (`mapping.overruled`); no merging does so by itself.
    """

    easting_m: FloatArray
    northing_m: FloatArray
    kind: tuple[str, ...]
    height_m: FloatArray
    sigma_m: FloatArray
    position_sigma_m: FloatArray
    looks: IntArray
    passes: IntArray
    disputed: npt.NDArray[np.bool_]
    look: IntArray
    radius_m: FloatArray
    least: npt.NDArray[np.bool_]
    overruled: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.kind)


def merge_objects(
    tables: Sequence[Looks],
    position_sigma_m: float | Sequence[float] = 0.5,
    one_floor: bool = False,
) -> MergedObjects:
    """Merge the looks of several passes.

    Looks of one kind within three position sigmas whose heights agree become one, nearest pairs first; two
    looks of one pass never do, as a pass sees an object once. Heights and positions are weighted by
    inverse variance; where looks of one object spread more than their sigmas, its sigma grows likewise. A look
    whose shadow runs out of the swath tells a least height only: it counts where no look of the object tells more,
    and then the greatest of them.

    Parameters
    ----------
    position_sigma_m : 1-sigma of each pass's track, one for all or one per table.
    one_floor : whether the looks' heights are above the floor of one map (`mapping.object_floors`): its error,
        the tables' `floor_sigma_m`, is then common to them and no number of passes makes it less.
    """
    position = np.broadcast_to(np.asarray(position_sigma_m, float), (len(tables),))
    owner = np.repeat(np.arange(len(tables)), [len(t.height_m) for t in tables])
    place = _column(tables, "easting_m"), _column(tables, "northing_m")
    points = np.column_stack(place).reshape(-1, 2)
    height, sigma = _column(tables, "height_m"), _column(tables, "sigma_m")
    kind = np.array([k for t in tables for k in t.kind], dtype=object)
    sigma = np.maximum(np.nan_to_num(sigma, nan=1.0), 1e-3)
    least, radius = _optional(tables, "lower_bound", bool), _radius(tables)
    floor = np.minimum(_optional(tables, "floor_sigma_m", float) * one_floor, sigma)
    where = np.hypot(_CENTRE_SIGMA_M, position[owner]) if len(owner) else np.zeros(0)
    group, rivals = _group(points, where, owner, kind, height, sigma, least)
    return _summarise(
        points, where, owner, kind, height, sigma, floor, group, rivals, least, radius
    )


def _column(tables: Sequence[Looks], name: str) -> FloatArray:
    if not tables:
        return np.zeros(0)
    return np.concatenate([np.asarray(getattr(t, name), float) for t in tables])


def _group(
    points: FloatArray, where: FloatArray, owner: IntArray, kind: npt.NDArray[Any], height: FloatArray,
    sigma: FloatArray, least: npt.NDArray[np.bool_],
) -> tuple[IntArray, list[tuple[int, int]]]:  # fmt: skip
    """Return each look's group, and the pairs of looks that contradict each other."""
    n = len(points)
    group = np.arange(n)
    members: dict[int, list[int]] = {i: [i] for i in range(n)}
    rivals: list[tuple[int, int]] = []
    if n < 2:
        return group, rivals
    pairs = cKDTree(points).query_pairs(
        3.0 * np.sqrt(2.0) * float(where.max()), output_type="ndarray"
    )
    apart = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    near = apart <= 3.0 * np.hypot(where[pairs[:, 0]], where[pairs[:, 1]])
    pairs, apart = pairs[near], apart[near]
    for i, j in pairs[np.argsort(apart, kind="stable")]:
        if owner[i] == owner[j]:
            continue
        higher = height[i] - height[j]
        # A least height agrees with any greater one.
        apart_m = 0.0 if (least[i] and higher < 0) or (least[j] and higher > 0) else abs(higher)
        agree = apart_m <= _AGREE_SIGMA * np.hypot(sigma[i], sigma[j])
        if kind[i] != kind[j] or not agree:
            rivals.append((int(i), int(j)))
            continue
        a, b = int(group[i]), int(group[j])
        if a == b or {owner[k] for k in members[a]} & {owner[k] for k in members[b]}:
            continue
        for k in members.pop(b):
            group[k] = a
            members[a].append(k)
    return group, rivals


def _summarise(
    points: FloatArray, where: FloatArray, owner: IntArray, kind: npt.NDArray[Any], height: FloatArray,
    sigma: FloatArray, floor: FloatArray, group: IntArray, rivals: Sequence[tuple[int, int]],
    least: npt.NDArray[np.bool_], radius: FloatArray,
) -> MergedObjects:  # fmt: skip
    _, look = np.unique(group, return_inverse=True)
    n = int(look.max()) + 1 if len(look) else 0
    first = np.zeros(n, np.int64)
    first[look[::-1]] = np.arange(len(look))[::-1]
    looks = np.bincount(look, minlength=n)
    open_only = np.bincount(look, ~least, minlength=n) == 0
    counts = ~least | _greatest(height, look, open_only)
    told = look[counts]
    h, h_sigma = _weighted(
        height[counts], sigma[counts], told, n, np.bincount(told, minlength=n), floor[counts]
    )
    widest = np.full(n, -np.inf)
    np.fmax.at(widest, look, radius)
    east, e_sigma = _weighted(points[:, 0], where, look, n, looks)
    north, n_sigma = _weighted(points[:, 1], where, look, n, looks)
    disputed = np.zeros(n, bool)
    for i, j in rivals:
        # Two looks may disagree and still belong to objects that others tell apart: mark both.
        if look[i] != look[j]:
            disputed[[look[i], look[j]]] = True
    return MergedObjects(
        easting_m=east,
        northing_m=north,
        kind=tuple(str(k) for k in kind[first]),
        height_m=h,
        sigma_m=h_sigma,
        position_sigma_m=np.maximum(e_sigma, n_sigma),
        looks=looks,
        passes=np.array([len(set(owner[look == k])) for k in range(n)], np.int64),
        disputed=disputed,
        look=look,
        radius_m=np.where(np.isfinite(widest), widest, np.nan),
        least=open_only,
        overruled=np.zeros(n, bool),
    )


def _greatest(
    height: FloatArray, look: IntArray, wanted: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Return which look is the highest of each wanted object, the first of equals."""
    highest = np.zeros(len(height), bool)
    for k in np.flatnonzero(wanted):
        mine = np.flatnonzero(look == k)
        highest[mine[np.argmax(height[mine])]] = True
    return highest


def _optional(tables: Sequence[Looks], name: str, kind: type) -> npt.NDArray[Any]:
    """Return a column that a table of looks may lack; zeros there."""
    parts: list[npt.NDArray[Any]] = [
        np.asarray(getattr(t, name, np.zeros(len(t.height_m))), kind) for t in tables
    ]
    return np.concatenate(parts) if parts else np.zeros(0, kind)


def _radius(tables: Sequence[Looks]) -> FloatArray:
    """Return the greater half size of each look's footprint; NaN where none is told."""
    half = np.maximum(
        _optional(tables, "half_across_m", float), _optional(tables, "half_along_m", float)
    )
    return np.where(half > 0, half, np.nan)


def _weighted(
    values: FloatArray, sigma: FloatArray, group: IntArray, n: int, looks: IntArray,
    common: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the means of groups (n,) and their sigma; `common` is the part of each sigma that a group shares."""
    weight = 1.0 / sigma**2
    total = np.bincount(group, weight, minlength=n)
    mean = np.bincount(group, weight * values, minlength=n) / total
    chi2 = np.bincount(group, weight * (values - mean[group]) ** 2, minlength=n)
    growth = np.maximum(chi2 / np.maximum(looks - 1, 1), 1.0)
    if common is None:
        return mean, np.sqrt(growth / total)
    share = weight / total[group]
    own = np.bincount(group, share**2 * (sigma**2 - common**2), minlength=n)
    together = np.bincount(group, share * common, minlength=n)
    return mean, np.sqrt(growth * own + together**2)


def write_objects(path: Path, objects: MergedObjects, crs: str) -> None:
    """Write `objects.gpkg`: a point per object."""
    points = shapely.points(objects.easting_m, objects.northing_m)
    columns = {
        "easting_m": objects.easting_m,
        "northing_m": objects.northing_m,
        "kind": np.array(objects.kind, dtype=object),
        "height_m": objects.height_m,
        "sigma_m": objects.sigma_m,
        "position_sigma_m": objects.position_sigma_m,
        "looks": objects.looks.astype(np.int32),
        "passes": objects.passes.astype(np.int32),
        "disputed": objects.disputed,
        "radius_m": objects.radius_m,
        "bound": np.where(objects.least, "lower", "").astype(object),
        "overruled": objects.overruled,
    }
    write_layer(path, points, columns, crs, "Point")
