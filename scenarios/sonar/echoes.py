"""From facet echoes to what the recorder writes: spreading, speckle, noise, gain, counts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from perception.records import FloatArray, Grid, Progress, silent
from scenarios.sections import SonarSection
from scenarios.sonar import beams, kernel

# The flat floor at two thirds of the range gives this many counts of 65535.
_NOMINAL_COUNTS = 3000.0
_CHUNK = 64


@dataclass(frozen=True, slots=True)
class SonarModel:
    """The sonar in its water: beam, number of samples a side, and the water's absorption."""

    beam: kernel.Beam
    samples: int
    absorption_db_m: float

    @property
    def slant_range_m(self) -> FloatArray:
        """Return the slant range of each sample's middle."""
        return (np.arange(self.samples) + 0.5) * self.beam.sample_m


def sonar_model(config: SonarSection, *, depth_m: float, cell_m: float) -> SonarModel:
    """Derive the sonar's constants from the scenario; absorption is that of mid-water."""
    width = float(np.deg2rad(config.horizontal_beam_deg))
    angles, weights = beams.azimuth_nodes(width, config.azimuths)
    beam = kernel.Beam(
        angles=angles,
        weights=weights,
        width=width,
        vertical=beams.vertical_table(
            float(np.deg2rad(config.vertical_beam_deg)), float(np.deg2rad(config.tilt_deg))
        ),
        exponent=config.lambert_exponent,
        lobe=0.0 if config.nadir_lobe_db is None else 10.0 ** (config.nadir_lobe_db / 10.0),
        lobe_tan2=float(np.tan(np.deg2rad(config.nadir_lobe_deg)) ** 2),
        turns=config.motion_during_echo,
        sound_speed=config.sound_speed_m_s,
        sample_m=config.range_m / config.samples,
        # A step of half a cell meets every height of the raster; longer ones would miss walls.
        step_m=0.5 * cell_m,
    )
    absorption = beams.absorption_db_m(
        config.frequency_khz,
        temperature_c=config.temperature_c,
        salinity_psu=config.salinity_psu,
        depth_m=0.5 * depth_m,
    )
    return SonarModel(beam, config.samples, absorption)


def facet_echoes(
    floor: Grid,
    albedo: FloatArray,
    poses: FloatArray,
    model: SonarModel,
    progress: Progress = silent,
) -> npt.NDArray[np.float32]:
    """Return the mean echo power (pings, 2, samples) before spreading, port first.

    `albedo` (rows, cols) is the floor's scattering strength as a power ratio; `poses` (pings, 10)
    has the columns of `scenarios.sonar.kernel.POSE`. Pings are independent, so the number of threads
    does not change a bit.
    """
    ground = kernel.Floor(
        np.ascontiguousarray(floor.elevation_m, np.float64),
        np.ascontiguousarray(albedo, np.float64),
        floor.west_m,
        floor.north_m,
        floor.cell_m,
    )
    power = np.zeros((len(poses), 2, model.samples), np.float32)

    def work(rows: slice) -> slice:
        part = np.zeros((rows.stop - rows.start, 2, model.samples))
        kernel.ping_echoes(ground, model.beam, poses[rows], part)
        power[rows] = part
        return rows

    with ThreadPoolExecutor(_threads()) as pool:
        for rows in pool.map(work, _chunks(len(poses))):
            progress("pinging", rows.stop, len(poses))
    return power


def _threads() -> int:
    """Return as many threads as numba was given: workers of an experiment say 1."""
    given = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(given) if given.isdigit() and int(given) > 0 else min(os.cpu_count() or 1, 4)


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))


def record(
    power: npt.NDArray[np.float32],
    model: SonarModel,
    config: SonarSection,
    *,
    altitude_m: float,
    sonar_altitude_m: FloatArray,
    sonar_depth_m: FloatArray,
    rng: np.random.Generator,
) -> npt.NDArray[np.uint16]:
    """Turn mean echo power into the recorder's counts (pings, 2, samples).

    Amplitude is ``sqrt(gain (S + N) g)``: S the echo after spreading and absorption with what leaks
    into it, N noise, g Gamma(L, 1/L) speckle; sums of many scatterers and noise are Gaussian
    together, so one draw serves both. The gain is `altitude_m`'s nominal one, in error as stated.
    """
    slant = model.slant_range_m
    loss = slant**-4.0 * 10.0 ** (-0.2 * model.absorption_db_m * slant)
    gain = slant ** (config.tvg_log / 10.0) * 10.0 ** (
        0.2 * model.absorption_db_m * config.tvg_absorption_scale * slant
    )
    # A range that does not reach the floor at this altitude still needs a reference.
    reach_m = min(altitude_m, 0.6 * float(slant[-1]))
    nominal = loss * kernel.floor_power(slant, reach_m, model.beam)
    noise = nominal[-1] * 10.0 ** (-config.snr_db / 10.0)
    echo = power * loss.astype(np.float32)
    echo += _leakage(echo, config.leakage_db)
    _add_arrivals(echo, nominal, model, config, sonar_altitude_m, sonar_depth_m)
    if config.dropouts:
        echo[rng.random(len(echo)) < config.dropouts] = 0.0
    echo += np.float32(noise)
    if config.texture_shape is not None:
        shape = config.texture_shape
        echo *= rng.gamma(shape, 1.0 / shape, echo.shape).astype(np.float32)
    echo *= rng.standard_gamma(config.looks, echo.shape, dtype=np.float32) / np.float32(
        config.looks
    )
    reference = int(2 * model.samples / 3)
    scale = _NOMINAL_COUNTS / np.sqrt(max(nominal[reference] * gain[reference], 1e-300))
    echo *= (gain * scale**2).astype(np.float32)
    amplitude = np.rint(np.sqrt(echo, out=echo), out=echo)
    return np.minimum(amplitude, 65535, out=amplitude).astype(np.uint16)


def _leakage(echo: npt.NDArray[np.float32], leakage_db: float) -> npt.NDArray[np.float32]:
    """Return what the side lobes of the beam bring in: the echo of the pings around, weakened."""
    around = uniform_filter1d(echo, 41, axis=0, mode="nearest")
    around = uniform_filter1d(around, 9, axis=2, mode="nearest").mean(axis=1, keepdims=True)
    leak: npt.NDArray[np.float32] = around * np.float32(10.0 ** (leakage_db / 10.0))
    return leak


def _add_arrivals(
    echo: npt.NDArray[np.float32],
    nominal: FloatArray,
    model: SonarModel,
    config: SonarSection,
    sonar_altitude_m: FloatArray,
    sonar_depth_m: FloatArray,
) -> None:
    """Add the surface's echo and the second bottom's, in place, the same on both sides."""
    slant = model.slant_range_m[None, :]
    # Past the first metres the level no longer falls with the floor's: hold it where it is zero.
    level = np.maximum(nominal, nominal[-1])[None, :]
    for at_m, db, decay_m in (
        (sonar_depth_m[:, None], config.surface_db, 1.5),
        (2.0 * sonar_altitude_m[:, None], config.multipath_db, 3.0),
    ):
        if db is None:
            continue
        past = slant - at_m
        tail = np.where(past >= 0, np.exp(-np.clip(past, 0, None) / decay_m), 0.0)
        echo += (level * tail * 10.0 ** (db / 10.0)).astype(np.float32)[:, None, :]
