"""The survey's loop: strips of drifting passes in, strips on corrected tracks out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mapping.comparison_memory import ComparisonMemory
from mapping.fixes import PositionFix
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.link_choice import apart
from mapping.overlaps import Window
from mapping.placing import at_lines, bridge, on_track
from mapping.pose_graph import HeightStep, Link, Solution
from mapping.prior_tie import ties_to_prior
from mapping.rounds import Registration, TextureStore
from mapping.sharing import solve_shared
from mapping.survey_check import check, steady, swath_width
from mapping.survey_loop import Given, compare_rounds
from mapping.survey_records import CorrectedSurvey, Diagnostics, Round, SurveyConfig
from mapping.textures import default_cell, thinned
from perception.records import (
    ElevationStrip,
    Grid,
    Progress,
    Trajectory,
    silent,
)

logger = logging.getLogger(__name__)


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
    # What the caller asks for stands; what the data give is held steady.
    compared_m = config.match.cell_m or steady(cell_m)
    thin = [thinned(strip, 0.6 * cell_m) for strip in strips]
    given = Given(
        thin, keyframes, ties, TextureStore(thin, config.match), width_m, compared_m, config, floor,
        progress, memory,
    )  # fmt: skip
    state = compare_rounds(given, known)
    chosen = apart(state.pool)
    links = [link for _, link in chosen]
    # Without links too: where the graph refused every one, the last round's solution still names them.
    solution = solve_shared(keyframes, links, ties, config.graph, state.steps)
    return assemble(
        strips, keyframes, solution, state.found, links, [w for w, _ in chosen], ties, state.steps,
        state.rounds, config,
    )  # fmt: skip


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
