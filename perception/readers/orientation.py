"""Which end of a stored row is near the vehicle: decided from the echoes, not from a convention.

Recorders store port near to far or far to near and no header field says which. The echoes do: beside
the vehicle lies the water column, quiet but for the transmit pulse, and it ends in the abrupt first
return of the bottom. From the far end the level rises inward gradually. So each ping is asked, from
either end, for the greatest step from "everything so far is quiet" to "loud". Levels are compared by
their rank within the ping, so it does not matter whether a recorder stores amplitude, power or decibels.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from perception.records import BoolArray, FloatArray

_FINE = 512  # blocks a ping is cut into: the water column of a low flyer is 2 % of its range
_COARSE = 128  # four fine ones each: speckle of one look averages out
_AFTER = 6  # blocks after a candidate edge: as long as a first return is surely loud
_DEEPEST = 0.75  # an edge is looked for in this part of the row
_PULSE_COARSE, _PULSE_FINE = 2, 5  # blocks at the very end that may hold the transmit pulse
_SURE = 0.12  # of the ranks, by which one end must beat the other
_AGREEING = 0.7  # of the pings, that must say the same
_LEAST_SAMPLES = 32
JUDGED_TOGETHER = 10  # successive pings; callers sample a file in runs of so many


def near_end_evidence(rows: Iterable[FloatArray], hint_fraction: Iterable[float]) -> float:
    """Return the evidence, as a difference of ranks in [-1, 1], that rows are stored near to far.

    Parameters
    ----------
    rows : echo amplitudes of some pings of one side, in stored order, in runs of
        `JUDGED_TOGETHER` successive ones.
    hint_fraction : the altitude field over the ping's slant range; NaN unknown. It counts only
        where the rows alone do not decide, since altitude fields lie.

    Returns
    -------
    float
        Positive near to far, negative far to near, 0 undecided.
    """
    judged = [
        (np.asarray(row, float), fraction)
        for row, fraction in zip(rows, hint_fraction, strict=True)
        if len(row) >= _LEAST_SAMPLES and np.any(np.nan_to_num(row))
    ]
    if not judged:
        return 0.0
    cut = _padding([row for row, _ in judged])
    trimmed = [row[cut[0] : len(row) - cut[1]] for row, _ in judged]
    evidence = _decided(_gains(trimmed))
    if evidence == 0.0 and max(cut) > 0 and min(cut) == 0:
        # Blank samples at one end, and no water column at the other: they are the water column.
        return 1.0 if cut[0] else -1.0
    if evidence == 0.0:
        ranks = np.array([_ranks(row) for row, _ in judged])
        evidence = _decided(_hinted(ranks, np.array([fraction for _, fraction in judged])))
    return evidence


def first_return_fractions(rows: Iterable[FloatArray]) -> FloatArray:
    """Return where each row (near to far) steps from quiet to loud, as a share of its length.

    A crude first return, for telling whether an altitude field can be true; NaN where no step shows.
    """
    kept = [np.asarray(row, float) for row in rows]
    out = np.full(len(kept), np.nan)
    known = [i for i, r in enumerate(kept) if len(r) >= _LEAST_SAMPLES and np.any(np.nan_to_num(r))]
    if known:
        coarse = _coarse(np.array([_ranks(kept[i]) for i in known]))
        rises = _rises(coarse, _PULSE_COARSE, after=2)
        step = rises.max(axis=1)
        at = rises.argmax(axis=1) + _PULSE_COARSE + 2.0
        out[known] = np.where(step > 2 * _SURE, at / _COARSE, np.nan)
    return out


def _padding(rows: list[FloatArray]) -> tuple[int, int]:
    """Return the samples at the start and at the end that are blank (exactly zero) in all rows."""

    def blank(row: FloatArray) -> int:
        filled = np.flatnonzero(np.nan_to_num(row))
        return int(filled[0]) if len(filled) else len(row)

    ends = np.array([(blank(row), blank(row[::-1])) for row in rows])
    shortest = min(len(row) for row in rows)
    start, stop = (int(v) for v in ends.min(axis=0))
    if start + stop > shortest - _LEAST_SAMPLES:
        return 0, 0
    # A blank sample or two at an end is a marker, not padding.
    return start if start > 2 else 0, stop if stop > 2 else 0


def _gains(rows: list[FloatArray]) -> FloatArray:
    """Return how much the greatest step from the stored start beats the one from the stored end."""
    ranks = np.array([_ranks(row) for row in rows])
    return _best_step(ranks) - _best_step(ranks[:, ::-1])


def _decided(gains: FloatArray) -> float:
    gains = gains[np.isfinite(gains)]
    if len(gains) == 0:
        return 0.0
    evidence = float(np.median(gains))
    agreeing = float(np.mean(np.sign(gains) == np.sign(evidence)))
    return evidence if abs(evidence) >= _SURE and agreeing >= _AGREEING else 0.0


def _ranks(row: FloatArray) -> FloatArray:
    """Return the ranks in [0, 1] of the row's block means (`_FINE`,)."""
    row = np.where(np.isfinite(row), np.abs(row), 0.0)
    edges = np.linspace(0, len(row), min(_FINE, len(row)) + 1).astype(np.int64)
    blocks = np.add.reduceat(row, edges[:-1]) / np.diff(edges)
    # Equal levels (blank water, a saturated pulse) share their mean rank: they are no step.
    _, inverse, counts = np.unique(blocks, return_inverse=True, return_counts=True)
    ranks = ((np.cumsum(counts) - (counts + 1) / 2) / max(len(blocks) - 1, 1))[inverse]
    if len(ranks) < _FINE:
        ranks = np.interp(np.linspace(0, 1, _FINE), np.linspace(0, 1, len(ranks)), ranks)
    return np.asarray(ranks)


def _coarse(ranks: FloatArray) -> FloatArray:
    return np.asarray(ranks.reshape(len(ranks), _COARSE, -1).mean(axis=2))


def _best_step(ranks: FloatArray) -> FloatArray:
    """Return the greatest step over the whole row, or over its first quarter seen finely.

    One value for each group of successive pings: a first return stays in its place from ping to ping,
    the ends of shadows of small things do not, so the rises are averaged before the greatest is taken.
    """
    starts = np.arange(0, len(ranks), _group(len(ranks)))
    sizes = np.diff(np.append(starts, len(ranks)))[:, None]
    whole = np.add.reduceat(_rises(_coarse(ranks), _PULSE_COARSE), starts) / sizes
    close = np.add.reduceat(_rises(ranks[:, : _FINE // 4], _PULSE_FINE), starts) / sizes
    return np.asarray(np.maximum(whole.max(axis=1), close.max(axis=1)))


def _group(n: int) -> int:
    """Return the pings a group has: ten, fewer where that would leave under six groups."""
    return max(min(JUDGED_TOGETHER, n // 6), 1)


def _rises(ranks: FloatArray, skip: int, after: int = _AFTER) -> FloatArray:
    """Return the rise (n, candidates) from all before, and from just before, to just after.

    The quiet before is the greater of the upper quartile of all and the mean of the blocks right
    before: a level that swells gradually, as seen from the far end, is no step.
    """
    deepest = int(_DEEPEST * ranks.shape[1])
    rises = np.empty((len(ranks), deepest - skip - 2))
    for column, at in enumerate(range(skip + 2, deepest)):
        rank = (at - skip) * 3 // 4
        before = np.partition(ranks[:, skip:at], rank, axis=1)[:, rank]
        near = ranks[:, max(at - after, skip) : at].mean(axis=1)
        rises[:, column] = ranks[:, at : at + after].mean(axis=1) - np.maximum(before, near)
    return rises


def _hinted(ranks: FloatArray, fraction: FloatArray) -> FloatArray:
    """Return how much the step at the altitude field's place from one end beats that from the other."""
    coarse = _coarse(ranks)
    with np.errstate(invalid="ignore"):
        known: BoolArray = (fraction > 0.02) & (fraction < 0.9)
    gains = np.full(len(ranks), np.nan)
    for i in np.flatnonzero(known):
        at = round(float(fraction[i]) * _COARSE)
        gains[i] = _step_at(coarse[i], at) - _step_at(coarse[i, ::-1], at)
    return gains


def _step_at(level: FloatArray, at: int) -> float:
    """Return the rise at a block from a little before to a little after."""
    before = level[max(at - 2 * _AFTER, _PULSE_COARSE) : max(at - 1, _PULSE_COARSE + 1)]
    return float(level[at : at + 2 * _AFTER].mean() - before.mean())
