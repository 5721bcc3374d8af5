"""A finished mission as frames of text: the map in shades, the track so far, the vehicle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapping.rasters import read_map
from mapping.trajectories import read_trajectory
from perception.records import FloatArray, Grid, InputError, Trajectory

_SHADES = " .:-=+*#%@"  # low to high ground
_TRACK, _VEHICLE = "o", "V"
LEGEND = (
    f"{_SHADES[1]} low to {_SHADES[-1]} high ground   {_TRACK} track so far   {_VEHICLE} vehicle"
)


@dataclass(frozen=True, slots=True)
class Frame:
    """One moment: the picture's lines and what there is to say."""

    lines: tuple[str, ...]
    caption: str


def find_mission(folder: Path) -> tuple[Grid, Trajectory]:
    """Return map and track of an output folder: the survey's, or a localization run's.

    Raises
    ------
    InputError
        The folder holds no map or no trajectory.
    """
    for stage in (folder / "map", folder / "locate", folder):
        track = stage / "trajectory.csv"
        ground = next(
            (p for p in (stage / "map.tif", folder / "map" / "map.tif") if p.exists()), None
        )
        if track.exists() and ground is not None:
            return read_map(ground), read_trajectory(track)
    raise InputError(
        f"{folder}: holds no map.tif with a trajectory.csv; give the --out folder of demo, run or map"
    )


def frames(
    grid: Grid, track: Trajectory, columns: int, rows: int, n_frames: int
) -> Iterator[Frame]:
    """Yield `n_frames` frames of at most (rows, columns) characters."""
    picture, cell_m = _shaded(grid, columns, rows)
    col = ((track.easting_m - grid.west_m) / cell_m).astype(int)
    # A character is about twice as high as it is wide.
    row = ((grid.north_m - track.northing_m) / (2 * cell_m)).astype(int)
    inside = (row >= 0) & (row < picture.shape[0]) & (col >= 0) & (col < picture.shape[1])
    steps = np.unique(np.linspace(0, len(track.time_s) - 1, n_frames).astype(int))
    for step in steps:
        canvas = picture.copy()
        so_far = inside[: step + 1]
        canvas[row[: step + 1][so_far], col[: step + 1][so_far]] = _TRACK
        if inside[step]:
            canvas[row[step], col[step]] = _VEHICLE
        yield Frame(tuple("".join(line) for line in canvas), _caption(track, int(step)))


def _shaded(grid: Grid, columns: int, rows: int) -> tuple[np.ndarray, float]:
    """Return the map as characters and the width of one in metres."""
    width_m = grid.east_m - grid.west_m
    height_m = grid.north_m - grid.south_m
    cell_m = max(width_m / columns, height_m / (2 * rows))
    n_cols, n_rows = int(np.ceil(width_m / cell_m)), int(np.ceil(height_m / (2 * cell_m)))
    e = grid.west_m + (np.arange(n_cols) + 0.5) * cell_m
    n = grid.north_m - (np.arange(n_rows) + 0.5) * 2 * cell_m
    heights = _nearest(grid, e, n)
    low, high = np.nanpercentile(grid.elevation_m, [2, 98])
    level = np.clip((heights - low) / max(high - low, 1e-9), 0, 1)
    index = np.nan_to_num(level * (len(_SHADES) - 2) + 1, nan=0.0).astype(int)
    return np.array(list(_SHADES))[index], cell_m


def _nearest(grid: Grid, easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
    row, col = grid.fractional_index(easting_m, northing_m)
    r = np.clip(np.rint(row).astype(int), 0, grid.shape[0] - 1)
    c = np.clip(np.rint(col).astype(int), 0, grid.shape[1] - 1)
    return grid.elevation_m[np.ix_(r, c)]


def _caption(track: Trajectory, step: int) -> str:
    elapsed_s = track.time_s[step] - track.time_s[0]
    sigma_m = np.hypot(track.sigma_easting_m[step], track.sigma_northing_m[step])
    status = f"  {track.status[step]}" if track.status else ""
    return (
        f"{elapsed_s:8.0f} s  E {track.easting_m[step]:.1f}  N {track.northing_m[step]:.1f}  "
        f"depth {track.depth_m[step]:.1f} m  heading {np.degrees(track.heading_rad[step]) % 360:.0f} deg  "
        f"sigma {sigma_m:.1f} m{status}"
    )
