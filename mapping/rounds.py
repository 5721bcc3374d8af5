"""One round of registration: every square that two passes share compared, and turned into links."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from mapping.fusion import default_cell as default_fusion_cell
from mapping.fusion import fuse
from mapping.keyframes import Keyframes
from mapping.link_choice import believed
from mapping.overlaps import Window
from mapping.placed import extent
from mapping.placed import placed as strip_placed
from mapping.pose_graph import GraphConfig, Link, Solution, perpendicular
from mapping.registration import Match, match
from mapping.textures import MatchConfig, Texture, placed_anew, texture
from perception.records import ElevationStrip, FloatArray, Grid, Progress

# More than two gain little: gathering is short and the rest holds the lock.
_THREADS = 2
# Cells of the floor that places echoes: some hundred bytes each while passes are fused. At a sixth of an
# altitude of 15 m they are 25 km2, and at the width it is smoothed to, 0.4 altitudes, 140 km2.
_FLOOR_CELLS = 4_000_000


@dataclass(frozen=True, slots=True)
class Registration:
    """One comparison of two passes: where, what came of it, and whether the graph believed it."""

    window: Window
    match: Match
    used: bool


class TextureStore:
    """Textures of the survey's strips: made once, placed anew for every round's poses and floor."""

    def __init__(self, strips: Sequence[ElevationStrip], config: MatchConfig) -> None:
        self._strips, self._config = strips, config
        self._known: dict[int, Texture] = {}

    def placed(self, index: int, strip: ElevationStrip, floor: Grid | None) -> Texture:
        """Return the texture of strip `index` at the poses of `strip`, on `floor`."""
        if index not in self._known:
            # From the strip as it came: heights are counted from there in every round.
            self._known[index] = texture(self._strips[index], self._config)
        return placed_anew(self._known[index], strip, floor)


def register(
    corrected: Sequence[ElevationStrip],
    textures: TextureStore,
    keyframes: Keyframes,
    solution: Solution,
    windows: Sequence[Window],
    cell_m: float,
    config: MatchConfig,
    graph: GraphConfig,
    widest_search_m: float,
    floor: Grid | None,
    progress: Progress,
    label: str,
) -> tuple[list[tuple[Window, Match]], list[Link]]:
    """Compare the passes over every window; return every comparison, and a link for each accepted one.

    Parameters
    ----------
    corrected : the strips on the track of `solution`.
    floor : a map that tells where echoes came from; None what the strips' soundings say of it.
    """
    known = known_floor(corrected) if floor is None else floor
    needed = sorted({index for w in windows for index in (w.first, w.second)})
    with ThreadPoolExecutor(_THREADS) as pool:
        made = pool.map(lambda index: textures.placed(index, corrected[index], known), needed)
        placed = dict(zip(needed, made, strict=True))

    def compare(window: Window) -> tuple[tuple[int, int], Match]:
        first = keyframes.nearest(window.first, window.first_line)
        second = keyframes.nearest(window.second, window.second_line)
        prior = expected_shift(keyframes, solution, first, second, graph)
        search_m = 3.0 * float(np.sqrt(np.linalg.eigvalsh(prior).max())) + 2.0 * cell_m
        return (first, second), match(
            placed[window.first],
            placed[window.second],
            (window.easting_m, window.northing_m),
            window.side_m,
            min(search_m, widest_search_m),
            cell_m,
            config,
            prior,
        )

    results: list[tuple[Window, Match]] = []
    ends: list[tuple[int, int]] = []
    # Transforms and gridding let go of the interpreter's lock; the order of results is that of the windows.
    with ThreadPoolExecutor(_THREADS) as pool:
        for window, (pair, result) in zip(windows, pool.map(compare, windows), strict=True):
            results.append((window, result))
            ends.append(pair)
            progress(label, len(results), len(windows))
    results = [(w, m) for (w, _), m in zip(results, believed([m for _, m in results]), strict=True)]
    links = [
        _link(corrected, keyframes, solution, window, result, pair, graph, floor)
        for (window, result), pair in zip(results, ends, strict=True)
        if result.accepted
    ]
    return results, links


def known_floor(strips: Sequence[ElevationStrip]) -> Grid | None:
    """Return the floor as the strips know it so far, smooth: soundings between the tracks count most.

    It serves to place echoes (`echo_places.placed_across`); a strip's heights are far better under its own
    track than at its rim, and `fuse` weights them so.
    """
    if not any(np.isfinite(s.elevation_m).any() for s in strips):
        return None
    altitude = float(np.nanmedian(np.concatenate([s.altitude_m for s in strips])))
    cell_m = affordable_cell(strips, max(default_fusion_cell(strips), altitude / 6.0))
    grid = fuse(strips, cell_m)
    weight = np.where(
        np.isfinite(grid.elevation_m),
        1.0 / np.nan_to_num(np.asarray(grid.sigma_m), nan=1.0) ** 2,
        0,
    )
    # Half a cell at least: between wide cells that few passes touch there is something to interpolate.
    width = max(0.4 * altitude / cell_m, 0.5)
    total = gaussian_filter(weight, width)
    mean = gaussian_filter(weight * np.nan_to_num(grid.elevation_m), width)
    height = np.where(total > 0, mean / np.where(total > 0, total, 1.0), np.nan)
    return replace(grid, elevation_m=height)


def affordable_cell(
    strips: Sequence[ElevationStrip], cell_m: float, most: int = _FLOOR_CELLS
) -> float:
    """Return `cell_m`, or as wide a cell as the strips' rectangle needs to stay near `most` cells.

    The floor is made anew every round, of the whole survey, whether its map is made in tiles or not.
    """
    window = extent([strip_placed(strip) for strip in strips], cell_m)
    cells = 0 if window is None else window.rows * window.cols
    return cell_m * max(1.0, float(np.sqrt(cells / most)))


def expected_shift(
    keyframes: Keyframes, solution: Solution, first: int, second: int, config: GraphConfig
) -> FloatArray:
    """Return the (2, 2) covariance of the shift between two keyframes expected beforehand.

    The lesser of what the two corrections' covariances allow and what the way between allows: errors from
    before the first of the two are common to both.
    """
    both = solution.covariance_m2[first] + solution.covariance_m2[second]
    low, high = sorted((first, second))
    way = keyframes.way_m[low + 1 : high + 1]
    if np.isfinite(way).all():
        walk = config.drift_m_per_sqrt_km**2 * way.sum() / 1000.0
        jump = (keyframes.jump_m[low + 1 : high + 1] ** 2).sum()
        steps = np.hypot(
            np.diff(keyframes.easting_m[low : high + 1]),
            np.diff(keyframes.northing_m[low : high + 1]),
        )
        by_pass = np.bincount(keyframes.strip[low:high] - keyframes.strip[low], weights=steps)
        rate = config.scale**2 + np.radians(config.heading_bias_deg) ** 2
        between = (walk + jump + rate * (by_pass**2).sum()) * np.eye(2)
        if not np.isfinite(both).all() or np.trace(between) < np.trace(both):
            both = between
    floor = np.eye(2) * 0.25
    return np.where(np.isfinite(both), both, 1e4 * np.eye(2)) + floor


def _link(
    strips: Sequence[ElevationStrip],
    keyframes: Keyframes,
    solution: Solution,
    window: Window,
    result: Match,
    ends: Sequence[int],
    config: GraphConfig,
    floor: Grid | None,
) -> Link:
    """Turn a match of corrected strips into a constraint on corrections of the navigation."""
    centre = np.array([window.easting_m, window.northing_m])
    unknown_m = None if floor is None else _typical_sigma(floor, window)
    offsets, ground = [], []
    # The mean of a random walk over the window against its value in the middle: q^2 L / 12, each pass.
    bend = 2.0 * config.drift_m_per_sqrt_km**2 / 1000.0 * window.side_m / 12.0
    covariance = result.covariance_m2 + (bend + _LEFT_OVER_M**2) * np.eye(2)
    for k in ends:
        strip = int(keyframes.strip[k])
        position = np.array([keyframes.easting_m[k], keyframes.northing_m[k]])
        offset = centre - position - solution.correction_m[k]
        offsets.append(offset)
        swing = solution.pass_errors[strip, 2] * perpendicular(offset)
        ground.append(solution.correction_m[k] + swing)
        covariance = covariance + _misplacement(strips[strip], keyframes, k, offset, unknown_m)
    return Link(
        first=ends[0],
        second=ends[1],
        first_offset_m=offsets[0],
        second_offset_m=offsets[1],
        shift_m=ground[1] - ground[0] - result.shift_m,
        covariance_m2=covariance,
    )


# The part of the floor's unevenness along a track that stays unknown beside it.
_UNKNOWN_RELIEF = 0.6
# What the width of beams and unmeasured rocking leave of any registration, 1-sigma an axis.
_LEFT_OVER_M = 0.2


def _typical_sigma(floor: Grid, window: Window) -> float | None:
    """Return the mean sigma (m) of a floor over a window; None where it has none there."""
    if floor.sigma_m is None:
        return None
    half = 0.5 * window.side_m
    row, col = floor.fractional_index(
        np.array([window.easting_m - half, window.easting_m + half]),
        np.array([window.northing_m + half, window.northing_m - half]),
    )
    rows = slice(max(int(row[0]), 0), max(int(row[1]) + 1, 0))
    cols = slice(max(int(col[0]), 0), max(int(col[1]) + 1, 0))
    sigma = floor.sigma_m[rows, cols]
    known = sigma[np.isfinite(sigma)]
    return float(known.mean()) if known.size else None


def _misplacement(
    strip: ElevationStrip,
    keyframes: Keyframes,
    keyframe: int,
    offset_m: FloatArray,
    unknown_m: float | None,
) -> FloatArray:
    """Return the (2, 2) covariance by which unknown relief misplaces a square of ground.

    Ground that lies h above the floor beneath the track is drawn h a / x towards it (`placed_across`). What
    is unknown of h is told by the floor map's sigma, or else by how uneven the floor is along the track.
    """
    heading = float(keyframes.heading_rad[keyframe])
    starboard = np.array([np.cos(heading), -np.sin(heading)])
    line = int(keyframes.line[keyframe])
    altitude = float(np.nan_to_num(strip.altitude_m[line]))
    beneath = -(strip.depth_m + strip.altitude_m)
    unevenness = float(np.nanstd(beneath)) if np.isfinite(beneath).any() else 0.1 * altitude
    away = max(abs(float(offset_m @ starboard)), altitude, 1e-6)
    unknown_m = _UNKNOWN_RELIEF * unevenness if unknown_m is None else unknown_m
    sigma = unknown_m * altitude / away
    return sigma**2 * np.outer(starboard, starboard)
