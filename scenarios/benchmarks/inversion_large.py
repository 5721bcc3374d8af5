"""Seconds and memory of the joint inversion on a map of a thousand cells a side.

Two floors: a level one, where nothing but speckle is to be explained, and a rough one with relief of half a
metre, whose echoes come from facets of their own (`_echoes`; the repository's simulator would take minutes for
sixteen kilometres of track). The error over the rough floor is a row of its own: speed at the cost of the surface would show.
"""

from __future__ import annotations

import os
import resource
import time

import numpy as np
from numba import njit

from perception.inversion import Look, invert
from perception.records import FloatArray, Grid, Progress, Swath
from scenarios.benchmarks import Row, Table

_SEED = 151
_LINES, _PINGS, _SAMPLES = 16, 2000, 1024
_SPACING_M, _PING_M, _REACH_M, _ALTITUDE_M, _DEPTH_M = 54.0, 0.47, 75.0, 15.0, 60.0
_FLOOR_CELL_M, _FACET_M = 0.5, 0.05
# Relief and its longest wave, profile exponent 2.6: the middling floor of `inversion-terrains`, halved.
_RELIEF_M, _LONGEST_M, _SLOPE = 0.5, 100.0, 2.6


def run(progress: Progress) -> Table:
    """Invert sixteen lines over a level floor, then over a rough one."""
    rows: list[Row] = []
    for done, (case, relief_m) in enumerate((("level", 0.0), ("rough", _RELIEF_M))):
        progress("large maps", done, 2)
        rows += _case(case, relief_m)
    progress("large maps", 2, 2)
    return Table("inversion-large", tuple(rows), {"seed": _SEED, "lines": _LINES})


def _case(case: str, relief_m: float) -> list[Row]:
    floor, looks = large_survey(relief_m, _LINES)
    load = os.getloadavg()[0]
    start, busy = time.perf_counter(), time.process_time()
    grid = invert(looks, 1.0).grid
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    cells = f"{grid.shape[0]} x {grid.shape[1]} cells, {_LINES} lines"
    error, sigma = surface_error(grid, floor)
    return [
        Row(case, "joint", "time", seconds, "s", "<= 60", cells),
        Row(case, "joint", "processor time", busy, "s", "", f"load {load:.1f} at the start"),
        Row(case, "process", "peak memory", peak, "GB", "<= 2", "echoes included"),
        Row(case, "joint", "mean absolute error", float(np.mean(np.abs(error))), "m"),
        Row(case, "joint", "within 1 sigma", 100 * float(np.mean(np.abs(error) < sigma)), "%", "60-76"),
    ]  # fmt: skip


def large_survey(relief_m: float, lines: int, seed: int = _SEED) -> tuple[Grid, list[Look]]:
    """Return the floor (elevation about -60 m) and the looks of parallel lines over it, heading north."""
    rng = np.random.default_rng(seed)
    width_m = (lines - 1) * _SPACING_M + 2 * _REACH_M
    count = int(np.ceil(max(width_m, _PINGS * _PING_M) / _FLOOR_CELL_M)) + 4
    relief = relief_m * _fractal(count, rng) if relief_m else np.zeros((count, count))
    # Node (0, 0) lies at (-reach, 0); a raster's edges lie half a cell outside its nodes.
    west_m, north_m = -_REACH_M - 0.5 * _FLOOR_CELL_M, (count - 0.5) * _FLOOR_CELL_M
    floor = Grid(relief[::-1] - _DEPTH_M, west_m, north_m, _FLOOR_CELL_M)
    return floor, [_look(line, relief, r) for line, r in enumerate(rng.spawn(lines))]


def _fractal(count: int, rng: np.random.Generator) -> FloatArray:
    """Draw a periodic floor (count, count) of unit rms whose profiles have a power law spectrum."""
    k = np.hypot(*np.meshgrid(*(np.fft.fftfreq(count, _FLOOR_CELL_M),) * 2))
    amplitude = np.where((k > 1 / _LONGEST_M) & (k < 1.0), np.maximum(k, 1e-9), np.inf) ** (
        -(_SLOPE + 1) / 2
    )
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((count, count))) * amplitude).real
    return np.asarray(field / np.std(field))


def _look(line: int, relief: FloatArray, rng: np.random.Generator) -> Look:
    """Return one line: Lambert's law, occlusion and layover, four looks of speckle."""
    still, nan = np.zeros(_PINGS), np.full(_PINGS, np.nan)
    # Two pings share a cell of the map, and a profile of the floor.
    along = np.arange(_PINGS) // 2 * 2 * _PING_M / _FLOOR_CELL_M
    east = (0.3 + _SPACING_M * line + _REACH_M) / _FLOOR_CELL_M
    sides = []
    for sign in (-1.0, 1.0):
        power = np.full((_PINGS, _SAMPLES), 1e-4)
        nearest = _echoes(relief, east, along[::2], sign, power[::2])
        power[1::2] = power[::2]
        speckle = rng.standard_gamma(4.0, power.shape, np.float32) / 4
        sides.append((np.sqrt(power * speckle).astype(np.float32), nearest))
    swath = Swath(
        time_s=np.arange(_PINGS) * 0.3, ping=np.arange(_PINGS),
        easting_m=np.full(_PINGS, 0.3 + _SPACING_M * line), northing_m=np.arange(_PINGS) * _PING_M,
        depth_m=np.full(_PINGS, _DEPTH_M - _ALTITUDE_M), heading_rad=still, pitch_rad=still,
        roll_rad=still, altitude_hint_m=nan, sample_m=np.full(_PINGS, _REACH_M / _SAMPLES),
        port=sides[0][0], starboard=sides[1][0], sound_speed_m_s=np.full(_PINGS, 1500.0),
        crs="EPSG:32633", pass_index=line,
    )  # fmt: skip
    first = np.repeat(np.minimum(sides[0][1], sides[1][1]), 2)
    return Look(swath, first + 0.02 * rng.standard_normal(_PINGS), np.full(_PINGS, 0.03))


@njit(cache=True)
def _echoes(relief, east, along, sign, power):  # type: ignore[no-untyped-def]
    """Add the lit facets' echoes to `power` (rays, samples); return (rays,) least slant ranges."""
    n, m = power.shape
    last = relief.shape[1] - 2
    nearest = np.full(n, np.inf)
    for i in range(n):
        r = min(int(along[i]), relief.shape[0] - 2)
        fr = along[i] - r
        top = 0.0
        height = 0.0
        for k in range(int(_REACH_M / _FACET_M) + 1):
            x = min(max(east + sign * k * _FACET_M / _FLOOR_CELL_M, 0.0), last)
            c = int(x)
            fc = x - c
            z = (1 - fr) * ((1 - fc) * relief[r, c] + fc * relief[r, c + 1]) + fr * (
                (1 - fc) * relief[r + 1, c] + fc * relief[r + 1, c + 1]
            )
            rise, height = z - height, z
            if k == 0:
                continue
            ground, drop = (k - 0.5) * _FACET_M, _ALTITUDE_M - z + 0.5 * rise
            slant = np.hypot(ground, drop)
            nearest[i] = min(nearest[i], slant)
            angle = ground / drop
            # Facets whose angle from the vertical does not grow lie in shadow or lie over.
            if angle <= top:
                continue
            top = angle
            length = np.hypot(_FACET_M, rise)
            cosine = (drop * _FACET_M + ground * rise) / (slant * length)
            bin_ = int(slant / _REACH_M * m)
            if cosine > 0 and bin_ < m:
                power[i, bin_] += cosine**2 * length / _REACH_M * m
    return nearest


def surface_error(grid: Grid, floor: Grid) -> tuple[FloatArray, FloatArray]:
    """Return error and sigma of the map's cells inside the outer lines."""
    from scipy.ndimage import uniform_filter

    size = max(1, round(grid.cell_m / floor.cell_m))
    mean = Grid(uniform_filter(floor.elevation_m, size), floor.west_m, floor.north_m, floor.cell_m)
    east, north = np.meshgrid(*grid.centres())
    off = grid.elevation_m - mean.sample(east, north)
    margin = 20.0
    inside = np.isfinite(off) & (east > margin) & (east < east.max() - _REACH_M - margin)
    inside &= (north > margin) & (north < _PINGS * _PING_M - margin)
    assert grid.sigma_m is not None
    return off[inside], grid.sigma_m[inside]
