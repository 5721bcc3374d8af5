"""What `bathynav locate` does: read, navigate, write."""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from localization.estimate import CONVERGED
from localization.maperror import assumed_sigma
from localization.measurements import Sensors, read_sensors
from localization.mission import Navigation, navigate
from localization.navchecks import check_against_map, off_the_map
from localization.navfile import NavTable, read_nav
from localization.navigator import Navigator, NavigatorConfig
from localization.terrain import TerrainMap, terrain_map
from mapping.fixes import write_fixes
from mapping.rasters import open_map, read_map
from mapping.trajectories import write_trajectory
from perception.geodesy import convergence, is_local
from perception.records import Grid, InputError, NoOverlapError, Progress
from scenarios.locating_swath import nav_of_survey, open_side_scan, patch_fixes

logger = logging.getLogger(__name__)

# Of a map of more cells only the part that the vehicle can reach is read.
_LARGE_CELLS = 4_000_000
# Beams reach to the side, and biases carry the track away from dead reckoning.
_MARGIN_M, _MARGIN_SIGMAS, _MARGIN_PART = 300.0, 6.0, 0.03


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """The options of `bathynav locate`; see its help."""

    prior: Path
    nav: Path | None = None
    sensors: Path | None = None
    map_sigma_m: float | None = None
    map_error_length_m: float | None = None
    particles: int = 4000
    seed: int = 0
    swath: tuple[Path, ...] = ()


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
    crs = crs_of(options.prior)
    sensors = None if options.sensors is None else read_sensors(options.sensors)
    survey = open_side_scan(options.swath, crs, progress) if options.swath else None
    # Files have headings from true north; inside they are from grid north.
    told = None
    if options.nav is not None:
        read = read_nav(options.nav, sensors)
        nav, told = on_grid(read, crs), read.heading_rad
    elif survey is not None:
        nav = nav_of_survey(survey, sensors or Sensors())
    else:
        raise InputError("locate needs --nav NAV.csv, --swath SURVEY, or both")
    prior, sigma_source = prior_with_sigma(options.prior, options.map_sigma_m, reach(nav))
    try:
        terrain = terrain_map(prior, options.map_error_length_m, reach(nav))
    except NoOverlapError as error:
        raise NoOverlapError(f"{nav.source} on {options.prior}: {error}") from error
    check_against_map(nav, float(np.nanmedian(terrain.height_m)), terrain.relief_m)
    off = off_the_map(nav, terrain.height_m, terrain.relief_m, terrain.error.stated_m)
    if off:
        logger.warning("%s on %s: %s", nav.source, options.prior, off)
    navigator = Navigator(
        terrain,
        nav.sensors,
        np.random.default_rng(options.seed),
        NavigatorConfig(particles=options.particles),
    )
    fixes = [] if survey is None else patch_fixes(survey, terrain, nav, progress)
    result = navigate(navigator, nav, fixes, crs=prior.crs, progress=progress)
    metrics = summary(result, nav, terrain)
    metrics["verdict"] += f"; {off}" if off else ""
    metrics["map_sigma_source"] = sigma_source
    metrics["seconds"] = round(time.perf_counter() - began, 3)
    for name, track in (
        ("trajectory", result.trajectory),
        ("trajectory-smoothed", result.smoothed),
    ):
        as_read = track if told is None else replace(track, heading_rad=told)
        write_trajectory(out / f"{name}.csv", as_read)
    write_fixes(out / "fixes.csv", result.fixes)
    draw_navigation(out / "locate.png", prior, nav, result.trajectory, result.smoothed)
    write_metrics(out, metrics, _config(options, nav.sensors), options.seed)
    return metrics


def on_grid(nav: NavTable, crs: str) -> NavTable:
    """Turn headings from true north, as files have them, to grid north."""
    if is_local(crs):
        return nav
    placed = np.isfinite(nav.easting_m) & np.isfinite(nav.northing_m)
    turn = convergence(
        np.array([np.median(nav.easting_m[placed])]), np.array([np.median(nav.northing_m[placed])]),
        crs,
    )  # fmt: skip
    # A place outside the CRS's domain has no convergence; nothing is known to correct then.
    return replace(
        nav, heading_rad=nav.heading_rad - (float(turn[0]) if np.isfinite(turn[0]) else 0.0)
    )


def crs_of(path: Path) -> str:
    """Name of a map's CRS, without reading the map."""
    with open_map(path) as opened:
        return opened.read(slice(0, 1), slice(0, 1)).crs


def prior_with_sigma(
    path: Path, sigma_m: float | None, bounds: tuple[float, float, float, float] | None = None
) -> tuple[Grid, str]:
    """Read a prior map and make sure that it has a sigma; tell where the sigma is from.

    Parameters
    ----------
    bounds : west, south, east, north of what is needed: of a large map no more is read.
    """
    grid = _part_of(path, sigma_m, bounds) if bounds else None
    if grid is None:
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


def _part_of(
    path: Path, sigma_m: float | None, bounds: tuple[float, float, float, float]
) -> Grid | None:
    """Read the part of a large map within bounds; None of a small one, or where nothing is met."""
    with open_map(path, sigma_m) as opened:
        rows, cols = opened.shape
        if rows * cols <= _LARGE_CELLS:
            return None
        corner = opened.read(slice(0, 1), slice(0, 1))
        west, south, east, north = bounds
        first, last = corner.fractional_index(np.array([west, east]), np.array([north, south]))
        row, col = np.clip(np.floor(first), 0, rows), np.clip(np.floor(last), 0, cols)
        # A few cells more: the edge of the data is none of the ground.
        window = (
            slice(max(int(row[0]) - 8, 0), min(int(row[1]) + 9, rows)),
            slice(max(int(col[0]) - 8, 0), min(int(col[1]) + 9, cols)),
        )
        if min(w.stop - w.start for w in window) < 2:
            return None
        grid = opened.read(*window)
    return grid if np.isfinite(grid.elevation_m).any() else None


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
        "events": "; ".join(f"{count} x {text}" for text, count in reasons.most_common(12)),
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


def observe(
    options: LocateOptions, out: Path, altitude_m: float, path_m: float, progress: Progress
) -> dict[str, Any]:
    """Run `locate --observability`: a fix's error for every cell, as map and picture."""
    from localization.observability import ObservabilityConfig, as_grid, observability
    from mapping.rasters import write_bands
    from scenarios.outputs import write_metrics
    from scenarios.plots_navigation import draw_observability

    began = time.perf_counter()
    grid, source = prior_with_sigma(options.prior, options.map_sigma_m)
    terrain = terrain_map(grid, options.map_error_length_m)
    chosen = Sensors() if options.sensors is None else read_sensors(options.sensors)
    config = ObservabilityConfig(path_m=path_m, altitude_m=altitude_m)
    found = observability(terrain, chosen, np.random.default_rng(options.seed), config, progress)
    bands = {
        "sigma_best": found.best_m, "sigma_mean": found.mean_m, "sigma_worst": found.worst_m,
        "best_heading_deg": np.degrees(found.best_heading_rad),
    }  # fmt: skip
    headings = np.degrees(found.headings_rad)
    bands |= {
        f"sigma_{h:05.1f}": layer for h, layer in zip(headings, found.by_heading_m, strict=True)
    }
    write_bands(out / "observability.tif", bands, as_grid(terrain, found.mean_m, grid.crs))
    draw_observability(out / "observability.png", grid, found)
    metrics = {
        "sigma_best_median_m": float(np.nanmedian(found.best_m)),
        "sigma_mean_median_m": float(np.nanmedian(found.mean_m)),
        "sigma_worst_median_m": float(np.nanmedian(found.worst_m)),
        "share_below_10_m": float(np.nanmean(found.mean_m[np.isfinite(found.mean_m)] < 10.0)),
        "over_bound_median": found.over_bound,
        "map_sigma_source": source,
        "seconds": round(time.perf_counter() - began, 3),
    }
    settings = {"map": options.prior, "sensors_resolved": asdict(chosen), **asdict(config)}
    write_metrics(out, metrics, settings, options.seed)
    return metrics
