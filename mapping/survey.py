"""The survey's loop: strips of drifting passes in, strips on corrected tracks out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from mapping.comparison_memory import ComparisonMemory
from mapping.crossings import height_steps
from mapping.fixes import PositionFix
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.link_choice import apart, enough, without
from mapping.overlaps import Window, find_overlaps
from mapping.placing import at_lines, bridge, on_track
from mapping.pose_graph import GraphConfig, HeightStep, Link, Solution
from mapping.pose_graph_relative import relative_covariance
from mapping.pose_graph_solve import solve
from mapping.prior_tie import ties_to_prior
from mapping.rounds import LEAST_SHIFT_M, Registration, TextureStore, ends_of, register
from mapping.sharing import solve_shared
from mapping.survey_check import check, least_square_m, square_cell_m, steady, swath_width
from mapping.textures import MatchConfig, default_cell, thinned
from perception.records import (
    BoolArray,
    ElevationStrip,
    FloatArray,
    Grid,
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
    squares : width of the compared squares in each round, as parts of the swath's width. Large squares are
        hard to mistake; small ones bend less with the drift, and there are more of them.
    rounds : most rounds of registering and solving; None one for each of `squares`.
    keyframe_m : way between keyframes; None a twelfth of the swath, a handful of metres.
    widest_search_m : no shift beyond this is looked for.
    settled_m : rounds beyond those of `squares` end when the corrections' rms change is below this; None a
        fifth of a cell.
    """

    graph: GraphConfig = field(default_factory=GraphConfig)
    match: MatchConfig = field(default_factory=MatchConfig)
    squares: tuple[float, ...] = (0.8, 0.5, 0.3, 0.2)
    rounds: int | None = None
    keyframe_m: float | None = None
    widest_search_m: float = 40.0
    settled_m: float | None = None


@dataclass(frozen=True, slots=True)
class Round:
    """One round of the loop.

    Attributes
    ----------
    floor : what told where echoes came from: "soundings" or "map".
    square_m : width of the compared squares.
    compared, accepted, used : comparisons made, accepted by themselves, believed by the graph.
    beyond : squares left for later, their shift expected wider than any search.
    evidence : mean log-likelihood ratio of a comparison against no match, refused ones included.
    moved_m : rms by which the track still moved.
    error_before, error_after : the graph's error (half a chi-square).
    passes : how many there were.
    anew : comparisons made in this round; the others held still since an earlier correction (`ComparisonMemory`).
    """

    floor: str
    square_m: float
    compared: int
    accepted: int
    used: int
    beyond: int
    evidence: float
    moved_m: float
    error_before: float
    error_after: float
    passes: int
    anew: int


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """What a user should know of the correction.

    Attributes
    ----------
    rounds : one record per round.
    indeterminate, worsened : the last graph did not determine its unknowns; or did not improve.
    fixes_used, fixes_refused : absolute fixes believed, and contradicted by the rest.
    largest_correction_m : by which a line was moved.
    prior_compared, prior_used : squares compared with a prior map, and those that the graph believed.
    prior_shift_m : (east, north) by which the tie to the prior map moved the track, on average.
    """

    rounds: tuple[Round, ...]
    indeterminate: bool
    worsened: bool
    fixes_used: int
    fixes_refused: int
    largest_correction_m: float
    prior_compared: int = 0
    prior_used: int = 0
    prior_shift_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class CorrectedSurvey:
    """Strips on corrected tracks, the track with covariance, and how it came about.

    `height_sigma_m` (strips,) is the 1-sigma of each strip's height offset; `links`, `ties` and
    `steps` are the registrations, fixes and height steps of the last graph (`pose_graph_files` writes it);
    `squares` are the links' places, one each. `registrations` are all comparisons of the last round.
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
    steps: tuple[HeightStep, ...] = ()
    squares: tuple[Window, ...] = ()


# Rounds of one square's width beyond the first, where passes come within reach one after the other.
_MORE_ROUNDS = 3

_Factor = TypeVar("_Factor")


@dataclass(frozen=True, slots=True)
class _Given:
    """What stays the same through the rounds; `thin` are the strips on the columns of the comparison."""

    thin: list[ElevationStrip]
    keyframes: Keyframes
    ties: list[KeyframeFix]
    textures: TextureStore
    width_m: float
    cell_m: float
    config: SurveyConfig
    floor: Grid | None
    progress: Progress
    memory: ComparisonMemory | None


@dataclass(frozen=True, slots=True)
class _State:
    """What the rounds so far brought; `pool` are the registrations of all of them, `found` of the last."""

    solution: Solution
    rounds: tuple[Round, ...] = ()
    found: tuple[Registration, ...] = ()
    pool: tuple[tuple[Window, Link], ...] = ()
    links: tuple[Link, ...] = ()
    steps: tuple[HeightStep, ...] = ()


def correct_survey(
    strips: Sequence[ElevationStrip],
    fixes: Sequence[PositionFix] = (),
    config: SurveyConfig | None = None,
    progress: Progress = silent,
    floor: Grid | None = None,
    known: CorrectedSurvey | None = None,
    memory: ComparisonMemory | None = None,
) -> CorrectedSurvey:
    """Correct the tracks of a survey by what its passes saw twice and by absolute fixes.

    The strips' positions are taken as dead reckoning of unknown start: differences are the odometry.
    Without fixes the start is held to `GraphConfig.start_m`.

    Parameters
    ----------
    floor : a map of the ground, from an earlier round of mapping, that tells where echoes came from; default
        what the strips' own soundings say of it.
    known : what an earlier call made of the same strips; then only the last, smallest squares are compared
        anew.
    memory : of the comparisons of earlier calls, on fewer passes of the same survey. Those that hold still are not
        made again; it keeps those that are made.

    Raises
    ------
    InputError
        No strip, or strips in different coordinate systems.
    """
    config = config or SurveyConfig()
    check(strips)
    width_m = steady(swath_width(strips))
    keyframes = choose_keyframes(strips, config.keyframe_m or width_m / 12.0)
    ties = tie_fixes(fixes, strips, keyframes, config.graph.drift_m_per_sqrt_km)
    cell_m = config.match.cell_m or default_cell(strips)
    thin = [thinned(strip, 0.6 * cell_m) for strip in strips]
    given = _Given(
        thin, keyframes, ties, TextureStore(thin, config.match), width_m, steady(cell_m), config, floor,
        progress, memory,
    )  # fmt: skip
    state = _rounds(given, known)
    chosen = apart(state.pool)
    links = [link for _, link in chosen]
    # Without links too: where the graph refused every one, the last round's solution still names them.
    solution = solve_shared(keyframes, links, ties, config.graph, state.steps)
    return assemble(
        strips, keyframes, solution, state.found, links, [w for w, _ in chosen], ties, state.steps,
        state.rounds, config,
    )  # fmt: skip


def _rounds(given: _Given, known: CorrectedSurvey | None) -> _State:
    """Compare narrowing squares until they pay no more; of a survey that is known the last ones only."""
    config = given.config
    squares = config.squares if known is None else config.squares[-1:]
    state = _begun(given, known)
    settled_m = config.settled_m or 0.2 * given.cell_m
    for number in range(config.rounds or len(squares)):
        last = number >= len(squares) - 1
        part = squares[min(number, len(squares) - 1)]
        state = _round(given, state, part, last, known)
        for _ in range(_MORE_ROUNDS):
            before = state.rounds[-1].beyond
            if not before or not state.found:
                break
            # Nearer passes are tied now: farther ones have come within reach of a search.
            state = _round(given, state, part, last, known, again=True)
            if state.rounds[-1].beyond > 0.9 * before:
                break
        if not state.found or (number >= len(squares) and state.rounds[-1].moved_m < settled_m):
            break
    return state


def _begun(given: _Given, known: CorrectedSurvey | None) -> _State:
    """Return what is known before the first round."""
    if known is None:
        return _State(solve(given.keyframes, (), given.ties, given.config.graph))
    return _State(
        known.solution, known.diagnostics.rounds, known.registrations,
        tuple(zip(known.squares, known.links, strict=True)),
        _trusted(known.links, known.solution.link_used),
        _trusted(known.steps, known.solution.step_used),
    )  # fmt: skip


def _round(
    given: _Given,
    state: _State,
    part: float,
    last: bool,
    known: CorrectedSurvey | None,
    again: bool = False,
) -> _State:
    """Compare squares of `part` of a swath on the track so far, and solve the graph of what matched.

    Where the same width is compared `again`, what was matched and believed stands and only the rest is compared.
    """
    config, keyframes = given.config, given.keyframes
    side_m = max(part * given.width_m, least_square_m(given.cell_m))
    corrected = on_track(given.thin, keyframes, state.solution)
    every = find_overlaps(corrected, side_m)
    reached, expected = _within_reach(given, state, every)
    held = tuple(r for r in state.found if r.used) if again else ()
    windows = _worth_comparing(
        without(reached, [r.window for r in held], given.thin), state, len(keyframes), last, known
    )
    compared = given.memory.compared if given.memory else 0
    results, links = register(
        corrected, given.textures, keyframes, state.solution, windows,
        square_cell_m(side_m, given.cell_m), config.match, config.graph, config.widest_search_m,
        given.floor, given.progress, f"registering, round {len(state.rounds) + 1}",
        np.array([expected[_place(w)] for w in windows]), given.memory,
    )  # fmt: skip
    links = [*(state.links if again else ()), *links]
    steps = height_steps(corrected, keyframes, state.solution, links)
    after = solve(keyframes, links, given.ties, config.graph, steps=steps)
    used = iter(after.link_used)
    every_result = [*((r.window, r.match) for r in held), *results]
    found = tuple(
        Registration(w, m, bool(next(used)) if m.accepted else False) for w, m in every_result
    )
    moved = after.correction_m - state.solution.correction_m
    said = Round(
        floor="soundings" if given.floor is None else "map",
        square_m=side_m,
        compared=len(results),
        accepted=len(links),
        used=sum(r.used for r in found),
        beyond=len(every) - len(reached),
        evidence=float(np.mean([r.match.evidence for r in found])) if found else 0.0,
        moved_m=float(np.sqrt((moved**2).sum(axis=1).mean())),
        error_before=after.error_before,
        error_after=after.error_after,
        passes=len(given.thin),
        anew=given.memory.compared - compared if given.memory else len(results),
    )
    logger.info("round %d: %s", len(state.rounds) + 1, said)
    believed_here = zip((r.window for r in found if r.match.accepted), links, strict=True)
    kept = _trusted(tuple(believed_here), after.link_used)
    pool = state.pool[: len(state.pool) - len(held)]
    return _State(
        after, (*state.rounds, said), found, (*pool, *kept), tuple(x for _, x in kept),
        _trusted(steps, after.step_used),
    )  # fmt: skip


def _trusted(factors: Sequence[_Factor], used: BoolArray) -> tuple[_Factor, ...]:
    return tuple(x for x, ok in zip(factors, used, strict=True) if ok)


# The model of the drift is a guess: shifts are expected to be so much wider than it says.
_CAUTION = 1.5


def _within_reach(
    given: _Given, state: _State, windows: Sequence[Window]
) -> tuple[tuple[Window, ...], dict[tuple[int, int, float, float], FloatArray]]:
    """Return the windows whose true shift the widest search holds, and the shift's covariance beforehand.

    A search that the truth may lie outside of finds something else. Those windows wait for a later round, when
    registrations of nearer passes have narrowed what is expected. Of passes that no navigation joins, or one that
    jumps, the graph expects nothing, though most begin with a fix of their own: they are searched as far as
    the search goes.
    """
    pairs = np.array([ends_of(given.keyframes, w) for w in windows], np.int64).reshape(-1, 2)
    relative = relative_covariance(state.solution, pairs)
    expected = _CAUTION**2 * relative + LEAST_SHIFT_M**2 * np.eye(2)
    unknown = ~np.isfinite(expected).all(axis=(1, 2))
    expected[unknown] = given.config.widest_search_m**2 * np.eye(2)
    joined = np.isfinite(given.keyframes.way_m) & ~(given.keyframes.jump_m > 0)
    dive = np.cumsum(~joined)
    separate = dive[pairs[:, 0]] != dive[pairs[:, 1]]
    narrow = 2.0 * np.sqrt(np.linalg.eigvalsh(expected)[:, -1]) <= given.config.widest_search_m
    reached = narrow | separate | unknown
    return _trusted(windows, reached), {
        _place(w): covariance for w, covariance in zip(windows, expected, strict=True)
    }


def _worth_comparing(
    windows: Sequence[Window],
    state: _State,
    keyframes: int,
    last: bool,
    known: CorrectedSurvey | None,
) -> list[Window]:
    """Return the windows to compare: fewer where they only narrow the next round's search."""
    if known is None:
        before = [(r.window, r.match) for r in state.found]
        return enough(windows, keyframes // (2 if last else 4), before)
    # The same squares as before, whose likeness is weighed against these (`gain_in_likeness`).
    places = {_place(r.window) for r in known.registrations}
    same = [w for w in windows if _place(w) in places]
    return same or enough(windows, keyframes // 2)


def _place(window: Window) -> tuple[int, int, float, float]:
    return window.first, window.second, window.easting_m, window.northing_m


def tie_to_map(
    strips: Sequence[ElevationStrip],
    corrected: CorrectedSurvey,
    draft: Grid,
    prior: Grid,
    config: SurveyConfig | None = None,
) -> CorrectedSurvey:
    """Return a corrected survey tied in the plane to a map that was there before.

    Parameters
    ----------
    strips : as navigated; `corrected` is what was made of them, `draft` its map.
    prior : the map to tie to. Where it shares no features with the draft the survey stays as it is.
    """
    config = config or SurveyConfig()
    keyframes, before = corrected.keyframes, corrected.solution
    side_m = 0.5 * swath_width(strips)
    ties = ties_to_prior(draft, prior, keyframes, before, config.graph, side_m)
    said = replace(corrected.diagnostics, prior_compared=ties.compared)
    if not ties.fixes:
        return replace(corrected, diagnostics=said)
    every = (*corrected.ties, *ties.fixes)
    solution = solve_shared(keyframes, corrected.links, every, config.graph, corrected.steps)
    shift_m = (solution.correction_m - before.correction_m).mean(axis=0)
    tied = assemble(
        strips, keyframes, solution, corrected.registrations, corrected.links, corrected.squares, every,
        corrected.steps, said.rounds, config,
    )  # fmt: skip
    own = len(corrected.ties)
    return replace(
        tied,
        diagnostics=replace(
            tied.diagnostics,
            fixes_used=int(solution.fix_used[:own].sum()),
            fixes_refused=int((~solution.fix_used[:own]).sum()),
            prior_compared=ties.compared,
            prior_used=int(solution.fix_used[own:].sum()),
            prior_shift_m=(float(shift_m[0]), float(shift_m[1])),
        ),
    )


def gain_in_likeness(before: CorrectedSurvey, after: CorrectedSurvey) -> float:
    """Return by what part the passes agree better in the second result than in the first.

    The evidence of a comparison is the log-likelihood ratio of what the two passes saw, given where each is
    thought to have looked: a better floor and track bring more of it, and nothing else enters, so that
    the figure knows no truth and cannot be pleased by a stiffer graph. Both must have compared squares
    of one width. Negative where fewer registrations are believed.
    """
    if not before.diagnostics.rounds or not after.diagnostics.rounds:
        return 0.0
    old, new = before.diagnostics.rounds[-1], after.diagnostics.rounds[-1]
    if old.evidence <= 0 or new.used < 0.9 * old.used:
        return -1.0
    return new.evidence / old.evidence - 1.0


def assemble(
    strips: Sequence[ElevationStrip],
    keyframes: Keyframes,
    solution: Solution,
    found: Sequence[Registration],
    links: Sequence[Link],
    squares: Sequence[Window],
    ties: Sequence[KeyframeFix],
    steps: Sequence[HeightStep],
    rounds: Sequence[Round],
    config: SurveyConfig,
) -> CorrectedSurvey:
    """Put a solved graph into the survey's own terms: strips on their track, poses with covariance."""
    corrected = on_track(strips, keyframes, solution)
    covariances = []
    for index, strip in enumerate(strips):
        between = config.graph.walk_m2_per_m * bridge(strip, index, keyframes)
        covariance = at_lines(strip, index, keyframes, solution.covariance_m2)
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
        steps=tuple(steps),
        squares=tuple(squares),
    )
