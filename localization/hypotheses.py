"""What no file tells of map, ranges and dead reckoning, listed as hypotheses for the Kalman bank.

A stated 1-sigma leaves open over what distance the map's error is alike, and that decides how much a
run of soundings tells: over 8 m an error averages out along the track, over 150 m it is a bias, and
in between it passes for terrain. The spectrum of the map gives the white part (`maperror`); of the
rest only the size is known. So the bank holds lengths from a little above the cell to the width of a
survey's swaths, all alike in prior, and the soundings weigh them. What the soundings cannot decide
stays open, and the mixture's covariance says so.
"""

from __future__ import annotations

from dataclasses import dataclass

from localization.terrain import TerrainMap

# Random walks of dead reckoning to choose among, m per square root of an hour, and their prior
# weights: from errors that are constant, as nav.csv's defaults have them, to a vehicle that slips or
# drifts with unmeasured currents.
_WALKS_M_SQRT_H = {0.1: 0.6, 0.7: 0.15, 4.0: 0.1, 25.0: 0.15}
# Ranges may be noisier than stated, and maps worse: these factors, with these prior weights.
_NOISIER, _NOISIER_WEIGHT = 2.0, 0.15
_WORSE, _WORSE_WEIGHT = 2.0, 0.1


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """What one filter of the bank assumes.

    Attributes
    ----------
    walk_m2_s : random walk of dead reckoning, variance per second and axis.
    reading : index of the map's reading (`TerrainMap.readings`).
    shared_m, length_m : 1-sigma of the map's error and the distance over which it falls to 1/e.
    noise_factor : range noise over the stated one.
    weight : prior weight; those of a bank need not sum to 1.
    """

    walk_m2_s: float
    reading: int
    shared_m: float
    length_m: float
    noise_factor: float
    weight: float


def hypotheses(terrain: TerrainMap, walk_m_sqrt_h: float | None) -> list[Hypothesis]:
    """List the assumptions of the bank for a map and, where it is known, a random walk."""
    walks = _WALKS_M_SQRT_H if walk_m_sqrt_h is None else {walk_m_sqrt_h: 1.0}
    usual = next(iter(walks))
    # Range noise, size of the map's error, walk, and weight: not all with all, to save time.
    kinds = [(1.0, 1.0, walk, weight) for walk, weight in walks.items()]
    kinds += [(1.0, _WORSE, usual, _WORSE_WEIGHT)]
    noisy = [(_NOISIER, 1.0, walk, _NOISIER_WEIGHT * weight) for walk, weight in walks.items()]
    out = []
    for i, reading in enumerate(terrain.readings):
        for noise, worse, walk, weight in kinds + (noisy if i == terrain.middle else []):
            of_reading = 1.0 if noise != 1.0 else reading.weight
            out.append(
                Hypothesis(
                    walk**2 / 3600.0, i, worse * reading.shared_m, reading.length_m, noise,
                    weight * of_reading,
                )
            )  # fmt: skip
    return out
