"""XTF's calendar fields to seconds."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from perception.readers.raw import floats, plural
from perception.records import FloatArray


def calendar_seconds(
    rows: npt.NDArray[Any], fraction_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (seconds since 1970, seconds of the day), each (n,); NaN where a field is impossible."""
    year, month, day = (rows[name].astype(np.int64) for name in ("Year", "Month", "Day"))
    hour, minute, second = (rows[name].astype(np.int64) for name in ("Hour", "Minute", "Second"))
    clock_ok = (hour < 24) & (minute < 60) & (second <= 60)
    of_day = np.where(clock_ok, hour * 3600.0 + minute * 60.0 + second + fraction_s, np.nan)
    date_ok = (
        (year >= 1970) & (year < 2200) & (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31)
    )
    months = (np.where(date_ok, year, 1970) - 1970) * 12 + np.where(date_ok, month, 1) - 1
    first = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64)
    days = first + np.where(date_ok, day, 1) - 1
    return np.where(date_ok, days * 86400.0 + of_day, np.nan), of_day


def ping_times(pings: npt.NDArray[Any], defects: list[str]) -> tuple[FloatArray, bool]:
    """Return ping times (n,) and whether they are UTC; NaN where the ping's own clock is impossible.

    Without a date the seconds of the day are kept (a midnight is bridged); without a clock either,
    the attitude time tag in milliseconds, and at last one second a ping.
    """
    fraction = np.minimum(floats(pings["HSeconds"]), 99.0) / 100.0
    utc_s, of_day = calendar_seconds(pings, fraction)
    dated = np.isfinite(utc_s)
    if dated.mean() > 0.5:
        if not dated.all():
            defects.append(
                f"impossible date in {plural(int((~dated).sum()), 'ping')}: time interpolated"
            )
        return utc_s, True
    year = int(np.median(pings["Year"]))
    defects.append(f"the clock has no date (year {year}): times are seconds, not UTC")
    if np.ptp(np.nan_to_num(of_day)) > 0:
        steps = np.diff(np.nan_to_num(of_day))
        days = np.concatenate([[0.0], np.cumsum(steps < -43200.0)])
        return of_day + 86400.0 * days, False
    tag = floats(pings["AttitudeTimeTag"]) / 1000.0
    if len(tag) > 1 and np.ptp(tag) > 0:
        return tag, False
    defects.append("the clock stands still: one second a ping assumed")
    return np.arange(len(pings), dtype=float), False
