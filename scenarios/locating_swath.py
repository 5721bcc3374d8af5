"""`locate --swath`: side-scan passes to patch fixes against the prior map."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from localization.measurements import Sensors
from localization.navfile import NavTable, nav_table
from localization.patch import match_patch_near, patches_of
from localization.terrain import TerrainMap
from mapping.fixes import PositionFix
from perception.readers import Survey, open_survey
from perception.records import FloatArray, InputError, Progress
from perception.strips import build_strip

logger = logging.getLogger(__name__)

# Navigation of a survey has no use for more rows than this a second.
_ROWS_PER_S = 1.0
# Two records of one voyage agree to this in place when their clocks do not.
_SAME_PLACE_M = 50.0


def open_side_scan(paths: Sequence[Path], crs: str, progress: Progress) -> Survey:
    """Open a side-scan survey in the prior map's CRS."""
    return open_survey(paths, crs=crs or None, progress=progress)


def nav_of_survey(survey: Survey, sensors: Sensors) -> NavTable:
    """Take the navigation from the sonar file itself, one row a second; it holds no ranges."""
    pings = survey.pings
    good = np.flatnonzero(pings.usable & np.isfinite(pings.time_s))
    seconds = np.floor(pings.time_s[good] * _ROWS_PER_S)
    first = good[np.concatenate([[True], np.diff(seconds) > 0])]
    if len(first) < 2:
        raise InputError("the survey's navigation has fewer than 2 usable rows; give --nav NAV.csv")
    columns: dict[str, FloatArray] = {
        "time_s": pings.time_s[first],
        "easting_m": pings.easting_m[first],
        "northing_m": pings.northing_m[first],
        "depth_m": pings.depth_m[first],
        "heading_deg": np.degrees(pings.heading_rad[first]),
    }
    return nav_table(columns, sensors, "the survey's navigation")


def patch_fixes(
    survey: Survey, terrain: TerrainMap, nav: NavTable, progress: Progress
) -> list[PositionFix]:
    """Match every pass's strip, patch by patch, within dead reckoning's uncertainty.

    Fixes carry times of the navigation's clock; where the two clocks differ the place decides.
    """
    fixes: list[PositionFix] = []
    for index in range(survey.n_passes):
        progress("matching passes", index, survey.n_passes)
        try:
            strip = build_strip(survey.swath(index)).strip
        except InputError as error:
            logger.warning("pass %d: no strip (%s)", index, error)
            continue
        for patch in patches_of(strip):
            time_s = _nav_time(nav, patch.time_s, patch.centre_m)
            if time_s is None:
                logger.warning("pass %d: its clock and track are not those of --nav", index)
                break
            fix = match_patch_near(terrain, patch, _reckoning(nav, time_s))
            fixes.append(_at(fix, time_s))
    progress("matching passes", survey.n_passes, survey.n_passes)
    return fixes


def _at(fix: PositionFix, time_s: float) -> PositionFix:
    from dataclasses import replace

    return replace(fix, time_s=time_s)


def _nav_time(nav: NavTable, time_s: float, place_m: tuple[float, float]) -> float | None:
    """Time of the navigation's clock: the same clock if it covers it, else that of the same place."""
    known = np.isfinite(nav.time_s) & np.isfinite(nav.easting_m) & np.isfinite(nav.northing_m)
    times = nav.time_s[known]
    if times.min() <= time_s <= times.max():
        return time_s
    apart = np.hypot(nav.easting_m[known] - place_m[0], nav.northing_m[known] - place_m[1])
    nearest = int(np.argmin(apart))
    return float(times[nearest]) if apart[nearest] < _SAME_PLACE_M else None


def _reckoning(nav: NavTable, time_s: float) -> FloatArray:
    """Covariance (2, 2) of dead reckoning alone at a time."""
    s = nav.sensors
    known = np.isfinite(nav.easting_m) & np.isfinite(nav.northing_m) & (nav.time_s <= time_s)
    away = 0.0
    if known.sum() > 1:
        east, north = nav.easting_m[known], nav.northing_m[known]
        away = float(np.hypot(east[-1] - east[0], north[-1] - north[0]))
    sigma2 = s.start_m**2 + (away * s.scale) ** 2 + (away * s.heading_rad) ** 2
    return sigma2 * np.eye(2)
