"""Our own NetCDF form of pings, CF names: for simulators, forward-looking kinds and exchange.

One file holds pings in time order. The layout is data, in `VARIABLES`; docs/sonar-files.md shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.files import whole_file
from perception.geodesy import convergence, is_local, short_name
from perception.readers.raw import RawFile, RawPings, blank_samples
from perception.records import FloatArray, InputError, IntArray, Progress, Swath

# Variable: (attributes, the swath's attribute).
VARIABLES: dict[str, tuple[dict[str, str], str]] = {
    "time": ({"standard_name": "time", "axis": "T"}, "time_s"),
    "easting": ({"standard_name": "projection_x_coordinate", "units": "m"}, "easting_m"),
    "northing": ({"standard_name": "projection_y_coordinate", "units": "m"}, "northing_m"),
    "depth": (
        {"standard_name": "depth", "units": "m", "positive": "down",
         "long_name": "depth of the sonar below the surface"},
        "depth_m",
    ),
    "heading": (
        {"standard_name": "platform_orientation", "units": "degree",
         "long_name": "heading from true north, clockwise"},
        "heading_rad",
    ),
    "pitch": ({"standard_name": "platform_pitch", "units": "degree", "comment": "bow up"}, "pitch_rad"),
    "roll": (
        {"standard_name": "platform_roll", "units": "degree", "comment": "starboard down"}, "roll_rad"
    ),
    "altitude": (
        {"standard_name": "height_above_sea_floor", "units": "m", "comment": "a hint: may be wrong"},
        "altitude_hint_m",
    ),
    "sample_interval": (
        {"units": "m", "long_name": "slant range from one sample to the next",
         "comment": "sample k is centred at (k + 0.5) sample_interval"},
        "sample_m",
    ),
    "sound_speed": (
        {"standard_name": "speed_of_sound_in_sea_water", "units": "m s-1"}, "sound_speed_m_s"
    ),
    "scan_angle": (
        {"units": "degree", "long_name": "azimuth of the beam from the bow, clockwise"},
        "scan_angle_rad",
    ),
}  # fmt: skip
_NEEDED = ("time", "easting", "northing", "heading", "sample_interval")
_EPOCH = "seconds since 1970-01-01T00:00:00Z"
_BLOCK = 512
# Beyond these a value is damage; it is then unknown.
_LIMITS = {
    "easting": (-1e8, 1e8), "northing": (-1e8, 1e8), "depth": (-100.0, 12000.0),
    "altitude": (0.0, 12000.0), "heading": (-720.0, 720.0), "pitch": (-90.0, 90.0),
    "roll": (-180.0, 180.0), "sample_interval": (1e-6, 100.0), "sound_speed": (1300.0, 1700.0),
    "scan_angle": (-720.0, 720.0), "time": (-1e11, 1e11),
}  # fmt: skip


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the file starts as NetCDF (classic or HDF5)."""
    return head.startswith((b"\x89HDF", b"CDF\x01", b"CDF\x02", b"CDF\x05"))


@dataclass(frozen=True)
class NetcdfFile(RawFile):
    """A scanned NetCDF of pings."""

    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows`; see `RawFile.samples`."""
        out = blank_samples(len(rows), width)
        with _opened(self.path) as data:
            for values, name in zip(out, ("port", "starboard"), strict=True):
                if name not in data.variables:
                    continue
                stored = data.variables[name]
                most = min(width, stored.shape[1])
                for first in range(0, len(rows), _BLOCK):
                    part = rows[first : first + _BLOCK]
                    # One slab per block of rows: the file is compressed in blocks of pings.
                    slab = self._slab(stored, int(part.min()), int(part.max()) + 1, most)
                    values[first : first + len(part), :most] = slab[part - part.min()]
        return out

    def _slab(self, stored: Any, first: int, stop: int, most: int) -> npt.NDArray[np.float64]:
        try:
            return _plain(stored[first:stop, :most])
        except RuntimeError as error:
            raise InputError(
                f"{self.path}: samples of pings {first} to {stop - 1} are damaged ({error}); "
                "copy the file again"
            ) from error


def _opened(path: Path) -> Any:
    import netCDF4

    try:
        return netCDF4.Dataset(path)
    except (OSError, RuntimeError) as error:
        raise InputError(
            f"{path}: cannot be read as NetCDF ({error}); was it copied whole?"
        ) from error


def _plain(values: Any) -> npt.NDArray[np.float64]:
    """Return values as floats with NaN where masked."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.ma.filled(np.ma.asarray(values).astype(np.float64), np.nan)


def scan(path: Path, progress: Progress) -> NetcdfFile:
    """Scan a NetCDF's pings.

    Raises
    ------
    InputError
        Not readable, or a needed variable is missing or of another length.
    """
    try:
        with _opened(path) as data:
            return _file_of(path, data)
    except (RuntimeError, IndexError) as error:
        raise InputError(f"{path}: is a damaged NetCDF ({error}); was it copied whole?") from error


def _file_of(path: Path, data: Any) -> NetcdfFile:
    missing = [name for name in _NEEDED if name not in data.variables]
    sides = [name for name in ("port", "starboard") if name in data.variables]
    if missing or not sides:
        lacking = ", ".join(missing) or "port and starboard"
        raise InputError(
            f"{path}: is no NetCDF of pings: it lacks {lacking}; docs/sonar-files.md has the layout"
        )
    n = len(data.variables["time"])
    found = {}
    for name in VARIABLES:
        if name in data.variables:
            values = (
                np.broadcast_to(_plain(data.variables[name][:]), (n,))
                if (data.variables[name].shape in ((), (1,), (n,)))
                else None
            )
            if values is None:
                raise InputError(
                    f"{path}: {name} has shape {data.variables[name].shape}, the pings are {n}; "
                    "give one value a ping"
                )
            low, high = _LIMITS[name]
            with np.errstate(invalid="ignore"):
                found[name] = np.where((values >= low) & (values <= high), values, np.nan)
    for name in sides:
        if data.variables[name].ndim != 2 or data.variables[name].shape[0] != n:
            raise InputError(
                f"{path}: {name} has shape {data.variables[name].shape}; it must be (ping, sample)"
            )
    columns = _columns(data, found, sides, n)
    units = str(getattr(data.variables["time"], "units", ""))
    return NetcdfFile(
        path=path,
        format="NetCDF of pings",
        sonar=str(getattr(data, "sonar", "")),
        pings=RawPings(**columns),
        crs=_crs_of(data),
        utc="since 1970-01-01" in units,
        frequency_hz=float(getattr(data, "frequency_hz", np.nan)),
        bits=str(data.variables[sides[0]].dtype),
        packets={"ping": n},
        scan_angle_deg=found.get("scan_angle"),
    )


def _columns(
    data: Any, found: dict[str, npt.NDArray[np.float64]], sides: Sequence[str], n: int
) -> dict[str, Any]:
    columns = RawPings.empty(n)
    for name, column in (
        ("time", "time_s"), ("easting", "x"), ("northing", "y"), ("depth", "depth_m"),
        ("altitude", "altitude_m"), ("heading", "heading_deg"), ("pitch", "pitch_deg"),
        ("roll", "roll_deg"), ("sound_speed", "sound_speed_m_s"),
    ):  # fmt: skip
        if name in found:
            columns[column] = found[name]
    columns["sound_speed_m_s"] = np.nan_to_num(columns["sound_speed_m_s"], nan=1500.0)
    counts = (
        _plain(data.variables["sample_count"][:]).astype(np.int64)
        if "sample_count" in data.variables
        else None
    )
    for name in sides:
        width = data.variables[name].shape[1]
        columns[f"{name}_samples"][:] = width if counts is None else np.clip(counts, 0, width)
    longest = np.maximum(columns["port_samples"], columns["starboard_samples"])
    columns["start_m"][:] = 0.0
    columns["range_m"] = found["sample_interval"] * longest
    return columns


def _crs_of(data: Any) -> str:
    import pyproj

    wkt = str(getattr(data.variables.get("crs"), "crs_wkt", "")) if "crs" in data.variables else ""
    if not wkt or is_local(wkt):
        return ""
    return short_name(pyproj.CRS.from_user_input(wkt))


def write_netcdf(path: Path, swath: Swath) -> None:
    """Write the pings of a swath as NetCDF; `open_survey` reads the same swath back.

    Headings go out from true north, as in every sonar file. Several passes are several files, or one
    swath of all pings in time order (`Survey.read`).
    """
    import netCDF4
    import pyproj

    with whole_file(path) as temporary, netCDF4.Dataset(temporary, "w", format="NETCDF4") as data:
        data.Conventions = "CF-1.11"
        data.title = "pings of a side-scan type sonar"
        data.source, data.sonar = swath.source, swath.sonar
        if np.isfinite(swath.frequency_hz):
            data.frequency_hz = swath.frequency_hz
        data.createDimension("ping", swath.n_pings)
        data.createDimension("sample", swath.n_samples)
        frame = data.createVariable("crs", "i4")
        frame.crs_wkt = pyproj.CRS.from_user_input(swath.crs).to_wkt()
        for name, (attributes, source) in VARIABLES.items():
            values = getattr(swath, source)
            if values is None:
                continue
            variable = data.createVariable(name, "f8", ("ping",))
            variable.setncatts(attributes)
            variable[:] = _in_file_units(swath, name, np.asarray(values, float))
        data.variables["time"].units = _EPOCH if swath.utc else "s"
        _write_sides(data, swath)


def _in_file_units(swath: Swath, name: str, values: FloatArray) -> FloatArray:
    if name == "heading":
        turned = convergence(swath.easting_m, swath.northing_m, swath.crs)
        return np.asarray(np.degrees(values + turned) % 360.0)
    if name in ("pitch", "roll", "scan_angle"):
        return np.asarray(np.degrees(values))
    return values


def _write_sides(data: Any, swath: Swath) -> None:
    count = data.createVariable("sample_count", "i4", ("ping",))
    count.long_name = "samples of each ping, from the first"
    there = np.isfinite(swath.port) | np.isfinite(swath.starboard)
    last = swath.n_samples - np.argmax(there[:, ::-1], axis=1)
    count[:] = np.where(there.any(axis=1), last, 0)
    for name in ("port", "starboard"):
        values = getattr(swath, name)
        if not np.isfinite(values).any():
            continue
        variable = data.createVariable(
            name, "f4", ("ping", "sample"), zlib=True, complevel=1, fill_value=np.float32(np.nan),
            chunksizes=(min(256, max(swath.n_pings, 1)), max(swath.n_samples, 1)),
        )  # fmt: skip
        variable.long_name = f"echo amplitude to {name}, near to far"
        variable.grid_mapping = "crs"
        variable[:] = values
