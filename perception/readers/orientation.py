"""Which end of a stored row is near the vehicle: decided from the echoes, not from a convention.

Recorders store port near to far or far to near and no header field says which. The echoes do: beside
the vehicle lies the water column, quiet but for the transmit pulse, and it ends in the abrupt first
return of the bottom. From the far end the level rises inward gradually. So each ping is asked, from
either end, for the greatest step from "everything so far is quiet" to "loud".
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from perception.records import FloatArray

_BLOCKS = 128  # a ping is judged by this many block means: speckle of one look averages to ~10 %
_AFTER = 6  # blocks after a candidate edge: 5 % of the range, as long as a first return is loud
_SKIP = 2  # blocks at the very end that may hold the transmit pulse or a marker
_DEEPEST = 96  # an edge is looked for in the first three quarters of the row
_SURE = 0.5  # nepers of level by which one end must beat the other


def near_end_evidence(rows: Iterable[FloatArray], hint_fraction: Iterable[float]) -> float:
    """Return the evidence, in nepers of level, that rows are stored near to far.

    Parameters
    ----------
    rows : echo amplitudes of some pings of one side, in stored order.
    hint_fraction : the altitude field over the ping's slant range; NaN unknown. It counts only
        where the rows alone do not decide, since altitude fields lie.

    Returns
    -------
    float
        Positive near to far, negative far to near, 0 undecided.
    """
    gains, hinted = [], []
    for row, fraction in zip(rows, hint_fraction, strict=True):
        level = _block_levels(np.asarray(row, float))
        if level is None:
            continue
        gains.append(_greatest_step(level) - _greatest_step(level[::-1]))
        if np.isfinite(fraction) and 0.02 < fraction < 0.9:
            at = round(fraction * _BLOCKS)
            hinted.append(_step_at(level, at) - _step_at(level[::-1], at))
    if not gains:
        return 0.0
    evidence = float(np.median(gains))
    agreeing = float(np.mean(np.sign(gains) == np.sign(evidence)))
    if abs(evidence) >= _SURE and agreeing >= 0.7:
        return evidence
    by_hint = float(np.median(hinted)) if hinted else 0.0
    return by_hint if abs(by_hint) >= _SURE else 0.0


def _block_levels(row: FloatArray) -> FloatArray | None:
    """Return the log of the row's block means; None where the row holds no echo."""
    row = np.where(np.isfinite(row), np.abs(row), 0.0)
    mean = row.mean() if len(row) >= _BLOCKS // 4 else 0.0
    if mean <= 0:
        return None
    edges = np.linspace(0, len(row), min(_BLOCKS, len(row)) + 1).astype(np.int64)
    blocks = np.add.reduceat(row, edges[:-1]) / np.diff(edges)
    if len(blocks) < _BLOCKS:
        blocks = np.interp(np.linspace(0, 1, _BLOCKS), np.linspace(0, 1, len(blocks)), blocks)
    # A floor of a thousandth of the mean keeps noiseless water columns (exact zeros) finite.
    return np.asarray(np.log(blocks + 1e-3 * mean))


def _greatest_step(level: FloatArray) -> float:
    """Return the greatest rise from the upper quartile of all before to the mean just after."""
    best = 0.0
    for at in range(_SKIP + 2, _DEEPEST):
        before = np.sort(level[_SKIP:at])[(at - _SKIP) * 3 // 4]
        best = max(best, level[at : at + _AFTER].mean() - before)
    return float(best)


def first_return_fraction(row: FloatArray) -> float:
    """Return where a row (near to far) steps from quiet to loud, as a share of its length.

    A crude first return, for telling whether an altitude field can be true; NaN where no step shows.
    """
    level = _block_levels(np.asarray(row, float))
    if level is None:
        return float("nan")
    best, where = _SURE, float("nan")
    for at in range(_SKIP + 2, _DEEPEST):
        before = np.sort(level[_SKIP:at])[(at - _SKIP) * 3 // 4]
        step = level[at : at + 2].mean() - before
        if step > best:
            best, where = step, at / _BLOCKS
    return where


def _step_at(level: FloatArray, at: int) -> float:
    before = level[max(at - 2 * _AFTER, _SKIP) : max(at - 1, _SKIP + 1)]
    return float(level[at : at + 2 * _AFTER].mean() - before.mean())
