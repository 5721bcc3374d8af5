"""The passes of a survey, one at a time: what one gives is let go before the next is read."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import TypeVar

from perception.readers import Survey
from perception.records import InputError, Progress, silent
from perception.strips import BottomFileError, PassResult, StripConfig, build_strip

logger = logging.getLogger(__name__)

T = TypeVar("T")


def each_pass(
    survey: Survey, make: Callable[[int], T], progress: Progress = silent
) -> Iterator[tuple[int, T]]:
    """Yield the number of every pass with what `make` makes of it.

    Raises
    ------
    InputError
        No pass gives anything; single ones that do not are left out with a warning.
    BottomFileError
        A bottom track from a file does not fit: no pass is left out for the file's sake.
    """
    refused: list[str] = []
    for index in range(survey.n_passes):
        progress("echoes to strips", index, survey.n_passes)
        try:
            made = make(index)
        except BottomFileError:
            raise
        except InputError as error:
            refused.append(str(error))
            logger.warning("%s; left out", error)
            continue
        yield index, made
        del made
    progress("echoes to strips", survey.n_passes, survey.n_passes)
    if len(refused) == survey.n_passes:
        raise InputError(refused[0] if refused else "the survey holds no pass to make a strip of")


def strips_of(
    survey: Survey, config: StripConfig | None = None, progress: Progress = silent
) -> Iterator[tuple[int, PassResult]]:
    """Yield the number and the strip of every pass; errors as `each_pass`."""
    return each_pass(survey, lambda index: build_strip(survey.swath(index), config), progress)
