"""Sonar files to one map: the method's summary, stage by stage.

Each function is one stage; the arithmetic lives in `perception` and `mapping`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapping.fixes import PositionFix
from mapping.fusion import fuse
from mapping.incremental import pass_by_pass
from mapping.object_floors import on_floor
from mapping.one_sided import hold_one_sided
from mapping.survey import correct_survey
from mapping.survey_records import CorrectedSurvey
from perception.attitude import levelled
from perception.bottom import BottomTrack
from perception.levels import SHADOW
from perception.objects import ObjectTable
from perception.readers import Survey
from perception.records import (
    BoolArray,
    ElevationStrip,
    FloatArray,
    Grid,
    InputError,
    Progress,
    Swath,
    Trajectory,
    silent,
)
from perception.strips import PassResult, StripConfig, common_samples, known_depth
from scenarios.map_loop import check_prior, refine_on_map, tied_to_prior
from scenarios.passes import strips_of
from scenarios.report.contacts import Contact, contacts_of, pictured

if TYPE_CHECKING:
    from perception.inversion import InversionResult, Look


# The likeliest objects of a pass that `contacts.html` may show: a picture takes some 10 kB.
_PICTURES_A_PASS = 100


@dataclass(frozen=True, slots=True)
class PassSummary:
    """What later stages need of one pass; echoes are read again where they are wanted.

    Attributes
    ----------
    strip, floor, objects, bottom : as in `PassResult`.
    shadow : (port, starboard) shadow masks (n, m), eight samples a byte: they are needed whole only
        while their own pass is inverted.
    n_samples : columns of the masks.
    contacts : what `contacts.html` shows of the objects, as navigated.
    """

    strip: ElevationStrip
    floor: ElevationStrip
    objects: ObjectTable
    bottom: BottomTrack
    shadow: tuple[np.ndarray, np.ndarray]
    n_samples: int
    contacts: tuple[Contact, ...] = ()

    @classmethod
    def of(cls, result: PassResult) -> PassSummary:
        port, starboard = (np.packbits(side == SHADOW, axis=1) for side in result.levels)
        width = result.levels[0].shape[1]
        return cls(
            result.strip, result.floor, result.objects, result.bottom, (port, starboard), width,
            tuple(pictured(contacts_of(result), _PICTURES_A_PASS)),
        )  # fmt: skip

    def masks(self) -> tuple[BoolArray, BoolArray]:
        """Return the shadow masks (n, m) of port and starboard."""
        port, starboard = (
            np.unpackbits(side, axis=1, count=self.n_samples).astype(bool) for side in self.shadow
        )
        return port, starboard


@dataclass(frozen=True, slots=True)
class SurveyMap:
    """What a survey became.

    Attributes
    ----------
    grid : the map.
    track : one pose for every side-scan ping in input order; unusable ones interpolated, pass -1.
    raw_track : the same poses as the file's own navigation had them.
    passes : strip, objects, bottom and shadows of each pass, as navigated.
    corrected : strips with corrected poses, and what the pose graph says of itself.
    objects : every pass's objects at their corrected places, one table a pass.
    inversion : diagnostics of the joint method; None where the map is of shadows alone.
    """

    grid: Grid
    track: Trajectory
    raw_track: Trajectory
    passes: tuple[PassSummary, ...]
    corrected: CorrectedSurvey
    objects: tuple[ObjectTable, ...]
    inversion: InversionResult | None

    @property
    def contacts(self) -> tuple[tuple[Contact, ...], ...]:
        """Every pass's contacts, as navigated."""
        return tuple(one.contacts for one in self.passes)


def map_survey(
    survey: Survey,
    *,
    fixes: Sequence[PositionFix] = (),
    cell_m: float | None = None,
    method: str = "joint",
    passes: Sequence[PassSummary] | None = None,
    prior: Grid | None = None,
    incremental: bool = False,
    progress: Progress = silent,
) -> SurveyMap:
    """Turn the passes of a survey into one map and one corrected track.

    Parameters
    ----------
    prior : a map that was there before, to whose relief the track is tied in the plane; heights are not.
    method : "joint" inverts shading, shadows and soundings of all passes on one grid;
        "shadow" fuses the strips of shadow heights.
    passes : results of `build_passes` where they are at hand.
    incremental : correct the track pass by pass instead of all at once.
    """
    check_prior(prior, survey.crs, survey.datum)
    results = build_passes(survey, progress) if passes is None else tuple(passes)
    corrected = _corrected(survey, results, fixes, method, prior, incremental, progress)
    track = whole_track(survey, corrected.trajectory)
    # The joint method has shadows and shading of its own: of the strips it is held to the soundings.
    strips = corrected.strips if method == "shadow" else _floors(results, corrected)
    grid = fuse(
        strips,
        cell_m=cell_m,
        crs=survey.crs,
        trajectory=corrected.trajectory,
        height_sigma_m=corrected.height_sigma_m,
        progress=progress,
    )
    inversion = None
    if method == "joint":
        from perception.inversion import invert

        looks = looks_of(survey, results, corrected)
        inversion = invert(looks, cell_m, crs=survey.crs, progress=progress)
        altitude_m = float(np.median(np.concatenate([strip.altitude_m for strip in strips])))
        held = hold_one_sided(inversion.grid, grid, strips, altitude_m)
        grid = with_pose_sigma(held, track, corrected.height_sigma_m)
    grid = replace(grid, datum=survey.datum)
    raw = navigated_track(survey)
    objects = tuple(
        on_floor(corrected_objects(p.objects, raw, track), grid,
                 track.easting_m[p.objects.ping], track.northing_m[p.objects.ping])
        for p in results
    )  # fmt: skip
    return SurveyMap(grid, track, raw, results, corrected, objects, inversion)


def _corrected(
    survey: Survey,
    results: Sequence[PassSummary],
    fixes: Sequence[PositionFix],
    method: str,
    prior: Grid | None,
    incremental: bool,
    progress: Progress,
) -> CorrectedSurvey:
    """Correct the track by registration, on the map's own drafts, and by a prior map where one is given.

    Pass by pass too the drafts come when all passes are there, as the map does.
    """

    def looks(corrected: CorrectedSurvey) -> list[Look]:
        return looks_of(survey, results, corrected)

    navigated = [result.strip for result in results]
    if incremental:
        corrected = pass_by_pass(navigated, fixes, progress=progress)
    else:
        corrected = correct_survey(navigated, fixes, progress=progress)
    if method == "joint":
        corrected = refine_on_map(navigated, corrected, looks, fixes, survey.crs, progress)
    if prior is None:
        return corrected
    own = looks if method == "joint" else None
    return tied_to_prior(navigated, corrected, own, prior, survey.crs, progress)


# The last survey's passes: a mission's strips and map are two commands in one process, and the same
# echoes need not be cut twice.
_recent: dict[tuple[object, ...], tuple[PassSummary, ...]] = {}


def _floors(
    results: Sequence[PassSummary], corrected: CorrectedSurvey
) -> tuple[ElevationStrip, ...]:
    """Return the passes' floors at the corrected poses and heights."""
    return tuple(
        replace(
            strip,
            elevation_m=result.floor.elevation_m + np.float32(height_m),
            sigma_m=result.floor.sigma_m,
        )
        for result, strip, height_m in zip(
            results, corrected.strips, corrected.height_m, strict=True
        )
    )


def build_passes(
    survey: Survey,
    progress: Progress = silent,
    config: StripConfig | None = None,
) -> tuple[PassSummary, ...]:
    """Turn every pass into a strip, reading one pass at a time; errors as `strips_of`."""
    key = (*identity(survey), config)
    if key in _recent:
        return _recent[key]
    results = tuple(PassSummary.of(r) for _, r in strips_of(survey, config, progress))
    keep_passes(survey, config, results)
    return results


def keep_passes(
    survey: Survey, config: StripConfig | None, passes: tuple[PassSummary, ...]
) -> None:
    """Keep a survey's passes for the next `build_passes` of this process; the last survey's go."""
    _recent.clear()
    _recent[(*identity(survey), config)] = passes


def identity(survey: Survey) -> tuple[object, ...]:
    """Return what makes two openings of a survey the same: its files as they are, its frame, its poses."""
    files = tuple((str(f.path.resolve()), *_stamp(f.path)) for f in survey.files)
    headers = tuple(
        hashlib.blake2b(np.ascontiguousarray(getattr(survey.pings, f.name)).tobytes()).hexdigest()
        for f in fields(survey.pings)
    )
    return (*files, survey.crs, *headers)


def _stamp(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def navigated_track(survey: Survey) -> Trajectory:
    """Return the files' own navigation, one pose a ping, of unknown accuracy (NaN)."""
    pings = survey.pings
    unknown = np.full(len(pings), np.nan)
    return Trajectory(
        time_s=pings.time_s,
        easting_m=pings.easting_m,
        northing_m=pings.northing_m,
        depth_m=pings.depth_m,
        heading_rad=pings.heading_rad,
        sigma_easting_m=unknown,
        sigma_northing_m=unknown,
        cov_en_m2=unknown,
        crs=survey.crs,
        utc=survey.utc,
        ping=np.arange(len(pings)),
        pass_index=pings.pass_index,
    )


def whole_track(survey: Survey, corrected: Trajectory) -> Trajectory:
    """Carry the correction of the passes' lines over to every ping of the survey.

    The *correction*, not the position, is interpolated by ping number: between lines the files'
    navigation knows how the vehicle moved better than a straight line does.
    """
    raw = navigated_track(survey)
    if corrected.ping is None:
        raise ValueError("a survey's trajectory must say which ping each pose belongs to")
    order = np.argsort(corrected.ping, kind="stable")
    known = corrected.ping[order]
    every = np.arange(survey.n_pings)

    def carried(values: FloatArray) -> FloatArray:
        return np.interp(every, known, values[order])

    def moved(mine: FloatArray, theirs: FloatArray) -> FloatArray:
        good = np.isfinite(theirs[order] - mine[known])
        if not good.any():
            return mine
        return mine + np.interp(every, known[good], (theirs[order] - mine[known])[good])

    numbers, kept = survey.pings.pass_index, corrected.pass_index
    used = np.isin(numbers, kept) if kept is not None else numbers >= 0
    turn = np.angle(np.exp(1j * (corrected.heading_rad[order] - raw.heading_rad[known])))
    return replace(
        raw,
        easting_m=moved(raw.easting_m, corrected.easting_m),
        northing_m=moved(raw.northing_m, corrected.northing_m),
        heading_rad=np.mod(raw.heading_rad + np.interp(every, known, turn), 2 * np.pi),
        sigma_easting_m=carried(corrected.sigma_easting_m),
        sigma_northing_m=carried(corrected.sigma_northing_m),
        cov_en_m2=carried(corrected.cov_en_m2),
        pass_index=np.where(used, numbers, -1),
    )


def corrected_swath(swath: Swath, track: Trajectory, height_offset_m: float) -> Swath:
    """Return a swath at its corrected poses; a height offset moves the sonar, not the echoes."""
    return replace(
        swath,
        easting_m=track.easting_m[swath.ping],
        northing_m=track.northing_m[swath.ping],
        heading_rad=track.heading_rad[swath.ping],
        depth_m=swath.depth_m - height_offset_m,
    )


def corrected_objects(table: ObjectTable, raw: Trajectory, track: Trajectory) -> ObjectTable:
    """Return objects moved as the correction moves and turns the poses of their pings."""
    ping = table.ping
    before, after = raw.heading_rad[ping], track.heading_rad[ping]
    moved_e, moved_n = (
        track.easting_m[ping] - raw.easting_m[ping], track.northing_m[ping] - raw.northing_m[ping],
    )  # fmt: skip
    return replace(
        table,
        easting_m=table.easting_m + moved_e + (np.cos(after) - np.cos(before)) * table.across_m,
        northing_m=table.northing_m + moved_n - (np.sin(after) - np.sin(before)) * table.across_m,
    )


def with_pose_sigma(grid: Grid, track: Trajectory, height_sigma_m: FloatArray) -> Grid:
    """Add to a grid's sigma what the poses do not know: their place times slope, and their height.

    The inversion takes its poses for true. Errors of pose are shared by all that a pass saw, so they are
    not averaged over cells; over passes they are taken at their rms, as if all were one.
    """
    if grid.sigma_m is None:
        return grid
    used = np.ones(len(track.time_s), bool) if track.pass_index is None else track.pass_index >= 0
    # Half of the trace: the slope has a direction, the error another.
    place_m2 = 0.5 * (track.sigma_easting_m**2 + track.sigma_northing_m**2)[used]
    place_m2 = place_m2[np.isfinite(place_m2)]
    if not place_m2.size:
        raise InputError(
            "the passes do not determine the track's accuracy, so the map has no sigma; "
            "give absolute positions with --fixes"
        )
    known = height_sigma_m[np.isfinite(height_sigma_m)]
    height_m2 = float(np.mean(known**2)) if known.size else 0.0
    slope2 = np.zeros(grid.shape)
    for axis, cell_m in enumerate((grid.cell_north_m, grid.cell_m)):
        if grid.shape[axis] > 1:
            slope2 += np.nan_to_num(np.gradient(grid.elevation_m, cell_m, axis=axis)) ** 2
    variance = grid.sigma_m**2 + slope2 * float(np.mean(place_m2)) + height_m2
    return replace(grid, sigma_m=np.sqrt(variance))


def looks_of(
    survey: Survey, results: Sequence[PassSummary], corrected: CorrectedSurvey
) -> list[Look]:
    """Return every pass as the joint inversion sees it, at its corrected poses."""
    track = whole_track(survey, corrected.trajectory)
    return [_look(survey, i, result, corrected, track) for i, result in enumerate(results)]


def _look(
    survey: Survey, index: int, result: PassSummary, corrected: CorrectedSurvey, track: Trajectory
) -> Look:
    """Return one pass as the joint inversion sees it: on one sample size, at corrected poses."""
    from perception.inversion import Look

    swath = survey.swath(result.strip.pass_index)
    port_power, starboard_power, sample_m = common_samples(swath)
    swath = replace(
        swath,
        port=np.sqrt(port_power),
        starboard=np.sqrt(starboard_power),
        sample_m=np.full(swath.n_pings, sample_m),
        # A height is moved by the pass's offset and pitch whether the file knows it or not.
        depth_m=known_depth(swath),
        flags=None,
    )
    port, starboard = result.masks()
    placed = corrected_swath(swath, track, float(corrected.height_m[index]))
    return Look(
        swath=levelled(placed, result.bottom.first_return_m)[0],
        altitude_m=np.where(result.bottom.valid, result.bottom.first_return_m, np.nan),
        altitude_sigma_m=result.bottom.sigma_m,
        shadow_port=port,
        shadow_starboard=starboard,
    )
