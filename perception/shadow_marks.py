"""Shadow labels joined over consecutive pings: extent, order of levels, darkness, and where one runs out of the swath."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy import ndimage

from perception.levels import SHADOW
from perception.records import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Track:
    """What the search for objects needs of the pings: all (n,), metres and radians."""

    along_m: FloatArray
    altitude_m: FloatArray
    altitude_sigma_m: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    heading_rad: FloatArray
    ping: IntArray


@dataclass(frozen=True, slots=True)
class Shadow:
    """One connected shadow: its box in the image, and start and end sample per ping.

    `start` and `end` are those of the ping's longest dark stretch. `open`: dark to the pings' last sample,
    so the shadow goes on unseen; such pings make a shadow of their own.
    """

    number: int
    row0: int
    row1: int
    col0: int
    col1: int
    start: IntArray
    end: IntArray
    cells: int
    open: bool

    @property
    def lengths(self) -> IntArray:
        return self.end - self.start

    @property
    def core(self) -> IntArray:
        """Return the rows (from `row0`) at least half as long as the longest."""
        return np.flatnonzero(self.lengths >= 0.5 * self.lengths.max())

    def peak_row(self) -> int:
        """Return the row (from `row0`) of the longest shadow, of lengths smoothed over three pings."""
        lengths = self.lengths.astype(float)
        if len(lengths) >= 3:
            lengths = np.convolve(lengths, [0.25, 0.5, 0.25], mode="same")
        return int(np.argmax(lengths))

    def along_extent(self, track: Track) -> tuple[float, float]:
        """Return the middle along the track and the half width, by moments of the lengths (metres).

        Moments, since a label's outermost pings are often a thread of speckle; a disc of radius a has
        a standard deviation of a / 2, a square of half side a has a / sqrt(3).
        """
        along = track.along_m[self.row0 : self.row1]
        weights = self.lengths.astype(float)
        y0 = float(np.average(along, weights=weights))
        spread = float(np.sqrt(np.average((along - y0) ** 2, weights=weights)))
        step = float(along[-1] - along[0]) / max(len(along) - 1, 1)
        return y0, max(1.9 * spread, 0.6 * step, 1e-2)


# A shadow that ends this near to its ping's last sample is cut off there.
_EDGE_SAMPLES = 3
# Gaps in a dark stretch below this part of the range do not end it.
_BRIDGE = 0.015


def find_shadows(
    label: IntArray, ratio: FloatArray, min_samples: int, min_pings: int, min_cells: int
) -> tuple[IntArray, list[Shadow]]:
    """Return the image of connected shadows (n, m), and those large enough to measure.

    Parameters
    ----------
    label : (n, m) levels; ratio : (n, m) equalised power, NaN past a ping's last sample.
    min_samples, min_pings, min_cells : least samples in range of the longest pings, pings, cells.
    """
    dark = label == SHADOW
    known = np.isfinite(ratio)
    last = np.where(known.any(axis=1), ratio.shape[1] - known[:, ::-1].argmax(axis=1), 0)
    tail = _tails(dark, last)
    tail[last - tail < min_samples] = ratio.shape[1]
    columns = np.arange(ratio.shape[1])
    cut = (columns >= tail[:, None]) & (columns < last[:, None])
    shadows = []
    total = 0
    marks = np.zeros(dark.shape, np.int32)
    for part, is_open in ((cut, True), (dark & ~cut, False)):
        found, count = ndimage.label(part, structure=np.ones((3, 3)))
        sizes = np.bincount(found.ravel(), minlength=count + 1)
        for number, box in enumerate(ndimage.find_objects(found), start=1):
            if sizes[number] < min_cells:
                continue
            shadow = _shadow(found, number, box, int(sizes[number]), is_open)
            shadow = replace(shadow, number=number + total)
            if (
                shadow.row1 - shadow.row0 >= min_pings
                and np.sort(shadow.lengths)[-2:].min() >= min_samples - 1
            ):
                shadows.append(shadow)
        marks += np.where(found > 0, found + total, 0).astype(np.int32)
        total += count
    return marks, shadows


def _shadow(
    marks: IntArray, number: int, box: tuple[slice, slice], cells: int, is_open: bool
) -> Shadow:
    """Return one mark's shadow, its thread-like first and last pings left off."""
    rows, columns = box
    own = marks[box] == number
    start, end = own.argmax(axis=1), own.shape[1] - own[:, ::-1].argmax(axis=1)
    if not is_open:
        start, end = _longest_runs(own, columns.start)
    lengths = end - start
    thick = np.flatnonzero(lengths > 0.1 * lengths.max())
    low, high = int(thick[0]), int(thick[-1]) + 1
    seen = own[low:high].any(axis=0).nonzero()[0] + columns.start
    return Shadow(number, rows.start + low, rows.start + high, int(seen[0]), int(seen[-1]) + 1,
                  start[low:high] + columns.start, end[low:high] + columns.start, cells, is_open)  # fmt: skip


@njit(cache=True, nogil=True)
def _tails(dark, last):  # type: ignore[no-untyped-def]
    """Return where the dark stretch begins (n,) that runs to each ping's last sample; the width where none does."""
    n, m = dark.shape
    begin = np.full(n, m, np.int64)
    for i in range(n):
        at = last[i]
        for k in range(last[i] - 1, -1, -1):
            if dark[i, k]:
                at = k
            elif at - k > max(_EDGE_SAMPLES, _BRIDGE * at):
                break
        if at < last[i]:
            begin[i] = at
    return begin


@njit(cache=True, nogil=True)
def _longest_runs(own, first):  # type: ignore[no-untyped-def]
    """Return start and end (n,) of each row's longest run of True, small gaps closed."""
    n, m = own.shape
    start, end = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i in range(n):
        begin, after = -1, -1
        for k in range(m):
            if not own[i, k]:
                continue
            if begin < 0 or k > after + 1 + _BRIDGE * (first + k):
                begin = k
            after = k + 1
            if after - begin > end[i] - start[i]:
                start[i], end[i] = begin, after
    return start, end


def order_evidence(shadow: Shadow, ratio: FloatArray, looks: float) -> float:
    """Return how surely the highlight comes before the shadow, in standard deviations (after: negative).

    The founding paper's rule (highlight then shadow is a hill, shadow then highlight a crater) on all
    pings of the shadow at once: columns of samples before its start and after its end are averaged
    over the pings, and the brighter stretch on either side is compared.
    """
    core = shadow.core
    length = int(np.median(shadow.lengths[core]))
    reach, window = max(6, int(1.2 * length)), max(2, length // 5)
    steps = np.arange(reach)
    m = ratio.shape[1]
    brightest, number = [], 0
    for edges, direction in ((shadow.start[core] - 1, -1), (shadow.end[core], 1)):
        columns = edges[:, None] + direction * steps
        inside = (columns >= 0) & (columns < m)
        values = ratio[(shadow.row0 + core)[:, None], np.clip(columns, 0, m - 1)]
        values = np.where(inside & np.isfinite(values), np.minimum(values, 8.0), 1.0)
        profile = np.convolve(values.mean(axis=0), np.full(window, 1 / window), mode="valid")
        brightest.append(float(profile.max()))
        number = len(core) * window
    spread = np.sqrt(2 / (number * min(looks, 4.0)))
    return float(np.log(brightest[0] / brightest[1]) / spread)


def darkness(shadow: Shadow, marks: IntArray, ratio: FloatArray) -> float:
    """Return the mean power over nominal inside a shadow, its ends (a fifth of the length each) left out."""
    core = shadow.core
    fifth = shadow.lengths[core] // 5
    columns = np.arange(shadow.col0, shadow.col1)
    inner = (columns >= (shadow.start[core] + fifth)[:, None]) & (
        columns < (shadow.end[core] - fifth)[:, None]
    )
    box = np.ix_(shadow.row0 + core, columns)
    inner &= (marks[box] == shadow.number) & np.isfinite(ratio[box])
    return float(ratio[box][inner].mean()) if inner.any() else 1.0
