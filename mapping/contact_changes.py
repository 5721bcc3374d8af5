"""What changed between two surveys of one area, as contacts: appeared, vanished, another height."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import shapely
from scipy.optimize import linear_sum_assignment

from mapping.objects import MergedObjects, merge_objects
from mapping.vectors import write_layer
from perception.files import existing_file, write_text
from perception.records import BoolArray, FloatArray, InputError, IntArray

# Two contacts may be one within this many sigmas of their distance.
_REACH_SIGMA = 3.0
STATES = ("appeared", "vanished", "changed", "same", "not surveyed before", "not surveyed again")


@dataclass(frozen=True, slots=True)
class PassContacts:
    """The contacts of one pass, as `merge_objects` takes them."""

    easting_m: FloatArray
    northing_m: FloatArray
    kind: tuple[str, ...]
    height_m: FloatArray
    sigma_m: FloatArray
    pass_index: IntArray


@dataclass(frozen=True, slots=True)
class ContactChange:
    """One contact of either survey; heights and sigmas are NaN where a survey has none of it.

    `difference_m` is after less before (a crater's depth as a negative height), `difference_sigma_m` its
    1-sigma; `moved_m` the distance between the two places, `position_sigma_m` the 1-sigma of the place.
    """

    status: str
    kind: str
    easting_m: float
    northing_m: float
    position_sigma_m: float
    height_before_m: float
    sigma_before_m: float
    height_after_m: float
    sigma_after_m: float
    difference_m: float
    difference_sigma_m: float
    moved_m: float


def read_contacts(path: Path) -> list[PassContacts]:
    """Read `objects.csv`, one table a pass.

    Raises
    ------
    InputError
        A column of the contract lacks, or holds what is no number.
    """
    path = existing_file(path)
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
        needed = ("easting_m", "northing_m", "kind", "height_m", "sigma_m", "pass")
    if not rows:
        return []
    lacking = [name for name in needed if name not in rows[0]]
    if lacking:
        raise InputError(f"{path}: lacks the column {lacking[0]}; give an objects.csv of bathynav")
    try:
        numbers = np.array(
            [[float(row[n]) for n in needed if n != "kind"] for row in rows], dtype=float
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: a value is no number ({error})") from error
    kinds = [str(row["kind"]) for row in rows]
    tables = []
    for index in np.unique(numbers[:, 4]):
        mine = np.flatnonzero(numbers[:, 4] == index)
        part = numbers[mine]
        tables.append(
            PassContacts(part[:, 0], part[:, 1], tuple(kinds[i] for i in mine), part[:, 2],
                         part[:, 3], part[:, 4].astype(np.int64))
        )  # fmt: skip
    return tables


def contact_changes(
    before: Sequence[PassContacts],
    after: Sequence[PassContacts],
    position_sigma_m: float = 1.0,
    beyond_sigma: float = 3.0,
    covered_before: Callable[[FloatArray, FloatArray], BoolArray] | None = None,
    covered_after: Callable[[FloatArray, FloatArray], BoolArray] | None = None,
) -> list[ContactChange]:
    """Compare two surveys' contacts.

    Looks of one survey at one object are merged first. Contacts of the two surveys are paired one to one,
    nearest in all, within three sigmas of their distance; a pair has changed where its kinds differ or
    its heights by more than `beyond_sigma` of their combined sigma.

    Parameters
    ----------
    position_sigma_m : 1-sigma of either survey's track.
    covered_before, covered_after : tell which places (n,) a survey saw; what the other did not see has
        neither appeared nor vanished. None takes all as seen.
    """
    old, new = merge_objects(before, position_sigma_m), merge_objects(after, position_sigma_m)
    pairs = _pairs(old, new, position_sigma_m)
    changes = [_pair(old, i, new, j, position_sigma_m, beyond_sigma) for i, j in pairs]
    for mine, used, covered, gone in (
        (old, {i for i, _ in pairs}, covered_after, True),
        (new, {j for _, j in pairs}, covered_before, False),
    ):
        seen = np.ones(len(mine), bool)
        if covered is not None and len(mine):
            seen = covered(mine.easting_m, mine.northing_m)
        changes += [
            _single(mine, k, bool(seen[k]), gone, position_sigma_m)
            for k in range(len(mine))
            if k not in used
        ]
    return sorted(changes, key=lambda change: STATES.index(change.status))


def _pairs(
    old: MergedObjects, new: MergedObjects, position_sigma_m: float
) -> list[tuple[int, int]]:
    """Pair contacts one to one, the sum of squared distances in sigmas least."""
    if not len(old) or not len(new):
        return []
    apart = np.hypot(
        old.easting_m[:, None] - new.easting_m, old.northing_m[:, None] - new.northing_m
    )
    sigma = np.hypot(old.position_sigma_m[:, None], new.position_sigma_m)
    score = np.square(apart / np.hypot(sigma, np.sqrt(2) * position_sigma_m))
    # Of equals the one of the same kind is taken; a pair out of reach is worse than none.
    other = np.array(old.kind)[:, None] != np.array(new.kind)
    cost = np.where(score <= _REACH_SIGMA**2, score + other, 1e6)
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 1e6]


def _signed(objects: MergedObjects, k: int) -> float:
    return float(objects.height_m[k]) * (1.0 if objects.kind[k] == "hill" else -1.0)


def _pair(
    old: MergedObjects, i: int, new: MergedObjects, j: int, position_sigma_m: float, beyond: float
) -> ContactChange:
    difference = _signed(new, j) - _signed(old, i)
    sigma = float(np.hypot(old.sigma_m[i], new.sigma_m[j]))
    changed = old.kind[i] != new.kind[j] or abs(difference) > beyond * sigma
    return ContactChange(
        status="changed" if changed else "same",
        kind=new.kind[j],
        easting_m=float(new.easting_m[j]),
        northing_m=float(new.northing_m[j]),
        position_sigma_m=float(np.hypot(new.position_sigma_m[j], position_sigma_m)),
        height_before_m=float(old.height_m[i]),
        sigma_before_m=float(old.sigma_m[i]),
        height_after_m=float(new.height_m[j]),
        sigma_after_m=float(new.sigma_m[j]),
        difference_m=difference,
        difference_sigma_m=sigma,
        moved_m=float(
            np.hypot(new.easting_m[j] - old.easting_m[i], new.northing_m[j] - old.northing_m[i])
        ),
    )


def _single(
    objects: MergedObjects, k: int, seen: bool, gone: bool, position_sigma_m: float
) -> ContactChange:
    nan = float("nan")
    height, sigma = float(objects.height_m[k]), float(objects.sigma_m[k])
    if gone:
        status = "vanished" if seen else "not surveyed again"
    else:
        status = "appeared" if seen else "not surveyed before"
    return ContactChange(
        status=status,
        kind=objects.kind[k],
        easting_m=float(objects.easting_m[k]),
        northing_m=float(objects.northing_m[k]),
        position_sigma_m=float(np.hypot(objects.position_sigma_m[k], position_sigma_m)),
        height_before_m=height if gone else nan,
        sigma_before_m=sigma if gone else nan,
        height_after_m=nan if gone else height,
        sigma_after_m=nan if gone else sigma,
        difference_m=-_signed(objects, k) if gone else _signed(objects, k),
        difference_sigma_m=sigma,
        moved_m=nan,
    )


def write_contact_changes(folder: Path, changes: Sequence[ContactChange], crs: str) -> None:
    """Write `contact-changes.csv` and `contact-changes.gpkg` (a point per contact) into a folder."""
    names = [f.name for f in fields(ContactChange)]
    lines = [",".join(names)]
    for change in changes:
        lines.append(",".join(_written(getattr(change, name)) for name in names))
    write_text(folder / "contact-changes.csv", "\n".join(lines) + "\n")
    columns = {name: np.array([getattr(change, name) for change in changes]) for name in names}
    if not changes:
        columns = {
            name: np.zeros(0, object if name in ("status", "kind") else float) for name in names
        }
    points = shapely.points(columns["easting_m"], columns["northing_m"])
    write_layer(folder / "contact-changes.gpkg", points, columns, crs, "Point")


def _written(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.3f}"
