"""Patch fixes: heights sounded along a stretch of track, matched as one against the prior map.

For every shift on a grid the map is read under the patch's points and the misfit's variance S is taken,
its mean removed (a level error is free). With an unknown noise level the likelihood of a shift is
``S^(-n/2)``, n the number of *independent* points: a strip's error and the map's are correlated, so n
is the area over the misfit's own correlation area, not the number of cells. With dead reckoning as
prior this gives a posterior whose moments are the fix and its covariance.

A fix is refused, with the reason, where the patch has too little in common with the map, where no
shift explains it better than flat ground would, where rivals remain, or at the border of the search.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from localization.integrity import protection_level
from localization.terrain import TerrainMap, lookup
from mapping.fixes import PositionFix
from perception.records import ElevationStrip, FloatArray

# Points of a patch that are matched: more repeat their neighbours.
_MOST_POINTS = 2500
_FEWEST_POINTS = 60
_LEAST_OVERLAP = 0.6
# The misfit's correlation is measured on what the best shift leaves, which has lost what the shift could
# absorb; against planted patches with white and correlated errors the variance came out too small by
# this factor (docs/terrain-navigation.md).
_ABSORBED = 1.7
# Log likelihood ratio over flat ground that proves relief in common; e^8 covers the shifts tried.
_PROOF = 8.0
# Posterior weight that must lie within four sigmas of the peak.
_SINGLE = 0.99
# An accepted fix must have narrowed the search at least so much, sigma against half width.
_NARROWED = 3.0


@dataclass(frozen=True, slots=True)
class Patch:
    """Soundings of a stretch of track, (n,) each, placed by dead reckoning, and where it centres."""

    time_s: float
    centre_m: tuple[float, float]
    east_m: FloatArray
    north_m: FloatArray
    elevation_m: FloatArray
    sigma_m: FloatArray


def patches_of(strip: ElevationStrip, length_m: float = 150.0) -> list[Patch]:
    """Cut a strip into patches of `length_m` along the track; cells without a height are left out."""
    step = np.hypot(np.diff(strip.easting_m), np.diff(strip.northing_m))
    way = np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(step), step, 0.0))])
    number = max(1, round(way[-1] / length_m))
    edges = np.linspace(0.0, way[-1] + 1e-6, number + 1)
    which = np.digitize(way, edges) - 1
    east, north = strip.positions()
    patches = []
    for k in range(number):
        lines = np.flatnonzero(which == k)
        if len(lines) < 3:
            continue
        known = (
            np.isfinite(strip.elevation_m[lines])
            & np.isfinite(strip.sigma_m[lines])
            & np.isfinite(east[lines])
        )
        middle = lines[len(lines) // 2]
        patches.append(
            Patch(
                time_s=float(strip.time_s[middle]),
                centre_m=(float(strip.easting_m[middle]), float(strip.northing_m[middle])),
                east_m=east[lines][known],
                north_m=north[lines][known],
                elevation_m=strip.elevation_m[lines][known],
                sigma_m=strip.sigma_m[lines][known],
            )
        )
    return patches


def match_patch_near(
    terrain: TerrainMap, patch: Patch, prior_m2: FloatArray, kind: str = "patch"
) -> PositionFix:
    """Match a patch within dead reckoning's uncertainty.

    Parameters
    ----------
    prior_m2 : (2, 2) covariance of the dead-reckoned position.

    Returns
    -------
    PositionFix
        At the patch's centre; `accepted` false with the reason where it may not be used.
    """
    patch = _thinned(patch)
    reach = 3.5 * float(np.sqrt(np.linalg.eigvalsh(prior_m2)[-1]))
    step = max(terrain.cell_m / 2, reach / 60)
    if len(patch.east_m) < _FEWEST_POINTS:
        return _refused(patch, prior_m2, kind, f"only {len(patch.east_m)} heights in the patch")
    first = _posterior(terrain, patch, np.zeros(2), reach, step, prior_m2)
    if first is None:
        return _refused(patch, prior_m2, kind, "patch and map have too little in common")
    # Once more around the peak, finer, so that the grid does not round the answer.
    fine = max(2.5 * first.sigma_m, 3 * step)
    second = _posterior(terrain, patch, first.mean_m, fine, fine / 40, prior_m2) or first
    reason = _why_not(first, second, reach)
    covariance = second.covariance_m2
    return PositionFix(
        time_s=patch.time_s,
        easting_m=patch.centre_m[0] + float(second.mean_m[0]),
        northing_m=patch.centre_m[1] + float(second.mean_m[1]),
        cov_ee_m2=float(covariance[0, 0]),
        cov_en_m2=float(covariance[0, 1]),
        cov_nn_m2=float(covariance[1, 1]),
        kind=kind,
        accepted=not reason,
        reason=reason or f"relief in common: log likelihood ratio {second.evidence:.0f}",
        protection_m=protection_level(covariance),
    )


@dataclass(frozen=True, slots=True)
class _Posterior:
    mean_m: FloatArray
    covariance_m2: FloatArray
    evidence: float
    single: float
    at_border: bool

    @property
    def sigma_m(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_m2)[-1]))


def _posterior(
    terrain: TerrainMap,
    patch: Patch,
    centre_m: FloatArray,
    reach_m: float,
    step_m: float,
    prior_m2: FloatArray,
) -> _Posterior | None:
    side = np.arange(-reach_m, reach_m + step_m / 2, step_m)
    east, north = (a.ravel() for a in np.meshgrid(centre_m[0] + side, centre_m[1] + side))
    weight = 1.0 / (patch.sigma_m**2 + terrain.error.total_m**2)
    misfit, share = _misfits(
        terrain.height_m, terrain.frame, patch.east_m, patch.north_m, patch.elevation_m, weight,
        east, north,
    )  # fmt: skip
    usable = (share >= _LEAST_OVERLAP) & (misfit > 0)
    if not usable.any():
        return None
    best = int(np.argmin(np.where(usable, misfit, np.inf)))
    independent = _independent(terrain, patch, east[best], north[best]) / _ABSORBED
    shift = np.stack([east, north])
    square = np.einsum("in,ij,jn->n", shift, np.linalg.inv(prior_m2), shift)
    log = np.where(usable, -0.5 * independent * np.log(np.maximum(misfit, 1e-12)), -np.inf)
    log = log - 0.5 * square
    posterior = np.exp(log - log.max())
    posterior /= posterior.sum()
    mean = shift @ posterior
    apart = shift - mean[:, None]
    covariance = (apart * posterior) @ apart.T + (step_m**2 / 12) * np.eye(2)
    top = int(np.argmax(posterior))
    mean_weight = np.average(patch.elevation_m, weights=weight)
    flat = np.average((patch.elevation_m - mean_weight) ** 2, weights=weight)
    near = np.einsum(
        "in,ij,jn->n", shift - shift[:, [top]], np.linalg.inv(covariance), shift - shift[:, [top]]
    )
    return _Posterior(
        mean_m=mean,
        covariance_m2=covariance,
        evidence=0.5 * independent * float(np.log(flat / misfit[best])),
        single=float(posterior[near < 16.0].sum()),
        at_border=bool(np.abs(shift[:, top] - centre_m).max() > reach_m - 1.5 * step_m),
    )


def _why_not(first: _Posterior, second: _Posterior, reach_m: float) -> str:
    if first.evidence < _PROOF:
        return (
            f"no relief in common: log likelihood ratio over flat ground {first.evidence:.1f}, "
            f"{_PROOF:g} needed"
        )
    if first.at_border:
        return "best at the border of the search"
    if first.single < _SINGLE:
        return f"ambiguous: {1 - first.single:.0%} of the probability lies elsewhere"
    if second.sigma_m > reach_m / _NARROWED:
        return f"the ground narrows the position to {second.sigma_m:.0f} m only"
    return ""


def _refused(patch: Patch, prior_m2: FloatArray, kind: str, reason: str) -> PositionFix:
    return PositionFix(
        patch.time_s, *patch.centre_m, float(prior_m2[0, 0]), float(prior_m2[0, 1]),
        float(prior_m2[1, 1]), kind, False, reason, protection_level(prior_m2),
    )  # fmt: skip


def _thinned(patch: Patch) -> Patch:
    n = len(patch.east_m)
    if n <= _MOST_POINTS:
        return patch
    chosen = np.sort(np.random.default_rng(0).permutation(n)[:_MOST_POINTS])
    return Patch(
        patch.time_s, patch.centre_m, patch.east_m[chosen], patch.north_m[chosen],
        patch.elevation_m[chosen], patch.sigma_m[chosen],
    )  # fmt: skip


def _independent(terrain: TerrainMap, patch: Patch, east_m: float, north_m: float) -> float:
    """Number of independent values in the misfit at a shift, from its correlation between pairs."""
    miss = patch.elevation_m - terrain.heights(patch.east_m + east_m, patch.north_m + north_m)
    known = np.isfinite(miss)
    e, n, miss = patch.east_m[known], patch.north_m[known], miss[known]
    if len(miss) < 10:
        return 3.0
    miss = miss - miss.mean()
    variance = float(np.mean(miss**2)) + 1e-12
    rng = np.random.default_rng(0)
    one, two = rng.integers(0, len(miss), (2, 60_000))
    apart = np.hypot(e[one] - e[two], n[one] - n[two])
    reach = float(np.percentile(apart, 80))
    edges = np.linspace(0.0, reach, 25)
    which = np.digitize(apart, edges) - 1
    inside = (which >= 0) & (which < 24) & (one != two)
    number = np.bincount(which[inside], minlength=24)
    products = np.bincount(which[inside], weights=(miss[one] * miss[two])[inside], minlength=24)
    correlation = products / np.maximum(number, 1) / variance
    # Squared correlation, its own scatter taken off, integrated over the plane.
    square = np.maximum(correlation**2 - 1.0 / np.maximum(number, 1), 0.0)
    ring = np.pi * (edges[1:] ** 2 - edges[:-1] ** 2)
    cells = np.unique(
        np.stack([np.floor(e / terrain.cell_m), np.floor(n / terrain.cell_north_m)]), axis=1
    ).shape[1]
    area = cells * terrain.cell_m * terrain.cell_north_m
    return float(np.clip(area / max(float(square @ ring), area / len(miss)), 3.0, len(miss)))


@numba.njit(cache=True)
def _misfits(heights, frame, pe, pn, z, weight, east, north):  # type: ignore[no-untyped-def]
    """Weighted variance of the misfit at every shift, its mean removed, and the share of weight."""
    out = np.empty(east.size)
    share = np.empty(east.size)
    total = weight.sum()
    for k in range(east.size):
        s0 = 0.0
        s1 = 0.0
        s2 = 0.0
        for i in range(pe.size):
            h = lookup(heights, frame, pe[i] + east[k], pn[i] + north[k])
            if h == h:
                d = z[i] - h
                s0 += weight[i]
                s1 += weight[i] * d
                s2 += weight[i] * d * d
        share[k] = s0 / total
        out[k] = s2 / s0 - (s1 / s0) ** 2 if s0 > 0 else np.nan
    return out, share
