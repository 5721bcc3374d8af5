"""The horizontal tie of a survey to a map that was there before: its relief, square by square, as absolute fixes.

A draft of the survey's own map is compared with the prior one wherever both know the ground. Each square
whose relief fits at one place and no other becomes a fix of the keyframe beside it, with the match's
covariance; squares without features are refused as in any registration, and the graph's outlier test refuses those
that contradict the rest (ground that changed, a prior map that is wrong in places).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter

from mapping.correlation import correlate
from mapping.keyframes import KeyframeFix, Keyframes
from mapping.pose_graph import GraphConfig, Solution
from mapping.registration import judge
from mapping.textures import MatchConfig
from perception.records import FloatArray, Grid

# Relief shorter than this many cells of the coarser map is beyond it.
_LEAST_CELLS = 20
# No further is looked: a survey a hundred metres off needs a fix, not a map.
_WIDEST_SEARCH_M = 60.0
# The draft's and the prior's own bends and blunders below a cell, 1-sigma an axis.
_LEFT_OVER_M = 0.2


@dataclass(frozen=True, slots=True)
class PriorTies:
    """Squares compared with the prior map, and the fixes that came of them."""

    compared: int
    fixes: tuple[KeyframeFix, ...]


def ties_to_prior(
    draft: Grid,
    prior: Grid,
    keyframes: Keyframes,
    solution: Solution,
    graph: GraphConfig,
    side_m: float,
) -> PriorTies:
    """Compare a survey's draft map with a prior one; return absolute fixes of keyframes.

    Parameters
    ----------
    draft : map of the survey on the track of `solution`.
    prior : in the same coordinate system.
    side_m : width of a square.
    """
    cell_m = max(draft.cell_m, prior.cell_m, prior.cell_north_m)
    side_m = max(side_m, _LEAST_CELLS * cell_m)
    inner = round(side_m / cell_m)
    compared, fixes = 0, []
    for centre in _squares(draft, prior, side_m):
        k = _beside(keyframes, solution, centre)
        expected = solution.covariance_m2[k] + np.eye(2) * cell_m**2
        if not np.isfinite(expected).all():
            expected = np.eye(2) * (_WIDEST_SEARCH_M / 3) ** 2
        reach_m = min(3.0 * float(np.sqrt(np.linalg.eigvalsh(expected).max())), _WIDEST_SEARCH_M)
        reach = max(3, int(np.ceil(reach_m / cell_m)))
        found = _compare(draft, prior, centre, inner, reach, cell_m, expected)
        compared += found is not None
        if found is None:
            continue
        shift_m, covariance = found
        if covariance is None:
            continue
        bend = graph.walk_m2_per_m * side_m / 12.0
        fixes.append(
            KeyframeFix(
                keyframe=k,
                correction_m=solution.correction_m[k] + shift_m,
                covariance_m2=covariance + (bend + _LEFT_OVER_M**2) * np.eye(2),
            )
        )
    return PriorTies(compared, tuple(fixes))


def _squares(draft: Grid, prior: Grid, side_m: float) -> list[tuple[float, float]]:
    """Return the centres of lattice squares that both maps may know."""
    west, east = max(draft.west_m, prior.west_m), min(draft.east_m, prior.east_m)
    south, north = max(draft.south_m, prior.south_m), min(draft.north_m, prior.north_m)
    columns = np.arange(np.floor(west / side_m), np.ceil(east / side_m))
    rows = np.arange(np.floor(south / side_m), np.ceil(north / side_m))
    return [((c + 0.5) * side_m, (r + 0.5) * side_m) for r in rows for c in columns]


def _beside(keyframes: Keyframes, solution: Solution, centre: tuple[float, float]) -> int:
    """Return the keyframe nearest to a place: what a draft shows there is mostly its pass's."""
    place = np.column_stack([keyframes.easting_m, keyframes.northing_m]) + solution.correction_m
    return int(np.argmin(np.hypot(*(place - np.array(centre)).T)))


def _compare(
    draft: Grid,
    prior: Grid,
    centre: tuple[float, float],
    inner: int,
    reach: int,
    cell_m: float,
    expected_m2: FloatArray,
) -> tuple[FloatArray, FloatArray | None] | None:
    """Return the shift (m) of the prior's relief against the draft's and its covariance, None if refused.

    None altogether where one of the two does not know the square.
    """
    size = int(fft.next_fast_len(inner + 2 * reach, real=True))
    steps = (np.arange(size) - 0.5 * (size - 1)) * cell_m
    east, north = np.meshgrid(centre[0] + steps, centre[1] + steps)
    edge = (size - inner) // 2
    inside = np.zeros((size, size), bool)
    inside[edge : edge + inner, edge : edge + inner] = True
    a, wa = _relief(draft, east, north, inner)
    b, wb = _relief(prior, east, north, inner)
    wa = np.where(inside, wa, 0.0).astype(np.float32)
    if (wa > 0).sum() < 0.6 * inner**2 or (wb[inside] > 0).mean() < 0.6:
        return None
    surface = correlate(a, wa, b, wb, reach)
    if surface is None:
        return None
    noise = [
        float(np.nanmedian(g.sigma_m)) ** 2 if g.sigma_m is not None else 0.0
        for g in (draft, prior)
    ]
    share = float(
        np.sqrt(np.prod([_share(x, n) for x, n in zip((a[inside], b[inside]), noise, strict=True)]))
    )
    found = judge(
        {"relief": (a, wa, b, wb)},
        {"relief": surface.scaled(share)},
        inner,
        cell_m,
        MatchConfig(),
        expected_m2,
    )
    return found.shift_cells * cell_m, None if found.reason else found.covariance_m2


def _share(relief: FloatArray, noise_m2: float) -> float:
    """Return the part of a relief's variance that is no noise."""
    variance = float(np.var(relief))
    return max(variance - noise_m2, 0.0) / variance if variance > 0 else 0.0


def _relief(
    grid: Grid, east: FloatArray, north: FloatArray, inner: int
) -> tuple[FloatArray, FloatArray]:
    """Return heights less their mean over half a square, and weight 1 where they are known."""
    height = grid.sample(east, north)
    known = np.isfinite(height)
    weight = known.astype(np.float32)
    width = inner / 4.0
    total = gaussian_filter(weight, width, mode="constant")
    mean = gaussian_filter(np.where(known, height - _level(height), 0.0), width, mode="constant")
    smooth = mean / np.maximum(total, 1e-6)
    relief = np.where(known, height - _level(height) - smooth, 0.0)
    return relief.astype(np.float32), weight


def _level(height: FloatArray) -> float:
    known = height[np.isfinite(height)]
    return float(np.median(known)) if known.size else 0.0
