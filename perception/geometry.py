"""Slant range and ground range over a floor: the triangles that every echo stage shares."""

from __future__ import annotations

import numpy as np
from numba import njit

from perception.records import FloatArray


def ground_range(slant_range_m: FloatArray, altitude_m: FloatArray) -> FloatArray:
    """Project slant range onto a flat floor: ``sqrt(slant^2 - altitude^2)``.

    Valid where relief is small against altitude; samples inside the water column (slant range below
    altitude) come back as NaN. Both arguments broadcast; metres.

    >>> float(ground_range(np.array(5.0), np.array(3.0)))
    4.0
    """
    squared = np.square(np.asarray(slant_range_m, float)) - np.square(np.asarray(altitude_m, float))
    return np.where(squared >= 0, np.sqrt(np.maximum(squared, 0.0)), np.nan)


def slant_range(ground_range_m: FloatArray, drop_m: FloatArray) -> FloatArray:
    """Return the slant range of a point `drop_m` below the sonar at `ground_range_m` (metres)."""
    return np.hypot(ground_range_m, drop_m)


def along_track(easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
    """Return the distance sailed (n,), from 0 at the first ping; never falling, metres.

    Positions that do not advance (a navigation slower than the pings) give equal distances.
    """
    if len(easting_m) == 0:
        return np.zeros(0)
    steps = np.hypot(np.diff(easting_m), np.diff(northing_m))
    return np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(steps), steps, 0.0))])


def progress_along(easting_m: FloatArray, northing_m: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return a strictly rising distance (n,) along a pass, metres, that jitter does not lengthen.

    Positions are projected on the pass's smoothed course; repeated fixes (navigation slower than
    the pings) are spread evenly over the pings between them.
    """
    n = len(easting_m)
    if n < 3:
        return np.arange(n, dtype=float) + (along_track(easting_m, northing_m) if n else 0.0)
    window = max(3, min(n // 2, 25) | 1)
    east = _smooth(np.asarray(easting_m, float), window)
    north = _smooth(np.asarray(northing_m, float), window)
    distance = along_track(east, north)
    step = np.diff(distance)
    typical = float(np.median(step[step > 0])) if np.any(step > 0) else 1.0
    # A step of nothing would make two lines one: keep order and finite spacing.
    return np.concatenate([[0.0], np.cumsum(np.maximum(step, 0.05 * typical))])


def _smooth(values: FloatArray, window: int) -> FloatArray:
    """Average over `window` values; ends are mirrored through their own value, so a line stays."""
    half = window // 2
    head = 2 * values[0] - values[half:0:-1]
    tail = 2 * values[-1] - values[-2 : -half - 2 : -1]
    padded = np.concatenate([head, values, tail])
    return np.convolve(padded, np.full(window, 1.0 / window), mode="valid")


@njit(cache=True, nogil=True)
def resample_rows(power, sample_m, common_m, n_out):  # type: ignore[no-untyped-def]
    """Resample each row of `power` (n, m) from its own `sample_m` (n,) to `common_m`, linearly.

    Samples past a row's last one come back as NaN. Linear in power, so that levels keep their mean.
    """
    n, m = power.shape
    out = np.full((n, n_out), np.nan, dtype=np.float32)
    for i in range(n):
        for k in range(n_out):
            position = (k + 0.5) * common_m / sample_m[i] - 0.5
            low = max(int(np.floor(position)), 0)
            if low >= m or (low == m - 1 and position > m - 0.5):
                continue
            high = min(low + 1, m - 1)
            # Half a sample before the first centre the first one is held.
            f = max(position - low, 0.0)
            value = power[i, low]
            if f > 0 and not np.isnan(power[i, high]):
                value = (1 - f) * value + f * power[i, high]
            out[i, k] = value
    return out
