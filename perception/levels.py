"""Levels: every sample nominal, highlight or shadow, by neighbours and speckle statistics together.

One look of speckle makes single samples meaningless (a tenth of a nominal floor lies 10 dB down), so the
label of a sample is the least cost over its neighbourhood: minus log likelihoods of Gamma speckle
around each level, plus a price for every change of label, summed along eight directions through the
image by dynamic programming (the aggregation of semi-global matching, Hirschmueller 2008).

Costs are held for a stretch of pings at a time. Paths run on from one stretch to the next: those that go backwards
are sent ahead once, and what they bring is kept at the stretches' ends. Labels are those of the whole image at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from perception.records import FloatArray, IntArray

NOMINAL, HIGHLIGHT, SHADOW, NO_DATA = 0, 1, -1, -2


@dataclass(frozen=True, slots=True)
class LevelConfig:
    """Settings of the segmentation.

    Attributes
    ----------
    nominal_db : texture and albedo within +- this are still nominal.
    highlight_db : a highlight's mean is at least this far up.
    shadow_db : a shadow's mean is at least this far down.
    change_cost : price of a change of label between neighbours, natural log units.
    """

    nominal_db: float = 2.5
    highlight_db: float = 5.0
    shadow_db: float = 9.0
    change_cost: float = 4.5


@dataclass(frozen=True, slots=True)
class Levels:
    """One side's labels and the statistics they were made with.

    Attributes
    ----------
    label : (n, m) int8: 0 nominal, 1 highlight, -1 shadow, -2 no data or water column.
    shadow_level : power ratio inside shadows (noise and leakage), from the data.
    looks : looks of the speckle; `independent` the part of samples that are independent
        (a pulse longer than a sample repeats itself).
    """

    label: IntArray
    shadow_level: float
    looks: float
    independent: float


def segment_levels(ratio: FloatArray, looks: float, config: LevelConfig | None = None) -> Levels:
    """Label every sample of one side.

    Parameters
    ----------
    ratio : (n, m) equalised power, 1 where nominal; NaN no data.
    looks : effective looks of the speckle.

    Returns
    -------
    Levels
        Without a single sample of data every label is -2.
    """
    config = config or LevelConfig()
    ratio = np.ascontiguousarray(ratio, dtype=np.float32)
    if not np.isfinite(ratio).any():
        return Levels(np.full(ratio.shape, NO_DATA, np.int8), 0.05, looks, 1.0)
    independent = independent_part(ratio)
    weight = np.float32(np.clip(looks, 0.5, 20) * independent)
    shadow_top = np.float32(10 ** (-config.shadow_db / 10))
    bounds = np.array(
        [shadow_top, 10 ** (-config.nominal_db / 10), 10 ** (config.nominal_db / 10),
         10 ** (config.highlight_db / 10)], np.float32,
    )  # fmt: skip
    label = _label(ratio, bounds, weight, np.float32(config.change_cost))
    dark = ratio[label == SHADOW]
    level = float(np.clip(dark.mean(), 1e-3, shadow_top)) if len(dark) > 100 else 0.05
    return Levels(label, level, looks, independent)


# Samples whose costs are held at once: 24 bytes each.
_STRETCH = 2_000_000


def _label(
    ratio: FloatArray, bounds: FloatArray, weight: np.float32, change_cost: np.float32
) -> IntArray:
    """Return the label (n, m) of least cost over eight directions."""
    n, m = ratio.shape
    count = max(1, -(-n * m // _STRETCH))
    stretches = [slice(n * k // count, n * (k + 1) // count) for k in range(count)]
    # What the backward paths bring to a stretch's last ping, and the forward ones to its first.
    behind = [np.zeros((4, m, 3), np.float32) for _ in stretches]
    for k in range(count - 1, 0, -1):
        cost = _unary(ratio[stretches[k]], bounds, weight)
        behind[k - 1][:] = behind[k]
        _sweep(cost, change_cost, -1, behind[k - 1], np.empty((0, m, 3), np.float32))
    ahead = np.zeros((4, m, 3), np.float32)
    label = np.empty((n, m), np.int8)
    for rows, back in zip(stretches, behind, strict=True):
        cost = _unary(ratio[rows], bounds, weight)
        total = np.zeros_like(cost)
        _sweep(cost, change_cost, 1, ahead, total)
        _sweep(cost, change_cost, -1, back, total)
        label[rows] = _decide(total, ratio[rows])
    return label


def independent_part(ratio: FloatArray) -> float:
    """Return the part of samples along a ping that are independent, 1 where the speckle is white.

    From the correlation of log power between neighbours: ``1 / (1 + 2 sum rho_k)`` while rho > 0.1.
    """
    n, m = ratio.shape
    part = ratio[:: max(1, n // 60)]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_ratio = np.log(np.maximum(part, 1e-6))
    # Differences at lag 12 hold the floor's slow texture: only what is faster counts as speckle.
    far = 12
    if m <= 2 * far:
        return 1.0
    whole = np.nanmedian(np.abs(log_ratio[:, far:] - log_ratio[:, :-far]))
    if not np.isfinite(whole) or whole <= 0:
        return 1.0
    total = 0.0
    for lag in range(1, far):
        step = np.nanmedian(np.abs(log_ratio[:, lag:] - log_ratio[:, :-lag]))
        rho = 1 - (step / whole) ** 2
        if rho < 0.1:
            break
        total += rho
    return float(1 / (1 + 2 * total))


@njit(cache=True, nogil=True)
def _unary(ratio, bounds, weight):  # type: ignore[no-untyped-def]
    """Return minus log likelihood (n, m, 3) of shadow, nominal, highlight, limited, times `weight`.

    Each class may have any mean within its bounds; the best one for the sample is taken (a generalised
    likelihood), so a very bright highlight or a very dark shadow costs nothing extra.
    """
    n, m = ratio.shape
    out = np.zeros((n, m, 3), dtype=np.float32)
    limit = np.float32(6.0)
    for i in range(n):
        for k in range(m):
            e = ratio[i, k]
            if np.isnan(e):
                continue
            e = max(e, np.float32(1e-4))
            # Costs relative to the sample's own best mean, -> 0 within a class's bounds.
            base = 1 + np.log(e)
            shadow = np.float32(0.0)
            if e > bounds[0]:
                shadow = e / bounds[0] + np.log(bounds[0]) - base
            mean = min(max(e, bounds[1]), bounds[2])
            nominal = e / mean + np.log(mean) - base
            highlight = np.float32(0.0)
            if e < bounds[3]:
                highlight = e / bounds[3] + np.log(bounds[3]) - base
            out[i, k, 0] = min(weight * shadow, limit)
            out[i, k, 1] = min(weight * nominal, limit)
            out[i, k, 2] = min(weight * highlight, limit)
    return out


@njit(cache=True, nogil=True)
def _sweep(cost, change_cost, step, previous, total):  # type: ignore[no-untyped-def]
    """Add the least path costs arriving at every sample (n, m, 3) from four directions to `total`, if it has room.

    The sweep runs forward (`step` 1) or backward (-1); a second one the other way makes eight directions.
    `previous` (4, m, 3) is what paths bring along from the ping before the first, and then from the last.
    """
    n, m, classes = cost.shape
    adds = len(total) > 0
    current = np.zeros((4, m, classes), dtype=np.float32)
    for ii in range(n):
        i = ii if step == 1 else n - 1 - ii
        for kk in range(m):
            k = kk if step == 1 else m - 1 - kk
            for d in range(4):
                # Arrive from: the sample before, the ping before, and its two diagonals.
                at = k - step if d == 0 else (k if d == 1 else (k - step if d == 2 else k + step))
                if at < 0 or at >= m:
                    for c in range(classes):
                        current[d, k, c] = cost[i, k, c]
                        if adds:
                            total[i, k, c] += cost[i, k, c]
                    continue
                row = current if d == 0 else previous
                least = min(row[d, at, 0], min(row[d, at, 1], row[d, at, 2]))
                for c in range(classes):
                    value = cost[i, k, c] + min(row[d, at, c], least + change_cost) - least
                    current[d, k, c] = value
                    if adds:
                        total[i, k, c] += value
        previous[:] = current


@njit(cache=True, nogil=True)
def _decide(total, ratio):  # type: ignore[no-untyped-def]
    """Return the label (n, m) of least total cost; -2 without data."""
    n, m, _ = total.shape
    label = np.zeros((n, m), dtype=np.int8)
    for i in range(n):
        for k in range(m):
            if np.isnan(ratio[i, k]):
                label[i, k] = -2
            elif total[i, k, 0] < total[i, k, 1] and total[i, k, 0] < total[i, k, 2]:
                label[i, k] = -1
            elif total[i, k, 2] < total[i, k, 1]:
                label[i, k] = 1
    return label
