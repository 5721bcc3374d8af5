"""Gain: echo power divided by what this sonar usually hears there, so that 1 is a nominal floor.

Beam pattern, the floor's angular law, a wrong time-varying gain and a slowly varying albedo cannot be
told apart from one pass, and need not be: their product is estimated from the data as robust
medians of log power, one factor after another (backfitting): per angle of incidence, per angle in
the rolled frame, per slant range, along the track, and a slow remainder in two dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.special import gammaincinv, polygamma

from perception.records import FloatArray, IntArray


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
    log_nominal : (n, m) float32 natural log of the nominal mean power.
    looks : effective number of looks of the speckle, from the spread of nominal samples.
    expansion : power to which the recorder's levels were raised, 1 for a linear recorder (`expansion`).
    """

    ratio: FloatArray
    log_nominal: FloatArray
    looks: float
    expansion: float = 1.0


# Medians come from at most this many samples a side: 1e5 hold a bin's median to 1 % at one look.
_SUBSAMPLE = 250_000


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
    range_m = (np.arange(m, dtype=np.float32) + 0.5) * np.float32(sample_m)
    first_sample = np.floor(first_return_m / sample_m)
    floor = (np.arange(m) >= first_sample[:, None]) & np.isfinite(power)
    if not floor.any():
        empty = np.full((n, m), np.nan, np.float32)
        return Equalised(empty, empty.copy(), 1.0)
    log_power = _log_power(power, floor)
    spread = incidence_coordinate(range_m, altitude_m)
    log_nominal = _factors(log_power, spread, floor, roll_rad, config)
    residual = log_power - log_nominal
    log_nominal += _slow_remainder(residual, floor, config)
    residual = np.where(floor, log_power - log_nominal, np.nan)
    power_law = expansion(log_power, np.asarray(first_sample, float), effective_looks(residual))
    residual *= np.float32(power_law)
    looks = effective_looks(residual)
    # The medians above are of log power; the nominal is the mean of power.
    median_of_mean = float(gammaincinv(looks, 0.5)) / looks
    ratio = (np.exp(residual) * np.float32(median_of_mean)).astype(np.float32)
    log_nominal -= np.float32(np.log(median_of_mean) / power_law)
    return Equalised(ratio, log_nominal.astype(np.float32), looks, power_law)


# Water below a linear recorder's floor by this much at least; one look of speckle spreads log power by 1.28.
_LINEAR_CONTRAST = 18 * float(np.log(10)) / 10
_ONE_LOOK_SPREAD = 1.28
_MOST_EXPANSION = 5.0


def expansion(log_power: FloatArray, first_sample: FloatArray, looks: float) -> float:
    """Return the power that undoes a recorder's compression of levels, at least 1.

    Recorders for display store something like the logarithm of the echo in 8 bits: water column and
    shadow then lie a few decibels below the floor and not twenty. Raising the levels to a power brings
    the water to 18 dB below the near floor, but never so far that the floor's speckle would spread
    more than one look's; a linear recorder, whose one-look speckle already does, is left as it is.

    Parameters
    ----------
    log_power : (n, m) natural log of recorded power.
    first_sample : (n,) sample of the first return.
    looks : effective looks of the recorded levels.
    """
    m = log_power.shape[1]
    place = np.arange(m) / np.maximum(first_sample, 1.0)[:, None]
    # Between the transmit pulse and the floor; from a little behind the edge to half as far again.
    water = log_power[(place > 0.4) & (place < 0.9)]
    near = log_power[(place > 1.1) & (place < 1.5)]
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
    values = log_residual.ravel()[:: max(1, log_residual.size // 200_000)]
    values = values[np.isfinite(values)]
    if len(values) < 50:
        return 1.0
    low, high = np.percentile(values, [25, 75])
    grid = np.geomspace(0.3, 200, 80)
    width = np.log(gammaincinv(grid, 0.75)) - np.log(gammaincinv(grid, 0.25))
    return float(np.interp(-(high - low), -width, grid))


def _log_power(power: FloatArray, floor: FloatArray) -> FloatArray:
    """Return log power, stored zeros lifted to a quarter of the least positive power."""
    values = power[floor]
    positive = values[values > 0]
    least = float(positive.min()) if len(positive) else 1.0
    typical = float(np.median(positive)) if len(positive) else 1.0
    return np.log(np.maximum(np.nan_to_num(power), max(0.25 * least, 1e-7 * typical))).astype(
        np.float32
    )


def _factors(
    log_power: FloatArray,
    spread: FloatArray,
    floor: FloatArray,
    roll_rad: FloatArray,
    config: GainConfig,
) -> FloatArray:
    """Return the sum of the one-dimensional factors, (n, m), by robust backfitting."""
    n, m = log_power.shape
    rows, columns = _subsample(floor)
    data = log_power[rows, columns]
    terms = [_Term(_bins_of(spread[rows, columns], config.angle_bins, float(spread.max())))]
    if float(np.std(roll_rad)) > np.deg2rad(0.7):
        rolled = np.arctan(np.sinh(spread[rows, columns])) + roll_rad[rows]
        terms.append(_Term(_bins_of(rolled, config.angle_bins, np.pi / 2)))
    # At a constant altitude angle and range are one and the same: a second factor would be noise.
    nadir = np.argmax(spread > 0, axis=1)
    varied = float(np.std(nadir)) > 0.05 * max(float(np.mean(nadir)), 1.0)
    if varied:
        terms.append(_Term(_bins_of(columns / m, config.range_bins, 1.0)))
    rest = data.copy()
    for _ in range(2 if len(terms) > 1 else 1):
        for term in terms:
            rest += term.at_data()
            term.fit(rest)
            rest -= term.at_data()
    total = terms[0].over(spread / max(float(spread.max()), 1e-9))
    if float(np.std(roll_rad)) > np.deg2rad(0.7):
        total += terms[1].over((np.arctan(np.sinh(spread)) + roll_rad[:, None]) / (np.pi / 2))
    if varied:
        total += terms[-1].over(np.broadcast_to(((np.arange(m) + 0.5) / m)[None, :], (n, m)))
    return total + _along(rest, rows, n, config.along_pings)[:, None].astype(np.float32)


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


def _subsample(floor: FloatArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of an even subset of the floor's samples."""
    flat = np.flatnonzero(floor)
    # A stride coprime to the width would visit all columns; an odd one is near enough.
    stride = max(1, len(flat) // _SUBSAMPLE) | 1
    flat = flat[::stride]
    rows, columns = np.divmod(flat, floor.shape[1])
    return rows, columns


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


def _slow_remainder(residual: FloatArray, floor: FloatArray, config: GainConfig) -> FloatArray:
    """Return the slowly varying remainder (n, m): medians of large blocks, interpolated between."""
    n, m = residual.shape
    tall = max(1, round(n / config.albedo_pings))
    wide = config.albedo_parts
    row_edges = np.linspace(0, n, tall + 1).astype(int)
    column_edges = np.linspace(0, m, wide + 1).astype(int)
    blocks = np.zeros((tall, wide))
    for i in range(tall):
        for j in range(wide):
            cell = np.s_[row_edges[i] : row_edges[i + 1], column_edges[j] : column_edges[j + 1]]
            values = residual[cell][floor[cell]]
            if len(values) > 50:
                step = max(1, len(values) // 5000)
                blocks[i, j] = np.median(values[::step])
    limit = config.albedo_limit_db * np.log(10) / 10
    blocks = np.clip(blocks, -limit, limit)
    row = np.clip((np.arange(n) + 0.5) / n * tall - 0.5, 0, tall - 1)
    column = np.clip((np.arange(m) + 0.5) / m * wide - 0.5, 0, wide - 1)
    along = np.array([np.interp(row, np.arange(tall), blocks[:, j]) for j in range(wide)])
    low = np.minimum(column.astype(int), max(wide - 2, 0))
    f = (column - low)[None, :].astype(np.float32)
    along32 = along.T.astype(np.float32)
    high = np.minimum(low + 1, wide - 1)
    return (1 - f) * along32[:, low] + f * along32[:, high]
