"""The frozen records that cross folder boundaries; needs numpy alone.

Conventions (docs/conventions.md has the reasons): SI units and radians; easting before northing;
elevation up, depth down from the surface, altitude above the bottom; headings clockwise from *grid*
north; roll positive starboard down, pitch positive bow up; NaN means no data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating[Any]]
IntArray = npt.NDArray[np.integer[Any]]
BoolArray = npt.NDArray[np.bool_]

# A long step reports (label, done, total); a command draws the bar, a library never prints.
Progress = Callable[[str, int, int], None]


def silent(label: str, done: int, total: int) -> None:
    """Report progress to nobody: the default of every long step."""


class BathynavError(Exception):
    """A condition that the user can mend; the message names file, value, limit and way out."""


class InputError(BathynavError, ValueError):
    """An input file or option cannot be used as it is."""


class NoOverlapError(BathynavError):
    """Two data sets that must overlap do not."""


class NoPathError(BathynavError):
    """No route keeps every limit; the message says which limit blocks and where."""


def _check_lengths(record: object, names: tuple[str, ...], length: int) -> None:
    for name in names:
        value = getattr(record, name)
        if value is not None and len(value) != length:
            raise ValueError(
                f"{type(record).__name__}.{name} must have one row per ping ({length}), "
                f"got {len(value)}"
            )


@dataclass(frozen=True, slots=True)
class Swath:
    """The pings of one pass of a side-scan type sonar, near to far, ping-major.

    Attributes
    ----------
    time_s : (n,) seconds since 1970-01-01 UTC where `utc`, else seconds of the file's own clock.
    ping : (n,) index of each ping in the order of the survey's files, from 0.
    easting_m, northing_m : (n,) position of the sonar in `crs`.
    depth_m : (n,) depth of the sonar below the surface; NaN unknown.
    heading_rad : (n,) clockwise from grid north.
    pitch_rad, roll_rad : (n,) bow up and starboard down positive; zero where not recorded.
    altitude_hint_m : (n,) what the file calls altitude, a hint and no more; NaN unknown.
    sample_m : (n,) slant range from one sample to the next; sample k is centred at
        ``(k + 0.5) * sample_m``.
    port, starboard : (n, m) float32 echo *amplitude* in the recorder's unit, NaN past a ping's last
        sample. A missing side is all NaN.
    sound_speed_m_s : (n,) speed that the ranges were made with.
    crs : projected coordinate system, anything `pyproj.CRS` reads.
    utc : whether `time_s` is absolute.
    scan_angle_rad : (n,) azimuth of the beam from the bow for forward-looking kinds (then only
        `starboard` is filled); None for a side-scan, which looks square to the heading.
    flags : (n,) quality flags of the pings, bits of `PingFlag` in `perception.readers`.
    """

    time_s: FloatArray
    ping: IntArray
    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    roll_rad: FloatArray
    altitude_hint_m: FloatArray
    sample_m: FloatArray
    port: FloatArray
    starboard: FloatArray
    sound_speed_m_s: FloatArray
    crs: str
    source: str = ""
    sonar: str = ""
    frequency_hz: float = float("nan")
    utc: bool = True
    pass_index: int = 0
    scan_angle_rad: FloatArray | None = None
    flags: IntArray | None = None

    def __post_init__(self) -> None:
        per_ping = (
            "ping", "easting_m", "northing_m", "depth_m", "heading_rad", "pitch_rad", "roll_rad",
            "altitude_hint_m", "sample_m", "port", "starboard", "sound_speed_m_s",
            "scan_angle_rad", "flags",
        )  # fmt: skip
        _check_lengths(self, per_ping, len(self.time_s))
        if self.port.shape != self.starboard.shape:
            raise ValueError(
                f"Swath.port {self.port.shape} and starboard {self.starboard.shape} must agree; "
                "pad the shorter side with NaN"
            )

    @property
    def n_pings(self) -> int:
        return len(self.time_s)

    @property
    def n_samples(self) -> int:
        return int(self.port.shape[1])

    def take(self, rows: slice | IntArray | BoolArray) -> Swath:
        """Return the swath of the chosen pings."""
        n = self.n_pings
        chosen: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.ndarray) and len(value) == n:
                chosen[f.name] = value[rows]
        return replace(self, **chosen)


@dataclass(frozen=True, slots=True)
class ElevationStrip:
    """Sea-floor height along one pass, in the strip's own frame.

    Line i is one ping (or a stack of consecutive ones) at `easting_m[i]`, `northing_m[i]`; column j lies
    `across_m[j]` to starboard of it, square to `heading_rad[i]`.

    Attributes
    ----------
    elevation_m, sigma_m : (n, m) height above the vertical datum and its 1-sigma; NaN no data.
    across_m : (m,) signed ground range, starboard positive.
    echo : (n, m) gain-equalised echo level, 1 where nominal (power ratio); NaN no data.
    shadow : (n, m) True where the sea floor lies in acoustic shadow.
    time_s, ping, easting_m, northing_m, depth_m, heading_rad, altitude_m, altitude_sigma_m : (n,).
    lead_m : (n,) how far ahead of the sonar the line lies, by its pitch (`perception.attitude`); None
        nowhere.
    flags : (n, m) uint8, bits of `perception.quality.CellFlag`; None where nothing is known.
    """

    elevation_m: FloatArray
    sigma_m: FloatArray
    across_m: FloatArray
    echo: FloatArray
    shadow: BoolArray
    time_s: FloatArray
    ping: IntArray
    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    heading_rad: FloatArray
    altitude_m: FloatArray
    altitude_sigma_m: FloatArray
    crs: str
    source: str = ""
    pass_index: int = 0
    lead_m: FloatArray | None = None
    flags: IntArray | None = None

    def __post_init__(self) -> None:
        shape = (len(self.time_s), len(self.across_m))
        for name in ("elevation_m", "sigma_m", "echo", "shadow", "flags"):
            if getattr(self, name) is not None and getattr(self, name).shape != shape:
                raise ValueError(
                    f"ElevationStrip.{name} must have shape {shape} (lines, columns), "
                    f"got {getattr(self, name).shape}"
                )
        per_line = (
            "ping", "easting_m", "northing_m", "depth_m", "heading_rad", "altitude_m",
            "altitude_sigma_m", "lead_m",
        )  # fmt: skip
        _check_lengths(self, per_line, len(self.time_s))

    @property
    def step_m(self) -> float:
        """Return the usual way from line to line, a millimetre at least; 1 m of a single line."""
        steps = np.hypot(np.diff(self.easting_m), np.diff(self.northing_m))
        return max(float(np.median(steps)), 1e-3) if len(steps) else 1.0

    def sonar_positions(self) -> tuple[FloatArray, FloatArray]:
        """Return easting and northing of the sonar itself, each (n,)."""
        if self.lead_m is None:
            return self.easting_m, self.northing_m
        east, north = np.sin(self.heading_rad), np.cos(self.heading_rad)
        return self.easting_m - self.lead_m * east, self.northing_m - self.lead_m * north

    def positions(self) -> tuple[FloatArray, FloatArray]:
        """Return easting and northing of every cell, each (n, m)."""
        # Starboard of heading h (clockwise from north) points to (cos h, -sin h).
        easting_m = self.easting_m[:, None] + np.cos(self.heading_rad)[:, None] * self.across_m
        northing_m = self.northing_m[:, None] - np.sin(self.heading_rad)[:, None] * self.across_m
        return easting_m, northing_m


@dataclass(frozen=True, slots=True)
class Grid:
    """A georeferenced raster of heights; rows run north to south, columns west to east.

    Attributes
    ----------
    elevation_m : (rows, cols) float; NaN no data.
    west_m, north_m : outer *edges* of the raster's first column and row.
    cell_m : width of a cell; `cell_north_m` its height where cells are not square.
    sigma_m, count : (rows, cols) 1-sigma of the cell's mean height, and number of data; or None.
    crs : projected coordinate system; empty for none.
    datum : name of the vertical datum; empty unknown.
    """

    elevation_m: FloatArray
    west_m: float
    north_m: float
    cell_m: float
    crs: str = ""
    sigma_m: FloatArray | None = None
    count: FloatArray | None = None
    datum: str = ""
    cell_height_m: float | None = None

    def __post_init__(self) -> None:
        if self.elevation_m.ndim != 2 or self.elevation_m.size == 0:
            raise ValueError(
                f"Grid.elevation_m must be a filled raster (rows, cols), "
                f"got shape {self.elevation_m.shape}"
            )
        for name in ("sigma_m", "count"):
            value = getattr(self, name)
            if value is not None and value.shape != self.elevation_m.shape:
                raise ValueError(
                    f"Grid.{name} must have shape {self.elevation_m.shape}, got {value.shape}"
                )
        if not (self.cell_m > 0 and self.cell_north_m > 0):
            raise ValueError(f"Grid cells must have a positive size, got {self.cell_m}")

    @property
    def shape(self) -> tuple[int, int]:
        rows, cols = self.elevation_m.shape
        return rows, cols

    @property
    def cell_north_m(self) -> float:
        """Height of a cell, the same as `cell_m` on square cells."""
        return self.cell_m if self.cell_height_m is None else self.cell_height_m

    @property
    def east_m(self) -> float:
        return self.west_m + self.shape[1] * self.cell_m

    @property
    def south_m(self) -> float:
        return self.north_m - self.shape[0] * self.cell_north_m

    def centres(self) -> tuple[FloatArray, FloatArray]:
        """Return easting (cols,) and northing (rows,) of the cells' centres."""
        rows, cols = self.shape
        easting_m = self.west_m + (np.arange(cols) + 0.5) * self.cell_m
        northing_m = self.north_m - (np.arange(rows) + 0.5) * self.cell_north_m
        return easting_m, northing_m

    def fractional_index(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return (row, col) as floats with whole numbers at cell centres."""
        row = (self.north_m - np.asarray(northing_m)) / self.cell_north_m - 0.5
        col = (np.asarray(easting_m) - self.west_m) / self.cell_m - 0.5
        return row, col

    def sample(self, easting_m: FloatArray, northing_m: FloatArray) -> FloatArray:
        """Interpolate heights bilinearly between cell centres.

        NaN outside the outermost centres, and wherever one of the four neighbours that carries
        weight is NaN.
        """
        return bilinear(self.elevation_m, *self.fractional_index(easting_m, northing_m))


def bilinear(values: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
    """Interpolate `values` at fractional (row, col); NaN outside or beside a NaN with weight."""
    rows, cols = values.shape
    row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
    inside = (row >= 0) & (row <= rows - 1) & (col >= 0) & (col <= cols - 1)
    r = np.where(inside, row, 0.0)
    c = np.where(inside, col, 0.0)
    r0 = np.minimum(r.astype(np.int64), max(rows - 2, 0))
    c0 = np.minimum(c.astype(np.int64), max(cols - 2, 0))
    r1 = np.minimum(r0 + 1, rows - 1)
    c1 = np.minimum(c0 + 1, cols - 1)
    fr, fc = r - r0, c - c0
    out = np.zeros(r.shape)
    for rr, cc, weight in (
        (r0, c0, (1 - fr) * (1 - fc)),
        (r0, c1, (1 - fr) * fc),
        (r1, c0, fr * (1 - fc)),
        (r1, c1, fr * fc),
    ):
        # A neighbour of zero weight must not spread its NaN to a point that does not need it.
        out += np.where(weight > 0, weight * values[rr, cc], 0.0)
    return np.where(inside, out, np.nan)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses in time order with the covariance of their horizontal positions.

    All arrays are (n,). `ping` and `pass_index` tie a pose to a side-scan ping where there is one;
    `pass_index` is -1 for a pose that belongs to no pass.
    """

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    heading_rad: FloatArray
    sigma_easting_m: FloatArray
    sigma_northing_m: FloatArray
    cov_en_m2: FloatArray
    crs: str = ""
    utc: bool = True
    ping: IntArray | None = None
    pass_index: IntArray | None = None
    status: tuple[str, ...] | None = None
    protection_m: FloatArray | None = None

    def __post_init__(self) -> None:
        per_pose = (
            "easting_m", "northing_m", "depth_m", "heading_rad", "sigma_easting_m",
            "sigma_northing_m", "cov_en_m2", "ping", "pass_index", "status", "protection_m",
        )  # fmt: skip
        _check_lengths(self, per_pose, len(self.time_s))


# Class numbers of the contract's regions.tif.
REGION_CLASSES = (
    "no data", "peak", "pit", "ridge", "valley", "saddle ridge", "saddle valley", "flat", "minimal",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class RegionMap:
    """Labels of a surface by mean and Gaussian curvature, and the graph of its regions.

    Attributes
    ----------
    class_code : (rows, cols) index into `REGION_CLASSES`.
    region : (rows, cols) region number from 1; 0 no data.
    probability : (9, rows, cols) float32 probability of each class; NaN no data; or None.
    table : one array per attribute, row r is region r + 1 (`class_code`, `class_probability`,
        `area_m2`, `relief_m`, `easting_m`, `northing_m`, `mean_H`, `mean_K`, ...).
    edges : (n, 2) pairs of neighbouring regions, smaller number first; `border_m` (n,) their
        common border's length.
    """

    class_code: IntArray
    region: IntArray
    west_m: float
    north_m: float
    cell_m: float
    crs: str = ""
    cell_height_m: float | None = None
    probability: FloatArray | None = None
    table: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    edges: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    border_m: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.class_code.shape != self.region.shape:
            raise ValueError(
                f"RegionMap.class_code {self.class_code.shape} and region {self.region.shape} "
                "must have one shape"
            )
