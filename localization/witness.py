"""The witness: a search begun anew once a place is found, on later soundings alone.

The soundings that chose a place cannot prove it: over weak ground, of all places that fit by chance the
search takes the one that fits best, and a tracker that starts there never looks elsewhere again. So
the search begins again from dead reckoning with the soundings that follow. They know nothing of the
choice. If they come to the same place the chance of both being wrong together is that of one times
the other's; if they come to another, the first is given up for it.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from localization.particles import ParticleFilter
from perception.records import FloatArray

# Weight of the witness that must lie about the place to confirm it, within so many sigmas; and at most
# when the witness, narrow itself, contradicts it.
_CONFIRMS, _WITHIN, _CONTRADICTS = 0.98, 2.5, 0.02


class Opinion(Enum):
    """What later soundings say of a place."""

    OPEN = "open"
    CONFIRMS = "confirms"
    CONTRADICTS = "contradicts"


def opinion_of(
    witness: ParticleFilter, mean: FloatArray, covariance: FloatArray, narrow_m: float
) -> Opinion:
    """Compare a search begun anew with the place on probation.

    Parameters
    ----------
    mean, covariance : (5,) and (5, 5) of the place.
    narrow_m : 1-sigma of an axis at which a search counts as having found; a place within it is the
        same place.
    """
    around = covariance[:2, :2] + narrow_m**2 * np.eye(2)
    share = witness.share_within(mean, around, _WITHIN)
    if share >= _CONFIRMS:
        return Opinion.CONFIRMS
    if share <= _CONTRADICTS:
        _, spread = witness.moments()
        if float(np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1])) < narrow_m:
            return Opinion.CONTRADICTS
    return Opinion.OPEN
