"""The rounds of a survey's correction: squares compared on the track so far, the graph of what matched solved."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapping.comparison_memory import ComparisonMemory
from mapping.crossings import height_steps
from mapping.keyframes import KeyframeFix, Keyframes
from mapping.link_choice import enough, without
from mapping.overlaps import Window, find_overlaps
from mapping.placing import on_track
from mapping.pose_graph import HeightStep, Link, Solution, trusted
from mapping.pose_graph_relative import relative_covariance
from mapping.pose_graph_solve import solve
from mapping.rounds import Registration, TextureStore, ends_of, register
from mapping.survey_check import least_square_m, square_cell_m
from mapping.survey_records import CorrectedSurvey, Round, SurveyConfig
from perception.records import ElevationStrip, FloatArray, Grid, Progress

logger = logging.getLogger(__name__)

# Rounds of one square's width beyond the first, where passes come within reach one after the other.
_MORE_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Given:
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
class State:
    """What the rounds so far brought; `pool` are the registrations of all of them, `found` of the last."""

    solution: Solution
    rounds: tuple[Round, ...] = ()
    found: tuple[Registration, ...] = ()
    pool: tuple[tuple[Window, Link], ...] = ()
    links: tuple[Link, ...] = ()
    steps: tuple[HeightStep, ...] = ()


def compare_rounds(given: Given, known: CorrectedSurvey | None) -> State:
    """Compare narrowing squares until they pay no more; of a survey that is known the last ones only."""
    config = given.config
    squares = config.squares if known is None else config.squares[-1:]
    state = _begun(given, known)
    settled_m = config.settled_m or 0.2 * given.cell_m
    rounds = config.rounds or len(squares)
    for number in range(rounds):
        last = number >= len(squares) - 1
        part = squares[min(number, len(squares) - 1)]
        if 0 < number < min(rounds, len(squares)) - 2 and _needless(
            given, state, squares[number + 1]
        ):
            continue
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


def _begun(given: Given, known: CorrectedSurvey | None) -> State:
    """Return what is known before the first round."""
    if known is None:
        return State(solve(given.keyframes, (), given.ties, given.config.graph))
    return State(
        known.solution, known.diagnostics.rounds, known.registrations,
        tuple(zip(known.squares, known.links, strict=True)),
        trusted(known.links, known.solution.link_used),
        trusted(known.steps, known.solution.step_used),
    )  # fmt: skip


def _round(
    given: Given,
    state: State,
    part: float,
    last: bool,
    known: CorrectedSurvey | None,
    again: bool = False,
) -> State:
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
        compared=len(found),
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
    kept = trusted(tuple(believed_here), after.link_used)
    pool = state.pool[: len(state.pool) - len(held)]
    return State(
        after, (*state.rounds, said), found, (*pool, *kept), tuple(x for _, x in kept),
        trusted(steps, after.step_used),
    )  # fmt: skip


# Surveys of more keyframes save the time of a round that they do not need.
_MANY_KEYFRAMES = 2000


def _needless(given: Given, state: State, next_part: float) -> bool:
    """Return whether the squares of the next width can be mistaken no more than these.

    Nine in ten need not be searched farther than a quarter of their width. The last but one width is never
    needless: without it a large survey ended twice as far off (1.7 m for 0.9 m).
    """
    if len(given.keyframes) <= _MANY_KEYFRAMES or not state.found:
        return False
    pairs = np.array([ends_of(given.keyframes, r.window) for r in state.found], np.int64)
    relative = relative_covariance(state.solution, pairs)
    search_m = 3.0 * _CAUTION * np.sqrt(np.linalg.eigvalsh(relative)[:, -1])
    return bool(np.percentile(search_m, 90) <= 0.25 * next_part * given.width_m)


# The model of the drift is a guess: shifts are expected to be so much wider than it says.
_CAUTION = 1.5
# What is expected of any shift beneath what the graph can know, 1-sigma an axis: beams, rocking, the floor that
# places echoes.
_LEAST_SHIFT_M = 0.5


def _within_reach(
    given: Given, state: State, windows: Sequence[Window]
) -> tuple[tuple[Window, ...], dict[tuple[int, int, float, float], FloatArray]]:
    """Return the windows whose true shift the widest search holds, and the shift's covariance beforehand.

    A search that the truth may lie outside of finds something else. Those windows wait for a later round, when
    registrations of nearer passes have narrowed what is expected. Of passes that no navigation joins, or one that
    jumps, the graph expects nothing, though most begin with a fix of their own: they are searched as far as
    the search goes.
    """
    pairs = np.array([ends_of(given.keyframes, w) for w in windows], np.int64).reshape(-1, 2)
    relative = relative_covariance(state.solution, pairs)
    expected = _CAUTION**2 * relative + _LEAST_SHIFT_M**2 * np.eye(2)
    unknown = ~np.isfinite(expected).all(axis=(1, 2))
    expected[unknown] = given.config.widest_search_m**2 * np.eye(2)
    joined = np.isfinite(given.keyframes.way_m) & ~(given.keyframes.jump_m > 0)
    dive = np.cumsum(~joined)
    separate = dive[pairs[:, 0]] != dive[pairs[:, 1]]
    narrow = 2.0 * np.sqrt(np.linalg.eigvalsh(expected)[:, -1]) <= given.config.widest_search_m
    reached = narrow | separate | unknown
    return trusted(windows, reached), {
        _place(w): covariance for w, covariance in zip(windows, expected, strict=True)
    }


def _worth_comparing(
    windows: Sequence[Window],
    state: State,
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
