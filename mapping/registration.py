"""Registration of two strips on what they share: relief, echo texture, objects.

Each is a *channel* with its own noise. Channels are correlated over every shift of the search, each
correlation becomes a log-likelihood with its own effective number of independent cells, and the
log-likelihoods add. Echo is compared side by side (port, starboard), and wave by wave: a slope that faces
one sonar may turn its back on the other, so waves along which the two looks are opposed are kept apart from
those along which they agree. docs/registration.md has the derivation.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import fft

from mapping.correlation import (
    Fields,
    Surface,
    coincide,
    correlate,
    fan_filter,
    landmark_field,
    refine,
    wave_directions,
)
from mapping.textures import (
    HEIGHT,
    OBJECTS,
    PORT,
    RELIEF,
    STARBOARD,
    MatchConfig,
    Texture,
    gather,
)
from perception.records import FloatArray

_SIDES = ((PORT, "port"), (STARBOARD, "starboard"))


@dataclass(frozen=True, slots=True)
class Match:
    """The shift that brings two strips together.

    Attributes
    ----------
    shift_m : (2,) east and north by which features of the second strip lie from those of the first.
    covariance_m2 : (2, 2) from the match's own shape.
    height_m, height_sigma_m : second strip's height minus the first's over the common ground; NaN none.
    evidence, margin : log-likelihood ratios against no match and against the next best shift.
    correlation : of each channel at the shift; a channel that was not used is not there.
    accepted, reason : whether the match may be believed, and why not.
    """

    shift_m: FloatArray
    covariance_m2: FloatArray
    height_m: float
    height_sigma_m: float
    evidence: float
    margin: float
    correlation: dict[str, float]
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
    fields, surfaces = _compare(a, wa, b, wb, (heading_a, heading_b), reach, cell_m)
    if "relief" in surfaces:
        share = np.sqrt(first.relief_share * second.relief_share)
        surfaces["relief"] = surfaces["relief"].scaled(float(share))
    if not surfaces:
        return _refused("no common ground")
    shift, covariance, evidence, margin, reason = judge(
        fields, surfaces, inner, cell_m, config, prior_m2
    )
    if reason and not np.isfinite(covariance).all():
        return _refused(reason)
    height_m, height_sigma_m = _height_between(
        a[HEIGHT], wa[HEIGHT], b[HEIGHT], wb[HEIGHT], shift, covariance / cell_m**2
    )
    centre = tuple(np.round(shift[::-1]).astype(int) + reach)
    correlation = {channel: float(surface.rho[centre]) for channel, surface in surfaces.items()}
    return Match(
        shift_m=shift * cell_m,
        covariance_m2=covariance,
        height_m=height_m,
        height_sigma_m=height_sigma_m,
        evidence=evidence,
        margin=margin,
        correlation=correlation,
        accepted=not reason,
        reason=reason,
    )


def _refused(reason: str) -> Match:
    return Match(
        np.zeros(2), np.full((2, 2), np.nan), np.nan, np.nan, 0.0, 0.0, {}, False, reason
    )  # fmt: skip


def _compare(
    a: FloatArray, wa: FloatArray, b: FloatArray, wb: FloatArray, headings: tuple[float, float],
    reach: int, cell_m: float,
) -> tuple[dict[str, Fields], dict[str, Surface]]:  # fmt: skip
    """Return the fields of every channel that the two squares have, and their correlations."""
    fields: dict[str, Fields] = {"relief": (a[RELIEF], wa[RELIEF], b[RELIEF], wb[RELIEF])}
    east, north = wave_directions(a.shape[1])
    for (i, name_a), (j, name_b) in product(_SIDES, _SIDES):
        if min((wa[i] > 0).sum(), (wb[j] > 0).sum()) < 0.02 * wa[i].size:
            continue
        towards = [
            (east * np.cos(h) - north * np.sin(h)) * (1.0 if k == STARBOARD else -1.0)
            for k, h in ((i, headings[0]), (j, headings[1]))
        ]
        facing = towards[0] * towards[1]
        for kind, gain in (
            ("echo", np.clip(1.0 + facing / 0.1, 0.0, 1.0)),
            ("shading", np.clip((-facing - 0.2) / 0.2, 0.0, 1.0)),
        ):
            if gain.mean() > 0.08:
                filtered = fan_filter(a[i], wa[i], gain)
                fields[f"{kind} {name_a}-{name_b}"] = (filtered, wa[i], b[j], wb[j])
    surfaces: dict[str, Surface] = {}
    for channel in list(fields):
        surface = correlate(*fields[channel], reach)
        if surface is not None and channel.startswith("shading"):
            fields[channel], surface = _signed(fields[channel], surface, reach)
        if surface is not None:
            surfaces[channel] = surface
    landmarks = landmark_field(a[OBJECTS], wa[OBJECTS], b[OBJECTS], wb[OBJECTS], cell_m)
    if landmarks is not None:
        fields["objects"] = landmarks
        surfaces["objects"] = coincide(*landmarks, reach)
    return {c: fields[c] for c in surfaces}, surfaces


def _signed(field: Fields, surface: Surface, reach: int) -> tuple[Fields, Surface | None]:
    """Choose the sign of a correlation that may have either: the one whose extreme is twice the other's.

    The side lobes of either sign look like peaks of the other, so where neither is stronger neither counts.
    """
    high, low = float(surface.significance.max()), float(-surface.significance.min())
    if high >= 2.0 * low:
        return field, surface
    if low < 2.0 * high:
        return field, None
    u, wu, v, wv = field
    return (u, wu, -v, wv), correlate(u, wu, -v, wv, reach)


def judge(
    fields: dict[str, Fields],
    surfaces: dict[str, Surface],
    inner: int,
    cell_m: float,
    config: MatchConfig,
    prior_m2: FloatArray | None,
) -> tuple[FloatArray, FloatArray, float, float, str]:
    """Return shift (cells, east and north), covariance (m2), evidence, margin, and why not (or "")."""
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
        return best, nothing, evidence, 0.0, "best at the border of the search"
    gains = {c: s.gain(int(row), int(col)) for c, s in surfaces.items()}
    if "objects" in gains:
        # The correlation of points with gains is a log-likelihood as it stands.
        gains["objects"] = 1.0
    offset, covariance, lobe = refine(fields, gains, best, inner)
    if covariance is None or np.abs(offset).max() > 1.5:
        return best, nothing, evidence, 0.0, "no clear peak"
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
    reason = ""
    if evidence < needed:
        reason = f"too little in common (evidence {evidence:.1f} of {needed:.1f})"
    elif margin < config.least_margin:
        reason = f"not the only fit (margin {margin:.1f})"
    elif np.sqrt(np.linalg.eigvalsh(covariance).max()) > 0.4 * reach * cell_m:
        reason = "too wide a peak"
    return best + offset, covariance, evidence, margin, reason


def _prior_cost(steps_m: FloatArray, prior_m2: FloatArray) -> FloatArray:
    x, y = np.meshgrid(steps_m, steps_m)
    inverse = np.linalg.inv(prior_m2)
    cost: FloatArray = 0.5 * (
        inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y
    )
    return cost


def _height_between(
    a: FloatArray, wa: FloatArray, b: FloatArray, wb: FloatArray, shift: FloatArray, cov_cells: FloatArray
) -> tuple[float, float]:  # fmt: skip
    """Return mean height of the second less the first at the shift, and its 1-sigma.

    Heights of a strip err together over metres, so the spread is taken between blocks a quarter of the
    square wide, and a tilt of the ground turns the shift's own error into height.
    """
    col, row = (int(v) for v in np.floor(shift))
    fx, fy = shift - np.floor(shift)
    moved = np.zeros_like(b)
    weight = np.full_like(wb, np.inf)
    for dy, dx, part in (
        (0, 0, (1 - fy) * (1 - fx)),
        (0, 1, (1 - fy) * fx),
        (1, 0, fy * (1 - fx)),
        (1, 1, fy * fx),
    ):
        turn = (-(row + dy), -(col + dx))
        moved += part * np.roll(b, turn, (0, 1))
        weight = np.minimum(weight, np.roll(wb, turn, (0, 1)))
    both = (wa > 0) & (weight > 0)
    if both.sum() < 25:
        return np.nan, np.nan
    w = np.where(
        both, 2.0 / (1.0 / np.where(both, wa, 1.0) + 1.0 / np.where(both, weight, 1.0)), 0.0
    )
    difference = np.where(both, moved - a, 0.0)
    mean = float((w * difference).sum() / w.sum())
    rows, cols = np.nonzero(both)
    quarter = max(1, int(np.ptp(rows) + 1) // 4)
    block = (rows // quarter) * 1000 + cols // quarter
    _, inverse = np.unique(block, return_inverse=True)
    weights = np.bincount(inverse, w[both])
    means = np.bincount(inverse, (w * difference)[both]) / weights
    n = weights.sum() ** 2 / (weights**2).sum()
    spread = float((weights * (means - mean) ** 2).sum() / weights.sum())
    plane = np.column_stack([cols - cols.mean(), rows - rows.mean()]).astype(float)
    tilt = np.linalg.lstsq(plane, (a[both] - a[both].mean()).astype(float), rcond=None)[0]
    return mean, float(np.sqrt(spread / max(n - 1.0, 1.0) + tilt @ cov_cells @ tilt + 1e-4))
