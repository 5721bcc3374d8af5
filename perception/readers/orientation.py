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
    judged = [
        (level, fraction)
        for level, fraction in zip(map(_block_levels, rows), hint_fraction, strict=True)
        if level is not None
    ]
    if not judged:
        return 0.0
    levels = np.array([level for level, _ in judged])
    gains = _rises(levels).max(axis=1) - _rises(levels[:, ::-1]).max(axis=1)
    evidence = float(np.median(gains))
    agreeing = float(np.mean(np.sign(gains) == np.sign(evidence)))
    if abs(evidence) >= _SURE and agreeing >= 0.7:
        return evidence
    hinted = [
        _step_at(level, round(fraction * _BLOCKS))
        - _step_at(level[::-1], round(fraction * _BLOCKS))
        for level, fraction in judged
        if np.isfinite(fraction) and 0.02 < fraction < 0.9
    ]
    by_hint = float(np.median(hinted)) if hinted else 0.0
    return by_hint if abs(by_hint) >= _SURE else 0.0


def first_return_fractions(rows: Iterable[FloatArray]) -> FloatArray:
    """Return where each row (near to far) steps from quiet to loud, as a share of its length.

    A crude first return, for telling whether an altitude field can be true; NaN where no step shows.
    """
    levels = [_block_levels(row) for row in rows]
    out = np.full(len(levels), np.nan)
    known = [i for i, level in enumerate(levels) if level is not None]
    if known:
        rises = _rises(np.array([levels[i] for i in known]), after=2)
        step = rises.max(axis=1)
        # The first rise that is most of the greatest: speckle puts the greatest some blocks later.
        at = (rises > 0.6 * step[:, None]).argmax(axis=1) + _SKIP + 2.0
        out[known] = np.where(step > _SURE, at / _BLOCKS, np.nan)
    return out


def _block_levels(row: FloatArray) -> FloatArray | None:
    """Return the log of the row's block means (128,); None where the row holds no echo."""
    row = np.where(np.isfinite(row), np.abs(row), 0.0).astype(float)
    mean = row.mean() if len(row) >= _BLOCKS // 4 else 0.0
    if mean <= 0:
        return None
    edges = np.linspace(0, len(row), min(_BLOCKS, len(row)) + 1).astype(np.int64)
    blocks = np.add.reduceat(row, edges[:-1]) / np.diff(edges)
    if len(blocks) < _BLOCKS:
        blocks = np.interp(np.linspace(0, 1, _BLOCKS), np.linspace(0, 1, len(blocks)), blocks)
    # A floor of a thousandth of the mean keeps noiseless water columns (exact zeros) finite.
    return np.asarray(np.log(blocks + 1e-3 * mean))


def _rises(levels: FloatArray, after: int = _AFTER) -> FloatArray:
    """Return the rise (n, candidates) from the upper quartile of all before to the mean just after."""
    rises = np.empty((len(levels), _DEEPEST - _SKIP - 2))
    for column, at in enumerate(range(_SKIP + 2, _DEEPEST)):
        rank = (at - _SKIP) * 3 // 4
        before = np.partition(levels[:, _SKIP:at], rank, axis=1)[:, rank]
        rises[:, column] = levels[:, at : at + after].mean(axis=1) - before
    return rises


def _step_at(level: FloatArray, at: int) -> float:
    """Return the rise at a block from a little before to a little after."""
    before = level[max(at - 2 * _AFTER, _SKIP) : max(at - 1, _SKIP + 1)]
    return float(level[at : at + 2 * _AFTER].mean() - before.mean())
