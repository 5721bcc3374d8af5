"""Objects told from the floor's own relief: the probability that a shadow is cast by something standing on it.

The founding paper separates objects from background. Rough ground casts shadows too, and slopes that face
away pass for them; three things tell them apart. The height that the shadow proves is compared with the
heights that the floor itself has over the footprint's size (the variogram of the soundings), the shadow's level
with that of ground which is merely turned away, and what adjoins the shadow with an object's highlight. How
common objects are differs from ground to ground, and the pass's own shadows tell it.
"""

from __future__ import annotations

import numpy as np

from perception.contours import Roughness
from perception.records import FloatArray

# Slopes that face away are a tenth as bright as flat floor, rarely less; ground without sound is far darker.
_TURNED_AWAY = 0.08
# Darker than this is the recorder's own noise and says nothing more.
_DARKEST = 0.02
# Height over relief at which a shadow as dark as turned-away ground is as likely an object's as not. One
# standard deviation is common, and a swath has room for hundreds of bumps of a footprint's size.
_EVEN = 7.0
# Odds grow with this power of either ratio; on simulated relief, boulders and pits 2.3 to 2.8.
_POWER = 2.5
# Standard deviations by which a highlight must adjoin the shadow, on one side of it, to speak for neither.
_EVEN_ORDER, _ORDER_POWER = 4.0, 0.8
# The share of objects among a pass's shadows is taken for a half, as sure as from this many shadows.
_PRIOR_SHADOWS = 10.0
_MOST_ODDS = 1e6


def object_odds(
    proved_m: float, half_size_m: float, darkness: float, order: float, roughness: Roughness | None
) -> float:
    """Return the odds that a shadow is an object's or a crater's, where half of all shadows are.

    ``(z / 7 * 0.08 / darkness) ^ 2.5 * ((1 + |order|) / 4) ^ 0.8`` with ``z = proved / sqrt(variogram(half size))``.

    Parameters
    ----------
    proved_m : height that the shadow's length proves, by the plain relation.
    half_size_m : the larger half size of the footprint.
    darkness : mean power over nominal inside the shadow.
    order : how surely a highlight comes before the shadow (after: negative), in standard deviations.
    roughness : of the floor; None takes a floor without relief.
    """
    if roughness is None:
        return _MOST_ODDS
    relief_m = float(np.sqrt(roughness.variogram(np.array(half_size_m))))
    stands = proved_m / max(relief_m, 1e-6) / _EVEN
    dark = _TURNED_AWAY / min(max(darkness, _DARKEST), 1.0)
    adjoins = (1 + abs(order)) / _EVEN_ORDER
    return float(min((stands * dark) ** _POWER * adjoins**_ORDER_POWER, _MOST_ODDS))


def probabilities(odds: FloatArray) -> FloatArray:
    """Return the probability of each of a pass's shadows (n,) to be an object's, from their `odds`.

    The share of objects among them is unknown too: it is the mean of their probabilities (a mixture's weight
    by expectation and maximisation), held towards a half. On ground that casts many doubtful shadows each is
    the less likely an object's; where most stand out, the doubtful ones gain.
    """
    odds = np.asarray(odds, float)
    share = 0.5
    for _ in range(50):
        posterior = odds * share / (1 - share)
        posterior = posterior / (1 + posterior)
        share = float(posterior.sum() + 0.5 * _PRIOR_SHADOWS) / (len(odds) + _PRIOR_SHADOWS)
    return posterior
