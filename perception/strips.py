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
    level_lines,
)
from perception.gain import Equalised, GainConfig, equalise
from perception.geometry import progress_along, resample_rows
from perception.layover import layover_cells
from perception.levels import LevelConfig, Levels, segment_levels
from perception.nearest_return import shortfall
from perception.objects import (
    ObjectConfig,
    ObjectRow,
    ObjectTable,
    Track,
    find_objects,
    listed_objects,
)
from perception.quality import CellFlag, cell_flags, saturated_samples
from perception.readers.raw import PingFlag
from perception.records import BoolArray, ElevationStrip, FloatArray, InputError, IntArray, Swath
from perception.strip_columns import add_object, columns_across, lay_on_columns, stretches
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
    bottom : altitude, sigma of its first return, first return, validity per ping.
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
    tracked = _bottom_of(swath, port, starboard, sample_m, config)
    if not tracked.valid.any():
        raise InputError(
            f"{swath.source or 'swath'}: pass {swath.pass_index} shows no bottom in "
            f"{swath.n_pings} pings; is this a side-scan channel?"
        )
    # To a micrometre: the last digits of large coordinates would tip fits of objects from one end to another.
    along_m = np.round(progress_along(swath.easting_m, swath.northing_m, swath.time_s), 6)
    # Where nothing is known of the depth there is nothing to level either.
    swath, lead_m = levelled(replace(swath, depth_m=known_depth(swath)), tracked.first_return_m)
    lines = _level(swath, tracked, along_m, sample_m, port.shape[1])
    sides, rows = _look(swath, (port, starboard), lines, sample_m, config)
    saturated = saturated_samples(port), saturated_samples(starboard)
    # Of a long pass every array of its samples counts.
    del port, starboard
    strip, floor = _lay(swath, lines, sides, rows, sample_m, config)
    labels = sides[0][1].label, sides[1][1].label
    echo = sides[0][0].ratio, sides[1][0].ratio
    cells = cell_flags(swath, saturated, labels, echo, tracked.valid, along_m, lines.altitude_m,
                       strip.across_m, sample_m)  # fmt: skip
    for part in stretches(len(cells)):
        folded = layover_cells(
            strip.elevation_m[part], strip.across_m, -swath.depth_m[part], sample_m
        )
        cells[part] |= folded * np.uint8(CellFlag.AMBIGUOUS)
    return PassResult(
        strip=replace(strip, lead_m=lead_m, flags=cells),
        floor=replace(floor, lead_m=lead_m, flags=cells),
        objects=ObjectTable.of(rows),
        bottom=BottomTrack(
            lines.altitude_m, lines.first_sigma_m, tracked.first_return_m, tracked.valid
        ),
        echo=echo,
        levels=labels,
        sample_m=sample_m,
        along_m=along_m,
        roughness=lines.roughness,
        tracked=tracked,
        flags=_ping_flags(swath, tracked.valid, saturated),
    )


@dataclass(frozen=True, slots=True)
class _Lines:
    """The floor below the sonar, levelled over all lines of a pass: (n,) each.

    `sigma_m` is that of height and altitude, `first_sigma_m` that of the first return as a nearest point; `roughness` is
    the floor's, `ground` that of the floor between objects.
    """

    along_m: FloatArray
    height_m: FloatArray
    sigma_m: FloatArray
    altitude_m: FloatArray
    first_return_m: FloatArray
    first_sigma_m: FloatArray
    roughness: Roughness
    ground: Roughness
    reach_m: float


def _level(
    swath: Swath, bottom: BottomTrack, along_m: FloatArray, sample_m: float, samples: int
) -> _Lines:
    """Level the lines of soundings at once; least ranges are lengthened by what a rough floor takes off."""
    depth_m, reach_m = swath.depth_m, sample_m * samples
    sounded = -(depth_m + bottom.altitude_m)
    rough = learn_roughness(sounded, bottom.sigma_m, along_m, reach_m)
    short, short_sigma = shortfall(bottom.first_return_m, depth_m, bottom.sigma_m, along_m, rough)
    # Where the two sides' first returns differ, part of it was found already.
    short = np.maximum(short - (bottom.altitude_m - bottom.first_return_m), 0.0)
    line_m, line_sigma = level_lines(sounded - short, bottom.sigma_m, along_m, rough)
    # Where within its sample the first echo began is the same unknown on every line: averaging many does
    # not take it away.
    echo_sigma = np.hypot(line_sigma, 0.3 * sample_m)
    line_sigma = np.hypot(echo_sigma, short_sigma)
    # Who looks for the nearest point himself is spared the half of it.
    first_sigma = np.hypot(echo_sigma, 0.5 * short_sigma)
    ground = learn_roughness(sounded, bottom.sigma_m, along_m, reach_m, between_objects=True)
    return _Lines(along_m, line_m, line_sigma, -depth_m - line_m, bottom.first_return_m,
                  first_sigma, rough, ground, reach_m)  # fmt: skip


def _look(
    swath: Swath,
    power: tuple[FloatArray, FloatArray],
    lines: _Lines,
    sample_m: float,
    config: StripConfig,
) -> tuple[list[tuple[Equalised, Levels]], list[ObjectRow]]:
    """Equalise and label both sides' echoes, and find their objects."""
    track = Track(lines.along_m, lines.altitude_m, lines.sigma_m, swath.easting_m, swath.northing_m,
                  swath.heading_rad, swath.ping)  # fmt: skip

    def one_side(side: int, power: FloatArray) -> tuple[Equalised, Levels, list[ObjectRow]]:
        equalised = equalise(power, sample_m, lines.first_return_m, lines.altitude_m,
                             side * swath.roll_rad, config.gain)  # fmt: skip
        levels = segment_levels(equalised.ratio, equalised.looks, config.levels)
        found = find_objects(equalised.ratio, levels, sample_m, side, track, swath.pass_index,
                             lines.roughness, lines.ground, config.objects)  # fmt: skip
        return equalised, levels, found

    # Both sides at once: the kernels let go of the interpreter's lock, and share nothing.
    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(one_side, (-1, 1), power))
    # A fit may run off the image it was made on: what lies past the swath was not seen.
    drop_m = float(np.median(lines.altitude_m))
    reach_m = float(np.sqrt(max(lines.reach_m**2 - drop_m**2, 0.0)))
    rows = [row for _, _, found in done for row in found if abs(row.across_m) <= reach_m]
    return [side[:2] for side in done], listed_objects(rows, config.objects)


def _lay(
    swath: Swath,
    lines: _Lines,
    sides: list[tuple[Equalised, Levels]],
    rows: list[ObjectRow],
    sample_m: float,
    config: StripConfig,
) -> tuple[ElevationStrip, ElevationStrip]:
    """Lay floor, objects, echo and shadow on the strip's columns; return it with objects and without."""
    across = columns_across(sides, sample_m, lines.altitude_m, config.cell_m)
    distance = np.unique(np.abs(across))
    beside = floor_beside(lines.height_m, lines.sigma_m, lines.along_m, distance, lines.roughness)
    floor, sigma = (values.astype(np.float32) for values in beside)
    del beside
    at = np.searchsorted(distance, np.abs(across))
    elevation, sigma = floor[:, at], sigma[:, at]
    echo, shadow, seen = lay_on_columns(sides, across, lines.altitude_m, sample_m)
    elevation[~seen] = sigma[~seen] = np.nan
    bare, bare_sigma = elevation.copy(), sigma.copy()
    for row in rows:
        add_object(elevation, sigma, row, across, lines.along_m)
    np.hypot(sigma, hidden_sigma(shadow, across, lines.altitude_m), out=sigma)
    strip = ElevationStrip(
        elevation_m=elevation,
        sigma_m=sigma,
        across_m=across,
        echo=echo,
        shadow=shadow,
        time_s=swath.time_s,
        ping=swath.ping,
        easting_m=swath.easting_m,
        northing_m=swath.northing_m,
        depth_m=swath.depth_m,
        heading_rad=swath.heading_rad,
        altitude_m=lines.altitude_m,
        altitude_sigma_m=lines.sigma_m,
        crs=swath.crs,
        source=swath.source,
        pass_index=swath.pass_index,
    )
    return strip, replace(strip, elevation_m=bare, sigma_m=bare_sigma)


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
