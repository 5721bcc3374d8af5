"""Registration of two strips on what they share: relief, echo texture, objects.

Each is a *channel* with its own noise. Channels are correlated over every shift of the search, each
correlation becomes a log-likelihood with its own effective number of independent cells, and the
log-likelihoods add. Echo is compared side by side (port, starboard), and wave by wave: a slope that faces
one sonar may turn its back on the other, so waves along which the two looks are opposed are kept apart from
those along which they agree. docs/registration.md has the derivation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from scipy import fft

from mapping.correlation import (
    Fields,
    Products,
    Side,
    Surface,
    coincide,
    correlate,
    fan_filters,
    landmark_field,
    products,
    refine,
    wave_directions,
)
from mapping.texture_grid import OBJECTS, PORT, RELIEF, STARBOARD, gather
from mapping.textures import MatchConfig, Texture
from perception.records import FloatArray

_SIDES = ((PORT, "port"), (STARBOARD, "starboard"))
# Where three less of evidence would do, two less of margin do: two fits of one square share most of their noise.
_MARGIN_COUNTS = 1.5
# Looks are told apart by half a degree, and the part of all waves that must be there of a kind.
_HEADING_STEP, _LEAST_WAVES = np.radians(0.5), 0.08


@dataclass(frozen=True, slots=True)
class Match:
    """The shift that brings two strips together.

    Attributes
    ----------
    shift_m : (2,) east and north by which features of the second strip lie from those of the first.
    covariance_m2 : (2, 2) from the match's own shape.
    evidence, margin : log-likelihood ratios against no match and against the next best shift.
    correlation : of each channel at the shift; a channel that was not used is not there.
    spare : log-likelihood ratio beyond what is asked for; negative what it falls short by, minus infinity
        where the match is refused for its shape.
    accepted, reason : whether the match may be believed, and why not.
    """

    shift_m: FloatArray
    covariance_m2: FloatArray
    evidence: float
    margin: float
    correlation: dict[str, float]
    spare: float
    accepted: bool
    reason: str


def match(
    first: Texture,
    second: Texture,
    centre_m: tuple[float, float],
    side_m: float,
    search_m: float,
    cell_m: float,
    config: MatchConfig | None = None,
    prior_m2: FloatArray | None = None,
) -> Match:
    """Find the shift of `second` against `first` over a square of ground.

    Parameters
    ----------
    centre_m, side_m : the square, easting and northing of its centre.
    search_m : largest shift looked at, per axis.
    prior_m2 : (2, 2) covariance of the shift expected beforehand; it helps to choose among peaks and
        has no part in the result's covariance.
    """
    config = config or MatchConfig()
    inner, reach = round(side_m / cell_m), max(3, round(search_m / cell_m))
    size = int(fft.next_fast_len(inner + 2 * reach, real=True))
    corner = (centre_m[0] - 0.5 * size * cell_m, centre_m[1] - 0.5 * size * cell_m)
    a, wa, heading_a = gather(first, corner, cell_m, size)
    b, wb, heading_b = gather(second, corner, cell_m, size)
    edge = (size - inner) // 2
    outside = np.ones((size, size), bool)
    outside[edge : edge + inner, edge : edge + inner] = False
    wa[:, outside] = 0.0
    fields, surfaces, waves = _compare(a, wa, b, wb, (heading_a, heading_b), reach, inner, cell_m)
    if "relief" in surfaces:
        share = np.sqrt(first.relief_share * second.relief_share)
        surfaces["relief"] = surfaces["relief"].scaled(float(share))
    if not surfaces:
        return _refused("no common ground")
    found = judge(fields, surfaces, inner, cell_m, config, prior_m2, waves)
    if found.reason and not np.isfinite(found.covariance_m2).all():
        return _refused(found.reason)
    centre = tuple(np.round(found.shift_cells[::-1]).astype(int) + reach)
    correlation = {channel: float(surface.rho[centre]) for channel, surface in surfaces.items()}
    return Match(
        shift_m=found.shift_cells * cell_m,
        covariance_m2=found.covariance_m2,
        evidence=found.evidence,
        margin=found.margin,
        correlation=correlation,
        spare=found.spare,
        accepted=not found.reason,
        reason=found.reason,
    )


def _refused(reason: str) -> Match:
    return Match(np.zeros(2), np.full((2, 2), np.nan), 0.0, 0.0, {}, -np.inf, False, reason)


def _compare(
    a: FloatArray, wa: FloatArray, b: FloatArray, wb: FloatArray, headings: tuple[float, float],
    reach: int, inner: int, cell_m: float,
) -> tuple[dict[str, Fields], dict[str, Surface], dict[str, FloatArray]]:  # fmt: skip
    """Return fields, correlations and weights of waves of every channel that the two squares have."""
    fields: dict[str, Fields] = {}
    surfaces: dict[str, Surface] = {}
    waves: dict[str, FloatArray] = {}
    relief = correlate(a[RELIEF], wa[RELIEF], b[RELIEF], wb[RELIEF], reach)
    if relief is not None:
        fields["relief"] = (a[RELIEF], wa[RELIEF], b[RELIEF], wb[RELIEF])
        surfaces["relief"] = relief
    enough = 0.02 * wa[RELIEF].size
    first = {k: Side.of(a[k], wa[k]) for k, _ in _SIDES if (wa[k] > 0).sum() >= enough}
    second = {k: Side.of(b[k], wb[k]) for k, _ in _SIDES if (wb[k] > 0).sum() >= enough}
    for (i, name_a), (j, name_b) in product(_SIDES, _SIDES):
        if i not in first or j not in second:
            continue
        pair = (a[i], wa[i], b[j], wb[j])
        looks = _towards(i, headings[0]), _towards(j, headings[1])
        gains = _gains(a.shape[1], *looks)
        for kind, sign, surface in _of_sides(pair, first[i], second[j], gains, reach):
            name = f"{kind} {name_a}-{name_b}"
            fields[name], surfaces[name] = pair, surface
            waves[name] = sign * _gains(inner, *looks)[kind]
    landmarks = landmark_field(a[OBJECTS], wa[OBJECTS], b[OBJECTS], wb[OBJECTS], cell_m)
    if landmarks is not None:
        fields["objects"] = landmarks
        surfaces["objects"] = coincide(*landmarks, reach)
    return fields, surfaces, waves


def _towards(side: int, heading_rad: float) -> tuple[float, float]:
    """Return the direction (east, north) in which a side of the sonar looks, to half a degree."""
    sign = 1.0 if side == STARBOARD else -1.0
    heading = round(heading_rad / _HEADING_STEP) * _HEADING_STEP
    return sign * float(np.cos(heading)), -sign * float(np.sin(heading))


# Some headings are looked at at a time; 0.6 MB each.
@lru_cache(maxsize=32)
def _gains(size: int, u: tuple[float, float], v: tuple[float, float]) -> dict[str, FloatArray]:
    """Return which waves two looks towards `u` and `v` see alike ("echo") and which with opposite sign."""
    east, north = wave_directions(size)
    facing = (east * u[0] + north * u[1]) * (east * v[0] + north * v[1])
    kinds = {
        "echo": np.clip(1.0 + facing / 0.1, 0.0, 1.0),
        "shading": np.clip((-facing - 0.2) / 0.2, 0.0, 1.0),
    }
    return {kind: gain.astype(np.float32) for kind, gain in kinds.items()}


def _of_sides(
    pair: Fields, first: Side, second: Side, gains: dict[str, FloatArray], reach: int
) -> Iterator[tuple[str, float, Surface]]:
    """Yield kind, sign and correlation of a side of one pass with a side of the other."""
    values, weights, _, _ = pair
    # A kind of wave of which there is next to nothing tells nothing.
    gains = {kind: gain for kind, gain in gains.items() if gain.mean() > _LEAST_WAVES}
    known: Products | None = None
    for kind, filtered in zip(
        gains, fan_filters(values, weights, list(gains.values())), strict=True
    ):
        found = products(first.carrying(filtered, weights), second, reach, known)
        if found is None:
            continue
        known = found
        sign, surface = 1.0, found.surface()
        if kind == "shading" and surface is not None:
            sign, surface = _signed(found, surface)
        if surface is not None:
            yield kind, sign, surface


def _signed(found: Products, surface: Surface) -> tuple[float, Surface | None]:
    """Choose the sign of a correlation that may have either: the one whose extreme is twice the other's.

    The side lobes of either sign look like peaks of the other, so where neither is stronger neither counts.
    """
    high, low = float(surface.significance.max()), float(-surface.significance.min())
    if high >= 2.0 * low:
        return 1.0, surface
    if low < 2.0 * high:
        return 1.0, None
    return -1.0, found.surface(-1.0)


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the correlations of two squares say of their shift, east and north; the rest as in `Match`."""

    shift_cells: FloatArray
    covariance_m2: FloatArray
    evidence: float
    margin: float = 0.0
    spare: float = -np.inf
    reason: str = ""


def judge(
    fields: dict[str, Fields],
    surfaces: dict[str, Surface],
    inner: int,
    cell_m: float,
    config: MatchConfig,
    prior_m2: FloatArray | None,
    waves: dict[str, FloatArray] | None = None,
) -> Verdict:
    """Choose the best shift of all correlations together, refine it below a cell, and weigh it.

    Parameters
    ----------
    waves : by which each wave of a channel counts in `refine`.
    """
    total = np.sum([s.log_likelihood for s in surfaces.values()], axis=0)
    common = np.max([s.common for s in surfaces.values()], axis=0)
    reach = total.shape[0] // 2
    steps = np.arange(-reach, reach + 1)
    score = np.where(common > 0.3 * common.max(), total, -np.inf)
    if prior_m2 is not None:
        score = score - _prior_cost(steps * cell_m, prior_m2)
    row, col = np.unravel_index(int(np.argmax(score)), score.shape)
    best = np.array([col - reach, row - reach], float)
    evidence = float(total[row, col])
    nothing = np.full((2, 2), np.nan)
    if row in (0, 2 * reach) or col in (0, 2 * reach):
        return Verdict(best, nothing, evidence, reason="best at the border of the search")
    gains = {c: s.gain(int(row), int(col)) for c, s in surfaces.items()}
    if "objects" in gains:
        # The correlation of points with gains is a log-likelihood as it stands.
        gains["objects"] = 1.0
    offset, covariance, lobe = refine(fields, gains, best, inner, waves)
    if covariance is None or np.abs(offset).max() > 1.5:
        return Verdict(best, nothing, evidence, reason="no clear peak")
    # A tenth of a cell is what two samplings of one ground leave of any peak (docs/registration.md).
    covariance = (covariance + 0.1**2 * np.eye(2)) * cell_m**2
    reach_of_peak = np.maximum(3.0 * lobe * np.sqrt(max(evidence, 1.0)), 3.0)
    far = (np.abs(steps[:, None] - best[1]) > reach_of_peak[1]) | (
        np.abs(steps - best[0]) > reach_of_peak[0]
    )
    margin = float(score[row, col]) - (float(score[far].max()) if far.any() else 0.0)
    # The more places are looked at, the better the best of them fits by chance.
    places = max(1.0, float((2 * reach) ** 2 / np.prod(2.0 * np.maximum(lobe, 0.5)) / 4.0))
    needed = config.least_evidence + float(np.log(places))
    spare = min(evidence - needed, _MARGIN_COUNTS * (margin - config.least_margin))
    reason = ""
    if evidence < needed:
        reason = f"too little in common (evidence {evidence:.1f} of {needed:.1f})"
    elif margin < config.least_margin:
        reason = f"not the only fit (margin {margin:.1f})"
    if np.sqrt(np.linalg.eigvalsh(covariance).max()) > 0.4 * reach * cell_m:
        reason, spare = "too wide a peak", -np.inf
    return Verdict(best + offset, covariance, evidence, margin, spare, reason)


def _prior_cost(steps_m: FloatArray, prior_m2: FloatArray) -> FloatArray:
    x, y = np.meshgrid(steps_m, steps_m)
    inverse = np.linalg.inv(prior_m2)
    cost: FloatArray = 0.5 * (
        inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y
    )
    return cost
