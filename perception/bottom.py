"""Bottom track: the first echo of the sea floor, as a path of least cost over all pings at once.

A threshold per ping is lost to noise, fish and the surface. Here each range of each ping is scored as
the change from water column to floor, using *all* samples before and a long stretch after it, and one
path through all pings is found by dynamic programming. A second bottom (at twice the range) fails
because the floor's own echo lies before it; a surface return and a fish fail because the water goes
on after them. docs/echoes-to-strips.md has the reasoning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.ndimage import binary_erosion, grey_closing, median_filter, uniform_filter1d
from scipy.signal import savgol_filter

from perception.records import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class BottomConfig:
    """Settings of the bottom track.

    Attributes
    ----------
    min_altitude_m : ranges below it are the transmit pulse's own; None takes 6 samples.
    smooth_pings : pings over which the finished track is smoothed (a running parabola).
    jump_cost : cost of moving the track by one cell of range between pings, in units of the score
        of one clear cell. Small values follow cliffs, large ones hold through noise.
    """

    min_altitude_m: float | None = None
    smooth_pings: int = 9
    jump_cost: float = 1.5


@dataclass(frozen=True, slots=True)
class BottomTrack:
    """The floor below the sonar, per ping; all (n,), metres.

    Attributes
    ----------
    altitude_m : vertical height above the floor. The first return is the *least* slant range, which on
        a slope lies to the uphill side, so the later of the two sides' first returns is nearer.
    sigma_m : 1-sigma of `altitude_m`.
    first_return_m : least slant range of either side.
    valid : False where no change to a floor was seen and the track is carried over.
    """

    altitude_m: FloatArray
    sigma_m: FloatArray
    first_return_m: FloatArray
    valid: BoolArray


# A coarse cell must be fine enough that the track lands beside the edge, and coarse enough for speed.
_COARSE_CELLS = 400
# Score of one cell is limited, so that one bright fish or one dark cell cannot outvote its neighbours.
_CELL_LIMIT = 3.0
# Echoes weaker than the floor's by more than this (log power, 30 dB) count as water: side lobes hear the
# neighbouring pings' nearer floor before their own, far above the noise and far below the floor.
_FAINT = 6.9
# Stretch after the edge that must look like floor, as a part of the range.
_AFTER = 0.5


def track_bottom(
    port_power: FloatArray,
    starboard_power: FloatArray,
    sample_m: float,
    altitude_hint_m: FloatArray | None = None,
    config: BottomConfig | None = None,
) -> BottomTrack:
    """Track the bottom through all pings of a pass.

    Parameters
    ----------
    port_power, starboard_power : (n, m) echo power near to far, any unit; NaN no data. One side may
        be all NaN.
    sample_m : range of one sample; sample k is centred at ``(k + 0.5) * sample_m``.
    altitude_hint_m : (n,) recorded altitude, in any scale, or None. Used only to carry the track
        across dropouts, and only where it goes along with the track elsewhere.

    Returns
    -------
    BottomTrack
    """
    config = config or BottomConfig()
    sides = [_log_power(side) for side in (port_power, starboard_power) if np.isfinite(side).any()]
    n = len(port_power)
    if not sides:
        nothing = np.full(n, np.nan)
        return BottomTrack(nothing, nothing.copy(), nothing.copy(), np.zeros(n, bool))
    nearest = max(2, round((config.min_altitude_m or 6 * sample_m) / sample_m))
    coarse, contrast = _coarse_track(sides, nearest, config)
    firsts, noise = zip(*(_refine(side, coarse, nearest, config) for side in sides), strict=True)
    valid = _is_valid(contrast)
    track = _assemble(np.array(firsts), np.array(noise), valid, sample_m, altitude_hint_m, config)
    return _below_objects(track, sides, sample_m)


def _log_power(power: FloatArray) -> FloatArray:
    """Return log power with a floor, so that stored zeros are dark and not minus infinity."""
    finite = power[np.isfinite(power)]
    positive = finite[finite > 0]
    floor = (
        max(0.25 * float(positive.min()), 1e-7 * float(np.median(positive)))
        if len(positive)
        else 1.0
    )
    return np.log(np.maximum(power, floor), dtype=np.float32)


def _coarse_track(
    sides: list[FloatArray], nearest: int, config: BottomConfig
) -> tuple[FloatArray, FloatArray]:
    """Return the track in samples (n,), to a coarse cell, and the floor's contrast in log units."""
    n, m = sides[0].shape
    block = max(1, -(-m // _COARSE_CELLS))
    cells = m // block
    first_cell = max(1, nearest // block)
    image = np.zeros((n, cells), np.float32)
    for side in sides:
        blocks = side[:, : cells * block].reshape(n, cells, block)
        known = np.isfinite(blocks)
        mean = np.where(known, blocks, 0).sum(2) / np.maximum(known.sum(2), 1)
        image += np.where(known.any(2), mean, np.nanmin(side)) / len(sides)
    # Three pings side by side: speckle falls, and no bottom moves by more than a cell or two.
    image = uniform_filter1d(image, 3, axis=0, mode="nearest") if n >= 3 else image
    track = _least_cost_path(_contrast_cost(image, first_cell), config.jump_cost * 0.5)
    # Two rounds: levels of water and floor from the track, then the track from the levels.
    for _ in range(2):
        water, floor, spread = _levels(image, track, first_cell)
        cost = _change_cost(image, water, floor, spread, first_cell, float(np.median(track)))
        track = _least_cost_path(cost, config.jump_cost)
    contrast = _edge_contrast(image, track, first_cell)
    return track * float(block), contrast


def _contrast_cost(image: FloatArray, first_cell: int) -> FloatArray:
    """Score every cell by the mean level after it less the mean level before it, scale-free.

    Windows are parts of the range, so an echo at twice the altitude has the floor in its "before".
    """
    n, cells = image.shape
    sums = np.concatenate([np.zeros((n, 1)), np.cumsum(image, axis=1, dtype=float)], axis=1)
    k = np.arange(cells)
    before_from = np.maximum(np.minimum(first_cell, k - 1), (0.3 * k).astype(int)).clip(0)
    after_to = np.minimum(cells, np.maximum(k + 2, (1.4 * k).astype(int) + 1))
    before = (sums[:, k] - sums[:, before_from]) / np.maximum(k - before_from, 1)
    after = (sums[:, after_to] - sums[:, k]) / np.maximum(after_to - k, 1)
    # The same over a tenth of the range on either side, which is sharp where the long windows are flat.
    close = np.maximum(2, (0.1 * k).astype(int))
    near = (
        sums[:, np.minimum(k + close, cells)] - 2 * sums[:, k] + sums[:, np.maximum(k - close, 0)]
    )
    score = np.clip(after - before, -2.0, 4.0) + np.clip(near / close, -2.0, 6.0)
    score[:, : first_cell + 1] = -4.0
    return (-4.0 * score).astype(np.float32)


def _levels(
    image: FloatArray, track: FloatArray, first_cell: int
) -> tuple[FloatArray, FloatArray, float]:
    """Return log level of water and of near floor per cell of range, and their spread."""
    # A ping without echo would teach a water far darker than the others'.
    taught = _is_valid(_edge_contrast(image, track, first_cell))
    if taught.any():
        image, track = image[taught], track[taught]
    n, cells = image.shape
    k = np.arange(cells)
    water, floor = np.full(cells, np.nan), np.full(cells, np.nan)
    in_water = (k < 0.93 * track[:, None]) & (k >= first_cell)
    # A first track may lie a little early: the floor's level is taken from further out.
    in_floor = (k > 1.12 * track[:, None] + 1) & (k < 1.6 * track[:, None] + 3)
    for j in range(cells):
        if in_water[:, j].sum() >= max(5, n // 50):
            water[j] = np.median(image[in_water[:, j], j])
        if in_floor[:, j].sum() >= max(5, n // 50):
            floor[j] = np.median(image[in_floor[:, j], j])
    water = _filled(
        water, float(np.median(image[in_water])) if in_water.any() else float(image.min())
    )
    floor = _filled(
        floor, float(np.median(image[in_floor])) if in_floor.any() else float(image.max())
    )
    floor = np.maximum(floor, water + 0.5)
    residual = np.abs(image - np.where(in_floor, floor, water))[in_water | in_floor]
    spread = 1.48 * float(np.median(residual)) if len(residual) else 1.0
    return np.maximum(water, floor - _FAINT), floor, max(spread, 0.2)


def _filled(values: FloatArray, fallback: float) -> FloatArray:
    """Carry the known values to the ends and between, where ranges have none of their own."""
    known = np.flatnonzero(np.isfinite(values))
    if len(known) == 0:
        return np.full(len(values), fallback)
    return np.interp(np.arange(len(values)), known, values[known])


def _change_cost(
    image: FloatArray,
    water: FloatArray,
    floor: FloatArray,
    spread: float,
    first_cell: int,
    usual: float,
) -> FloatArray:
    """Return the cost of the floor beginning at each cell: log likelihood ratios, limited per cell."""
    n, cells = image.shape
    ratio = (floor - water) * (image - (floor + water) / 2) / spread**2
    ratio = np.clip(ratio, -_CELL_LIMIT, _CELL_LIMIT)
    ratio[:, :first_cell] = 0
    sums = np.concatenate([np.zeros((n, 1)), np.cumsum(ratio, axis=1, dtype=float)], axis=1)
    k = np.arange(cells)
    after_to = np.minimum(cells, np.maximum(k + 3, ((1 + _AFTER) * k).astype(int) + 1))
    # Means and not sums: the far floor is often as dark as water, and would outvote the true edge by
    # its number alone. The usual range brings the score back to the scale of single cells.
    before = sums[:, k] / np.maximum(k - first_cell, 1)
    after = (sums[:, after_to] - sums[:, k]) / np.maximum(after_to - k, 1)
    cost = usual * (before - after)
    # A ping without any echo would otherwise drag the track to the far end at no limit.
    low = cost.min(axis=1, keepdims=True)
    cost = np.minimum(cost - low, 20 * _CELL_LIMIT)
    cost[:, : first_cell + 1] = 40 * _CELL_LIMIT
    return cost.astype(np.float32)


@njit(cache=True, nogil=True)
def _least_cost_path(cost, jump_cost):  # type: ignore[no-untyped-def]
    """Return the column per row (n,) that minimises cost plus `jump_cost` per column moved.

    Exact, by dynamic programming; the minimum over all jumps is a two-pass distance transform.
    """
    n, m = cost.shape
    back = np.zeros((n, m), dtype=np.int32)
    total = cost[0].astype(np.float64)
    reach = np.empty(m)
    source = np.empty(m, dtype=np.int32)
    for i in range(1, n):
        for k in range(m):
            reach[k] = total[k]
            source[k] = k
        for k in range(1, m):
            if reach[k - 1] + jump_cost < reach[k]:
                reach[k] = reach[k - 1] + jump_cost
                source[k] = source[k - 1]
        for k in range(m - 2, -1, -1):
            if reach[k + 1] + jump_cost < reach[k]:
                reach[k] = reach[k + 1] + jump_cost
                source[k] = source[k + 1]
        for k in range(m):
            back[i, k] = source[k]
            total[k] = reach[k] + cost[i, k]
    path = np.empty(n, dtype=np.float64)
    k = int(np.argmin(total))
    for i in range(n - 1, -1, -1):
        path[i] = k
        k = back[i, k]
    return path


def _edge_contrast(image: FloatArray, track: FloatArray, first_cell: int) -> FloatArray:
    """Return mean log level after the track less the mean before it, per ping."""
    n, cells = image.shape
    sums = np.concatenate([np.zeros((n, 1)), np.cumsum(image, axis=1, dtype=float)], axis=1)
    at = np.clip(track.astype(int), 1, cells - 1)
    rows = np.arange(n)
    begin = np.clip((0.5 * at).astype(int), min(first_cell, cells - 2), at - 1)
    end = np.clip((1.3 * at).astype(int) + 2, at + 1, cells)
    after = (sums[rows, end] - sums[rows, at]) / (end - at)
    before = (sums[rows, at] - sums[rows, begin]) / np.maximum(at - begin, 1)
    return after - before


def _is_valid(contrast: FloatArray) -> BoolArray:
    """Tell pings with a floor: at least a third of the usual step, and a step at all."""
    usual = float(np.median(contrast))
    return contrast > max(0.35 * usual, 0.3)


def _refine(
    side: FloatArray, coarse: FloatArray, nearest: int, config: BottomConfig
) -> tuple[FloatArray, FloatArray]:
    """Return one side's first return in samples (fractional), and its noise per ping.

    Works on single samples in a band around the coarse track, by the same change score.
    """
    n, m = side.shape
    block = max(1, -(-m // _COARSE_CELLS))
    half = int(max(4 * block, 8, 0.06 * float(np.median(coarse))))
    width = 2 * half + 1
    start = np.clip(coarse.astype(int) + block // 2 - half, 0, max(m - width, 0))
    columns = np.minimum(start[:, None] + np.arange(min(width, m)), m - 1)
    band = np.take_along_axis(side, columns, axis=1).astype(float)
    band = np.where(np.isfinite(band), band, np.nanmin(side))
    low = np.median(band[:, : half // 2 + 1])
    high = np.median(band[:, half + 1 : half + 1 + max(3, half // 2)])
    spread = max(1.48 * float(np.median(np.abs(band[:, half + 1 :] - high))), 0.3)
    low = max(low, high - _FAINT)
    if high - low < 0.3:
        high = low + 0.3
    ratio = np.clip((high - low) * (band - (high + low) / 2) / spread**2, -3, 3)
    sums = np.concatenate([np.zeros((n, 1)), np.cumsum(ratio, axis=1)], axis=1)[:, :-1]
    cost = 2 * sums - sums[:, -1:]
    cost[columns < nearest] = cost.max() + 1
    path = _least_cost_in_band(cost, start, config.jump_cost)
    own = start + np.argmin(cost, axis=1)
    smooth = _running_parabola(path + 0.5, config.smooth_pings)
    noise = 1.48 * median_filter(np.abs(own + 0.5 - smooth), min(25, n), mode="nearest")
    return smooth, noise


def _least_cost_in_band(cost: FloatArray, start: np.ndarray, jump_cost: float) -> FloatArray:
    """Find the path of least cost in a band whose first column moves from ping to ping."""
    lowest = int(start.min())
    n, width = cost.shape
    full = np.full((n, int(start.max()) - lowest + width), float(cost.max()) + 10.0, np.float32)
    np.put_along_axis(full, (start - lowest)[:, None] + np.arange(width), cost, axis=1)
    path: FloatArray = _least_cost_path(full, jump_cost) + lowest
    return path


def _running_parabola(values: FloatArray, window: int) -> FloatArray:
    """Smooth by a running parabola, after a running median that drops single wild pings."""
    n = len(values)
    if n < 5:
        return values
    calm = median_filter(values, 5, mode="nearest")
    length = min(window, n if n % 2 else n - 1) | 1
    # A parabola and not a line: heave over a few pings must not be flattened.
    return savgol_filter(calm, length, 2, mode="interp") if length > 2 else calm


def _assemble(
    firsts: FloatArray,
    noise: FloatArray,
    valid: BoolArray,
    sample_m: float,
    hint_m: FloatArray | None,
    config: BottomConfig,
) -> BottomTrack:
    """Turn the sides' first returns (s, n) in samples to altitude, sigma and first return."""
    averaged = np.sqrt(min(config.smooth_pings, firsts.shape[1]))
    sigma = np.hypot(noise / averaged, 0.3)
    first = firsts.min(axis=0)
    later = firsts.max(axis=0)
    mean = np.average(firsts, axis=0)
    # Where both sides agree within their noise the mean is best; where they do not, the floor slopes and
    # the later return is the vertical one.
    both = np.hypot(sigma[0], sigma[-1]) + 1e-9
    lean = np.clip((later - first) / both / 3 - 0.5, 0, 1) if len(firsts) == 2 else 0.0
    altitude = mean + lean * (later - mean)
    sigma_m = np.hypot(sigma.mean(axis=0) / np.sqrt(len(firsts)), 0.5 * (later - first)) * sample_m
    altitude_m, first_m = altitude * sample_m, first * sample_m
    if valid.any() and not valid.all():
        # Smoothing reached into the pings beside a dropout.
        clear = binary_erosion(valid, np.ones(config.smooth_pings // 2 * 2 + 1), border_value=1)
        clear = clear if clear.any() else valid
        altitude_m, first_m, sigma_m = _carried(altitude_m, first_m, sigma_m, clear, hint_m)
    return BottomTrack(altitude_m, sigma_m, first_m, valid)


def _carried(
    altitude_m: FloatArray,
    first_m: FloatArray,
    sigma_m: FloatArray,
    valid: BoolArray,
    hint_m: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Carry the track over pings without a floor: along the hint where it fits, else straight."""
    n = len(valid)
    index = np.arange(n)
    known = index[valid]
    carried = np.interp(index, known, altitude_m[valid])
    gap = np.min(
        np.abs(
            index[:, None]
            - np.stack(
                [
                    known[np.clip(np.searchsorted(known, index), 0, len(known) - 1)],
                    known[np.clip(np.searchsorted(known, index) - 1, 0, len(known) - 1)],
                ],
                axis=1,
            )
        ),
        axis=1,
    )
    drift = np.diff(altitude_m[valid])
    step = float(np.sqrt(np.mean(np.square(drift)))) if len(drift) else 0.0
    spread = step * np.sqrt(gap) + 0.02 * carried
    if hint_m is not None and np.isfinite(hint_m[valid]).sum() > 20:
        scale, residual = _hint_scale(hint_m[valid], altitude_m[valid])
        usable = np.isfinite(hint_m) & (hint_m > 0)
        if scale is not None and residual < 0.03 * float(np.median(carried)) and usable.all():
            offset = altitude_m - (scale[0] * hint_m + scale[1])
            carried = scale[0] * hint_m + scale[1] + np.interp(index, known, offset[valid])
            spread = np.minimum(spread, np.hypot(residual, 0.01 * carried))
    altitude = np.where(valid, altitude_m, carried)
    first = np.where(valid, first_m, carried)
    return altitude, first, np.where(valid, sigma_m, np.hypot(sigma_m, spread))


def _below_objects(track: BottomTrack, sides: list[FloatArray], sample_m: float) -> BottomTrack:
    """Put the altitude back on the floor where an object to the side echoes first.

    Such an object makes a short dip in the track, while the floor's own edge still stands at the
    range the track has on either side of the dip. Dips are found by closing the track (largest, then
    least value over a stretch); the edge decides whether the floor goes through beneath. Dips of less
    than eight samples are left: the object's own edge would be taken for the floor's.
    """
    n = len(track.altitude_m)
    samples = track.altitude_m / sample_m
    window = min(n, _DIP_PINGS) | 1
    closed = grey_closing(samples, window, mode="nearest")
    sigma = track.sigma_m / sample_m
    dip = closed - samples > np.maximum(3 * sigma, 8.0)
    if not dip.any():
        return track
    m = sides[0].shape[1]
    # Past a ping's last sample there is nothing: dark, like the water.
    image = np.mean([np.where(np.isfinite(side), side, np.nanmin(side)) for side in sides], axis=0)
    usual = float(np.median(_edge_step(image, samples, np.flatnonzero(~dip), m)))
    rows = np.flatnonzero(dip)
    through = _edge_step(image, closed, rows, m) > 0.4 * usual
    rows = rows[through]
    altitude = track.altitude_m.copy()
    altitude[rows] = closed[rows] * sample_m
    spread = track.sigma_m.copy()
    spread[rows] = np.maximum(spread[rows], 1.5 * sample_m)
    return BottomTrack(altitude, spread, track.first_return_m, track.valid)


# An object beside the track is passed within this many pings; a longer rise is the floor itself.
_DIP_PINGS = 61


def _edge_step(image: FloatArray, track: FloatArray, rows: np.ndarray, m: int) -> FloatArray:
    """Return the step of log level across the track at `rows`, six samples to either side."""
    if len(rows) == 0:
        return np.zeros(0)
    at = track[rows].astype(int)[:, None]
    before = np.clip(at + np.arange(-7, -1), 0, m - 1)
    after = np.clip(at + np.arange(1, 7), 0, m - 1)
    step: FloatArray = (image[rows[:, None], after] - image[rows[:, None], before]).mean(axis=1)
    return step


def _hint_scale(hint_m: FloatArray, altitude_m: FloatArray) -> tuple[FloatArray | None, float]:
    """Fit ``altitude = a * hint + b`` robustly; None where the hint says nothing."""
    good = np.isfinite(hint_m) & (hint_m > 0)
    if good.sum() < 20 or np.ptp(hint_m[good]) < 1e-6:
        return None, np.inf
    for _ in range(4):
        fit = np.polyfit(hint_m[good], altitude_m[good], 1)
        residual = altitude_m - np.polyval(fit, np.where(np.isfinite(hint_m), hint_m, 0))
        scale = 1.48 * float(np.median(np.abs(residual[good]))) + 1e-9
        good = np.isfinite(hint_m) & (hint_m > 0) & (np.abs(residual) < 3 * scale)
        if good.sum() < 20:
            return None, np.inf
    return fit, scale
