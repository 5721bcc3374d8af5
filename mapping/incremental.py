"""A survey that grows while it is sailed: a pass arrives, is matched with what it overlaps, and the track is updated.

Only the new pass is registered and only what it touches is solved anew (iSAM2). The graph that results is the
batch's on the same registrations; those were made with what was known when their pass came, so a batch over all passes
at the end may differ by a part of its sigma.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapping.crossings import height_steps
from mapping.fixes import PositionFix
from mapping.keyframes import KeyframeFix, Keyframes, choose_keyframes, tie_fixes
from mapping.link_choice import apart_numbers
from mapping.overlaps import Window, find_overlaps
from mapping.placing import on_track
from mapping.pose_graph import HeightStep, Link, Solution
from mapping.pose_graph_incremental import IncrementalGraph
from mapping.pose_graph_solve import solve
from mapping.registration import Match
from mapping.rounds import Registration, TextureStore, register
from mapping.survey import CorrectedSurvey, SurveyConfig, assemble
from mapping.survey_check import check, least_square_m, square_cell_m, swath_width
from mapping.textures import default_cell, thinned
from perception.records import ElevationStrip, Progress, silent

logger = logging.getLogger(__name__)


def pass_by_pass(
    strips: Sequence[ElevationStrip],
    fixes: Sequence[PositionFix] = (),
    config: SurveyConfig | None = None,
    progress: Progress = silent,
) -> CorrectedSurvey:
    """Correct a survey as `correct_survey` does, each pass as it comes, with the fixes nearest to it in time.

    Raises
    ------
    InputError
        No strip, or strips that cannot be one survey.
    """
    check(strips)
    own: list[list[PositionFix]] = [[] for _ in strips]
    for fix in fixes:
        away_s = [
            max(float(s.time_s.min()) - fix.time_s, fix.time_s - float(s.time_s.max()), 0.0)
            for s in strips
        ]
        own[int(np.argmin(away_s))].append(fix)
    survey = IncrementalSurvey(config, fixes_to_come=any(fix.accepted for fix in fixes))
    for number, (strip, given) in enumerate(zip(strips, own, strict=True), start=1):
        so_far = survey.add_pass(strip, given, progress)
        used = sum(r.used for r in so_far.registrations)
        logger.info("pass %d: %d of %d registrations", number, used, len(so_far.registrations))
    return so_far


class IncrementalSurvey:
    """Strips in, one after the other; the corrected survey so far out.

    Parameters
    ----------
    config : as for `correct_survey`. Cells and keyframes follow the first pass where it does not say.
    fixes_to_come : whether absolute fixes will decide where the survey lies.
    """

    def __init__(self, config: SurveyConfig | None = None, fixes_to_come: bool = False) -> None:
        self._config = config or SurveyConfig()
        self._graph = IncrementalGraph(self._config.graph, fixes_to_come)
        self._strips: list[ElevationStrip] = []
        self._thin: list[ElevationStrip] = []
        self._textures = TextureStore(self._thin, self._config.match)
        self._ties: list[KeyframeFix] = []
        self._steps: list[HeightStep] = []
        # The place of each link that the graph was ever given.
        self._squares: list[Window] = []
        self._cell_m = self._keyframe_m = float("nan")

    def add_pass(
        self,
        strip: ElevationStrip,
        fixes: Sequence[PositionFix] = (),
        progress: Progress = silent,
    ) -> CorrectedSurvey:
        """Add a pass, and the fixes that belong to it; return the survey so far.

        Raises
        ------
        InputError
            The pass cannot be of one survey with the earlier ones.
        """
        check([*self._strips, strip])
        config = self._config
        if not self._strips:
            self._cell_m = config.match.cell_m or default_cell([strip])
            self._keyframe_m = config.keyframe_m or swath_width([strip]) / 12.0
        self._strips.append(strip)
        self._thin.append(thinned(strip, 0.6 * self._cell_m))
        keyframes = choose_keyframes(self._strips, self._keyframe_m)
        ties = tie_fixes(fixes, self._strips, keyframes, config.graph.drift_m_per_sqrt_km)
        self._ties += ties
        self._graph.add_pass(keyframes, ties)
        found = self._match(keyframes, progress)
        solution = self._graph.solution()
        used = iter(solution.link_used[found[2] :])
        registrations = [
            Registration(w, m, bool(next(used)) if m.accepted else False) for w, m in found[0]
        ]
        # What was taken out again is no part of the survey: wider squares, and what contradicts the rest.
        kept = np.flatnonzero(solution.link_used)
        solution = replace(solution, link_used=np.ones(len(kept), bool))
        return assemble(
            self._strips, keyframes, solution, registrations, [self._graph.links[i] for i in kept],
            [self._squares[i] for i in kept], self._ties, self._steps, (), config,
        )  # fmt: skip

    def _match(
        self, keyframes: Keyframes, progress: Progress
    ) -> tuple[list[tuple[Window, Match]], list[Link], int]:
        """Register the newest pass by narrowing squares; leave the links that know most of each piece of ground.

        Returns the last round's comparisons, its links, and the number of the first of those in the graph.
        """
        config, graph, new = self._config, self._graph, len(self._strips) - 1
        solution = graph.solution()
        results: list[tuple[Window, Match]] = []
        links: list[Link] = []
        before = 0
        # Links of all rounds that the graph did not doubt, by their number there.
        pool: list[tuple[Window, Link]] = []
        numbers: list[int] = []
        for number, part in enumerate(config.squares, start=1):
            corrected = on_track(self._thin, keyframes, solution)
            side_m = max(part * swath_width(self._strips), least_square_m(self._cell_m))
            windows = [w for w in find_overlaps(corrected, side_m) if w.second == new]
            results, links = register(
                corrected, self._textures, keyframes, solution, windows,
                square_cell_m(side_m, self._cell_m),
                config.match, config.graph, config.widest_search_m, None, progress,
                f"pass {new + 1}, round {number}",
            )  # fmt: skip
            last = number == len(config.squares)
            steps = [
                step
                for step in (height_steps(corrected, keyframes, solution, links) if last else ())
                if step.second == new
            ]
            before = len(graph.links)
            graph.add_links(links, steps)
            squares = [w for w, m in results if m.accepted]
            self._squares += squares
            self._steps += steps
            solution = self._doubted(keyframes, before)
            kept = np.flatnonzero(solution.link_used[before:])
            pool += [(squares[i], links[i]) for i in kept]
            numbers += [before + int(i) for i in kept]
            if not last:
                graph.take_out(range(before, len(graph.links)))
        chosen = set(apart_numbers(pool))
        in_graph = graph.solution().link_used[numbers]
        graph.take_out([numbers[i] for i in np.flatnonzero(in_graph) if i not in chosen])
        back = [pool[i] for i in np.flatnonzero(~in_graph) if i in chosen]
        graph.add_links([link for _, link in back], [])
        self._squares += [w for w, _ in back]
        return results, links, before

    def _doubted(self, keyframes: Keyframes, first: int) -> Solution:
        """Take out the links from `first` on that contradict the rest (GNC knows no increments)."""
        graph = self._graph
        present = graph.solution().link_used
        kept = [link for link, ok in zip(graph.links, present, strict=True) if ok]
        judged = solve(keyframes, kept, self._ties, self._config.graph, steps=self._steps)
        numbers = np.flatnonzero(present)[~judged.link_used]
        graph.take_out([int(n) for n in numbers if n >= first])
        return graph.solution()
