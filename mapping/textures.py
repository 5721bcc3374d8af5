"""What of a strip can be matched: relief, echo texture of each side, objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.ndimage import uniform_filter

from mapping.echo_places import placed_across
from perception.records import BoolArray, ElevationStrip, FloatArray, Grid

# What a cell's echo tells: that ground was seen there; its level, on either side of the sonar.
SEEN, OF_PORT, OF_STARBOARD = 1, 2, 4


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
    smooth_m: float = 1.0
    least_evidence: float = 6.0
    least_margin: float = 4.0


@dataclass(frozen=True, slots=True)
class Texture:
    """What of a strip can be matched, (n, m) each but for the objects.

    Attributes
    ----------
    relief, relief_weight : float32, weight zero no data; `relief_share` is the part of the relief's variance that its
        own sigma does not explain.
    level, echo : float32 log echo, and what it may be used for: `SEEN`, `OF_PORT`, `OF_STARBOARD`, added up.
    objects : (k, 3) line, column and size of each object, positive a hill, negative a crater.
    across_m : where each cell truly lies to starboard of its line, as far as the floor's height is known.
    """

    relief: FloatArray
    relief_weight: FloatArray
    level: FloatArray
    echo: npt.NDArray[np.uint8]
    objects: FloatArray
    strip: ElevationStrip
    relief_share: float
    across_m: FloatArray


def texture(
    strip: ElevationStrip, config: MatchConfig | None = None, floor: Grid | None = None
) -> Texture:
    """Return what of a strip can be matched, in the strip's own frame.

    relief: height less its mean over `highpass_m`, weighted by 1/sigma^2.
    port, starboard: log echo less its mean over `highpass_m`, evened in contrast.
    objects: spikes at the tops of hills and the middles of craters, from any side the same.

    Parameters
    ----------
    floor : what is known of the floor so far. A strip places its echoes as if the floor were level beneath
        each line; with it they are placed where their slant range meets it.
    """
    config = config or MatchConfig()
    size = _filter_size(strip, config.highpass_m)
    relief, relief_weight, relief_share = _relief(strip, size)
    loud = np.isfinite(strip.echo) & (strip.echo > 0) & ~strip.shadow
    level = _level(strip, loud, size, config.smooth_m)
    # Near nadir an echo tells nothing about slope, and the two sides meet.
    off_nadir = np.abs(strip.across_m) > 0.4 * np.nan_to_num(strip.altitude_m)[:, None]
    side = np.where(strip.across_m < 0, OF_PORT, np.where(strip.across_m > 0, OF_STARBOARD, 0))
    echo = np.where(loud & off_nadir, side, 0) + np.where(np.isfinite(strip.echo), SEEN, 0)
    spikes = _landmarks(strip, level)
    spikes[~np.isfinite(strip.echo)] = 0.0
    objects = np.column_stack([*np.nonzero(spikes), spikes[np.nonzero(spikes)]])
    return Texture(
        relief, relief_weight, level, echo.astype(np.uint8), objects, strip, relief_share,
        placed_across(strip, floor),
    )  # fmt: skip


def _relief(strip: ElevationStrip, size: tuple[int, int]) -> tuple[FloatArray, FloatArray, float]:
    """Return heights less their mean over a box, their weights, and the part of their variance that is no noise."""
    seen = np.isfinite(strip.elevation_m) & np.isfinite(strip.sigma_m) & (strip.sigma_m > 0)
    if not seen.any():
        nothing = np.zeros(seen.shape, np.float32)
        return nothing, nothing, 0.0
    # A floor keeps a few cells of great confidence from deciding alone.
    sigma = np.where(seen, strip.sigma_m, 1.0)
    sigma = np.maximum(sigma, np.median(sigma[seen]) * 0.5)
    weight = np.where(seen, 1.0 / sigma**2, 0.0)
    weight /= weight.max()
    relief = _highpass(np.where(seen, strip.elevation_m, 0.0), weight, size)
    signal = float(np.average(relief**2, weights=weight))
    noise = float(np.average(sigma**2, weights=weight))
    return relief, weight.astype(np.float32), signal / (signal + noise)


def _level(
    strip: ElevationStrip, loud: BoolArray, size: tuple[int, int], smooth_m: float
) -> FloatArray:
    """Return log echo less its mean over a box, evened in contrast."""
    # Power is averaged before the logarithm: single looks have a long tail of darkness in logarithms.
    fine = _filter_size(strip, smooth_m, least=1)
    power = uniform_filter(
        np.where(loud, strip.echo, 0.0).astype(np.float32), fine, mode="constant"
    )
    share = uniform_filter(loud.astype(np.float32), fine, mode="constant")
    level = np.log(np.maximum(power, 1e-6) / np.maximum(share, 1e-6))
    level = _highpass(np.clip(level, -2.0, 2.0), loud.astype(np.float32), size)
    return _evened(level, loud.astype(np.float32), (2 * size[0] + 1, 2 * size[1] + 1))


def placed_anew(known: Texture, strip: ElevationStrip, floor: Grid | None) -> Texture:
    """Return a texture at the strip's new poses and placed on a better known floor; its values stay."""
    return replace(known, strip=strip, across_m=placed_across(strip, floor))


def thinned(strip: ElevationStrip, width_m: float) -> ElevationStrip:
    """Return the strip with columns averaged to no more than `width_m` each.

    Power and heights are means of what is there, sigma likewise (columns err together), shadow the majority.
    The sides are not mixed: columns are counted from the track outwards.
    """
    _, spacing = _spacings(strip) if len(strip.time_s) > 1 and len(strip.across_m) > 1 else (0, 1e9)
    factor = int(width_m / spacing)
    if factor < 2:
        return strip
    block = np.floor(np.arange(len(strip.across_m)) - int((strip.across_m < 0).sum())) // factor
    first = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
    size = np.diff(np.append(first, len(block)))

    def mean(values: FloatArray) -> FloatArray:
        seen = np.isfinite(values)
        number = np.add.reduceat(seen.astype(np.float32), first, axis=1)
        total = np.add.reduceat(np.where(seen, values, 0.0), first, axis=1)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    return replace(
        strip,
        elevation_m=mean(strip.elevation_m),
        sigma_m=mean(strip.sigma_m),
        echo=mean(strip.echo),
        shadow=np.add.reduceat(strip.shadow.astype(np.float32), first, axis=1) > 0.5 * size,
        across_m=np.add.reduceat(strip.across_m, first) / size,
        flags=None if strip.flags is None else np.bitwise_or.reduceat(strip.flags, first, axis=1),
    )


def _filter_size(strip: ElevationStrip, width_m: float, least: int = 3) -> tuple[int, int]:
    """Return lines and columns of a box about `width_m` wide: odd, as an even one shifts by half a sample."""
    step, spacing = _spacings(strip)
    lines, columns = (max(least, 2 * round((width_m / d - 1.0) / 2.0) + 1) for d in (step, spacing))
    return lines, columns


def _highpass(values: FloatArray, weight: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Subtract the weighted mean over a box, so that gaps neither count nor leak."""
    v = values.astype(np.float32)
    w = weight.astype(np.float32)
    mean_w = uniform_filter(w, size, mode="constant")
    mean_v = uniform_filter(v * w, size, mode="constant")
    return np.where(w > 0, v - mean_v / np.maximum(mean_w, 1e-6), 0.0)


def _evened(values: FloatArray, weight: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Divide by the rms over a box and clip: one glaring slope must not decide a whole square."""
    mean_w = uniform_filter(weight, size, mode="constant")
    mean_sq = uniform_filter(values**2 * weight, size, mode="constant")
    rms = np.sqrt(mean_sq / np.maximum(mean_w, 1e-6))
    typical = float(np.sqrt((values**2 * weight).sum() / max(float(weight.sum()), 1.0)))
    # A floor of half the typical contrast: plain mud must not be blown up into texture.
    return np.clip(values / np.maximum(rms, 0.5 * max(typical, 1e-6)), -2.5, 2.5)


def _landmarks(strip: ElevationStrip, level: FloatArray) -> FloatArray:
    """Return (n, m) a signed spike at each object's centre (hills up, craters down), else 0.

    An object is a patch of shadow off the nadir that spans three lines and a square metre. A hill's shadow
    follows its highlight, and its top lies where the shadow starts; in a crater the shadow comes first, and
    the middle lies where it ends. Both places are the same from every side, unlike the shadow itself. A
    spike's size grows with the shadow's, but slowly: one ridge must not outvote ten boulders.
    """
    n, m = strip.shadow.shape
    spikes = np.zeros((n, m), np.float32)
    off_nadir = np.abs(strip.across_m) > 0.6 * np.nan_to_num(strip.altitude_m)[:, None]
    step, spacing = _spacings(strip)
    for side in (-1, 1):
        columns = np.flatnonzero(np.sign(strip.across_m) == side)[::side]
        if len(columns) < 8:
            continue
        shadow = (strip.shadow & off_nadir)[:, columns]
        # Single dark samples are speckle: a shadow has no holes of a sample and no lone samples.
        shadow = uniform_filter(shadow.astype(np.float32), 3) > 0.6
        label, count = ndimage.label(shadow)
        if not count:
            continue
        area = np.bincount(label.ravel(), minlength=count + 1) * step * spacing
        first = shadow & ~np.pad(shadow, ((0, 0), (1, 0)))[:, :-1]
        final = shadow & ~np.pad(shadow, ((0, 0), (0, 1)))[:, 1:]
        starts, ends = _edge_means(label, first, count), _edge_means(label, final, count)
        reach = max(1, round(1.5 / spacing))
        bright = uniform_filter(level[:, columns], (3, 2 * (reach // 2) + 1))
        for k in range(1, count + 1):
            if area[k] < 1.0 or starts[k, 2] < 3:
                continue
            row = int(starts[k, 0])
            near = bright[row, max(int(starts[k, 1]) - reach, 0)]
            far = bright[row, min(int(ends[k, 1]) + reach, len(columns) - 1)]
            crater = far > near + 0.3
            column = int(ends[k, 1] if crater else starts[k, 1])
            spikes[row, columns[column]] = (-1.0 if crater else 1.0) * min(area[k], 16.0) ** 0.25
    return spikes


def _edge_means(
    label: npt.NDArray[np.int32], edge: npt.NDArray[np.bool_], count: int
) -> FloatArray:
    """Return (count + 1, 3) mean row and column of each label's edge cells, and their number."""
    rows, cols = np.nonzero(edge)
    which = label[rows, cols]
    number = np.bincount(which, minlength=count + 1).astype(float)
    sums = [
        np.bincount(which, v, minlength=count + 1) / np.maximum(number, 1) for v in (rows, cols)
    ]
    return np.stack([*sums, number], axis=1)


def _spacings(strip: ElevationStrip) -> tuple[float, float]:
    """Return the usual distance between lines and between columns."""
    return strip.step_m, max(float(np.median(np.diff(strip.across_m))), 1e-3)


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
