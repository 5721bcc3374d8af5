"""Strips: one pass's echoes to its elevation strip, stage after stage.

bottom track -> equalised echo -> levels -> shadows and objects -> levelled contour lines
"""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from perception.attitude import levelled
from perception.bottom import BottomConfig, BottomTrack, track_bottom
from perception.bottom_files import GivenBottom
from perception.contours import (
    Roughness,
    floor_beside,
    learn_roughness,
    least_range_bias,
    level_lines,
)
from perception.gain import Equalised, GainConfig, equalise
from perception.geometry import progress_along, resample_rows
from perception.levels import SHADOW, LevelConfig, Levels, segment_levels
from perception.objects import ObjectConfig, ObjectRow, ObjectTable, Track, find_objects
from perception.quality import cell_flags, saturated_samples
from perception.readers.raw import PingFlag
from perception.records import BoolArray, ElevationStrip, FloatArray, InputError, IntArray, Swath
from perception.unseen import hidden_sigma

logger = logging.getLogger(__name__)


# A ping with more of its samples at the recorder's ceiling is flagged as a whole.
_MANY_SATURATED = 0.05


@dataclass(frozen=True, slots=True)
class StripConfig:
    """Settings of the way from echoes to a strip.

    Attributes
    ----------
    cell_m : width of the strip's columns across the track; None takes twice the sample, no more than
        500 columns a side.
    bottom, gain, levels, objects : settings of the stages.
    given_bottom : a bottom track from a file, taken in place of the tracker's.
    """

    cell_m: float | None = None
    bottom: BottomConfig = field(default_factory=BottomConfig)
    gain: GainConfig = field(default_factory=GainConfig)
    levels: LevelConfig = field(default_factory=LevelConfig)
    objects: ObjectConfig = field(default_factory=ObjectConfig)
    given_bottom: GivenBottom | None = None


class BottomFileError(InputError):
    """A bottom track from a file does not fit its survey: the file's fault, not the pass's."""


@dataclass(frozen=True, slots=True)
class PassResult:
    """All that one pass gave.

    Attributes
    ----------
    strip : heights with sigma.
    floor : the same without the objects: what the soundings alone say.
    objects : objects and craters.
    bottom : altitude, sigma, first return, validity per ping.
    echo : (port, starboard) equalised power ratio (n, m), 1 nominal; NaN no data.
    levels : (port, starboard) int8 labels (n, m): 0 nominal, 1 highlight, -1 shadow, -2 no data.
    sample_m : slant range of a sample of `echo` and `levels` (one for the whole pass; pings recorded
        with another are resampled).
    along_m : (n,) distance along the pass.
    roughness : variogram of the floor, learned from the soundings.
    tracked : the bottom as it was tracked (or given), before lines were levelled together.
    flags : (n,) bits of `PingFlag`.
    """

    strip: ElevationStrip
    floor: ElevationStrip
    objects: ObjectTable
    bottom: BottomTrack
    echo: tuple[FloatArray, FloatArray]
    levels: tuple[IntArray, IntArray]
    sample_m: float
    along_m: FloatArray
    roughness: Roughness
    tracked: BottomTrack
    flags: IntArray


def build_strip(swath: Swath, config: StripConfig | None = None) -> PassResult:
    """Turn the pings of one pass into its elevation strip and objects.

    Raises
    ------
    InputError
        The pass has fewer than 10 pings or no echo above the noise to track a bottom in.
    BottomFileError
        The given bottom does not fit the pass.
    """
    config = config or StripConfig()
    if swath.n_pings < 10:
        raise InputError(
            f"{swath.source or 'swath'}: pass {swath.pass_index} has {swath.n_pings} usable pings; "
            "at least 10 are needed"
        )
    port, starboard, sample_m = common_samples(swath)
    bottom = tracked = _bottom_of(swath, port, starboard, sample_m, config)
    if not bottom.valid.any():
        raise InputError(
            f"{swath.source or 'swath'}: pass {swath.pass_index} shows no bottom in "
            f"{swath.n_pings} pings; is this a side-scan channel?"
        )
    along_m = progress_along(swath.easting_m, swath.northing_m, swath.time_s)
    # Where nothing is known of the depth there is nothing to level either.
    swath, lead_m = levelled(replace(swath, depth_m=known_depth(swath)), bottom.first_return_m)
    depth_m = swath.depth_m
    # Heights along the line of soundings, levelled over all lines at once.
    sounded = -(depth_m + bottom.altitude_m)
    reach = sample_m * port.shape[1]
    rough = learn_roughness(sounded, bottom.sigma_m, along_m, reach)
    short, short_sigma = least_range_bias(bottom.altitude_m, rough)
    # Where the two sides' first returns differ, part of it was found already.
    short = np.maximum(short - (bottom.altitude_m - bottom.first_return_m), 0.0)
    line_m, line_sigma = level_lines(sounded - short, bottom.sigma_m, along_m, rough)
    # Where within its sample the first echo began is the same unknown on every line: averaging many does
    # not take it away.
    line_sigma = np.sqrt(line_sigma**2 + (0.3 * sample_m) ** 2 + short_sigma**2)
    altitude_m = -depth_m - line_m
    level = BottomTrack(altitude_m, line_sigma, bottom.first_return_m, bottom.valid)
    track = Track(along_m, altitude_m, line_sigma, swath.easting_m, swath.northing_m,
                  swath.heading_rad, swath.ping)  # fmt: skip

    def one_side(side: int, power: FloatArray) -> tuple[Equalised, Levels, list[ObjectRow]]:
        equalised = equalise(power, sample_m, bottom.first_return_m, altitude_m,
                             side * swath.roll_rad, config.gain)  # fmt: skip
        levels = segment_levels(equalised.ratio, equalised.looks, config.levels)
        found = find_objects(equalised.ratio, levels, sample_m, side, track, swath.pass_index,
                             rough, config.objects)  # fmt: skip
        return equalised, levels, found

    # Both sides at once: the kernels let go of the interpreter's lock, and share nothing.
    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(one_side, (-1, 1), (port, starboard)))
    sides = [(equalised, levels) for equalised, levels, _ in done]
    rows = [row for _, _, found in done for row in found]
    # A fit may run off the image it was made on: what lies past the swath was not seen.
    reach_m = float(np.sqrt(max(reach**2 - float(np.median(altitude_m)) ** 2, 0.0)))
    rows = sorted((r for r in rows if abs(r.across_m) <= reach_m), key=lambda row: row.ping)
    strip, floor = _strip(
        swath, level, along_m, depth_m, line_m, line_sigma, sides, sample_m, rough, rows, config
    )
    strip, floor = (replace(s, lead_m=lead_m) for s in (strip, floor))
    levels = sides[0][1].label, sides[1][1].label
    echo = sides[0][0].ratio, sides[1][0].ratio
    saturated = saturated_samples(port), saturated_samples(starboard)
    cells = cell_flags(swath, saturated, levels, echo, bottom.valid, along_m, altitude_m,
                       strip.across_m, sample_m)  # fmt: skip
    return PassResult(
        strip=replace(strip, flags=cells),
        floor=replace(floor, flags=cells),
        objects=ObjectTable.of(rows),
        bottom=level,
        echo=echo,
        levels=levels,
        sample_m=sample_m,
        along_m=along_m,
        roughness=rough,
        tracked=tracked,
        flags=_ping_flags(swath, bottom.valid, saturated),
    )


def common_samples(swath: Swath) -> tuple[FloatArray, FloatArray, float]:
    """Return port and starboard *power* (n, m) on one sample size, and that size.

    The commonest (median) sample size of the pass; pings recorded otherwise are resampled.
    """
    own = np.asarray(swath.sample_m, float)
    common = float(np.median(own))
    port, starboard = (np.square(side, dtype=np.float32) for side in (swath.port, swath.starboard))
    if np.allclose(own, common, rtol=1e-5):
        return port, starboard, common
    count = int(np.ceil(float(own.max()) * swath.n_samples / common))
    return (
        resample_rows(port, own, common, count),
        resample_rows(starboard, own, common, count),
        common,
    )


def _ping_flags(swath: Swath, valid: BoolArray, saturated: tuple[BoolArray, BoolArray]) -> IntArray:
    """Return the swath's own flags with what its echoes add: no bottom, and many saturated samples."""
    flags = np.zeros(swath.n_pings, np.int64) if swath.flags is None else np.array(swath.flags)
    flags[~valid] |= int(PingFlag.NO_BOTTOM)
    share = np.mean(np.concatenate(saturated, axis=1), axis=1)
    flags[share > _MANY_SATURATED] |= int(PingFlag.SATURATED)
    return flags


def _bottom_of(
    swath: Swath, port: FloatArray, starboard: FloatArray, sample_m: float, config: StripConfig
) -> BottomTrack:
    """Return the bottom of the file that was given, else the tracker's."""
    given = config.given_bottom
    # The file that `strips` wrote says nothing of a pass that gave no strip: such a pass is tracked, and refused
    # again.
    silent = given is not None and not np.isin(swath.ping, given.ping).any()
    if given is None or silent:
        tracked = track_bottom(port, starboard, sample_m, swath.altitude_hint_m, config.bottom)
        if given is None or not tracked.valid.any():
            return tracked
    try:
        return given.of(swath)
    except InputError as error:
        raise BottomFileError(str(error)) from error


def known_depth(swath: Swath) -> FloatArray:
    """Return the sonar's depth (n,), NaN interpolated; zero where the file has none."""
    depth = np.asarray(swath.depth_m, float)
    known = np.isfinite(depth)
    if not known.any() or np.all(depth[known] == 0):
        # The survey warns once for all its passes.
        logger.info(
            "%s: pass %d has no depth of the sonar; elevations are relative to the sonar",
            swath.source or "swath", swath.pass_index,
        )  # fmt: skip
        return np.zeros(len(depth))
    index = np.arange(len(depth))
    return np.interp(index, index[known], depth[known])


def _strip(
    swath: Swath,
    bottom: BottomTrack,
    along_m: FloatArray,
    depth_m: FloatArray,
    line_m: FloatArray,
    line_sigma: FloatArray,
    sides: list[tuple[Equalised, Levels]],
    sample_m: float,
    rough: Roughness,
    rows: list[ObjectRow],
    config: StripConfig,
) -> tuple[ElevationStrip, ElevationStrip]:
    """Lay floor, objects, echo and shadow on the strip's columns; return it with objects and without."""
    across = _columns(sides, sample_m, bottom.altitude_m, config.cell_m)
    distance = np.unique(np.abs(across))
    floor, sigma = floor_beside(line_m, line_sigma, along_m, distance, rough)
    at = np.searchsorted(distance, np.abs(across))
    elevation, sigma = floor[:, at], sigma[:, at]
    echo, shadow, seen = _on_columns(sides, across, bottom.altitude_m, sample_m)
    bare, bare_sigma = (np.where(seen, v, np.nan).astype(np.float32) for v in (elevation, sigma))
    for row in rows:
        _add_object(elevation, sigma, row, across, along_m)
    sigma = np.hypot(sigma, hidden_sigma(shadow, across, bottom.altitude_m))
    elevation = np.where(seen, elevation, np.nan)
    sigma = np.where(seen, sigma, np.nan)
    strip = ElevationStrip(
        elevation_m=elevation.astype(np.float32),
        sigma_m=sigma.astype(np.float32),
        across_m=across,
        echo=echo,
        shadow=shadow,
        time_s=swath.time_s,
        ping=swath.ping,
        easting_m=swath.easting_m,
        northing_m=swath.northing_m,
        depth_m=depth_m,
        heading_rad=swath.heading_rad,
        altitude_m=bottom.altitude_m,
        altitude_sigma_m=line_sigma,
        crs=swath.crs,
        source=swath.source,
        pass_index=swath.pass_index,
    )
    return strip, replace(strip, elevation_m=bare, sigma_m=bare_sigma)


def _columns(
    sides: list[tuple[Equalised, Levels]],
    sample_m: float,
    altitude_m: FloatArray,
    cell_m: float | None,
) -> FloatArray:
    """Return the columns' across-track places, symmetric about the track where both sides are there."""
    reach = []
    for equalised, _ in sides:
        heard = np.flatnonzero(np.isfinite(equalised.ratio).any(axis=0))
        slant = (heard[-1] + 1) * sample_m if len(heard) else 0.0
        least = float(np.min(altitude_m))
        reach.append(float(np.sqrt(max(slant**2 - least**2, 0.0))))
    cell = cell_m or max(2 * sample_m, max(reach) / 500)
    left, right = (int(np.floor(r / cell)) for r in reach)
    return (np.arange(-left, right) + 0.5) * cell


def _on_columns(
    sides: list[tuple[Equalised, Levels]],
    across: FloatArray,
    altitude_m: FloatArray,
    sample_m: float,
) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Return echo (n, m), shadow and seen masks on the strip's columns, over a flat floor."""
    n, m = len(altitude_m), len(across)
    echo = np.full((n, m), np.nan, np.float32)
    shadow, seen = np.zeros((n, m), bool), np.zeros((n, m), bool)
    cell = across[1] - across[0] if m > 1 else sample_m
    for (equalised, levels), columns in zip(sides, (across < 0, across > 0), strict=True):
        if not columns.any():
            continue
        x = np.abs(across[columns])
        # Mean echo over a column's samples, by running sums: speckle falls and no sample is dropped.
        known = np.isfinite(equalised.ratio)
        sums = np.concatenate(
            [np.zeros((n, 1)), np.cumsum(np.where(known, equalised.ratio, 0), axis=1, dtype=float)],
            axis=1,
        )
        counts = np.concatenate(
            [np.zeros((n, 1), np.int32), np.cumsum(known, axis=1, dtype=np.int32)], axis=1
        )
        width = equalised.ratio.shape[1]
        inner = np.hypot(np.maximum(x - cell / 2, 0), altitude_m[:, None]) / sample_m
        outer = np.hypot(x + cell / 2, altitude_m[:, None]) / sample_m
        low = np.clip(np.floor(inner), 0, width - 1).astype(np.int32)
        high = np.clip(np.maximum(np.ceil(outer), low + 1), 1, width).astype(np.int32)
        number = np.take_along_axis(counts, high, 1) - np.take_along_axis(counts, low, 1)
        total = np.take_along_axis(sums, high, 1) - np.take_along_axis(sums, low, 1)
        inside = (number > 0) & (outer <= width + 1)
        echo[:, columns] = np.where(inside, total / np.maximum(number, 1), np.nan)
        middle = np.clip(
            (np.hypot(x, altitude_m[:, None]) / sample_m).astype(np.int32), 0, width - 1
        )
        label = np.take_along_axis(levels.label, middle, 1)
        shadow[:, columns] = inside & (label == SHADOW)
        # Ground before the first echo (on a slope, or beside nadir) is floor all the same; ground past the last
        # sample of its ping is not.
        last = np.where(known.any(axis=1), width - known[:, ::-1].argmax(axis=1), 0)
        seen[:, columns] = outer <= last[:, None] + 1
    return echo, shadow, seen


def _add_object(
    elevation: FloatArray,
    sigma: FloatArray,
    row: ObjectRow,
    across: FloatArray,
    along_m: FloatArray,
) -> None:
    """Add one object's fitted shape to the lines' contours, in place."""
    beta = row.shape if np.isfinite(row.shape) else 1.0
    tenth = np.sqrt((2 * np.log(10.0)) ** (1 / beta))
    sx, sy = max(row.half_across_m / tenth, 1e-3), max(row.half_along_m / tenth, 1e-3)
    lines = np.flatnonzero(np.abs(along_m - row.along_m) < 2.5 * row.half_along_m)
    columns = np.flatnonzero(np.abs(across - row.across_m) < 2.5 * row.half_across_m)
    if len(lines) == 0 or len(columns) == 0:
        return
    box = np.ix_(lines, columns)
    q = ((along_m[lines] - row.along_m) / sy)[:, None] ** 2 + (
        (across[columns] - row.across_m) / sx
    ) ** 2
    profile = np.exp(-0.5 * np.minimum(q**beta, 60.0))
    sign = 1.0 if row.kind == "hill" else -1.0
    elevation[box] += sign * row.height_m * profile
    # Height's own sigma scales with the profile; on its flanks the place and shape count, a quarter of the height.
    flank = 0.5 * row.height_m * 2 * np.sqrt(profile * (1 - profile)) * 0.5
    sigma[box] = np.sqrt(sigma[box] ** 2 + (row.sigma_m * profile) ** 2 + flank**2)
