"""What a format's reader gives: the headers of a file's pings, and a door to their samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.records import BoolArray, FloatArray, IntArray


class PingFlag(IntFlag):
    """What is known against a ping; bits of `Swath.flags`."""

    POSITION_FILLED = 1  # no valid position in the file: interpolated between neighbours
    CLOCK_FILLED = 2  # its clock stepped back or stood still: time interpolated
    HEADING_FILLED = 4  # no heading in the file: course of the track, or interpolated
    NO_DEPTH = 8  # depth unknown
    TURNING = 16  # the vehicle turns faster than the image bears
    SATURATED = 32  # many samples at the recorder's ceiling
    NO_BOTTOM = 64  # no bottom found (set by the bottom tracker)
    STOPPED = 128  # the vehicle stands still
    NO_SAMPLES = 256  # neither side has an echo


@dataclass(frozen=True, slots=True)
class RawPings:
    """Headers of the side-scan pings of one file, in file order, as the file has them.

    All (n,). NaN is unknown: a reader turns the zeros that mean "not recorded" into NaN where the
    format makes that plain (zero position, zero altitude). Angles in degrees as in every file.

    Attributes
    ----------
    time_s : seconds since 1970 UTC where `RawFile.utc`, else of the file's clock.
    x, y : east and north in `RawFile.crs`, or metres of an unknown grid where that is empty.
    heading_deg : from true north.
    port_samples, starboard_samples : samples per side, 0 for a missing side.
    range_m : slant range at the end of the last sample, by `sound_speed_m_s`.
    start_m : slant range at the beginning of the first sample.
    number : the file's own ping number, -1 where it has none.
    """

    time_s: FloatArray
    x: FloatArray
    y: FloatArray
    depth_m: FloatArray
    altitude_m: FloatArray
    heading_deg: FloatArray
    pitch_deg: FloatArray
    roll_deg: FloatArray
    speed_m_s: FloatArray
    sound_speed_m_s: FloatArray
    range_m: FloatArray
    start_m: FloatArray
    port_samples: IntArray
    starboard_samples: IntArray
    number: IntArray

    @classmethod
    def empty(cls, n: int) -> dict[str, Any]:
        """Return one array of "unknown" per field, for a reader to fill."""
        whole = {"port_samples": 0, "starboard_samples": 0, "number": -1}
        return {
            f.name: np.full(n, whole[f.name], np.int64) if f.name in whole else np.full(n, np.nan)
            for f in fields(cls)
        }

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def samples(self) -> IntArray:
        """Return the samples of each ping's longer side."""
        return np.maximum(self.port_samples, self.starboard_samples)


@dataclass(frozen=True)
class RawFile(ABC):
    """One scanned sonar file.

    Attributes
    ----------
    crs : CRS of `pings.x, y`; empty for metres of an unknown grid.
    packets : kind of packet to its count, for `bathynav info`.
    defects : plain sentences with counts: what was wrong and what was made of it.
    bits : bits of a sample in the file, with its kind ("16-bit integer").
    frequency_hz : of the side-scan in use; NaN unknown.
    scan_angle_deg : (n,) azimuth from the bow for forward-looking kinds, else None.
    """

    path: Path
    format: str
    sonar: str
    pings: RawPings
    crs: str = ""
    utc: bool = True
    frequency_hz: float = float("nan")
    bits: str = ""
    packets: dict[str, int] | None = None
    defects: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    scan_angle_deg: FloatArray | None = None

    @abstractmethod
    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows` from the file.

        Returns
        -------
        port, starboard : (len(rows), width) float32, near to far from `start_m`, NaN past a ping's
            last sample and for a missing side.
        """


def blank_samples(n: int, width: int) -> tuple[FloatArray, FloatArray]:
    """Return port and starboard of `n` pings without a sample yet."""
    return np.full((n, width), np.nan, np.float32), np.full((n, width), np.nan, np.float32)


def spread_rows(n: int, most: int, together: int = 1) -> IntArray:
    """Return at most `most` rows in runs of `together`, evenly over `n`: to judge a file by."""
    if n <= most:
        return np.arange(n)
    starts = np.linspace(0, n - together, max(most // together, 1)).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(together))


def floats(values: npt.ArrayLike) -> FloatArray:
    """Return values as float64; a signalling NaN of a damaged file turns quiet without a warning."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(values).astype(np.float64)


def plural(count: int, noun: str) -> str:
    """Write `1 ping` or `1,200 pings`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def valid_degrees(x: FloatArray, y: FloatArray) -> BoolArray:
    """Return where (x, y) is a longitude and latitude that a file means: not (0, 0), on Earth."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(x + y) & ~((x == 0) & (y == 0)) & (abs(x) <= 180) & (abs(y) <= 90)
