"""Objects told from the floor's own relief: the probability that a shadow is cast by something standing on it.

The founding paper separates objects from background. Rough ground casts shadows too, and slopes that face
away pass for them; two things tell them apart. The height that the shadow proves is compared with the
heights that the floor itself has over the footprint's size (the variogram of the soundings), and the
shadow's level with that of ground which is merely turned away.
"""

from __future__ import annotations

import numpy as np

from perception.contours import Roughness

# Slopes that face away are a tenth as bright as flat floor, rarely less; ground without sound is far darker.
_TURNED_AWAY = 0.08
# Darker than this is the recorder's own noise and says nothing more.
_DARKEST = 0.02
# Height over relief at which a shadow as dark as turned-away ground is as likely an object's as not. One
# standard deviation is common, and a swath has room for hundreds of bumps of a footprint's size.
_EVEN = 7.0
# Odds grow with this power of either ratio; on simulated relief, boulders and pits 2.3 to 2.8.
_POWER = 2.5


def object_probability(
    proved_m: float, half_size_m: float, darkness: float, roughness: Roughness | None
) -> float:
    """Return the probability (0 to 1) that a shadow is an object's or a crater's and not the relief's.

    ``odds = (z / 7 * 0.08 / darkness) ^ 2.5`` with ``z = proved / sqrt(variogram(half size))``.

    Parameters
    ----------
    proved_m : height that the shadow's length proves, by the plain relation.
    half_size_m : the larger half size of the footprint.
    darkness : mean power over nominal inside the shadow.
    roughness : of the floor; None takes a floor without relief.
    """
    if roughness is None:
        return 1.0
    relief_m = float(np.sqrt(roughness.variogram(np.array(half_size_m))))
    stands = proved_m / max(relief_m, 1e-6) / _EVEN
    dark = _TURNED_AWAY / min(max(darkness, _DARKEST), 1.0)
    odds = (stands * dark) ** _POWER
    return float(odds / (1 + odds))
