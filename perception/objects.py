"""Objects and craters: shadows joined over consecutive pings, each with height, sigma and footprint.

Shadow labels that touch form a candidate; the echo around it is fitted with a bump and with a pit
(`perception.silhouettes`), and the better of the two gives kind, height above the surrounding floor, and
footprint. Where neither explains the shadow (a wreck, a mast), the paper's own relation over the shadow's
pings stands in, with a wider sigma.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields

import numpy as np
from scipy import ndimage

from perception.fitting import BumpFit, Patch, fit_patch
from perception.geometry import ground_range
from perception.levels import SHADOW, Levels
from perception.object_table import ObjectRow, ObjectTable, write_objects_csv
from perception.records import FloatArray, IntArray
from perception.shadows import crater_depth, hill_height, hill_sigma

__all__ = ["ObjectConfig", "ObjectRow", "ObjectTable", "Track", "find_objects", "write_objects_csv"]


@dataclass(frozen=True, slots=True)
class ObjectConfig:
    """Settings of the search for objects.

    Attributes
    ----------
    min_samples, min_pings, min_cells : least shadow: samples in range of its longest ping, pings, and
        samples altogether.
    min_gain : least log likelihood over a flat floor of an object, natural log units.
    shape_sigma : what the family of shapes leaves open, as a part of the height.
    fits, fits_per_ping : at most ``fits + fits_per_ping * pings`` shadows a side, the largest, are fitted;
        on a floor strewn with shadows the rest are measured by the plain relation, which is quick, and
        those below `plain_cells` samples are left out.
    """

    min_samples: int = 6
    min_pings: int = 2
    min_cells: int = 20
    min_gain: float = 30.0
    shape_sigma: float = 0.04
    fits: int = 30
    fits_per_ping: float = 0.025
    plain_cells: int = 60


@dataclass(frozen=True, slots=True)
class Track:
    """What the search needs of the pings: all (n,), metres and radians."""

    along_m: FloatArray
    altitude_m: FloatArray
    altitude_sigma_m: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    heading_rad: FloatArray
    ping: IntArray


@dataclass(frozen=True, slots=True)
class _Shadow:
    """One connected shadow: its box in the image, and start and end sample per ping (-1 none)."""

    number: int
    row0: int
    row1: int
    col0: int
    col1: int
    start: IntArray
    end: IntArray
    cells: int

    @property
    def lengths(self) -> IntArray:
        return np.where(self.start >= 0, self.end - self.start, 0)


def find_objects(
    ratio: FloatArray,
    levels: Levels,
    sample_m: float,
    side: int,
    track: Track,
    pass_index: int,
    floor_sigma_m: FloatArray | None = None,
    config: ObjectConfig | None = None,
) -> list[ObjectRow]:
    """Find the objects and craters of one side of a pass.

    Parameters
    ----------
    ratio : (n, m) equalised power; NaN no data.
    levels : labels and statistics of the same samples.
    sample_m : range of a sample.
    side : -1 port, 1 starboard.
    floor_sigma_m : (m,) 1-sigma of the floor's height at each slant sample against the floor below
        the sonar, on flat ground zero; None takes zero.

    Returns
    -------
    list of ObjectRow, in order of the pings.
    """
    config = config or ObjectConfig()
    marks, shadows = _shadows(levels.label, config)
    budget = config.fits + int(config.fits_per_ping * len(ratio))
    least = sorted((shadow.cells for shadow in shadows), reverse=True)[:budget][-1:]
    rows = []
    for shadow in shadows:
        fitted = shadow.cells >= least[0]
        if not fitted and shadow.cells < config.plain_cells:
            continue
        row = _measure(
            shadow, fitted, marks, ratio, levels, sample_m, side, track, floor_sigma_m, config
        )
        if row is not None:
            rows.append(_placed(row, side, track, pass_index))
    return rows


def _shadows(label: IntArray, config: ObjectConfig) -> tuple[IntArray, list[_Shadow]]:
    """Return the image of connected shadows (n, m), and those large enough to measure."""
    marks, count = ndimage.label(label == SHADOW, structure=np.ones((3, 3)))
    sizes = np.bincount(marks.ravel(), minlength=count + 1)
    shadows = []
    for number, box in enumerate(ndimage.find_objects(marks), start=1):
        rows, columns = box
        if (
            sizes[number] < config.min_cells
            or rows.stop - rows.start < config.min_pings
            or columns.stop - columns.start < config.min_samples
        ):
            continue
        own = marks[box] == number
        any_row = own.any(axis=1)
        start = np.where(any_row, own.argmax(axis=1) + columns.start, -1)
        end = np.where(any_row, columns.stop - own[:, ::-1].argmax(axis=1), -1)
        shadow = _Shadow(number, rows.start, rows.stop, columns.start, columns.stop,
                         start, end, int(sizes[number]))  # fmt: skip
        if np.sort(shadow.lengths)[-2:].min() >= config.min_samples - 1:
            shadows.append(shadow)
    return marks, shadows


def _measure(
    shadow: _Shadow,
    fitted: bool,
    marks: IntArray,
    ratio: FloatArray,
    levels: Levels,
    sample_m: float,
    side: int,
    track: Track,
    floor_sigma_m: FloatArray | None,
    config: ObjectConfig,
) -> ObjectRow | None:
    """Return height, kind and footprint of one shadow's object, not yet placed on the map."""
    peak = _peak_row(shadow)
    row = shadow.row0 + peak
    drop = float(track.altitude_m[row])
    start_m, end_m = shadow.start[peak] * sample_m, shadow.end[peak] * sample_m
    if not start_m > drop * 1.0001:
        return None
    floor_sigma = 0.0
    if floor_sigma_m is not None:
        floor_sigma = float(floor_sigma_m[min(shadow.end[peak], len(floor_sigma_m)) - 1])
    drop_sigma = float(np.hypot(track.altitude_sigma_m[row], floor_sigma))
    order = _order_evidence(shadow, ratio, levels.looks * levels.independent)
    fit = None
    if fitted:
        starts = _starts(shadow, start_m, end_m, drop, track)
        if abs(order) > _SURE_ORDER:
            starts = [start for start in starts if start[0] * order > 0]
        patch = _patch(shadow, marks, ratio, levels, sample_m, track)
        fit = fit_patch(patch, starts, favour=_ORDER_WEIGHT * order)
        if fit is not None and fit.gain < config.min_gain:
            return None
    if fit is not None and _explains(fit, shadow, drop, track):
        pings = int((shadow.lengths >= 0.5 * shadow.lengths.max()).sum())
        return _of_fit(fit, start_m, end_m, drop, drop_sigma, pings, config)
    return _of_shadow(shadow, order > 0, sample_m, start_m, end_m, drop, drop_sigma, track)


def _order_evidence(shadow: _Shadow, ratio: FloatArray, looks: float) -> float:
    """Return how surely the highlight comes before the shadow, in standard deviations (after: negative).

    The founding paper's rule (highlight then shadow is a hill, shadow then highlight a crater) on all
    pings of the shadow at once: columns of samples before its start and after its end are averaged
    over the pings, and the brighter stretch on either side is compared.
    """
    core = np.flatnonzero(shadow.lengths >= 0.5 * shadow.lengths.max())
    length = int(np.median(shadow.lengths[core]))
    reach, window = max(6, int(1.2 * length)), max(2, length // 5)
    steps = np.arange(reach)
    m = ratio.shape[1]
    brightest, number = [], 0
    for edges, direction in ((shadow.start[core] - 1, -1), (shadow.end[core], 1)):
        columns = edges[:, None] + direction * steps
        inside = (columns >= 0) & (columns < m)
        values = ratio[(shadow.row0 + core)[:, None], np.clip(columns, 0, m - 1)]
        values = np.where(inside & np.isfinite(values), np.minimum(values, 8.0), 1.0)
        profile = np.convolve(values.mean(axis=0), np.full(window, 1 / window), mode="valid")
        brightest.append(float(profile.max()))
        number = len(core) * window
    spread = np.sqrt(2 / (number * min(looks, 4.0)))
    return float(np.log(brightest[0] / brightest[1]) / spread)


def _peak_row(shadow: _Shadow) -> int:
    """Return the row of the longest shadow, of lengths smoothed over three pings."""
    lengths = shadow.lengths.astype(float)
    if len(lengths) >= 3:
        lengths = np.convolve(lengths, [0.25, 0.5, 0.25], mode="same")
    return int(np.argmax(np.where(shadow.start >= 0, lengths, -1)))


# Beyond this many standard deviations the order of levels alone settles the kind; below, each counts for this
# much log likelihood.
_SURE_ORDER, _ORDER_WEIGHT = 3.0, 3.0

# A patch is averaged down to at most this many lines and bins: the fit's cost is their product.
_PATCH_LINES, _PATCH_BINS = 24, 110
# Many looks would make the fit surer than the family of shapes is true, and the priors mute.
_MOST_WEIGHT = 1.0


def _patch(
    shadow: _Shadow,
    marks: IntArray,
    ratio: FloatArray,
    levels: Levels,
    sample_m: float,
    track: Track,
) -> Patch:
    """Cut the echo around a shadow: one length to either side in range, half a width along."""
    n, m = ratio.shape
    length = shadow.col1 - shadow.col0
    width = shadow.row1 - shadow.row0
    row0, row1 = max(0, shadow.row0 - width // 2 - 3), min(n, shadow.row1 + width // 2 + 3)
    margin = max(length, 12)
    col0, col1 = max(0, shadow.col0 - margin), min(m, shadow.col1 + margin)
    tall = max(1, -(-(row1 - row0) // _PATCH_LINES))
    wide = max(1, -(-(col1 - col0) // _PATCH_BINS))
    row1 = row0 + max(1, (row1 - row0) // tall) * tall
    col1 = col0 + max(1, (col1 - col0) // wide) * wide
    cut = ratio[row0:row1, col0:col1].astype(float)
    others = (marks[row0:row1, col0:col1] > 0) & (marks[row0:row1, col0:col1] != shadow.number)
    sizes_matter = ndimage.binary_opening(others, np.ones((2, 2)))
    cut[ndimage.binary_dilation(sizes_matter, np.ones((3, 5)))] = np.nan
    blocks = cut.reshape((row1 - row0) // tall, tall, (col1 - col0) // wide, wide)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    mean = np.where(known, blocks, 0).sum(axis=(1, 3)) / np.maximum(count, 1)
    # A cell of which half is missing would weigh as a whole one: leave it out.
    mean = np.where(2 * count >= tall * wide, mean, np.nan)
    independent = min(1.0, levels.independent * wide) if wide > 1 else levels.independent
    weight = levels.looks * independent * tall * (wide if levels.independent == 1 else 1.0)
    lines = np.s_[row0:row1]
    drop = track.altitude_m[lines].reshape(-1, tall).mean(axis=1)
    # Close to nadir the nominal level says nothing: the floor's bins there are as long as an object.
    slant = (col0 + (np.arange(mean.shape[1]) + 0.5) * wide) * sample_m
    mean[slant < 1.03 * drop[:, None]] = np.nan
    return Patch(
        ratio=np.ascontiguousarray(mean),
        along_m=np.ascontiguousarray(track.along_m[lines].reshape(-1, tall).mean(axis=1)),
        drop_m=np.ascontiguousarray(drop),
        start_m=col0 * sample_m,
        step_m=wide * sample_m,
        weight=float(np.clip(weight, 0.2, _MOST_WEIGHT)),
        leak=levels.shadow_level,
    )


def _starts(
    shadow: _Shadow, start_m: float, end_m: float, drop: float, track: Track
) -> list[tuple[float, float, FloatArray]]:
    """Return starting points of the fit: bumps and pits, short and long, smooth and steep."""
    y0, half = _along_extent(shadow, track)
    x_start = float(ground_range(np.array(start_m), np.array(drop)))
    high = float(hill_height(end_m - start_m, start_m, drop))
    deep = float(crater_depth(end_m - start_m, start_m, drop))
    law = np.log(1.8)
    starts = []
    for size_x, beta, lag in itertools.product((0.4, 0.7, 1.1, 1.7), (1.0, 2.0, 5.0), (0.1, 0.6)):
        sx, sy = size_x * half, (0.8 if beta == 1.0 else 0.95) * half
        corners = (2.0, 6.0) if beta == 5.0 else (2.0,)
        for corner in corners:
            # The grazing point lies `lag` sizes behind the summit; lower by the shape's fall to there.
            fall = np.exp(0.5 * lag ** (2 * beta))
            at = [
                x_start - lag * sx,
                y0,
                np.log(high * fall),
                np.log(sx),
                np.log(sy),
                np.log(beta),
                law,
            ]
            starts.append((1.0, corner, np.array(at)))
            # A pit's near rim lies a size and more before its centre.
            rim = x_start + (1.6 if beta == 1.0 else 1.1) * sx * (0.7 + 0.6 * lag)
            at = [rim, y0, np.log(1.25 * deep), np.log(sx), np.log(sy), np.log(beta), law]
            starts.append((-1.0, corner, np.array(at)))
    return starts


def _along_extent(shadow: _Shadow, track: Track) -> tuple[float, float]:
    """Return the shadow's middle along the track and its half width, by moments of its lengths.

    Moments, since a label's outermost pings are often a thread of speckle; a disc of radius a has a
    standard deviation of a / 2, a square of half side a has a / sqrt(3).
    """
    along = track.along_m[shadow.row0 : shadow.row1]
    weights = shadow.lengths.astype(float)
    y0 = float(np.average(along, weights=weights))
    spread = float(np.sqrt(np.average((along - y0) ** 2, weights=weights)))
    step = float(along[-1] - along[0]) / max(len(along) - 1, 1)
    return y0, max(1.9 * spread, 0.6 * step, 1e-2)


def _explains(fit: BumpFit, shadow: _Shadow, drop: float, track: Track) -> bool:
    """Tell whether the fit is an object that the shadow could belong to."""
    x0, y0 = fit.parameters[:2]
    sx, sy = np.exp(fit.parameters[3:5])
    middle, reach = _along_extent(shadow, track)
    sigma_log = float(np.sqrt(max(fit.covariance[2, 2], 0)))
    return bool(
        x0 > 0
        and abs(y0 - middle) < 1.5 * reach + sy
        and sy < 4 * reach + 1.0
        and sx < 8 * sy
        and fit.height_m < (0.98 * drop if fit.sign > 0 else 3 * drop)
        and sigma_log < 0.5
    )


def _of_fit(
    fit: BumpFit,
    start_m: float,
    end_m: float,
    drop: float,
    drop_sigma: float,
    pings: int,
    config: ObjectConfig,
) -> ObjectRow:
    x0, y0, _, log_sx, log_sy, log_beta, _ = fit.parameters
    height = fit.height_m
    beta = float(np.exp(log_beta))
    # Heights scale with the sonar's height above the floor; log A has the fit's own sigma.
    relative = np.sqrt(fit.covariance[2, 2] + config.shape_sigma**2 + (drop_sigma / drop) ** 2)
    # The horizontal beam's spread, which the model has not, blurs what few pings see.
    relative = np.hypot(relative, 0.25 / max(pings, 1))
    # Nearer than about the altitude the echo folds over itself and is dimmed by slope as much as by shadow:
    # in trials a fifth to a third of the height was off there.
    relative = np.hypot(relative, 0.4 * np.clip(1.3 - x0 / drop, 0.0, 0.8))
    tenth = np.sqrt((2 * np.log(10.0)) ** (1 / beta))
    return ObjectRow(
        easting_m=np.nan, northing_m=np.nan, kind="hill" if fit.sign > 0 else "crater",
        height_m=height, sigma_m=float(height * relative), slant_range_m=start_m,
        shadow_length_m=end_m - start_m, pass_index=0, ping=0, across_m=float(x0), along_m=float(y0),
        half_across_m=float(np.exp(log_sx) * tenth), half_along_m=float(np.exp(log_sy) * tenth),
        shape=beta, gain=fit.gain,
    )  # fmt: skip


def _of_shadow(
    shadow: _Shadow,
    hill: bool,
    sample_m: float,
    start_m: float,
    end_m: float,
    drop: float,
    drop_sigma: float,
    track: Track,
) -> ObjectRow:
    """Measure by the paper's relation: order of levels for the kind, the longest shadow for the height."""
    length = end_m - start_m
    height = float((hill_height if hill else crater_depth)(length, start_m, drop))
    sigma = float(hill_sigma(length, start_m, drop, sample_m, drop_sigma))
    x_start, x_end = (float(ground_range(np.array(v), np.array(drop))) for v in (start_m, end_m))
    middle, half = _along_extent(shadow, track)
    return ObjectRow(
        easting_m=np.nan, northing_m=np.nan, kind="hill" if hill else "crater", height_m=height,
        # The shape is not known here: a smooth summit lies above its grazing point.
        sigma_m=float(np.hypot(sigma, 0.15 * height)), slant_range_m=start_m, shadow_length_m=length,
        pass_index=0, ping=0, across_m=x_start if hill else 0.5 * (x_start + x_end),
        along_m=middle, half_across_m=min(half, 0.5 * (x_end - x_start)), half_along_m=half,
    )  # fmt: skip


def _placed(row: ObjectRow, side: int, track: Track, pass_index: int) -> ObjectRow:
    """Give a row its place on the map and its ping."""
    line = int(np.clip(np.searchsorted(track.along_m, row.along_m), 0, len(track.along_m) - 1))
    if line > 0 and row.along_m - track.along_m[line - 1] < track.along_m[line] - row.along_m:
        line -= 1
    across = side * row.across_m
    ahead = row.along_m - track.along_m[line]
    heading = float(track.heading_rad[line])
    course = _course(track, line)
    values = {f.name: getattr(row, f.name) for f in fields(row)}
    values |= {
        "easting_m": float(track.easting_m[line] + np.cos(heading) * across + np.sin(course) * ahead),
        "northing_m": float(track.northing_m[line] - np.sin(heading) * across + np.cos(course) * ahead),
        "across_m": across,
        "ping": int(track.ping[line]),
        "pass_index": pass_index,
    }  # fmt: skip
    return ObjectRow(**values)


def _course(track: Track, line: int) -> float:
    """Return the course over ground about a line, from positions some pings apart."""
    low, high = max(0, line - 10), min(len(track.along_m) - 1, line + 10)
    east = track.easting_m[high] - track.easting_m[low]
    north = track.northing_m[high] - track.northing_m[low]
    if np.hypot(east, north) == 0:
        return float(track.heading_rad[line])
    return float(np.arctan2(east, north))
