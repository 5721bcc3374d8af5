"""The survey's loop: strips of drifting passes in, strips on corrected tracks out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from mapping.fixes import PositionFix
from mapping.fusion import default_cell as default_fusion_cell
from mapping.fusion import fuse
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.overlaps import Window, find_overlaps
from mapping.pose_graph import GraphConfig, Link, Solution, perpendicular, solve
from mapping.registration import Match, match
from mapping.textures import (
    HEIGHT,
    MatchConfig,
    Texture,
    default_cell,
    placed_anew,
    texture,
    thinned,
)
from perception.records import (
    ElevationStrip,
    FloatArray,
    Grid,
    InputError,
    Progress,
    Trajectory,
    silent,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SurveyConfig:
    """How a survey is corrected.

    Attributes
    ----------
    rounds : most rounds of registering and solving.
    keyframe_m : way between keyframes; None a twelfth of the swath, a handful of metres.
    first_window_m, window_m : width of the compared squares in the first round and later; None derives
        them from the swath's width, narrower from round to round: large squares are hard to mistake, small
        ones bend less with the drift.
    widest_search_m : no shift beyond this is looked for.
    settled_m : the loop ends when the corrections' rms change is below this; None a fifth of a cell.
    """

    graph: GraphConfig = field(default_factory=GraphConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    rounds: int = 4
    keyframe_m: float | None = None
    first_window_m: float | None = None
    window_m: float | None = None
    widest_search_m: float = 40.0
    settled_m: float | None = None


@dataclass(frozen=True, slots=True)
class Registration:
    """One comparison of two passes: where, what came of it, and whether the graph believed it."""

    window: Window
    match: Match
    used: bool


@dataclass(frozen=True, slots=True)
class Round:
    """One round of the loop: comparisons made, accepted and used, and how far the track still moved."""

    compared: int
    accepted: int
    used: int
    moved_m: float
    error_before: float
    error_after: float


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """What a user should know of the correction.

    Attributes
    ----------
    rounds : one record per round.
    indeterminate, worsened : the last graph did not determine its unknowns; or did not improve.
    fixes_used, fixes_refused : absolute fixes believed, and contradicted by the rest.
    largest_correction_m : by which a line was moved.
    """

    rounds: tuple[Round, ...]
    indeterminate: bool
    worsened: bool
    fixes_used: int
    fixes_refused: int
    largest_correction_m: float


@dataclass(frozen=True, slots=True)
class CorrectedSurvey:
    """Strips on corrected tracks, the track with covariance, and how it came about.

    `height_sigma_m` (strips,) is the 1-sigma of each strip's height offset; `links` and `ties` are the
    registrations and fixes of the last graph (`pose_graph_files` writes it).
    """

    strips: tuple[ElevationStrip, ...]
    trajectory: Trajectory
    registrations: tuple[Registration, ...]
    diagnostics: Diagnostics
    height_m: FloatArray
    height_sigma_m: FloatArray
    keyframes: Keyframes
    solution: Solution
    links: tuple[Link, ...] = ()
    ties: tuple[KeyframeFix, ...] = ()


def correct_survey(
    strips: Sequence[ElevationStrip],
    fixes: Sequence[PositionFix] = (),
    config: SurveyConfig | None = None,
    progress: Progress = silent,
    floor: Grid | None = None,
) -> CorrectedSurvey:
    """Correct the tracks of a survey by what its passes saw twice and by absolute fixes.

    The strips' positions are taken as dead reckoning of unknown start: differences are the odometry.
    Without fixes the start is held to `GraphConfig.start_m`.

    Parameters
    ----------
    floor : a map of the ground, from an earlier round of mapping, that tells where echoes came from; default
        what the strips' own soundings say of it.

    Raises
    ------
    InputError
        No strip, or strips in different coordinate systems.
    """
    config = config or SurveyConfig()
    _check(strips)
    keyframes = choose_keyframes(strips, config.keyframe_m or _swath_width(strips) / 12.0)
    ties = tie_fixes(fixes, strips, keyframes, config.graph.drift_m_per_sqrt_km)
    cell_m = config.match.cell_m or default_cell(strips)
    settled_m = config.settled_m or 0.2 * cell_m
    solution = solve(keyframes, (), ties, config.graph)
    thin = [thinned(strip, 0.6 * cell_m) for strip in strips]
    textures: dict[int, Texture] = {}
    rounds: list[Round] = []
    found: list[Registration] = []
    links: list[Link] = []
    for number in range(config.rounds):
        corrected = _apply(thin, keyframes, solution)
        windows = find_overlaps(corrected, _window_side(strips, config, number))
        found, links, after = _round(
            corrected,
            textures,
            keyframes,
            ties,
            solution,
            windows,
            cell_m,
            config,
            progress,
            number,
            floor,
        )
        moved = after.correction_m - solution.correction_m
        moved_m = float(np.sqrt((moved**2).sum(axis=1).mean()))
        rounds.append(
            Round(
                compared=len(found),
                accepted=sum(r.match.accepted for r in found),
                used=sum(r.used for r in found),
                moved_m=moved_m,
                error_before=after.error_before,
                error_after=after.error_after,
            )
        )
        logger.info("round %d: %s", number + 1, rounds[-1])
        solution = after
        # The first rounds' squares are coarse by intent: the third always pays.
        if number > 1 and (moved_m < settled_m or not rounds[-1].used):
            break
    return _result(strips, keyframes, solution, found, links, ties, rounds, config)


def known_floor(strips: Sequence[ElevationStrip]) -> Grid | None:
    """Return the floor as the strips know it so far, smooth: soundings between the tracks count most.

    It serves to place echoes (`textures.placed_across`); a strip's heights are far better under its own
    track than at its rim, and `fuse` weights them so.
    """
    if not any(np.isfinite(s.elevation_m).any() for s in strips):
        return None
    altitude = float(np.nanmedian(np.concatenate([s.altitude_m for s in strips])))
    cell_m = max(default_fusion_cell(strips), altitude / 6.0)
    grid = fuse(strips, cell_m)
    weight = np.where(
        np.isfinite(grid.elevation_m),
        1.0 / np.nan_to_num(np.asarray(grid.sigma_m), nan=1.0) ** 2,
        0,
    )
    width = 0.4 * altitude / cell_m
    total = gaussian_filter(weight, width)
    mean = gaussian_filter(weight * np.nan_to_num(grid.elevation_m), width)
    height = np.where(total > 0, mean / np.where(total > 0, total, 1.0), np.nan)
    return replace(grid, elevation_m=height)


def _check(strips: Sequence[ElevationStrip]) -> None:
    if not strips:
        raise InputError("the survey holds no strip; was a pass of ten pings or more found?")
    names = sorted({strip.crs for strip in strips})
    if len(names) > 1:
        raise InputError(
            f"the strips lie in different coordinate systems ({', '.join(names)}); "
            "give one for all with --crs EPSG:N"
        )


def _swath_width(strips: Sequence[ElevationStrip]) -> float:
    """Return the median width of what the strips show."""
    widths = []
    for strip in strips:
        seen = (np.isfinite(strip.echo) | np.isfinite(strip.elevation_m)).any(axis=0)
        if seen.any():
            widths.append(float(np.ptp(strip.across_m[seen])))
    return max(float(np.median(widths)), 1.0) if widths else 50.0


def _window_side(strips: Sequence[ElevationStrip], config: SurveyConfig, number: int) -> float:
    width = _swath_width(strips)
    if number == 0:
        return config.first_window_m or 0.8 * width
    return config.window_m or (0.6 if number == 1 else 0.42) * width


def _round(
    corrected: Sequence[ElevationStrip],
    known: dict[int, Texture],
    keyframes: Keyframes,
    ties: Sequence[KeyframeFix],
    solution: Solution,
    windows: Sequence[Window],
    cell_m: float,
    config: SurveyConfig,
    progress: Progress,
    number: int,
    floor: Grid | None,
) -> tuple[list[Registration], list[Link], Solution]:
    """Compare the passes over every window and solve the graph with what came of it."""
    textures: dict[int, Texture] = {}
    unknown_m = None if floor is None or floor.sigma_m is None else _typical(floor.sigma_m)
    floor = known_floor(corrected) if floor is None else floor
    results: list[tuple[Window, Match]] = []
    links: list[Link] = []
    for done, window in enumerate(windows, start=1):
        for index in (window.first, window.second):
            if index not in textures:
                if index not in known:
                    known[index] = texture(corrected[index], config.match)
                    raw_m = known[index].values[..., HEIGHT]
                    # Heights as the strip has them: offsets are counted from there in every round.
                    raw_m -= np.where(raw_m != 0, np.float32(solution.height_m[index]), 0)
                textures[index] = placed_anew(known[index], corrected[index], floor)
        ends = [
            keyframes.nearest(s, line)
            for s, line in ((window.first, window.first_line), (window.second, window.second_line))
        ]
        prior = _expected_shift(keyframes, solution, ends[0], ends[1], config.graph)
        search_m = 3.0 * float(np.sqrt(np.linalg.eigvalsh(prior).max())) + 2.0 * cell_m
        result = match(
            textures[window.first],
            textures[window.second],
            (window.easting_m, window.northing_m),
            window.side_m,
            min(search_m, config.widest_search_m),
            cell_m,
            config.match,
            prior,
        )
        results.append((window, result))
        if result.accepted:
            link = _link(keyframes, solution, window, result, ends, config.graph)
            misplaced = [
                _misplacement(
                    corrected[int(keyframes.strip[k])], keyframes, k, link_offset, unknown_m
                )
                for k, link_offset in zip(
                    ends, (link.first_offset_m, link.second_offset_m), strict=True
                )
            ]
            links.append(replace(link, covariance_m2=link.covariance_m2 + sum(misplaced)))
        progress(f"registering, round {number + 1}", done, len(windows))
    after = solve(keyframes, links, ties, config.graph)
    used = iter(after.link_used)
    return (
        [
            Registration(window, result, bool(next(used)) if result.accepted else False)
            for window, result in results
        ],
        links,
        after,
    )


def _expected_shift(
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
    keyframes: Keyframes,
    solution: Solution,
    window: Window,
    result: Match,
    ends: Sequence[int],
    config: GraphConfig,
) -> Link:
    """Turn a match of corrected strips into a constraint on corrections of the navigation."""
    centre = np.array([window.easting_m, window.northing_m])
    offsets, ground = [], []
    for k in ends:
        strip = int(keyframes.strip[k])
        position = np.array([keyframes.easting_m[k], keyframes.northing_m[k]])
        offset = centre - position - solution.correction_m[k]
        offsets.append(offset)
        swing = solution.pass_errors[strip, 2] * perpendicular(offset)
        ground.append(solution.correction_m[k] + swing)
    # The mean of a random walk over the window against its value in the middle: q^2 L / 12, each pass.
    bend = 2.0 * config.drift_m_per_sqrt_km**2 / 1000.0 * window.side_m / 12.0
    return Link(
        first=ends[0],
        second=ends[1],
        first_offset_m=offsets[0],
        second_offset_m=offsets[1],
        shift_m=ground[1] - ground[0] - result.shift_m,
        covariance_m2=result.covariance_m2 + bend * np.eye(2),
        height_m=-float(result.height_m),
        height_sigma_m=float(result.height_sigma_m),
    )


def _typical(sigma_m: FloatArray) -> float:
    return float(np.nanmedian(sigma_m))


# The part of the floor's unevenness along a track that stays unknown beside it.
_UNKNOWN_RELIEF = 0.4


def _misplacement(
    strip: ElevationStrip,
    keyframes: Keyframes,
    keyframe: int,
    offset_m: FloatArray,
    unknown_m: float | None,
) -> FloatArray:
    """Return the (2, 2) covariance by which unknown relief misplaces a square of ground.

    Ground that lies h above the floor beneath the track is drawn h a / x towards it (`placed_across`). What
    is unknown of h is the floor map's sigma, or else a part of how uneven the floor is along the track.
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


def _apply(
    strips: Sequence[ElevationStrip], keyframes: Keyframes, solution: Solution
) -> list[ElevationStrip]:
    """Return the strips on the corrected track."""
    moved = []
    for index, strip in enumerate(strips):
        correction = _at_lines(strip, index, keyframes, solution.correction_m)
        moved.append(
            replace(
                strip,
                easting_m=strip.easting_m + correction[:, 0],
                northing_m=strip.northing_m + correction[:, 1],
                heading_rad=(strip.heading_rad + solution.pass_errors[index, 2]) % (2 * np.pi),
                elevation_m=strip.elevation_m + solution.height_m[index],
            )
        )
    return moved


def _at_lines(
    strip: ElevationStrip, index: int, keyframes: Keyframes, values: FloatArray
) -> FloatArray:
    """Interpolate per-keyframe values (k, ...) to the lines of one strip (n, ...)."""
    part = slice(int(keyframes.starts[index]), int(keyframes.starts[index + 1]))
    lines = np.arange(len(strip.time_s))
    flat = values[part].reshape(part.stop - part.start, -1)
    columns = [np.interp(lines, keyframes.line[part], column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(len(lines), *values.shape[1:])


def _bridge(strip: ElevationStrip, index: int, keyframes: Keyframes) -> FloatArray:
    """Return (n,) the variance per (m of way x q^2) that a walk has between two known ends."""
    part = slice(int(keyframes.starts[index]), int(keyframes.starts[index + 1]))
    marks = keyframes.line[part]
    lines = np.arange(len(strip.time_s))
    after = np.clip(np.searchsorted(marks, lines, side="right"), 1, max(len(marks) - 1, 1))
    if len(marks) < 2:
        return np.zeros(len(lines))
    span = marks[after] - marks[after - 1]
    f = (lines - marks[after - 1]) / np.maximum(span, 1)
    return f * (1 - f) * keyframes.way_m[part][after]


def _result(
    strips: Sequence[ElevationStrip],
    keyframes: Keyframes,
    solution: Solution,
    found: Sequence[Registration],
    links: Sequence[Link],
    ties: Sequence[KeyframeFix],
    rounds: Sequence[Round],
    config: SurveyConfig,
) -> CorrectedSurvey:
    corrected = _apply(strips, keyframes, solution)
    q2 = config.graph.drift_m_per_sqrt_km**2 / 1000.0
    covariances = []
    for index, strip in enumerate(strips):
        between = q2 * _bridge(strip, index, keyframes)
        covariance = _at_lines(strip, index, keyframes, solution.covariance_m2)
        covariances.append(covariance + between[:, None, None] * np.eye(2))
    covariance = np.concatenate(covariances)
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(s, name) for s in corrected])
        for name in ("time_s", "depth_m", "heading_rad", "ping")
    }
    places = [strip.sonar_positions() for strip in corrected]
    trajectory = Trajectory(
        **joined,
        easting_m=np.concatenate([east for east, _ in places]),
        northing_m=np.concatenate([north for _, north in places]),
        sigma_easting_m=np.sqrt(covariance[:, 0, 0]),
        sigma_northing_m=np.sqrt(covariance[:, 1, 1]),
        cov_en_m2=covariance[:, 0, 1],
        crs=strips[0].crs,
        pass_index=np.concatenate([np.full(len(s.ping), s.pass_index) for s in strips]),
    )
    diagnostics = Diagnostics(
        rounds=tuple(rounds),
        indeterminate=solution.indeterminate,
        worsened=solution.worsened,
        fixes_used=int(solution.fix_used.sum()),
        fixes_refused=int((~solution.fix_used).sum()),
        largest_correction_m=float(np.hypot(*solution.correction_m.T).max()),
    )
    return CorrectedSurvey(
        strips=tuple(corrected),
        trajectory=trajectory,
        registrations=tuple(found),
        diagnostics=diagnostics,
        height_m=solution.height_m,
        height_sigma_m=solution.height_sigma_m,
        keyframes=keyframes,
        solution=solution,
        links=tuple(links),
        ties=tuple(ties),
    )
