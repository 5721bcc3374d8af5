"""Registration of two strips on what they share: relief, slope shading, echo texture, objects.

Each of the four is a *channel* with its own noise. Channels are correlated over every shift of the
search, each correlation becomes a log-likelihood with its own effective number of independent cells, and
the log-likelihoods add. docs/registration.md has the derivation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.ndimage import uniform_filter

from perception.records import ElevationStrip, FloatArray

# Channels of a `Texture`, in the order of its last axis; heights ride along, for the offset between strips.
RELIEF, SHADE, ALBEDO, OBJECTS, HEIGHT = range(5)
CHANNEL_NAMES = ("relief", "shading", "echo", "objects")


@dataclass(frozen=True, slots=True)
class MatchConfig:
    """How strips are compared.

    Attributes
    ----------
    cell_m : cell of the comparison; None follows the strips' resolution.
    highpass_m : structure wider than this is left out: it tells little about place and much about bias.
    least_evidence : log-likelihood ratio against no match at all, beyond the logarithm of the number of
        places looked at, below which a match is refused.
    least_margin : log-likelihood ratio against the next best shift, likewise.
    """

    cell_m: float | None = None
    highpass_m: float = 16.0
    least_evidence: float = 6.0
    least_margin: float = 4.0


@dataclass(frozen=True, slots=True)
class Texture:
    """What of a strip can be matched: (n, m, 5) float32 values and weights, zero weight no data."""

    values: FloatArray
    weights: FloatArray
    strip: ElevationStrip


@dataclass(frozen=True, slots=True)
class Match:
    """The shift that brings two strips together.

    Attributes
    ----------
    shift_m : (2,) east and north by which features of the second strip lie from those of the first.
    covariance_m2 : (2, 2) from the match's own shape.
    height_m, height_sigma_m : second strip's height minus the first's over the common ground; NaN none.
    evidence, margin : log-likelihood ratios against no match and against the next best shift.
    correlation : (4,) of each channel at the shift; NaN not used.
    accepted, reason : whether the match may be believed, and why not.
    """

    shift_m: FloatArray
    covariance_m2: FloatArray
    height_m: float
    height_sigma_m: float
    evidence: float
    margin: float
    correlation: FloatArray
    accepted: bool
    reason: str


def texture(strip: ElevationStrip, config: MatchConfig | None = None) -> Texture:
    """Return what of a strip can be matched, in the strip's own frame.

    relief: height less its mean over `highpass_m`, weighted by 1/sigma^2.
    shading: log echo less its mean, with the sign of the side: proportional to the slope towards starboard
    on both sides, so it can be compared between any two looks.
    echo: the same without the sign: what the bottom's material does.
    objects: where shadows begin, weighted by their length: the top of an object, from any side.
    """
    config = config or MatchConfig()
    n, m = strip.elevation_m.shape
    values = np.zeros((n, m, 5), np.float32)
    weights = np.zeros((n, m, 5), np.float32)
    size = _filter_size(strip, config.highpass_m)
    seen = np.isfinite(strip.elevation_m) & np.isfinite(strip.sigma_m) & (strip.sigma_m > 0)
    if seen.any():
        # A floor keeps a few cells of great confidence from deciding alone.
        sigma = np.maximum(strip.sigma_m, np.median(strip.sigma_m[seen]) * 0.5)
        weight = np.where(seen, 1.0 / np.where(seen, sigma, 1.0) ** 2, 0.0)
        weight /= weight.max()
        values[..., RELIEF] = _highpass(np.where(seen, strip.elevation_m, 0.0), weight, size)
        weights[..., RELIEF] = weight
        values[..., HEIGHT] = np.where(seen, strip.elevation_m, 0.0)
        weights[..., HEIGHT] = weight
    loud = np.isfinite(strip.echo) & (strip.echo > 0) & ~strip.shadow
    level = np.log(np.where(loud, strip.echo, 1.0))
    level = _highpass(np.clip(level, -3.0, 3.0), loud.astype(np.float32), size)
    # Near nadir an echo tells nothing about slope and its sign flips.
    off_nadir = np.abs(strip.across_m) > 0.4 * np.nan_to_num(strip.altitude_m)[:, None]
    values[..., SHADE] = level * np.sign(strip.across_m)
    weights[..., SHADE] = loud & off_nadir
    values[..., ALBEDO] = level
    weights[..., ALBEDO] = loud
    tops = _shadow_starts(strip)
    values[..., OBJECTS] = tops - tops.mean()
    weights[..., OBJECTS] = np.isfinite(strip.echo)
    values[weights == 0] = 0.0
    return Texture(values, weights, strip)


def _filter_size(strip: ElevationStrip, width_m: float) -> tuple[int, int]:
    step = np.median(np.hypot(np.diff(strip.easting_m), np.diff(strip.northing_m)))
    spacing = np.median(np.diff(strip.across_m))
    return (
        int(max(3, round(width_m / max(float(step), 1e-3)))),
        int(max(3, round(width_m / max(float(spacing), 1e-3)))),
    )


def _highpass(values: FloatArray, weight: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Subtract the weighted mean over a box, so that gaps neither count nor leak."""
    v = values.astype(np.float32)
    w = weight.astype(np.float32)
    mean_w = uniform_filter(w, size, mode="constant")
    mean_v = uniform_filter(v * w, size, mode="constant")
    return np.where(w > 0, v - mean_v / np.maximum(mean_w, 1e-6), 0.0)


def _shadow_starts(strip: ElevationStrip) -> FloatArray:
    """Return (n, m) the root of the length of the shadow that starts in each cell, else 0."""
    n, m = strip.shadow.shape
    starts = np.zeros((n, m), np.float32)
    outward = np.sign(strip.across_m)
    for side in (-1, 1):
        columns = np.flatnonzero(outward == side)
        if len(columns) < 3:
            continue
        columns = columns if side > 0 else columns[::-1]
        shadow = strip.shadow[:, columns]
        length = np.zeros(shadow.shape, np.float32)
        running = np.zeros(n, np.float32)
        for j in range(len(columns) - 1, -1, -1):
            running = np.where(shadow[:, j], running + 1, 0)
            length[:, j] = running
        begins = shadow & ~np.pad(shadow, ((0, 0), (1, 0)))[:, :-1]
        starts[:, columns] = np.where(begins & (length >= 2), np.sqrt(length), 0.0)
    return starts


@numba.njit(cache=True)
def _scatter(
    values: FloatArray,
    weights: FloatArray,
    east: FloatArray,
    north: FloatArray,
    heading: FloatArray,
    across: FloatArray,
    west: float,
    south: float,
    cell: float,
    size: int,
) -> tuple[FloatArray, FloatArray]:
    """Average a texture's cells into a square grid (5, size, size), row 0 south.

    Each datum is shared among the four cells around it: given whole to one cell, a regular lattice of data
    on a regular grid beats, and every match is off by up to half a datum's spacing.
    """
    total = np.zeros((5, size, size), np.float32)
    weight = np.zeros((5, size, size), np.float32)
    for i in range(values.shape[0]):
        c, s = np.cos(heading[i]), np.sin(heading[i])
        for j in range(values.shape[1]):
            x = (east[i] + c * across[j] - west) / cell - 0.5
            y = (north[i] - s * across[j] - south) / cell - 0.5
            col, row = int(np.floor(x)), int(np.floor(y))
            if not (0 <= col < size - 1 and 0 <= row < size - 1):
                continue
            fx, fy = x - col, y - row
            for k in range(5):
                w = weights[i, j, k]
                if w > 0:
                    for dy in range(2):
                        for dx in range(2):
                            part = w * (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
                            total[k, row + dy, col + dx] += part * values[i, j, k]
                            weight[k, row + dy, col + dx] += part
    for k in range(5):
        for row in range(size):
            for col in range(size):
                if weight[k, row, col] > 0:
                    total[k, row, col] /= weight[k, row, col]
    return total, weight


def default_cell(strips: Sequence[ElevationStrip]) -> float:
    """Return a cell for comparing: the strips' coarser spacing, at least a 250th of their width."""
    cells = []
    for strip in strips:
        if len(strip.time_s) < 2 or len(strip.across_m) < 2:
            continue
        step = np.median(np.hypot(np.diff(strip.easting_m), np.diff(strip.northing_m)))
        spacing = np.median(np.diff(strip.across_m))
        cells.append(max(float(step), float(spacing), float(np.ptp(strip.across_m)) / 250.0))
    return float(np.median(cells)) if cells else 1.0


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
    a, wa, heading_a = _gather(first, corner, cell_m, size)
    b, wb, heading_b = _gather(second, corner, cell_m, size)
    edge = (size - inner) // 2
    outside = np.ones((size, size), bool)
    outside[edge : edge + inner, edge : edge + inner] = False
    wa[:, outside] = 0.0
    fields = _channels(a, wa, b, wb, heading_a, heading_b)
    surfaces = {
        channel: surface
        for channel, field in fields.items()
        if (surface := _correlate(*field, reach)) is not None
    }
    _choose_shading_or_echo(surfaces, np.cos(heading_b - heading_a))
    if not surfaces:
        return _refused("no common ground")
    shift, covariance, evidence, margin, reason = _judge(
        {c: fields[c] for c in surfaces}, surfaces, inner, cell_m, config, prior_m2
    )
    if reason and not np.isfinite(covariance).all():
        return _refused(reason)
    height_m, height_sigma_m = _height_between(
        a[HEIGHT], wa[HEIGHT], b[HEIGHT], wb[HEIGHT], shift, covariance / cell_m**2
    )
    correlation = np.full(4, np.nan)
    centre = tuple(np.round(shift[::-1]).astype(int) + reach)
    for channel, surface in surfaces.items():
        correlation[channel] = surface.rho[centre]
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
        np.zeros(2), np.full((2, 2), np.nan), np.nan, np.nan, 0.0, 0.0, np.full(4, np.nan), False, reason
    )  # fmt: skip


def _gather(
    texture: Texture, corner: tuple[float, float], cell_m: float, size: int
) -> tuple[FloatArray, FloatArray, float]:
    """Return the texture on the square's grid (5, size, size), its weights, and its mean heading."""
    strip = texture.strip
    half = 0.5 * size * cell_m
    east, north = strip.easting_m - corner[0] - half, strip.northing_m - corner[1] - half
    along = np.abs(east * np.sin(strip.heading_rad) + north * np.cos(strip.heading_rad))
    near = along < 1.5 * half
    if not near.any():
        nothing = np.zeros((5, size, size), np.float32)
        return nothing, nothing.copy(), 0.0
    rows = slice(int(np.argmax(near)), len(near) - int(np.argmax(near[::-1])))
    values, weights = _scatter(
        texture.values[rows], texture.weights[rows], strip.easting_m[rows], strip.northing_m[rows],
        strip.heading_rad[rows], strip.across_m, corner[0], corner[1], cell_m, size,
    )  # fmt: skip
    heading = strip.heading_rad[near]
    return values, weights, float(np.arctan2(np.sin(heading).mean(), np.cos(heading).mean()))


_Fields = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _channels(
    a: FloatArray, wa: FloatArray, b: FloatArray, wb: FloatArray, heading_a: float, heading_b: float
) -> dict[int, _Fields]:
    """Return the fields to correlate, (first, weight, second, weight) for each channel.

    Shading is the slope towards each strip's own starboard, s1 and s2. Where the two are askew the first is
    differentiated along s2 and the second along s1: both are then the same second derivative.
    """
    fields: dict[int, _Fields] = {RELIEF: (a[RELIEF], wa[RELIEF], b[RELIEF], wb[RELIEF])}
    along = np.cos(heading_b - heading_a)
    if abs(along) > 0.7:
        sign = np.float32(np.sign(along))
        shade = (a[SHADE], wa[SHADE], sign * b[SHADE], wb[SHADE])
    else:
        shade = (
            *_slope_towards(a[SHADE], wa[SHADE], heading_b),
            *_slope_towards(b[SHADE], wb[SHADE], heading_a),
        )
    fields[SHADE] = shade
    if not _same_looks(a, wa, b, wb, along):
        fields[ALBEDO] = (a[ALBEDO], wa[ALBEDO], b[ALBEDO], wb[ALBEDO])
    smooth_a, smooth_b = (uniform_filter(x[OBJECTS], 3) for x in (a, b))
    fields[OBJECTS] = (smooth_a, wa[OBJECTS], smooth_b, wb[OBJECTS])
    return fields


def _slope_towards(
    values: FloatArray, weights: FloatArray, heading_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Return the derivative towards starboard of a heading, and its weights, on a grid with row 0 south."""
    # The box before the difference keeps speckle from being differentiated.
    mean_w = uniform_filter(weights, 3)
    smooth = uniform_filter(values * weights, 3) / np.maximum(mean_w, 1e-6)
    north, east = np.gradient(smooth)
    slope = np.cos(heading_rad) * east - np.sin(heading_rad) * north
    whole = mean_w > 0.6 * max(float(mean_w.max()), 1e-12)
    return np.where(whole, slope, 0.0).astype(np.float32), whole.astype(np.float32)


def _same_looks(a: FloatArray, wa: FloatArray, b: FloatArray, wb: FloatArray, along: float) -> bool:
    """Tell whether both strips look at the square from the same side, so shading and echo are one."""
    both = (wa[SHADE] > 0) & (wb[SHADE] > 0) & (np.abs(a[ALBEDO]) > 0) & (np.abs(b[ALBEDO]) > 0)
    if abs(along) <= 0.7 or not both.any():
        return False
    side_a, side_b = np.sign(a[SHADE] * a[ALBEDO])[both], np.sign(b[SHADE] * b[ALBEDO])[both]
    return bool(np.mean(side_a * side_b) * np.sign(along) > 0.5)


def _choose_shading_or_echo(surfaces: dict[int, _Surface], along: float) -> None:
    """Keep one of shading and echo where strips look from opposite sides.

    The two are then one correlation with opposite signs: what the slope does is reversed, what the material
    does is not. The side lobes of either look like peaks of the other, so the stronger extreme decides,
    and where neither is stronger both are left out.
    """
    if abs(along) <= 0.7 or SHADE not in surfaces or ALBEDO not in surfaces:
        return
    shade, echo = (float(surfaces[c].significance.max()) for c in (SHADE, ALBEDO))
    if shade < 2.0 * echo:
        del surfaces[SHADE]
    if echo < 2.0 * shade:
        del surfaces[ALBEDO]


@dataclass(frozen=True, slots=True)
class _Surface:
    """One channel's correlation over the search: (s, s) arrays, row 0 the southernmost shift."""

    rho: FloatArray
    log_likelihood: FloatArray
    common: FloatArray
    independent: FloatArray
    scale: FloatArray
    significance: FloatArray

    def gain(self, row: int, col: int) -> float:
        """Return what the log-likelihood gains per unit of the raw correlation, 0 where it is negative."""
        rho, scale = float(self.rho[row, col]), float(self.scale[row, col])
        if rho <= 0.0 or scale <= 0.0:
            return 0.0
        return float(self.independent[row, col]) * rho / (1 - rho**2) / scale


def _correlate(
    u: FloatArray, wu: FloatArray, v: FloatArray, wv: FloatArray, reach: int
) -> _Surface | None:
    """Correlate two weighted fields over shifts of up to `reach` cells.

    Under no match the sum over x of U(x) V(x + d) has the variance sum over lags of R_U R_V, whatever the
    fields' own correlation; dividing by it tells how many cells the square is really worth.
    """
    mask_u, mask_v = (wu > 0).astype(np.float32), (wv > 0).astype(np.float32)
    n_u, n_v = float(mask_u.sum()), float(mask_v.sum())
    if n_u < 25 or n_v < 25:
        return None
    weighted_u, weighted_v = wu * u, wv * v
    left = fft.rfft2(np.stack([weighted_u, weighted_u * u, wu, mask_u]))
    right = fft.rfft2(np.stack([weighted_v, wv, weighted_v * v, mask_v]))
    size = u.shape[0]
    products = fft.irfft2(np.conj(left) * right, s=u.shape)
    steps = np.arange(-reach, reach + 1) % size
    num, power_u, power_v, common = products[:, steps[:, None], steps]
    power = np.abs(left[0]) ** 2 * np.abs(right[0]) ** 2
    # The half spectrum of a real field counts each inner column twice.
    twice = np.full(power.shape[1], 2.0)
    twice[0] = 1.0
    if size % 2 == 0:
        twice[-1] = 1.0
    power = (power * twice).astype(np.float64) / (float(size) ** 2 * n_v)
    variance = power.sum()
    energy = np.sqrt(np.maximum(power_u, 0.0) * np.maximum(power_v, 0.0))
    if variance <= 0 or energy.max() <= 0:
        return None
    good = (common > 0.3 * common.max()) & (energy > 1e-6 * energy.max())
    rho = np.where(good, num / np.where(good, energy, 1.0), 0.0)
    rho = np.clip(rho, -0.999, 0.999)
    variance_d = variance * np.maximum(common, 1.0) / n_u
    independent = np.minimum(energy**2 / variance_d, np.maximum(common, 1.0))
    likelihood = -0.5 * independent * np.log1p(-(np.maximum(rho, 0.0) ** 2))
    significance = np.where(good, num / np.sqrt(variance_d), 0.0)
    return _Surface(rho, np.where(good, likelihood, 0.0), common, independent, energy, significance)


def _judge(
    fields: dict[int, _Fields],
    surfaces: dict[int, _Surface],
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
    offset, covariance, lobe = _refine(fields, gains, best, inner)
    if covariance is None or np.abs(offset).max() > 1.5:
        return best, nothing, evidence, 0.0, "no clear peak"
    # A tenth of a cell is what sampling on a grid leaves of any peak.
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


def _refine(
    fields: dict[int, _Fields], gains: dict[int, float], best: FloatArray, inner: int
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Climb to the top of the summed correlation below a cell; return offset, covariance, lobe (cells).

    With X(k) the cross-spectrum of the squares at the whole-cell shift, the correlation's slope at a
    further shift d is the sum of -k Im X exp(ikd), its curvature that of -k k' Re X exp(ikd). What the two
    squares share has no imaginary part at the right d; what they do not has random phase. So the sum of
    k k' (Im X)^2 is the slope's variance, and curvature^-1 variance curvature^-1 the shift's (the
    sandwich), whatever the fields' spectra.
    """
    # Channels that share their speckle (shading and echo) add up before they are squared below.
    total = np.zeros((inner, inner // 2 + 1), complex)
    filled = 0.0
    for channel, gain in gains.items():
        if gain > 0:
            spectrum, part = _cross_spectrum(fields[channel], best, inner)
            total += spectrum * (gain / inner**2)
            filled = max(filled, part)
    if not filled:
        return np.zeros(2), None, np.ones(2)
    ky = 2 * np.pi * fft.fftfreq(inner)[:, None]
    kx = 2 * np.pi * fft.rfftfreq(inner)[None, :]
    twice = np.full(kx.shape, 2.0)
    twice[0, 0] = 1.0
    if inner % 2 == 0:
        twice[0, -1] = 1.0
    offset, nothing = np.zeros(2), np.ones(2)
    for last in (False, False, True):
        turn = np.exp(1j * (kx * offset[0] + ky * offset[1]))
        x = total * turn
        slope = -np.array([(kx * twice * x.imag).sum(), (ky * twice * x.imag).sum()])
        curvature = _second_moments(kx, ky, twice * x.real)
        if np.linalg.eigvalsh(curvature).min() <= 0:
            return offset, None, nothing
        inverse = np.linalg.inv(curvature)
        if last:
            # Where the squares are filled in part, neighbouring modes move together.
            spread = _second_moments(kx, ky, (twice * x.imag) ** 2) / filled
            return offset, inverse @ spread @ inverse, np.sqrt(np.diag(inverse))
        offset = offset + np.clip(inverse @ slope, -0.8, 0.8)
    raise AssertionError("unreachable: the last round returns")


def _cross_spectrum(
    field: _Fields, best: FloatArray, inner: int
) -> tuple[npt.NDArray[np.complexfloating[Any]], float]:
    """Return the cross-spectrum of the two squares at a whole-cell shift, and how far they are filled."""
    u, wu, v, wv = field
    edge = (u.shape[0] - inner) // 2
    here = np.s_[edge : edge + inner, edge : edge + inner]
    col, row = best.astype(int)
    there = np.s_[edge + row : edge + row + inner, edge + col : edge + col + inner]
    both = (wu[here] > 0) & (wv[there] > 0)
    left = np.where(both, wu[here] * u[here], 0.0)
    right = np.where(both, wv[there] * v[there], 0.0)
    return np.conj(fft.rfft2(left)) * fft.rfft2(right), float(both.mean())


def _second_moments(kx: FloatArray, ky: FloatArray, weight: FloatArray) -> FloatArray:
    xy = (kx * ky * weight).sum()
    return np.array([[(kx * kx * weight).sum(), xy], [xy, (ky * ky * weight).sum()]])


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
