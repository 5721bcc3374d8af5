"""A survey that grows while it is sailed: a pass arrives, what it moves is matched anew, and the track is updated.

A registration of two passes depends on where they were thought to lie when they were compared, and every pass moves the
earlier ones. So each arrival goes through the batch's own rounds, where comparisons that hold still are remembered
(`comparison_memory`) and only those that have moved are made again, of old passes too; graduated non-convexity
doubts all registrations together, and iSAM2 takes in and out what has changed. The end is the batch's.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapping.comparison_memory import QUICK, SETTLED, ComparisonMemory
from mapping.fixes import PositionFix
from mapping.pose_graph import Solution, trusted
from mapping.pose_graph_incremental import IncrementalGraph
from mapping.pose_graph_solve import with_range_scale
from mapping.survey import assemble, correct_survey
from mapping.survey_check import check
from mapping.survey_records import CorrectedSurvey, Round, SurveyConfig
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
    survey = IncrementalSurvey(config)
    for number, (strip, given) in enumerate(zip(strips, own, strict=True), start=1):
        so_far = survey.add_pass(strip, given, progress, settle=number == len(strips))
        used = sum(r.used for r in so_far.registrations)
        logger.info("pass %d: %d of %d registrations", number, used, len(so_far.registrations))
    return so_far


class IncrementalSurvey:
    """Strips in, one after the other; the corrected survey so far out.

    Parameters
    ----------
    config : as for `correct_survey`.
    """

    def __init__(self, config: SurveyConfig | None = None) -> None:
        self._config = config or SurveyConfig()
        self._strips: list[ElevationStrip] = []
        self._fixes: list[PositionFix] = []
        self._memory = ComparisonMemory()
        self._graph: IncrementalGraph | None = None
        self._rounds: tuple[Round, ...] = ()

    def add_pass(
        self,
        strip: ElevationStrip,
        fixes: Sequence[PositionFix] = (),
        progress: Progress = silent,
        settle: bool = False,
    ) -> CorrectedSurvey:
        """Add a pass, and the fixes that belong to it; return the survey so far.

        Parameters
        ----------
        settle : whether to end where the batch ends. Else what has moved by less than `QUICK` sigmas of its match is left
            as it was, which costs less and leaves the track within about 0.3 of its sigma of the batch's.

        Raises
        ------
        InputError
            The pass cannot be of one survey with the earlier ones.
        """
        strips, given = [*self._strips, strip], [*self._fixes, *fixes]
        self._memory.tolerance = SETTLED if settle else QUICK
        survey = correct_survey(
            strips, given, self._config, _of_pass(progress, len(strips)), memory=self._memory
        )
        self._strips, self._fixes = strips, given
        self._rounds = (*self._rounds, *survey.diagnostics.rounds)
        return assemble(
            strips, survey.keyframes, self._updated(survey), survey.registrations, survey.links,
            survey.squares, survey.ties, survey.steps, self._rounds, self._config,
        )  # fmt: skip

    def _updated(self, survey: CorrectedSurvey) -> Solution:
        """Return the survey's solution, from iSAM2 updated by what has come, gone or changed."""
        batch = survey.solution
        if batch.indeterminate:
            return batch
        absolute = bool(survey.ties)
        if self._graph is None or not self._graph.goes_on(survey.keyframes, batch.config, absolute):
            self._graph = IncrementalGraph(batch.config, absolute)
        self._graph.add_passes(survey.keyframes)
        self._graph.hold(
            trusted(survey.links, batch.link_used),
            trusted(survey.ties, batch.fix_used),
            trusted(survey.steps, batch.step_used),
        )
        found = self._graph.solution()
        updated = replace(
            batch,
            correction_m=found.correction_m,
            covariance_m2=found.covariance_m2,
            pass_errors=found.pass_errors,
            pass_sigma=found.pass_sigma,
            height_m=found.height_m,
            height_sigma_m=found.height_sigma_m,
        )
        return with_range_scale(updated, survey.keyframes, survey.links, survey.ties)


def _of_pass(progress: Progress, number: int) -> Progress:
    def told(label: str, done: int, total: int) -> None:
        progress(f"pass {number}, {label}", done, total)

    return told
