"""Two output folders of `strips` or `map`, compared as contacts: what each saw, and what changed."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mapping.contact_changes import (
    STATES,
    contact_changes,
    read_contacts,
    write_contact_changes,
)
from mapping.rasters import read_map
from perception.records import BoolArray, FloatArray, InputError
from perception.strip_files import read_strip

Covered = Callable[[FloatArray, FloatArray], BoolArray]
# A contact this far past the outermost cell that a survey saw still lies on its edge, metres.
_EDGE_M = 2.0


def compare_folders(
    first: Path, second: Path, out: Path, position_sigma_m: float, beyond_sigma: float
) -> dict[str, Any]:
    """Compare the contacts of two output folders; return the numbers of each kind of change.

    Raises
    ------
    InputError
        A folder holds no objects.csv, or the two are in different coordinate systems.
    """
    for folder in (first, second):
        if not (folder / "objects.csv").exists():
            raise InputError(
                f"{folder}: holds no objects.csv; give two folders written by `bathynav strips` or "
                "`bathynav map`, or two maps"
            )
    before, after = (read_contacts(folder / "objects.csv") for folder in (first, second))
    crs, other = _crs(first), _crs(second)
    if crs and other and crs != other:
        raise InputError(
            f"{second}: its coordinate system differs from that of {first}; make both with one --crs"
        )
    changes = contact_changes(
        before, after, position_sigma_m, beyond_sigma, _coverage(first), _coverage(second)
    )
    write_contact_changes(out, changes, crs or other)
    counts = {state: sum(change.status == state for change in changes) for state in STATES}
    return {f"contacts_{state.replace(' ', '_')}": number for state, number in counts.items()}


def _crs(folder: Path) -> str:
    path = folder / "config.toml"
    if not path.exists():
        return ""
    return str(tomllib.loads(path.read_text(encoding="utf-8")).get("crs", ""))


def _coverage(folder: Path) -> Covered | None:
    """Return what tells the places that a folder's survey saw: by its map, else by its strips."""
    if (folder / "map.tif").exists():
        grid = read_map(folder / "map.tif")
        return lambda east, north: np.isfinite(grid.sample(east, north))
    paths = sorted(folder.glob("strip-*.nc"))
    if not paths:
        return None
    return lambda east, north: _in_strips(paths, east, north)


def _in_strips(paths: list[Path], east: FloatArray, north: FloatArray) -> BoolArray:
    seen = np.zeros(len(east), bool)
    for path in paths:
        strip = read_strip(path)
        known = np.isfinite(strip.elevation_m)
        rows = np.flatnonzero(known.any(axis=1))
        if not len(rows):
            continue
        # Outermost columns with a height, per line.
        low = strip.across_m[known[rows].argmax(axis=1)] - _EDGE_M
        high = strip.across_m[known.shape[1] - 1 - known[rows][:, ::-1].argmax(axis=1)] + _EDGE_M
        heading = strip.heading_rad[rows]
        for i in np.flatnonzero(~seen):
            de, dn = east[i] - strip.easting_m[rows], north[i] - strip.northing_m[rows]
            ahead = np.sin(heading) * de + np.cos(heading) * dn
            across = np.cos(heading) * de - np.sin(heading) * dn
            seen[i] = bool(np.any((np.abs(ahead) < _EDGE_M) & (across > low) & (across < high)))
    return seen
