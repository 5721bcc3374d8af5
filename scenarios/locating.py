"""What `bathynav locate` does: read, navigate, write."""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from localization.maperror import assumed_sigma
from localization.measurements import Sensors, read_sensors
from localization.mission import Navigation, navigate
from localization.navfile import NavTable, check_against_map, read_nav
from localization.navigator import CONVERGED, Navigator, NavigatorConfig
from localization.terrain import TerrainMap, terrain_map
from mapping.fixes import write_fixes
from mapping.rasters import read_map
from mapping.trajectories import write_trajectory
from perception.records import Grid, Progress

logger = logging.getLogger(__name__)

# Beams reach to the side, and biases carry the track away from dead reckoning.
_MARGIN_M, _MARGIN_SIGMAS, _MARGIN_PART = 300.0, 6.0, 0.03


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """The options of `bathynav locate`; see its help."""

    prior: Path
    nav: Path
    sensors: Path | None = None
    map_sigma_m: float | None = None
    map_error_length_m: float | None = None
    particles: int = 4000
    seed: int = 0


def locate(options: LocateOptions, out: Path, progress: Progress) -> dict[str, Any]:
    """Run `locate` and write its folder; return the metrics for the console.

    Raises
    ------
    InputError, NoOverlapError
        See `localization.navfile.read_nav`, `mapping.rasters.read_map`, `terrain_map`.
    """
    from scenarios.outputs import write_metrics
    from scenarios.plots_navigation import draw_navigation

    began = time.perf_counter()
    nav = read_nav(options.nav, None if options.sensors is None else read_sensors(options.sensors))
    prior, sigma_source = prior_with_sigma(options.prior, options.map_sigma_m)
    terrain = terrain_map(prior, options.map_error_length_m, reach(nav))
    check_against_map(nav, float(np.nanmedian(terrain.height_m)))
    navigator = Navigator(
        terrain,
        nav.sensors,
        np.random.default_rng(options.seed),
        NavigatorConfig(particles=options.particles),
    )
    result = navigate(navigator, nav, crs=prior.crs, progress=progress)
    metrics = summary(result, nav, terrain)
    metrics["map_sigma_source"] = sigma_source
    metrics["seconds"] = round(time.perf_counter() - began, 3)
    write_trajectory(out / "trajectory.csv", result.trajectory)
    write_trajectory(out / "trajectory-smoothed.csv", result.smoothed)
    write_fixes(out / "fixes.csv", result.fixes)
    draw_navigation(out / "locate.png", prior, nav, result.trajectory, result.smoothed)
    write_metrics(out, metrics, _config(options, nav.sensors), options.seed)
    return metrics


def prior_with_sigma(path: Path, sigma_m: float | None) -> tuple[Grid, str]:
    """Read a prior map and make sure that it has a sigma; tell where the sigma is from."""
    grid = read_map(path, sigma_m)
    if sigma_m is not None:
        return grid, "--map-sigma"
    if grid.sigma_m is not None and np.isfinite(grid.sigma_m).any():
        return grid, "the map's band"
    depth = abs(float(np.nanmedian(grid.elevation_m)))
    assumed = assumed_sigma(depth)
    logger.warning(
        "%s: has no sigma; %.2f m assumed (IHO S-44 Order 1a at %.0f m); give --map-sigma",
        path, assumed, depth,
    )  # fmt: skip
    sigma = np.where(np.isfinite(grid.elevation_m), assumed, np.nan)
    return replace(grid, sigma_m=sigma), "assumed: IHO S-44 Order 1a"


def reach(nav: NavTable) -> tuple[float, float, float, float]:
    """West, south, east, north of what the vehicle may see."""
    east = nav.easting_m[np.isfinite(nav.easting_m)]
    north = nav.northing_m[np.isfinite(nav.northing_m)]
    way = float(np.sum(np.hypot(np.diff(nav.easting_m), np.diff(nav.northing_m)), where=True))
    way = way if np.isfinite(way) else float(np.hypot(np.ptp(east), np.ptp(north)))
    ranges = nav.slant_range_m[np.isfinite(nav.slant_range_m)]
    beams = float(np.median(ranges)) if ranges.size else 0.0
    margin = _MARGIN_M + _MARGIN_SIGMAS * nav.sensors.start_m + _MARGIN_PART * way + beams
    return (
        float(east.min() - margin), float(north.min() - margin),
        float(east.max() + margin), float(north.max() + margin),
    )  # fmt: skip


def summary(result: Navigation, nav: NavTable, terrain: TerrainMap) -> dict[str, Any]:
    """Figures of a run that need no truth."""
    t = result.trajectory
    status = np.array(t.status)
    converged = np.flatnonzero(status == CONVERGED)
    sigma = np.hypot(t.sigma_easting_m, t.sigma_northing_m)
    last = result.estimates[-1]
    share = Counter(t.status or ())
    reasons = Counter(e.reason.split(";")[0] for e in result.estimates if e.reason)
    start = float(nav.time_s[np.isfinite(nav.time_s)][0])
    return {
        "rows": len(nav),
        "beams": nav.slant_range_m.shape[1],
        "converged": bool(converged.size),
        "converged_after_s": float(t.time_s[converged[0]] - start) if converged.size else None,
        **{
            f"share_{name.replace('-', '_')}": share[name] / len(nav)
            for name in ("converged", "searching", "dead-reckoning", "lost")
        },
        "sigma_median_m": float(np.nanmedian(sigma)),
        "sigma_last_m": float(sigma[-1]),
        "protection_last_m": last.protection_m,
        "heading_bias_deg": float(np.degrees(last.state[2])),
        "scale_error": float(last.state[3]),
        "depth_bias_m": float(last.state[4]),
        "fixes_accepted": sum(f.accepted for f in result.fixes),
        "fixes_refused": sum(not f.accepted for f in result.fixes),
        "map_sigma_m": terrain.error.stated_m,
        "map_white_m": terrain.error.white_m,
        "map_sigma_filtered_m": terrain.error.total_m,
        "map_relief_m": terrain.relief_m,
        "verdict": _verdict(result, bool(converged.size)),
        "events": dict(reasons.most_common(12)),
    }


def _verdict(result: Navigation, converged: bool) -> str:
    """One sentence for the user."""
    last = result.estimates[-1]
    sigma = float(np.sqrt(np.trace(last.covariance_m2)))
    if not converged:
        return f"no fix: this ground and these ranges leave the position uncertain by {sigma:.0f} m"
    if last.status == CONVERGED:
        return f"position known to {sigma:.2f} m at the end"
    return f"{last.status} at the end, position uncertain by {sigma:.0f} m"


def _config(options: LocateOptions, sensors: Sensors) -> dict[str, Any]:
    return {**asdict(options), "sensors_resolved": asdict(sensors)}
