"""`bathynav locate --patch`: where in the map does a patch of sea floor belong."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from localization.compact import CompactMap
from localization.placing import Place, Placing, place_on_compact, place_on_raster
from mapping.rasters import read_map
from perception.files import write_text
from perception.geodesy import convergence, is_local
from perception.records import Grid, InputError, Progress, silent


def place_patch(
    prior_path: Path,
    patch_path: Path,
    heading_deg: float | None,
    compact: bool,
    out: Path,
    map_sigma_m: float | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Place a patch, write `hypotheses.csv`, the picture and `metrics.json`; return the metrics.

    Parameters
    ----------
    heading_deg : azimuth of the patch's own north from true north, where it is known, to 0.5 degrees.
    map_sigma_m : 1-sigma of the map; None takes its band, else IHO S-44 Order 1a.
    compact : match the map's hills, hollows and thumbnail alone, a hundredth of its bytes.

    Raises
    ------
    InputError
        A file cannot be read, or the patch cannot be compared with the map.
    """
    from scenarios.outputs import write_metrics
    from scenarios.plots_navigation import draw_placing

    began = time.perf_counter()
    prior, patch = read_map(prior_path, map_sigma_m), read_map(patch_path)
    middle = (0.5 * (prior.west_m + prior.east_m), 0.5 * (prior.south_m + prior.north_m))
    turn = None if heading_deg is None else np.radians(heading_deg) - _convergence(prior, *middle)
    try:
        if compact:
            placing = place_on_compact(CompactMap.of(prior), patch, turn, progress)
        else:
            placing = place_on_raster(prior, patch, turn, progress)
    except InputError as error:
        raise InputError(f"{patch_path} on {prior_path}: {error}") from error
    metrics = summary(placing, prior, patch)
    metrics["seconds"] = round(time.perf_counter() - began, 3)
    write_text(out / "hypotheses.csv", hypotheses_csv(placing, prior))
    draw_placing(out / "patch.png", prior, patch, placing)
    config = {
        "map": prior_path,
        "patch": patch_path,
        "heading_deg": heading_deg,
        "compact": compact,
        "map_sigma_m": map_sigma_m,
    }
    write_metrics(out, metrics, config)
    return metrics


def summary(placing: Placing, prior: Grid, patch: Grid) -> dict[str, Any]:
    """Figures of a placing; place and protection are null without a fix."""
    best = placing.places[0] if placing.accepted else None
    covariance = None if best is None else best.covariance
    return {
        "fix": placing.accepted,
        "easting_m": None if best is None else best.easting_m,
        "northing_m": None if best is None else best.northing_m,
        "heading_deg": None if best is None else _heading_deg(best, prior),
        "sigma_easting_m": None if covariance is None else float(np.sqrt(covariance[0, 0])),
        "sigma_northing_m": None if covariance is None else float(np.sqrt(covariance[1, 1])),
        "sigma_heading_deg": None
        if covariance is None
        else float(np.degrees(np.sqrt(covariance[2, 2]))),
        "protection_m": None if best is None else best.protection_m,
        "offset_easting_m": _offset(best, prior, patch, 0),
        "offset_northing_m": _offset(best, prior, patch, 1),
        "ambiguity": None if np.isnan(placing.ambiguity) else placing.ambiguity,
        "hypotheses": len(placing.places),
        "evidence": placing.places[0].evidence if placing.places else None,
        "map_carried_percent": 100.0 * placing.carried_bytes / (4.0 * prior.elevation_m.size),
        "verdict": _verdict(placing),
    }


def _verdict(placing: Placing) -> str:
    """One sentence for the user; without a fix it names the likeliest place all the same."""
    if placing.accepted or not placing.places:
        return f"{'placed' if placing.accepted else 'no fix'}: {placing.reason}"
    best = placing.places[0]
    return f"no fix: {placing.reason} (likeliest at {best.easting_m:.1f} E {best.northing_m:.1f} N)"


def hypotheses_csv(placing: Placing, prior: Grid) -> str:
    """All places kept, likeliest first, as text."""
    names = (
        "rank,easting_m,northing_m,heading_deg,sigma_easting_m,sigma_northing_m,evidence,accepted"
    )
    lines = [names]
    for rank, p in enumerate(placing.places, start=1):
        sigma = np.sqrt(np.diag(p.covariance))
        told = "true" if rank == 1 and placing.accepted else "false"
        lines.append(
            f"{rank},{p.easting_m:.3f},{p.northing_m:.3f},{_heading_deg(p, prior):.3f},"
            f"{sigma[0]:.4g},{sigma[1]:.4g},{p.evidence:.2f},{told}"
        )
    return "\n".join(lines) + "\n"


def _offset(best: Place | None, prior: Grid, patch: Grid, axis: int) -> float | None:
    """How far the patch lies from where its own file has it; None where that is another frame."""
    if best is None or not patch.crs or patch.crs != prior.crs:
        return None
    own = (0.5 * (patch.west_m + patch.east_m), 0.5 * (patch.south_m + patch.north_m))
    return float((best.easting_m, best.northing_m)[axis] - own[axis])


def _heading_deg(place: Place, prior: Grid) -> float:
    turn = place.turn_rad + _convergence(prior, place.easting_m, place.northing_m)
    return float(np.degrees(turn) % 360.0)


def _convergence(prior: Grid, easting_m: float, northing_m: float) -> float:
    """Grid north to true north, 0 where the map names no projection."""
    if not prior.crs or is_local(prior.crs):
        return 0.0
    found = convergence(np.array([easting_m]), np.array([northing_m]), prior.crs)
    return float(np.nan_to_num(found[0]))
