"""One round of registration: every square that two passes share compared, and turned into links."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from mapping.comparison_memory import Circumstances, ComparisonMemory
from mapping.fusion import default_cell as default_fusion_cell
from mapping.fusion import fuse
from mapping.keyframes import Keyframes
from mapping.link_choice import believed
from mapping.links import PassFacts, link_of
from mapping.overlaps import Window
from mapping.placed import extent
from mapping.placed import placed as strip_placed
from mapping.pose_graph import GraphConfig, Link, Solution
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
    expected: FloatArray,
    memory: ComparisonMemory | None = None,
) -> tuple[list[tuple[Window, Match]], list[Link]]:
    """Compare the passes over every window; return every comparison, and a link for each accepted one.

    Parameters
    ----------
    corrected : the strips on the track of `solution`.
    floor : a map that tells where echoes came from; None what the strips' soundings say of it.
    expected : (windows, 2, 2) covariance of the shift expected beforehand.
    memory : of earlier comparisons; those that hold still are not made again.
    """
    known = known_floor(corrected) if floor is None else floor
    given = Circumstances(windows, corrected, keyframes, solution, expected, known, cell_m)
    recalled = {} if memory is None else memory.recall(given)
    made = _compared(given, recalled, textures, config, widest_search_m, progress, label)
    matches = [made[number] for number in range(len(windows))]
    if memory is not None:
        memory.keep(given, recalled, matches)
    results = list(zip(windows, believed(matches), strict=True))
    seen = {index for w, m in results if m.accepted for index in (w.first, w.second)}
    facts = {index: PassFacts.of(corrected[index]) for index in seen}

    def link(window: Window, result: Match) -> Link:
        def make() -> Link:
            return link_of(corrected, facts, keyframes, solution, window, result, graph, floor)

        return make() if memory is None else memory.link(window, cell_m, make)

    return results, [link(window, result) for window, result in results if result.accepted]


def _compared(
    given: Circumstances, recalled: dict[int, Match], textures: TextureStore, config: MatchConfig,
    widest_search_m: float, progress: Progress, label: str,
) -> dict[int, Match]:  # fmt: skip
    """Return what the windows' squares say, by the windows' numbers: as recalled, the others compared now."""
    windows, cell_m = given.windows, given.cell_m
    fresh = [i for i in range(len(windows)) if i not in recalled]
    needed = sorted({i for n in fresh for i in (windows[n].first, windows[n].second)})
    with ThreadPoolExecutor(_THREADS) as pool:
        ready = pool.map(lambda i: textures.placed(i, given.strips[i], given.floor), needed)
        placed = dict(zip(needed, ready, strict=True))

    def compare(number: int) -> Match:
        window, prior = windows[number], given.expected[number]
        search_m = 3.0 * float(np.sqrt(np.linalg.eigvalsh(prior).max())) + 2.0 * cell_m
        return match(
            placed[window.first],
            placed[window.second],
            (window.easting_m, window.northing_m),
            window.side_m,
            min(search_m, widest_search_m),
            cell_m,
            config,
            prior,
        )

    made = dict(recalled)
    # Transforms and gridding let go of the interpreter's lock; the order of results is that of the windows.
    with ThreadPoolExecutor(_THREADS) as pool:
        for number, result in zip(fresh, pool.map(compare, fresh), strict=True):
            made[number] = result
            progress(label, len(made), len(windows))
    return made


def ends_of(keyframes: Keyframes, window: Window) -> tuple[int, int]:
    """Return the keyframes nearest to where the two passes of a window saw it."""
    return (
        keyframes.nearest(window.first, window.first_line),
        keyframes.nearest(window.second, window.second_line),
    )


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
