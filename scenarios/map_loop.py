"""The loop between map and track: a draft of the map tells where echoes came from, and the passes are matched anew."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from mapping.compare import same_frame
from mapping.fixes import PositionFix
from mapping.fusion import default_cell, fuse
from mapping.survey import correct_survey, gain_in_likeness, tie_to_map
from mapping.survey_records import CorrectedSurvey
from perception.records import ElevationStrip, Grid, Progress, silent

if TYPE_CHECKING:
    from perception.inversion import Look

logger = logging.getLogger(__name__)

_MOST_ROUNDS = 2
# Parts of the evidence: what is less than the first is noise of the comparison itself, and a round that brings
# less than the second does not pay for another draft.
_NOISE, _PAYS = 0.02, 0.30


def refine_on_map(
    strips: Sequence[ElevationStrip],
    corrected: CorrectedSurvey,
    looks: Callable[[CorrectedSurvey], Sequence[Look]],
    fixes: Sequence[PositionFix] = (),
    crs: str | None = None,
    progress: Progress = silent,
) -> CorrectedSurvey:
    """Return the survey matched anew on drafts of its own map, as long as the passes agree better for it.

    A strip places echoes on the floor that the soundings suggest, which between tracks errs by a good part of the
    relief; the joint inversion knows better where it is right. Whether it is, the passes tell
    (`mapping.survey.gain_in_likeness`): a round that they do not agree better in is thrown away, and one in
    which they hardly do is the last.

    Parameters
    ----------
    strips : as navigated.
    looks : makes the inversion's looks of a corrected survey.
    """
    rounds = corrected.diagnostics.rounds
    if not rounds or rounds[-1].used < 3:
        return corrected
    for _ in range(_MOST_ROUNDS):
        draft = draft_map(strips, looks(corrected), crs, progress)
        again = correct_survey(strips, fixes, progress=progress, floor=draft, known=corrected)
        gain = gain_in_likeness(corrected, again)
        logger.info("matched anew on the map: evidence %+.0f %%", 100 * gain)
        if gain > _NOISE:
            corrected = again
        if gain < _PAYS:
            break
    return corrected


def draft_map(
    strips: Sequence[ElevationStrip],
    looks: Sequence[Look],
    crs: str | None = None,
    progress: Progress = silent,
) -> Grid:
    """Return a map on cells coarse enough to be had in a fraction of the final one's time."""
    from perception.inversion import InversionConfig, invert

    altitude_m = float(np.nanmedian(np.concatenate([strip.altitude_m for strip in strips])))
    # Relief misplaces echoes by its mean over squares of tens of metres: fine cells are not needed.
    cell_m = max(2.0 * default_cell(strips), altitude_m / 6.0)
    # Its sigma serves as a mean over squares, and the last steps move it by centimetres.
    quick = InversionConfig(iterations=4, samples=3)
    return invert(looks, cell_m, quick, crs, progress).grid


def check_prior(prior: Grid | None, crs: str, datum: str) -> None:
    """Refuse a prior map that a survey's map cannot be compared with, before any work is done.

    Parameters
    ----------
    prior : None is no prior map.
    crs, datum : of the survey; empty where it tells none, which fits any.

    Raises
    ------
    InputError
        The prior map is in another coordinate system or datum.
    """
    if prior is not None:
        same_frame(Grid(np.zeros((1, 1)), 0.0, 1.0, 1.0, crs, datum=datum), prior)


def tied_to_prior(
    strips: Sequence[ElevationStrip],
    corrected: CorrectedSurvey,
    looks: Callable[[CorrectedSurvey], Sequence[Look]] | None,
    prior: Grid,
    crs: str | None = None,
    progress: Progress = silent,
) -> CorrectedSurvey:
    """Return the survey tied in the plane to a prior map, by a draft of its own.

    Parameters
    ----------
    looks : as for `refine_on_map`; None takes the strips' own heights for the draft.

    Raises
    ------
    InputError
        The prior map is in another coordinate system or datum.
    """
    if looks is None:
        draft = fuse(corrected.strips, crs=crs, trajectory=corrected.trajectory)
    else:
        draft = draft_map(strips, looks(corrected), crs, progress)
    same_frame(draft, prior)
    return tie_to_map(strips, corrected, draft, prior)
