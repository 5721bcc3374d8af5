"""What the vehicle senses: one `Measurement` per row of `nav.csv`, and the soundings in it.

A beam is a direction in the body frame (azimuth clockwise from the bow, angle off the vertical) and
a slant range. Its *sounding* is the point of the sea floor it struck, relative to the vehicle, and
the elevation there; comparing soundings with the map needs no ray casting, since the measured range
itself says where the ray ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from perception.files import read_toml
from perception.records import FloatArray, InputError

# The contract's default beams: a Janus DVL, 30 degrees off nadir between the axes.
_JANUS_AZIMUTH_DEG = (45.0, 135.0, 225.0, 315.0)
_JANUS_OFF_NADIR_DEG = 30.0


@dataclass(frozen=True, slots=True)
class Beam:
    """Direction of one ranging beam in the body frame, and its noise."""

    azimuth_rad: float
    off_nadir_rad: float
    fraction: float | None = None


@dataclass(frozen=True, slots=True)
class Sensors:
    """Beam directions and 1-sigma figures; the defaults are the contract's.

    Attributes
    ----------
    beams : direction of `beam1_m` ... `beamN_m`; empty takes `default_beams` of what the file has.
    beam_fraction, beam_floor_m : noise of a range, as a fraction of it and at least.
    start_m : error of the first position, an axis.
    scale, heading_rad, depth_bias_m : constant errors of odometry and depth.
    walk_m_sqrt_h : random walk of the dead-reckoned position, metres per square root of an hour, an
        axis; None lets the filters' evidence choose.
    tide_m_sqrt_h : random walk of the depth bias.
    """

    beams: tuple[Beam, ...] = ()
    beam_fraction: float = 0.01
    beam_floor_m: float = 0.02
    start_m: float = 50.0
    scale: float = 0.005
    heading_rad: float = math.radians(0.5)
    depth_bias_m: float = 1.0
    walk_m_sqrt_h: float | None = None
    tide_m_sqrt_h: float = 0.2


@dataclass(frozen=True, slots=True)
class Measurement:
    """One row of navigation: where dead reckoning has the vehicle, its attitude, its ranges.

    `slant_range_m` is (beams,), NaN for no return; its directions are `Sensors.beams`, the altimeter
    first where there is one. Angles in radians; NaN for what the row does not tell.
    """

    time_s: float
    easting_m: float
    northing_m: float
    depth_m: float
    heading_rad: float
    pitch_rad: float
    roll_rad: float
    slant_range_m: FloatArray
    speed_m_s: float = float("nan")


@dataclass(frozen=True, slots=True)
class Soundings:
    """The points of the sea floor struck by the beams of one measurement, (n,) each.

    Attributes
    ----------
    east_m, north_m : from the vehicle to the point.
    elevation_m : of the point, by the depth sensor as it reads.
    range_sigma_m : 1-sigma of the slant range.
    down, out_east, out_north : the ray's unit vector.
    beam : index of the beam.
    """

    east_m: FloatArray
    north_m: FloatArray
    elevation_m: FloatArray
    range_sigma_m: FloatArray
    down: FloatArray
    out_east: FloatArray
    out_north: FloatArray
    beam: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def count(self) -> int:
        return len(self.elevation_m)


def default_beams(number: int) -> tuple[Beam, ...]:
    """Directions to assume of `number` beams: one looks down, more stand around at 30 degrees."""
    if number == 1:
        return (Beam(0.0, 0.0),)
    azimuths: tuple[float, ...]
    if number == len(_JANUS_AZIMUTH_DEG):
        azimuths = _JANUS_AZIMUTH_DEG
    else:
        azimuths = tuple((45.0 + 360.0 * i / number) % 360.0 for i in range(number))
    return tuple(Beam(math.radians(a), math.radians(_JANUS_OFF_NADIR_DEG)) for a in azimuths)


def beam_vectors(beams: tuple[Beam, ...]) -> FloatArray:
    """Unit vectors (n, 3) forward, starboard, down of the beams in the body frame."""
    azimuth = np.array([b.azimuth_rad for b in beams])
    off = np.array([b.off_nadir_rad for b in beams])
    return np.stack([np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), np.cos(off)], -1)


def body_axes(heading_rad: float, pitch_rad: float, roll_rad: float) -> FloatArray:
    """Rotation (3, 3) from forward-starboard-down to east-north-down.

    Roll (starboard down) is applied first, then pitch (bow up), then heading (clockwise).

    >>> body_axes(np.pi / 2, 0.0, 0.0)[:, 0].round(6) + 0.0  # the bow points east
    array([1., 0., 0.])
    """
    ch, sh = math.cos(heading_rad), math.sin(heading_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    heading = np.array([[sh, ch, 0.0], [ch, -sh, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    axes: FloatArray = heading @ pitch @ roll
    return axes


def soundings_of(
    measurement: Measurement, vectors: FloatArray, fractions: FloatArray, floor_m: float
) -> Soundings:
    """Turn the ranges of a measurement into points of the sea floor.

    Parameters
    ----------
    vectors : (beams, 3) from `beam_vectors`.
    fractions, floor_m : 1-sigma of a range is ``max(fraction * range, floor_m)``.

    Returns
    -------
    Soundings
        Of the beams with a positive finite range that look down; none where depth or heading is
        not known.
    """
    ranges = measurement.slant_range_m
    heading = measurement.heading_rad
    usable = np.isfinite(ranges) & (ranges > 0)
    if not (math.isfinite(measurement.depth_m) and math.isfinite(heading)):
        usable &= False
        heading = 0.0
    pitch = measurement.pitch_rad if math.isfinite(measurement.pitch_rad) else 0.0
    roll = measurement.roll_rad if math.isfinite(measurement.roll_rad) else 0.0
    rays = vectors @ body_axes(heading, pitch, roll).T
    # A ray within 20 degrees of level tells where the floor is, not how high.
    chosen = np.flatnonzero(usable & (rays[:, 2] > 0.34))
    ranges, rays = ranges[chosen], rays[chosen]
    return Soundings(
        east_m=ranges * rays[:, 0],
        north_m=ranges * rays[:, 1],
        elevation_m=-measurement.depth_m - ranges * rays[:, 2],
        range_sigma_m=np.maximum(fractions[chosen] * ranges, floor_m),
        down=rays[:, 2],
        out_east=rays[:, 0],
        out_north=rays[:, 1],
        beam=chosen,
    )


def read_sensors(path: Path) -> Sensors:
    """Read `--sensors`: `[[beam]]` directions in degrees and a table `[sigma]`.

    ::

        [[beam]]
        azimuth_deg = 45.0        # clockwise from the bow
        off_nadir_deg = 30.0
        fraction = 0.01           # optional: noise of this beam

        [sigma]                   # all optional, 1-sigma
        beam_fraction = 0.01
        beam_floor_m = 0.02
        start_m = 50.0
        scale = 0.005
        heading_deg = 0.5
        depth_bias_m = 1.0
        walk_m_sqrt_h = 3.0       # random walk of dead reckoning
        tide_m_sqrt_h = 0.2       # random walk of the depth bias

    Raises
    ------
    InputError
        An unknown key, a missing direction, or a value out of its range.
    """
    table = read_toml(path)
    _refuse_unknown(path, "top level", table, {"beam", "sigma"})
    sigma = table.get("sigma", {})
    names = {
        "beam_fraction": (1e-5, 0.5), "beam_floor_m": (0.0, 10.0), "start_m": (0.1, 1e5),
        "scale": (0.0, 0.5), "heading_deg": (0.0, 180.0), "depth_bias_m": (0.0, 100.0),
        "walk_m_sqrt_h": (0.0, 1e4), "tide_m_sqrt_h": (0.0, 50.0),
    }  # fmt: skip
    _refuse_unknown(path, "[sigma]", sigma, set(names))
    values = {k: _number(path, f"sigma.{k}", v, *names[k]) for k, v in sigma.items()}
    if "heading_deg" in values:
        values["heading_rad"] = math.radians(values.pop("heading_deg"))
    beams = tuple(_beam(path, i, b) for i, b in enumerate(table.get("beam", []), start=1))
    return Sensors(beams=beams, **values)


def _beam(path: Path, index: int, table: dict[str, Any]) -> Beam:
    _refuse_unknown(path, f"[[beam]] {index}", table, {"azimuth_deg", "off_nadir_deg", "fraction"})
    missing = [k for k in ("azimuth_deg", "off_nadir_deg") if k not in table]
    if missing:
        raise InputError(f"{path}: [[beam]] {index} lacks {missing[0]}; give it in degrees")
    fraction = table.get("fraction")
    return Beam(
        math.radians(_number(path, "azimuth_deg", table["azimuth_deg"], -360.0, 360.0)),
        math.radians(_number(path, "off_nadir_deg", table["off_nadir_deg"], 0.0, 90.0)),
        None if fraction is None else _number(path, "fraction", fraction, 1e-5, 0.5),
    )


def _number(path: Path, name: str, value: object, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(f"{path}: {name} must be a number from {low:g} to {high:g}, got {value!r}")
    return float(value)


def _refuse_unknown(path: Path, where: str, table: dict[str, Any], known: set[str]) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        raise InputError(
            f"{path}: {where} has an unknown key {unknown[0]!r}; known are {', '.join(sorted(known))}"
        )
