"""Where terrain can fix a vehicle, and how well: Fisher information cell by cell.

A vehicle that crosses a cell on a straight line of length `path_m` and heading h sounds the ground at
known places relative to itself. Each sounding of variance R on a slope g adds ``J' J / R`` to the
information on (east, north, depth bias), with J = (g_east, g_north, 1); the bias is marginalised
(Schur complement), so a plane tells nothing about the place, as it should. The bound is the
Cramer-Rao bound of the horizontal error, ``sqrt(trace(inverse))``; start information of the vehicle's
own position is added, so featureless ground gives the start's sigma rather than infinity.

Soundings that share a map error count together, as in `localization.likelihood`. A linear bound cannot see
rival places: what they add is found by simulating lines over the map (`localization.ambiguity`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from localization.ambiguity import Line, corrected, risen, square_miss
from localization.likelihood import DEFAULT_LENGTH_M
from localization.measurements import Sensors, beam_vectors, default_beams
from localization.readings import Reading
from localization.terrain import TerrainMap
from perception.records import FloatArray, Grid, Progress, silent


@dataclass(frozen=True, slots=True)
class ObservabilityConfig:
    """How the vehicle crosses a cell.

    Attributes
    ----------
    path_m : length of the line, centred on the cell.
    spacing_m : way from one update to the next.
    altitude_m : height above the bottom.
    headings : number of headings tried, over half a turn (a line has the same information both ways).
    lines : number of lines simulated to learn what the bound does not see; 0 gives the bound itself.
    """

    path_m: float = 300.0
    spacing_m: float = 4.5
    altitude_m: float = 50.0
    headings: int = 8
    lines: int = 64


@dataclass(frozen=True, slots=True)
class Observability:
    """Horizontal error of a fix, 1-sigma of both axes together, (rows, cols) m, NaN no data.

    Attributes
    ----------
    best_m, worst_m, mean_m : over the headings; `best_heading_rad` is the first's.
    by_heading_m : (headings, rows, cols).
    over_bound : median of the error over the linear bound.
    """

    best_m: FloatArray
    worst_m: FloatArray
    mean_m: FloatArray
    best_heading_rad: FloatArray
    by_heading_m: FloatArray
    headings_rad: FloatArray
    over_bound: float


def observability(
    terrain: TerrainMap,
    sensors: Sensors | None,
    rng: np.random.Generator,
    config: ObservabilityConfig | None = None,
    progress: Progress = silent,
) -> Observability:
    """Compute the error of a terrain fix for every cell and heading.

    Parameters
    ----------
    sensors : beams, noise and start sigma; four beams at 30 degrees by default.
    rng : source of the lines simulated.
    """
    sensors, config = sensors or Sensors(), config or ObservabilityConfig()
    headings = np.arange(config.headings) * np.pi / config.headings
    layers = []
    for i, heading in enumerate(headings):
        layers.append(bound_at(terrain, sensors, config, float(heading)))
        progress("observability", i + 1, len(headings))
    linear = np.array(layers)
    knots = simulated(terrain, sensors, config, linear, rng, progress)
    bounds = linear if knots is None else corrected(linear, knots)
    known = np.isfinite(terrain.height_m)
    filled = np.where(known, bounds, np.inf)
    best = np.argmin(filled, axis=0)
    return Observability(
        best_m=np.where(known, filled.min(axis=0), np.nan),
        worst_m=np.where(known, bounds.max(axis=0), np.nan),
        mean_m=np.where(known, bounds.mean(axis=0), np.nan),
        best_heading_rad=np.where(known, headings[best], np.nan),
        by_heading_m=bounds,
        headings_rad=headings,
        over_bound=float(np.nanmedian(bounds / linear)),
    )


def simulated(
    terrain: TerrainMap,
    sensors: Sensors,
    config: ObservabilityConfig,
    bounds_m: FloatArray,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> tuple[FloatArray, FloatArray] | None:
    """Simulate lines over the map; return how the error rises with the bound, see `ambiguity.risen`.

    Parameters
    ----------
    bounds_m : (headings, rows, cols) from `bound_at`.

    Returns
    -------
    None where hardly a line fits on the map: it is smaller than the path, or full of holes.
    """
    cells = np.argwhere(np.isfinite(bounds_m))
    bound, square = [], []
    for i in range(config.lines):
        progress("lines simulated", i + 1, config.lines)
        # Where most of the map is too near its edge, a few tries a line must do.
        for _ in range(5):
            heading, row, col = rng.choice(cells)
            reading = terrain.readings[rng.integers(len(terrain.readings))]
            line = _line_over(terrain, reading, sensors, config, (heading, row, col))
            if np.isfinite(terrain.heights(line.east_m, line.north_m)).all():
                bound.append(float(bounds_m[heading, row, col]))
                square.append(square_miss(reading.height_m, terrain.frame, line, bound[-1], rng))
                break
    if len(bound) < config.lines / 4 or not bound:
        return None
    return risen(np.array(bound), np.array(square))


def _line_over(
    terrain: TerrainMap,
    reading: Reading,
    sensors: Sensors,
    config: ObservabilityConfig,
    cell: tuple[int, int, int],
) -> Line:
    """The soundings of a line through a cell (heading, row, column), the map's error as one reading has it."""
    heading = cell[0] * np.pi / config.headings
    slant, vectors, noise_m = _beams(sensors, config)
    number = max(round(config.path_m / config.spacing_m), 1) + 1
    along = (np.arange(number) - (number - 1) / 2) * config.spacing_m
    reach = np.array([_offset(r * v, heading) for r, v in zip(slant, vectors, strict=True)])
    east = terrain.west_m + cell[2] * terrain.cell_m + np.sin(heading) * along
    north = terrain.north_m - cell[1] * terrain.cell_north_m + np.cos(heading) * along
    east, north = (east + reach[:, :1]).ravel(), (north + reach[:, 1:]).ravel()
    range_m2 = np.repeat(noise_m**2, number)
    apart = np.hypot(east[:, None] - east, north[:, None] - north)
    covariance = reading.shared_m**2 * np.exp(-apart / reading.length_m)
    covariance += np.diag(range_m2 + terrain.error.between_m**2 + 1e-9)
    parts = ((reading.shared_m**2, reading.length_m),)
    shared = _shared_variance(
        terrain, config, slant * np.hypot(vectors[:, 0], vectors[:, 1]), parts
    )
    return Line(east, north, covariance, range_m2 + shared, sensors.start_m, sensors.depth_bias_m)


def _beams(
    sensors: Sensors, config: ObservabilityConfig
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slant ranges (n,), unit vectors (n, 3) in the body frame, and noise of the height (n,)."""
    beams = sensors.beams or default_beams(4)
    vectors = beam_vectors(beams)
    slant = config.altitude_m / vectors[:, 2]
    fractions = np.array([b.fraction or sensors.beam_fraction for b in beams])
    noise = np.maximum(fractions * slant, sensors.beam_floor_m) * vectors[:, 2]
    return slant, vectors, noise


def bound_at(
    terrain: TerrainMap, sensors: Sensors, config: ObservabilityConfig, heading_rad: float
) -> FloatArray:
    """Bound (rows, cols) for lines of one heading; see the module's head."""
    slope_e, slope_n, known = _slopes(terrain)
    slant, vectors, noise = _beams(sensors, config)
    per_line = max(config.path_m / config.spacing_m, 1.0)
    sums = np.zeros((6, *terrain.height_m.shape))
    products = (
        slope_e**2, slope_e * slope_n, slope_n**2, slope_e, slope_n, np.ones_like(slope_e)
    )  # fmt: skip
    kernel = _line(terrain, config.path_m, heading_rad)
    lines = [_along(np.where(known, p, 0.0), kernel) for p in products]
    error = terrain.error
    length = error.length_m if np.isfinite(error.length_m) else DEFAULT_LENGTH_M
    parts = (
        (error.filtered_m**2, error.filtered_length_m), (error.correlated_m**2, length),
    )  # fmt: skip
    shared = _shared_variance(
        terrain, config, slant * np.hypot(vectors[:, 0], vectors[:, 1]), parts
    )
    for b in range(len(slant)):
        weight = per_line / (noise[b] ** 2 + shared)
        east, north = _offset(slant[b] * vectors[b], heading_rad)
        shift = (-north / terrain.cell_north_m, east / terrain.cell_m)
        for k in range(6):
            # The beam strikes beside the line: read the sums there.
            moved = ndimage.shift(lines[k], (-shift[0], -shift[1]), order=1, mode="nearest")
            sums[k] += weight * moved
    return np.where(np.isfinite(terrain.height_m), _bound(sums, sensors), np.nan)


def _slopes(terrain: TerrainMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    height = terrain.height_m.astype(float)
    known = np.isfinite(height)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    down, east = np.gradient(height[tuple(nearest)], terrain.cell_north_m, terrain.cell_m)
    return east, -down, known


def _line(terrain: TerrainMap, path_m: float, heading_rad: float) -> FloatArray:
    """Kernel that averages over a line through its centre, each cell by the way in it."""
    half = path_m / 2
    reach_r = int(np.ceil(half / terrain.cell_north_m)) + 1
    reach_c = int(np.ceil(half / terrain.cell_m)) + 1
    kernel = np.zeros((2 * reach_r + 1, 2 * reach_c + 1))
    along = np.linspace(-half, half, max(int(path_m / min(terrain.cell_m, 2.0)), 2))
    row = np.round(-along * np.cos(heading_rad) / terrain.cell_north_m).astype(int) + reach_r
    col = np.round(along * np.sin(heading_rad) / terrain.cell_m).astype(int) + reach_c
    np.add.at(kernel, (row, col), 1.0)
    mean: FloatArray = kernel / kernel.sum()
    return mean


def _along(values: FloatArray, kernel: FloatArray) -> FloatArray:
    from scipy.signal import oaconvolve

    pad = tuple((n // 2, n // 2) for n in kernel.shape)
    wide = np.pad(values, pad, mode="edge")
    out: FloatArray = oaconvolve(wide, kernel[::-1, ::-1], mode="valid")
    return out


def _offset(ray_m: FloatArray, heading_rad: float) -> tuple[float, float]:
    """East and north of a beam's footprint for a level vehicle."""
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    return float(ray_m[0] * s + ray_m[1] * c), float(ray_m[0] * c - ray_m[1] * s)


def _shared_variance(
    terrain: TerrainMap,
    config: ObservabilityConfig,
    out_m: FloatArray,
    parts: tuple[tuple[float, float], ...],
) -> float:
    """Map error with its sharing, and what interpolation misses.

    Parameters
    ----------
    out_m : (beams,) reach of the beams to the side.
    parts : variance and correlation length of the map's error.
    """
    total = terrain.error.between_m**2
    for variance, reach in parts:
        # Beams 90 degrees apart are sqrt(2) of their reach to the side from one another.
        beams = 1.0 + (len(out_m) - 1) * np.exp(-np.sqrt(2) * float(np.mean(out_m)) / reach)
        total += variance * (1.0 + 2.0 * reach / config.spacing_m) * beams
    return float(total)


def _bound(sums: FloatArray, sensors: Sensors) -> FloatArray:
    """Schur complement over the depth bias, start information added, trace of the inverse."""
    ee, en, nn, e, n, one = sums
    bias = one + sensors.depth_bias_m**-2
    start = sensors.start_m**-2
    a = ee - e * e / bias + start
    b = en - e * n / bias
    d = nn - n * n / bias + start
    determinant = np.maximum(a * d - b * b, 1e-30)
    return np.asarray(np.sqrt((a + d) / determinant))


def as_grid(terrain: TerrainMap, values: FloatArray, crs: str) -> Grid:
    """Return a layer as a `Grid` on the map's frame, as planning takes it (metres of 1-sigma)."""
    return Grid(
        elevation_m=values,
        west_m=terrain.west_m - terrain.cell_m / 2,
        north_m=terrain.north_m + terrain.cell_north_m / 2,
        cell_m=terrain.cell_m,
        cell_height_m=terrain.cell_north_m,
        crs=crs,
    )
