"""Proof of a match: evidence added up, how much of it convinces, and how much refutes."""

from __future__ import annotations

import math
from dataclasses import dataclass

# Probability, before the match is tested, that the place found is a wrong one.
_DOUBT = 0.05
# Evidence is not hoarded above this, so that later failure shows soon; below minus `_REFUTED` the
# map does worse than no map. Where ground or map tell little, the evidence is a random walk about
# zero: an allowance for each update keeps that walk from reaching the bar.
_MOST_EVIDENCE, _LEAST_EVIDENCE, _REFUTED, _ALLOWANCE = 30.0, -6.0, 15.0, 0.1
# Evidence at which a proved match is believed although its innovations repeat.
_VOUCHED = 10.0
# Every search that failed is a chance more to be fooled by: the next must prove so much more, and
# for twice as many updates; up to these numbers of failures.
_DEARER, _MOST_DEARER, _MOST_DOUBLINGS = 4.0, 5, 4


@dataclass(slots=True)
class Proof:
    """Where a match stands between found and proved.

    Attributes
    ----------
    probation : updates, at least, before a match is called converged.
    bar : log of the likelihood ratio, of map against free ground, that proves a match.
    updates : that fitted since the place was found.
    evidence, against : sum of the log likelihood ratio, and its one-sided sum below zero.
    attempts : searches that failed before.
    believed : whether this match was proved once.
    """

    probation: int
    bar: float
    updates: int = 0
    evidence: float = 0.0
    against: float = 0.0
    attempts: int = 0
    believed: bool = False

    def begin(self, surprise: float) -> None:
        """Begin with a place just found, `surprise` evidence against it."""
        self.updates, self.evidence, self.against = 0, -surprise, 0.0

    def add(self, gained: float) -> None:
        """Add an update's evidence."""
        self.evidence = min(max(self.evidence + gained, _LEAST_EVIDENCE), _MOST_EVIDENCE)
        self.against = min(self.against + gained + _ALLOWANCE, 0.0)

    def fail(self) -> None:
        """Give the match up."""
        self.attempts += 1
        self.updates, self.believed = 0, False

    def convince(self) -> None:
        """Take the match for proved."""
        self.believed = True
        self.attempts = max(self.attempts - 1, 0)

    @property
    def refuted(self) -> bool:
        """Whether free ground explains the soundings far better than the map."""
        return self.against < -_REFUTED

    @property
    def vouched(self) -> bool:
        """Whether a proved match's map explains the soundings far better than memory does.

        Coloured innovations are then the map's own unmodelled error, not a wrong place.
        """
        return self.believed and self.evidence > _VOUCHED

    @property
    def holds(self) -> bool:
        """Whether the match is proved now."""
        if self.believed:
            return self.evidence > 0.0
        long = self.probation * 2 ** min(self.attempts, _MOST_DOUBLINGS)
        dear = self.bar + _DEARER * min(self.attempts, _MOST_DEARER)
        return self.updates >= long and self.evidence > dear

    @property
    def doubt(self) -> float:
        """Probability that the place is the wrong one, while it is not proved."""
        return doubt_of(self.evidence)


def doubt_of(evidence: float) -> float:
    """Probability that a place not yet proved is the wrong one; evidence against it raises that.

    Evidence for it counts once the match is proved, not before: a lucky ping is no proof.
    """
    against = math.exp(min(max(evidence, -30.0), 0.0))
    return _DOUBT / (_DOUBT + (1 - _DOUBT) * against)
