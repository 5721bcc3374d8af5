"""How wrong a prior map is: its white error filtered out, the rest described.

The observed map is terrain plus error. White error has a flat spectrum, terrain falls with
frequency, so the floor of the map's power spectrum bounds the white error from above; the stated
sigma bounds it too. What the stated sigma has beyond that floor must be *correlated* over more than
a cell, and cannot be told from terrain: it is kept as variance.

The white part is removed by the Wiener filter W = S / (S + N), with S the terrain's spectrum and N
the floor; it leaves an error of spectrum S N / (S + N), hence of variance and correlation length
known. On flat ground this is what makes slopes usable at all: 0.3 m of white error on cells of 5 m
is a false slope of 0.06, beside which a relief of 1 m over a kilometre is nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage, optimize

from perception.records import BoolArray, FloatArray

# IHO S-44, Order 1a: total vertical uncertainty at 95 % is sqrt(a^2 + (b depth)^2).
_S44_A_M, _S44_B = 0.5, 0.013
# Below this many cells a spectrum says nothing; the map is used as it is.
_LEAST_CELLS = 32 * 32
# Correlation lengths tried where none is given: from what is barely not white from cell to cell to
# the width of swaths, over which sound speed and tide err alike.
_SHORTEST_CELLS, _LONGEST_M, _LENGTHS = 1.6, 150.0, 4
# Terrain spectra fall as k^-p; two-dimensional fractals of Hurst exponent 0 to 1.5 have p of 2 to 5.
_SLOPES = np.arange(2.0, 5.01, 0.5)


@dataclass(frozen=True, slots=True)
class MapError:
    """What is known of a map's error after filtering.

    Attributes
    ----------
    stated_m : median 1-sigma as given.
    white_m : white part found in the map's own spectrum, before filtering.
    filtered_m, filtered_length_m : what the filter leaves of it, and its correlation length.
    correlated_m : the part of the stated sigma that the spectrum shows not to be white.
    length_m : correlation length of that part where it was given; NaN not known.
    between_m : terrain between the cells' centres that bilinear interpolation misses.
    """

    stated_m: float
    white_m: float
    filtered_m: float
    filtered_length_m: float
    correlated_m: float
    length_m: float = float("nan")
    between_m: float = 0.0

    @property
    def total_m(self) -> float:
        """1-sigma of the filtered map between its cells' centres, all parts together."""
        return float(np.sqrt(self.filtered_m**2 + self.correlated_m**2 + self.between_m**2))


def assumed_sigma(depth_m: float) -> float:
    """1-sigma to assume of a map that states none: IHO S-44 Order 1a at its depth.

    >>> round(assumed_sigma(60.0), 2)
    0.47
    """
    return float(np.hypot(_S44_A_M, _S44_B * depth_m)) / 1.96


def map_error_lengths(error: MapError, cell_m: float) -> dict[float, float]:
    """Correlation lengths (m) that a map's error may have, and their prior weights.

    One where it was given, or where all of it is white; else several, all alike: a stated sigma says
    nothing of the length, and each length passes for terrain of another kind.
    """
    if np.isfinite(error.length_m):
        white = error.filtered_m > error.correlated_m
        return {error.filtered_length_m if white else error.length_m: 1.0}
    if error.correlated_m == 0:
        return {error.filtered_length_m: 1.0}
    shortest = _SHORTEST_CELLS * cell_m
    tried = np.geomspace(shortest, max(_LONGEST_M, 4 * shortest), _LENGTHS)
    return {float(length): 1.0 / _LENGTHS for length in tried}


def filter_map(
    elevation_m: FloatArray,
    sigma_m: FloatArray,
    cell_m: float,
    cell_north_m: float,
    error_length_m: float | None = None,
) -> tuple[FloatArray, FloatArray, MapError]:
    """Filter the white error out of a map; return heights, their 1-sigma, and the error's parts.

    Parameters
    ----------
    elevation_m, sigma_m : (rows, cols), NaN no data.
    error_length_m : correlation length of the error where it is known: less than two cells means
        that the whole of `sigma_m` is white, more that none of it is.

    Notes
    -----
    A cell whose sigma is larger than the median keeps its excess in proportion.
    """
    valid = np.isfinite(elevation_m)
    stated = float(np.nanmedian(np.where(valid, sigma_m, np.nan))) if valid.any() else 0.0
    stated = stated if np.isfinite(stated) else 0.0
    cells = np.where(np.isfinite(sigma_m), sigma_m, stated)
    length = float("nan") if error_length_m is None else error_length_m
    known_white = error_length_m is not None and error_length_m < 2 * cell_m
    known_red = error_length_m is not None and not known_white
    if valid.sum() < _LEAST_CELLS or stated == 0.0 or known_red:
        between = _between_cells(elevation_m, stated if not known_red else 0.0)
        error = MapError(stated, 0.0, 0.0, cell_m, stated, length, between)
        return elevation_m, np.where(valid, np.hypot(cells, between), np.nan), error
    work, power, frequency = _spectrum(elevation_m, valid, cell_m, cell_north_m)
    area = cell_m * cell_north_m
    floor = stated**2 * area if known_white else min(_floor(power, frequency), stated**2 * area)
    terrain = _terrain_spectrum(power, frequency, floor)
    gain = terrain / (terrain + floor)
    left = gain * floor
    height = _apply(work, valid, gain)
    filtered = float(np.sqrt(np.mean(left) / area))
    # A correlation exp(-d / L) covers an area of 2 pi L^2.
    reach = float(np.sqrt(left.max() / (2 * np.pi * max(filtered, 1e-9) ** 2)))
    white = float(np.sqrt(floor / area))
    error = MapError(
        stated_m=stated,
        white_m=white,
        filtered_m=filtered,
        filtered_length_m=max(reach, cell_m),
        correlated_m=float(np.sqrt(max(stated**2 - white**2, 0.0))),
        length_m=length,
        between_m=_between_cells(elevation_m, white),
    )
    return height, np.where(valid, cells * (error.total_m / stated), np.nan), error


def _between_cells(elevation_m: FloatArray, white_m: float) -> float:
    """Estimate what bilinear interpolation misses, from what it misses on wider cells.

    The mean of a cell's four diagonal neighbours is the interpolation on a doubled grid at its worst
    point; on a grid of four times the cell it misses more by a factor 2^p, p the ground's own power,
    and going down to the grid itself divides by the same. Half of the worst point's variance is the
    mean over a cell.
    """
    doubled, fourfold = (_missed(elevation_m, lag, white_m) for lag in (1, 2))
    if doubled <= 0:
        return 0.0
    # Between a jumble of steps and a smooth surface.
    ratio = float(np.clip(fourfold / doubled, 2.0, 16.0))
    return float(np.sqrt(doubled / ratio / 2))


def _missed(elevation_m: FloatArray, lag: int, white_m: float) -> float:
    """Mean square of a cell less the mean of its four diagonal neighbours, noise taken off."""
    rows, cols = elevation_m.shape
    if min(rows, cols) <= 2 * lag:
        return 0.0
    inner = elevation_m[lag:-lag, lag:-lag]
    near, far = slice(None, -2 * lag), slice(2 * lag, None)
    corners = (
        elevation_m[near, near] + elevation_m[near, far] + elevation_m[far, near]
        + elevation_m[far, far]
    )  # fmt: skip
    miss = (inner - corners / 4).ravel()
    miss = miss[np.isfinite(miss)]
    if miss.size < 16:
        return 0.0
    # The white error adds its own variance and a quarter of it to the difference.
    return max(float(np.mean(miss**2)) - 1.25 * white_m**2, 0.0)


def _spectrum(
    elevation_m: FloatArray, valid: BoolArray, cell_m: float, cell_north_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the filled map, its spectral density (m^2 per cycle^2/m^2) and |k| on the rfft grid."""
    nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    filled = np.asarray(elevation_m)[tuple(nearest)]
    rows, cols = filled.shape
    window = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(cols + 2)[1:-1])
    flat = filled - filled[valid].mean()
    density = np.abs(fft.rfft2(flat * window)) ** 2 * cell_m * cell_north_m
    # Filled cells carry no noise: the density belongs to the valid share of the window.
    density /= np.sum(window**2 * valid)
    frequency = np.hypot(
        fft.fftfreq(rows, cell_north_m)[:, None], fft.rfftfreq(cols, cell_m)[None, :]
    )
    return filled, density, frequency


def _floor(power: FloatArray, frequency: FloatArray) -> float:
    """Fit N + A k^-p to the upper half of the spectrum and return N, the white part."""
    top = frequency.max() / np.sqrt(2)
    edges = np.linspace(0.25 * top, top, 13)
    which = np.digitize(frequency.ravel(), edges) - 1
    inside = (which >= 0) & (which < 12)
    number = np.bincount(which[inside], minlength=12)
    # The median of an exponential variable is ln 2 of its mean; the mean would follow spikes.
    ring = np.array(
        [
            np.median(power.ravel()[inside & (which == i)]) / np.log(2) if number[i] else np.nan
            for i in range(12)
        ]
    )
    centre = (edges[1:] + edges[:-1]) / 2 / top
    use = np.isfinite(ring) & (ring > 0)
    if use.sum() < 4:
        return 0.0
    best, floor = np.inf, 0.0
    for slope in _SLOPES:
        design = np.stack([np.ones(use.sum()), centre[use] ** -slope], axis=1) / ring[use, None]
        solution, misfit = optimize.nnls(design, np.ones(use.sum()))
        if misfit < best:
            best, floor = misfit, float(solution[0])
    return floor


def _terrain_spectrum(power: FloatArray, frequency: FloatArray, floor: float) -> FloatArray:
    """Radial mean of the spectrum less the floor, positive and falling, on the rfft grid."""
    bins = 48
    low = frequency[frequency > 0].min()
    edges = np.geomspace(low, frequency.max() * 1.001, bins + 1)
    which = np.clip(np.digitize(frequency.ravel(), edges) - 1, 0, bins - 1)
    number = np.bincount(which, minlength=bins)
    mean = np.bincount(which, weights=power.ravel(), minlength=bins) / np.maximum(number, 1)
    filled = number > 0
    centre = np.sqrt(edges[1:] * edges[:-1])
    # A ring of n values of an exponential variable has a standard error of its mean of 1/sqrt(n):
    # what does not stand out of the floor by two of them is no terrain.
    margin = floor * 2.0 / np.sqrt(np.maximum(number, 1))
    terrain = np.where(mean > floor + margin, mean - floor, 1e-3 * floor)
    terrain = np.minimum.accumulate(terrain[filled])
    logs = np.interp(
        np.log(np.maximum(frequency, low)), np.log(centre[filled]), np.log(terrain + 1e-12)
    )
    return np.exp(logs)


def _apply(filled: FloatArray, valid: BoolArray, gain: FloatArray) -> FloatArray:
    """Filter with mirrored edges; NaN where the map had none."""
    rows, cols = filled.shape
    mean = filled[valid].mean()
    pad_r, pad_c = min(rows - 1, 64), min(cols - 1, 64)
    wide = np.pad(filled - mean, ((pad_r, pad_r), (pad_c, pad_c)), mode="reflect")
    # The gain belongs to the unpadded grid: read it at the padded grid's frequencies.
    row = np.abs(fft.fftfreq(wide.shape[0])) * rows
    col = fft.rfftfreq(wide.shape[1]) * cols
    half = gain[: rows // 2 + 1]
    at = np.meshgrid(
        np.clip(row, 0, half.shape[0] - 1), np.clip(col, 0, half.shape[1] - 1), indexing="ij"
    )
    response = ndimage.map_coordinates(half, at, order=1, mode="nearest")
    smooth = fft.irfft2(fft.rfft2(wide) * response, s=wide.shape)
    smooth = smooth[pad_r : pad_r + rows, pad_c : pad_c + cols] + mean
    return np.where(valid, smooth, np.nan)
