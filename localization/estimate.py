"""What a navigator tells at each row."""

from __future__ import annotations

from dataclasses import dataclass

from perception.records import FloatArray

# Words of the contract's `status`.
CONVERGED, SEARCHING, RECKONING, LOST = "converged", "searching", "dead-reckoning", "lost"


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the vehicle is, by all measurements up to this one.

    `covariance_m2` (2, 2) is of easting and northing; `state` (5,) is offset east, offset north,
    heading bias, scale, depth bias, and `state_covariance` theirs; `reason` tells what changed;
    `afresh` that the state does not follow from the row before: another place was taken up.
    """

    time_s: float
    easting_m: float
    northing_m: float
    covariance_m2: FloatArray
    status: str
    protection_m: float
    state: FloatArray
    state_covariance: FloatArray
    reason: str = ""
    afresh: bool = False
