"""A hundred passes of 2,000 pings registered and solved: seconds, memory, and the track against the truth.

Strips are planted, not simulated (sonar of 100 km would take longer than all that is to be shown): a periodic
fractal floor with albedo, seen with slope, speckle and broad errors of height, from a track that drifts by 4 m per
root-km, 0.4 degrees and 0.4 % a pass; fixes of 0.4 m at both ends of the survey. `BATHYNAV_PASSES` makes it
smaller.
"""

from __future__ import annotations

import os
import resource
import sys
import time
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from mapping.fixes import PositionFix
from mapping.survey import correct_survey
from mapping.survey_records import CorrectedSurvey, SurveyConfig
from perception.records import ElevationStrip, FloatArray, Progress
from scenarios.benchmarks import Row, Table
from scenarios.metrics import percent_cut

_CRS = "EPSG:32630"
_ORIGIN_M = np.array([500_000.0, 5_600_000.0])
_STEP_M, _COLUMN_M, _REACH_M, _ALTITUDE_M, _SPEED_M_S = 0.5, 0.5, 58.0, 15.0, 1.5
_FLOOR_M = 40.0
# What a slope does to the logarithm of the echo, two to three altitudes away; four looks in samples of 0.15 m.
_SLOPE_GAIN, _LOOKS = 4.5, 12.0
_PINGS, _PINGS_A_KEYFRAME, _APART_M, _TURN_M = 2000, 20, 45.0, 60.0
_WALK_M, _BIAS_DEG, _SCALE, _FIX_M = 4.0, 0.4, 0.004, 0.4


@dataclass(frozen=True, slots=True)
class Planted:
    """A survey whose truth is known: strips as navigated, fixes, and (n, 2) true positions of every line."""

    strips: list[ElevationStrip]
    fixes: list[PositionFix]
    truth_m: FloatArray


def run(progress: Progress) -> Table:
    """Plant a survey, correct it, and compare the track with the truth."""
    passes = int(os.environ.get("BATHYNAV_PASSES", "100"))
    survey = plant(passes, np.random.default_rng(1), progress)
    # Kernels are compiled and textures' filters warm before the clock runs.
    correct_survey([s for s in survey.strips[:2]])
    before_mb = _peak_mb()
    wall, processor = time.perf_counter(), time.process_time()
    config = SurveyConfig(keyframe_m=_PINGS_A_KEYFRAME * _STEP_M)
    result = correct_survey(survey.strips, survey.fixes, config, progress)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    rows = _rows(survey, result, passes)
    case = rows[0].case
    rows += [
        Row(case, "registration and graph", "time", wall, "s", "<= 60 for 100 passes, two cores"),
        Row(case, "registration and graph", "processor time", processor, "s"),
        Row(case, "registration and graph", "peak memory", _peak_mb(), "MB", "",
            f"{before_mb:.0f} with the strips alone"),
    ]  # fmt: skip
    return Table(
        "mapping-large", tuple(rows), {"seed": 1, "passes": passes, "pings a pass": _PINGS}
    )


def _peak_mb() -> float:
    """Return the greatest resident memory of this process so far."""
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes / (1e6 if sys.platform == "darwin" else 1e3)


def _rows(survey: Planted, result: CorrectedSurvey, passes: int) -> list[Row]:
    raw = np.concatenate([np.column_stack([s.easting_m, s.northing_m]) for s in survey.strips])
    track = np.column_stack([result.trajectory.easting_m, result.trajectory.northing_m])
    before, after = (
        float(np.sqrt(((t - survey.truth_m) ** 2).sum(axis=1).mean())) for t in (raw, track)
    )
    kept = result.solution
    sigma = np.sqrt(np.trace(kept.covariance_m2, axis1=1, axis2=2).mean())
    compared = sum(r.anew for r in result.diagnostics.rounds)
    case = f"{passes} passes x {_PINGS} pings, {len(result.keyframes)} keyframes"
    method = "registration and graph"
    return [
        Row(case, "dead reckoning", "track rms error", before, "m"),
        Row(case, method, "track rms error", after, "m", "", f"{sigma:.2f} m claimed"),
        Row(case, method, "cut", percent_cut(before, after), "%", ">= 85"),
        Row(case, method, "squares compared", compared, "",
            "", ", ".join(f"{r.used} of {r.compared}" for r in result.diagnostics.rounds) + " used"),
    ]  # fmt: skip


def plant(passes: int, rng: np.random.Generator, progress: Progress) -> Planted:
    """Return parallel lines 45 m apart and, for one pass in eight, lines that cross them end to end."""
    ground, albedo = (
        _field(rng, 1.8),
        gaussian_filter(rng.normal(size=(1024, 1024)), 2.0, mode="wrap"),
    )
    albedo *= 1.5 * np.log(10) / 10 / albedo.std()
    strips: list[ElevationStrip] = []
    places: list[FloatArray] = []
    error, clock, ping = np.zeros(2), 1.7e9, 0
    for index, (east, north, heading_deg) in enumerate(_legs(passes)):
        heading = np.radians(heading_deg)
        ahead = np.array([np.sin(heading), np.cos(heading)])
        bias, scale = np.radians(_BIAS_DEG) * rng.normal(), _SCALE * rng.normal()
        along = _STEP_M * np.arange(_PINGS)
        truth = _ORIGIN_M + [east, north] + along[:, None] * ahead
        if index:
            # From line to line it sails, and drifts, as far as the next line is away.
            transit_m = max(_TURN_M, float(np.hypot(*(truth[0] - places[-1][-1]))))
            clock += transit_m / _SPEED_M_S
            error = error + _WALK_M * np.sqrt(transit_m / 1000) * rng.normal(size=2)
        walk = _WALK_M * np.sqrt(_STEP_M / 1000) * rng.normal(size=(_PINGS, 2))
        walk += _STEP_M * (scale * ahead + bias * np.array([ahead[1], -ahead[0]]))
        errors = error + np.cumsum(walk, axis=0)
        error = errors[-1]
        strips.append(
            _seen(ground, albedo, truth, truth - errors, heading, bias, clock + along / _SPEED_M_S,
                  ping, index, rng)
        )  # fmt: skip
        places.append(truth)
        clock, ping = clock + along[-1] / _SPEED_M_S, ping + _PINGS
        progress("planting strips", index + 1, passes)
    ends = ((strips[0].time_s[0], places[0][0]), (strips[-1].time_s[-1], places[-1][-1]))
    fixes = [_fix(float(t), place + _FIX_M * rng.normal(size=2)) for t, place in ends]
    return Planted(strips, fixes, np.concatenate(places))


def _legs(passes: int) -> list[tuple[float, float, float]]:
    """Return start (east, north) and heading of each pass."""
    length = _STEP_M * _PINGS
    parallel = passes - passes // 8
    legs = [
        (i * _APART_M, 0.0 if i % 2 == 0 else length, 0.0 if i % 2 == 0 else 180.0)
        for i in range(parallel)
    ]
    # Crossing lines run back over the parallel ones, as many end to end as fit, then the next row.
    width = parallel * _APART_M
    a_row = max(1, int(width // length))
    for i in range(passes - parallel):
        row, place = divmod(i, a_row)
        back = row % 2 == 0
        start = width - place * length if back else place * length
        legs.append((start, (0.25 + 0.25 * row) * length, 270.0 if back else 90.0))
    return legs


def _fix(time_s: float, place_m: FloatArray) -> PositionFix:
    variance = _FIX_M**2
    return PositionFix(time_s, float(place_m[0]), float(place_m[1]), variance, 0.0, variance, "gps")


def _field(rng: np.random.Generator, exponent: float, size: int = 1024) -> FloatArray:
    """Return a periodic field of unit rms on nodes a metre apart, fractal below a hundred metres."""
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    k = np.where(k >= 1.0 / 100.0, k, np.inf)
    field = np.fft.irfft2(
        np.fft.rfft2(rng.normal(size=(size, size))) * k**-exponent, s=(size, size)
    )
    scaled: FloatArray = field / field.std()
    return scaled


def _at(field: FloatArray, places_m: FloatArray) -> FloatArray:
    """Return a periodic field at places of the survey."""
    cells = places_m - _ORIGIN_M
    at = [cells[..., 1], cells[..., 0]]
    values: FloatArray = map_coordinates(field, at, order=1, mode="grid-wrap")
    return values


def _true_range(
    ground: FloatArray, truth_m: FloatArray, beneath: FloatArray, across: FloatArray,
    starboard: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return (n, m) the ground range, to starboard, of what a sonar draws at each column of a strip.

    It knows a slant range and draws as if the floor were level: ground that lies h higher than that beneath the track
    is drawn about h a / x nearer to it.
    """
    range_m = np.broadcast_to(across, (len(truth_m), len(across)))
    for _ in range(4):
        rise = _at(ground, truth_m[:, None, :] + range_m[..., None] * starboard) - beneath[:, None]
        squared = across**2 + 2.0 * _ALTITUDE_M * rise - rise**2
        range_m = np.sign(across) * np.sqrt(np.maximum(squared, 0.0))
    return range_m


def _seen(
    ground: FloatArray, albedo: FloatArray, truth_m: FloatArray, navigated_m: FloatArray,
    heading_rad: float, bias_rad: float, time_s: FloatArray, ping: int, index: int,
    rng: np.random.Generator,
) -> ElevationStrip:  # fmt: skip
    """Return what a pass saw, at the places where its navigation has it."""
    across = np.arange(-_REACH_M, _REACH_M + 1e-9, _COLUMN_M)
    starboard = np.array([np.cos(heading_rad), -np.sin(heading_rad)])
    beneath = _at(ground, truth_m)
    range_m = _true_range(ground, truth_m, beneath, across, starboard)
    places = truth_m[:, None, :] + range_m[..., None] * starboard
    height = _at(ground, places)
    outward = (
        _at(ground, places + 0.25 * starboard) - _at(ground, places - 0.25 * starboard)
    ) / 0.5
    level = _at(albedo, places)
    level += _SLOPE_GAIN * np.clip(outward * np.sign(across), -0.5, 0.3)
    # Heights off the track err together over metres and lose their fine structure.
    broad = gaussian_filter(rng.normal(size=height.shape), 6.0)
    height = gaussian_filter(height, 4.0) + 0.3 * broad / broad.std() + 0.1 * rng.normal()
    n = len(truth_m)
    return ElevationStrip(
        elevation_m=(height - _FLOOR_M).astype(np.float32),
        sigma_m=np.full(height.shape, 0.3, np.float32),
        across_m=across,
        echo=(np.exp(level) * rng.gamma(_LOOKS, 1 / _LOOKS, height.shape)).astype(np.float32),
        shadow=np.zeros(height.shape, bool), time_s=time_s, ping=ping + np.arange(n),
        easting_m=navigated_m[:, 0], northing_m=navigated_m[:, 1], depth_m=_FLOOR_M - _ALTITUDE_M - beneath,
        heading_rad=np.full(n, heading_rad - bias_rad), altitude_m=np.full(n, _ALTITUDE_M),
        altitude_sigma_m=np.full(n, 0.1), crs=_CRS, pass_index=index,
    )  # fmt: skip
