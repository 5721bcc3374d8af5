"""Gain: echo power divided by what this sonar usually hears there, so that 1 is a nominal floor.

Beam pattern, the floor's angular law, a wrong time-varying gain and a slowly varying albedo cannot be
told apart from one pass, and need not be: their product is estimated from the data as robust
medians of log power, one factor after another (backfitting): per angle of incidence, per angle in
the rolled frame, per slant range, along the track, and a slow remainder in two dimensions.

Medians are of samples of the whole pass; arrays of the pass's size there are two, the power and the ratio made of
it: all between is worked out for a hundred pings at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.special import gammaincinv, polygamma

from perception.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class GainConfig:
    """Settings of the equalisation.

    Attributes
    ----------
    angle_bins, range_bins : resolution of the factors over angle and slant range.
    along_pings : pings over which the factor along the track is smoothed.
    albedo_pings, albedo_parts : size of the blocks of the slow remainder: pings, and parts of the
        swath's width. Larger than any object, or its shadow would be called a dark floor.
    albedo_limit_db : the slow remainder never corrects by more, for the same reason.
    """

    angle_bins: int = 96
    range_bins: int = 64
    along_pings: int = 61
    albedo_pings: int = 128
    albedo_parts: int = 8
    albedo_limit_db: float = 3.0


@dataclass(frozen=True, slots=True)
class Equalised:
    """One side's echo over its nominal level.

    Attributes
    ----------
    ratio : (n, m) float32 power over nominal power, mean 1 on a nominal floor; NaN in the water
        column and where there is no data.
    looks : effective number of looks of the speckle, from the spread of nominal samples.
    expansion : power to which the recorder's levels were raised, 1 for a linear recorder.
    """

    ratio: FloatArray
    looks: float
    expansion: float = 1.0


# Medians come from at most this many samples a side: 1e5 hold a bin's median to 1 % at one look.
_SUBSAMPLE = 250_000
# The spread of the residual, from as many samples; a least and a usual power from more.
_SPREAD_SAMPLE, _POWER_SAMPLE = 200_000, 1_000_000


def equalise(
    power: FloatArray,
    sample_m: float,
    first_return_m: FloatArray,
    altitude_m: FloatArray,
    roll_rad: FloatArray,
    config: GainConfig | None = None,
) -> Equalised:
    """Equalise one side of a pass.

    Parameters
    ----------
    power : (n, m) echo power, near to far; NaN no data.
    sample_m : range of a sample.
    first_return_m, altitude_m : (n,) from the bottom track; samples before the first return are
        water column.
    roll_rad : (n,) roll towards this side (positive turns the side's beam down).

    Returns
    -------
    Equalised
    """
    config = config or GainConfig()
    n, m = power.shape
    echo = _Echo(power, sample_m, np.floor(first_return_m / sample_m), altitude_m, roll_rad)
    tall = max(1, round(n / config.albedo_pings))
    edges = np.linspace(0, n, tall + 1).astype(int)
    stretches = [slice(a, b) for a, b in pairwise(edges)]
    lit = np.concatenate([echo.floor(rows).sum(axis=1) for rows in stretches])
    ratio = np.full((n, m), np.nan, np.float32)
    if not lit.any():
        return Equalised(ratio, 1.0)
    echo = replace(echo, least=_least_power(echo, stretches))
    factors = _Factors.of(echo, lit, stretches, config)
    slow = _slow_remainder(echo, factors, ratio, stretches, config)
    found = _residual(echo, slow, ratio, stretches)
    spread = effective_looks(found.sample)
    power_law = _power_law(found.near, found.water, spread)
    looks = effective_looks(found.sample * np.float32(power_law))
    # The medians above are of log power; the nominal is the mean of power.
    median_of_mean = float(gammaincinv(looks, 0.5)) / looks
    for rows in stretches:
        part = ratio[rows]
        part *= np.float32(power_law)
        np.exp(part, out=part)
        part *= np.float32(median_of_mean)
    return Equalised(ratio, looks, power_law)


@dataclass(frozen=True, slots=True)
class _Echo:
    """One side of a pass, from which stretches of pings are worked out.

    Attributes
    ----------
    power : (n, m). first_sample, altitude_m, roll_rad : (n,).
    least : power to which less is lifted before the logarithm.
    """

    power: FloatArray
    sample_m: float
    first_sample: FloatArray
    altitude_m: FloatArray
    roll_rad: FloatArray
    least: float = 1.0

    def floor(self, rows: slice) -> BoolArray:
        """Return which samples are floor and not water."""
        power = self.power[rows]
        after: BoolArray = np.arange(power.shape[1]) >= self.first_sample[rows, None]
        return after & np.isfinite(power)

    def log_power(self, rows: slice) -> FloatArray:
        return self.log_of(self.power[rows])

    def log_of(self, power: FloatArray) -> FloatArray:
        return np.log(np.maximum(np.nan_to_num(power), self.least)).astype(np.float32)

    @property
    def range_m(self) -> FloatArray:
        m = self.power.shape[1]
        return (np.arange(m, dtype=np.float32) + 0.5) * np.float32(self.sample_m)

    def spread(self, rows: slice) -> FloatArray:
        """Return the pings' incidence coordinate."""
        return incidence_coordinate(self.range_m, self.altitude_m[rows])


# Water below a linear recorder's floor by this much at least; one look of speckle spreads log power by 1.28.
_LINEAR_CONTRAST = 18 * float(np.log(10)) / 10
_ONE_LOOK_SPREAD = 1.28
_MOST_EXPANSION = 5.0


def _beside_the_edge(
    log_power: FloatArray, first_sample: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the levels of near floor and of water, from a little beside the first return."""
    place = np.arange(log_power.shape[1]) / np.maximum(first_sample, 1.0)[:, None]
    # Between the transmit pulse and the floor; from a little behind the edge to half as far again.
    return log_power[(place > 1.1) & (place < 1.5)], log_power[(place > 0.4) & (place < 0.9)]


def _power_law(near: FloatArray, water: FloatArray, looks: float) -> float:
    """Return the power that undoes a recorder's compression of levels, at least 1.

    Recorders for display store something like the logarithm of the echo in 8 bits: water column and
    shadow then lie a few decibels below the floor and not twenty. Raising the levels to a power brings
    the water to 18 dB below the near floor, but never so far that the floor's speckle would spread
    more than one look's; a linear recorder, whose one-look speckle already does, is left as it is.

    Parameters
    ----------
    near, water : log power of near floor and of the water column; `looks` those of the recorded levels.
    """
    if len(water) < 100 or len(near) < 100:
        return 1.0
    contrast = float(np.median(near) - np.median(water))
    spread = float(np.sqrt(polygamma(1, looks)))
    if contrast <= 0:
        return 1.0
    wanted = min(_LINEAR_CONTRAST / contrast, _ONE_LOOK_SPREAD / spread)
    return float(np.clip(wanted, 1.0, _MOST_EXPANSION))


def incidence_coordinate(range_m: FloatArray, altitude_m: FloatArray) -> FloatArray:
    """Return ``asinh(tan(incidence))`` on a flat floor, (n, m): the angle near nadir, log range far off.

    Equal steps of it resolve both the steep change near nadir and the low grazing angles.
    """
    ratio = np.maximum(range_m[None, :] / np.maximum(altitude_m, 1e-3)[:, None], 1.0)
    # asinh(sqrt(u^2 - 1)) = acosh(u)
    return np.arccosh(ratio).astype(np.float32)


def effective_looks(log_residual: FloatArray) -> float:
    """Return the looks whose log-Gamma speckle has the spread of `log_residual` (NaN ignored).

    By the interquartile range, which shadows and highlights hardly touch.
    """
    values = log_residual.ravel()[:: max(1, log_residual.size // _SPREAD_SAMPLE)]
    values = values[np.isfinite(values)]
    if len(values) < 50:
        return 1.0
    low, high = np.percentile(values, [25, 75])
    grid = np.geomspace(0.3, 200, 80)
    width = np.log(gammaincinv(grid, 0.75)) - np.log(gammaincinv(grid, 0.25))
    return float(np.interp(-(high - low), -width, grid))


def _least_power(echo: _Echo, stretches: Sequence[slice]) -> float:
    """Return a quarter of the floor's least positive power, to which stored zeros are lifted."""
    least, sample = np.inf, []
    stride = max(1, echo.power.size // _POWER_SAMPLE)
    for rows in stretches:
        values = echo.power[rows][echo.floor(rows)]
        positive = values[values > 0]
        if len(positive):
            least = min(least, float(positive.min()))
            sample.append(positive[::stride])
    if not sample:
        return 0.25
    return max(0.25 * least, 1e-7 * float(np.median(np.concatenate(sample))))


@dataclass(frozen=True, slots=True)
class _Factors:
    """The one-dimensional factors of the gain: over angle of incidence, and where they vary over rolled angle and range.

    `top` is the greatest incidence coordinate of the pass, `along` (n,) the factor along the track.
    """

    terms: list[_Term]
    rolls: bool
    varied: bool
    top: float
    along: FloatArray

    @classmethod
    def of(
        cls, echo: _Echo, lit: IntArray, stretches: Sequence[slice], config: GainConfig
    ) -> _Factors:
        """Fit the factors by robust backfitting to an even subset of the floor's samples; `lit` (n,) their number."""
        n, m = echo.power.shape
        rows, columns, data, spread = _subset(echo, int(lit.sum()), stretches)
        top = float(incidence_coordinate(echo.range_m[-1:], echo.altitude_m).max())
        terms = [_Term(_bins_of(spread, config.angle_bins, top))]
        rolls = float(np.std(echo.roll_rad)) > np.deg2rad(0.7)
        if rolls:
            rolled = np.arctan(np.sinh(spread)) + echo.roll_rad[rows]
            terms.append(_Term(_bins_of(rolled, config.angle_bins, np.pi / 2)))
        # At a constant altitude angle and range are one and the same: a second factor would be noise.
        nadir = np.searchsorted(echo.range_m, echo.altitude_m, side="right") % m
        varied = float(np.std(nadir)) > 0.05 * max(float(np.mean(nadir)), 1.0)
        if varied:
            terms.append(_Term(_bins_of(columns / m, config.range_bins, 1.0)))
        rest = data.copy()
        for _ in range(2 if len(terms) > 1 else 1):
            for term in terms:
                rest += term.at_data()
                term.fit(rest)
                rest -= term.at_data()
        return cls(terms, rolls, varied, top, _along(rest, rows, n, config.along_pings))

    def over(self, echo: _Echo, rows: slice) -> FloatArray:
        """Return the factors' sum over a stretch of pings."""
        spread = echo.spread(rows)
        total = self.terms[0].over(spread / max(self.top, 1e-9))
        if self.rolls:
            rolled = np.arctan(np.sinh(spread)) + echo.roll_rad[rows, None]
            total += self.terms[1].over(rolled / (np.pi / 2))
        if self.varied:
            m = spread.shape[1]
            total += self.terms[-1].over((np.arange(m) + 0.5) / m)
        return total + self.along[rows, None].astype(np.float32)


class _Term:
    """One factor of the gain: a median of what the others leave, per bin."""

    def __init__(self, bins: tuple[IntArray, int]) -> None:
        self.index, self.count = bins
        self.order = np.argsort(self.index, kind="stable")
        self.edges = np.searchsorted(self.index[self.order], np.arange(self.count + 1))
        self.values = np.zeros(self.count)

    def fit(self, rest: FloatArray) -> None:
        sorted_rest = rest[self.order]
        found = np.full(self.count, np.nan)
        for b in range(self.count):
            low, high = self.edges[b], self.edges[b + 1]
            if high - low >= 20:
                found[b] = np.median(sorted_rest[low:high])
        known = np.flatnonzero(np.isfinite(found))
        if len(known):
            self.values = np.interp(np.arange(self.count), known, found[known])

    def at_data(self) -> FloatArray:
        return self.values[self.index].astype(np.float32)

    def over(self, position: FloatArray) -> FloatArray:
        """Interpolate between bin centres at `position`, 0 to 1 over the bins."""
        centres = (np.arange(self.count) + 0.5) / self.count
        return np.interp(position, centres, self.values).astype(np.float32)


def _bins_of(values: FloatArray, count: int, top: float) -> tuple[IntArray, int]:
    index = (values / max(top, 1e-9) * count).astype(np.int32)
    return np.clip(index, 0, count - 1), count


def _subset(
    echo: _Echo, count: int, stretches: Sequence[slice]
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return row, column, log power and incidence coordinate of an even subset of the floor's `count` samples."""
    # A stride coprime to the width would visit all columns; an odd one is near enough.
    stride = max(1, count // _SUBSAMPLE) | 1
    m, passed = echo.power.shape[1], 0
    parts = []
    for rows in stretches:
        flat = np.flatnonzero(echo.floor(rows))
        parts.append(flat[-passed % stride :: stride] + rows.start * m)
        passed += len(flat)
    row, column = np.divmod(np.concatenate(parts), m)
    ratio = echo.range_m[column] / np.maximum(echo.altitude_m[row], 1e-3)
    spread = np.arccosh(np.maximum(ratio, 1.0)).astype(np.float32)
    return row, column, echo.log_of(echo.power[row, column]), spread


def _along(rest: FloatArray, rows: IntArray, n: int, window: int) -> FloatArray:
    """Return the slow factor along the track (n,): running median of the pings' medians, smoothed."""
    edges = np.searchsorted(rows, np.arange(n + 1))
    medians = np.full(n, np.nan)
    for i in range(n):
        if edges[i + 1] - edges[i] >= 5:
            medians[i] = np.median(rest[edges[i] : edges[i + 1]])
    known = np.flatnonzero(np.isfinite(medians))
    if len(known) == 0:
        return np.zeros(n)
    filled = np.interp(np.arange(n), known, medians[known])
    calm = median_filter(filled, min(window, n) | 1, mode="nearest")
    return gaussian_filter1d(calm, window / 8, mode="nearest")


def _slow_remainder(
    echo: _Echo,
    factors: _Factors,
    log_nominal: FloatArray,
    stretches: Sequence[slice],
    config: GainConfig,
) -> FloatArray:
    """Write what the factors make nominal to `log_nominal` (n, m); return what they leave, medians of large blocks.

    One row of blocks a stretch, `albedo_parts` across.
    """
    m = echo.power.shape[1]
    wide = config.albedo_parts
    column_edges = np.linspace(0, m, wide + 1).astype(int)
    blocks = np.zeros((len(stretches), wide))
    for i, rows in enumerate(stretches):
        log_nominal[rows] = factors.over(echo, rows)
        residual, floor = echo.log_power(rows) - log_nominal[rows], echo.floor(rows)
        for j, (first, last) in enumerate(pairwise(column_edges)):
            values = residual[:, first:last][floor[:, first:last]]
            if len(values) > 50:
                step = max(1, len(values) // 5000)
                blocks[i, j] = np.median(values[::step])
    limit = config.albedo_limit_db * np.log(10) / 10
    return np.clip(blocks, -limit, limit)


@dataclass(frozen=True, slots=True)
class _Found:
    """What `_residual` saw: an even sample of the residual; levels of near floor and of water."""

    sample: FloatArray
    near: FloatArray
    water: FloatArray


def _residual(
    echo: _Echo, blocks: FloatArray, log_nominal: FloatArray, stretches: Sequence[slice]
) -> _Found:
    """Turn `log_nominal` (n, m) into log power less it and the slow remainder, NaN where not floor, in place."""
    n, m = log_nominal.shape
    tall, wide = blocks.shape
    row = np.clip((np.arange(n) + 0.5) / n * tall - 0.5, 0, tall - 1)
    column = np.clip((np.arange(m) + 0.5) / m * wide - 0.5, 0, wide - 1)
    along = np.array([np.interp(row, np.arange(tall), blocks[:, j]) for j in range(wide)])
    low = np.minimum(column.astype(int), max(wide - 2, 0))
    f = (column - low)[None, :].astype(np.float32)
    along32 = along.T.astype(np.float32)
    high = np.minimum(low + 1, wide - 1)
    stride = max(1, n * m // _SPREAD_SAMPLE)
    sample, near, water = [], [], []
    for rows in stretches:
        log_power, part = echo.log_power(rows), log_nominal[rows]
        part += (1 - f) * along32[rows][:, low] + f * along32[rows][:, high]
        part[:] = np.where(echo.floor(rows), log_power - part, np.nan)
        sample.append(part.ravel()[-rows.start * m % stride :: stride])
        beside = _beside_the_edge(log_power, np.asarray(echo.first_sample[rows], float))
        near.append(beside[0])
        water.append(beside[1])
    return _Found(*(np.concatenate(values) for values in (sample, near, water)))
