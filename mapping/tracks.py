"""Tracks as a vector layer: one line a pass, as corrected and as navigated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from mapping.trajectories import iso_times
from mapping.vectors import Layer, write_layers
from perception.records import Trajectory


def track_layer(track: Trajectory) -> Layer:
    """Return one line for each pass of two poses or more.

    Attributes of a line: `pass`, `pings`, `length_m`, `start` and `end` (ISO 8601 UTC, or seconds where the
    clock has no date), `sigma_m` (rms of the position's 1-sigma per axis; missing where unknown).
    """
    passes = np.zeros(len(track.time_s), int) if track.pass_index is None else track.pass_index
    known = np.isfinite(track.easting_m) & np.isfinite(track.northing_m)
    lines: list[Any] = []
    rows: list[tuple[Any, ...]] = []
    for number in np.unique(passes[passes >= 0]):
        mine = np.flatnonzero((passes == number) & known)
        if len(mine) < 2:
            continue
        line = shapely.LineString(np.column_stack([track.easting_m[mine], track.northing_m[mine]]))
        variance = 0.5 * (track.sigma_easting_m[mine] ** 2 + track.sigma_northing_m[mine] ** 2)
        sigma = float(np.sqrt(variance.mean()))
        ends = track.time_s[mine[[0, -1]]]
        start, end = iso_times(ends) if track.utc else [f"{value:.3f}" for value in ends]
        lines.append(line)
        rows.append((int(number), len(mine), line.length, start, end, sigma))
    names = ("pass", "pings", "length_m", "start", "end", "sigma_m")
    kinds: tuple[Any, ...] = (np.int32, np.int32, float, object, object, float)
    columns: dict[str, npt.NDArray[Any]] = {
        name: np.array([row[k] for row in rows], dtype=kind)
        for k, (name, kind) in enumerate(zip(names, kinds, strict=True))
    }
    return Layer(lines, columns, "LineString")


def write_tracks(path: Path, corrected: Trajectory, navigated: Trajectory) -> None:
    """Write `tracks.gpkg` with the layers `corrected` and `navigated`, in the corrected track's CRS."""
    layers = {"corrected": track_layer(corrected), "navigated": track_layer(navigated)}
    write_layers(path, layers, corrected.crs)
