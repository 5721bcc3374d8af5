"""Strip files: one pass's elevation strip as NetCDF with CF attributes, written and read back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from perception.files import existing_file, whole_file
from perception.quality import CellFlag
from perception.records import ElevationStrip, InputError

if TYPE_CHECKING:
    import xarray

CHUNK_LINES = 128

# variable: (dimensions, units, long name, standard name or "")
_VARIABLES: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "elevation_m": (("line", "column"), "m", "height of the sea floor above the vertical datum", ""),
    "sigma_m": (("line", "column"), "m", "1-sigma of elevation", ""),
    "echo": (("line", "column"), "1", "echo power over its nominal level", ""),
    "shadow": (("line", "column"), "1", "sea floor in acoustic shadow", ""),
    "across_m": (("column",), "m", "ground range, starboard positive", ""),
    "time_s": (("line",), "", "time of the ping", "time"),
    "ping": (("line",), "1", "index of the ping in the order of the survey's files", ""),
    "easting_m": (("line",), "m", "easting of the sonar", "projection_x_coordinate"),
    "northing_m": (("line",), "m", "northing of the sonar", "projection_y_coordinate"),
    "depth_m": (("line",), "m", "depth of the sonar below the surface", "depth"),
    "heading_rad": (("line",), "rad", "heading, clockwise from grid north", ""),
    "altitude_m": (("line",), "m", "height of the sonar above the sea floor", "height_above_sea_floor"),
    "altitude_sigma_m": (("line",), "m", "1-sigma of altitude", ""),
    "lead_m": (("line",), "m", "how far ahead of the sonar the line lies", ""),
}  # fmt: skip
# Variables that a strip may lack.
_OPTIONAL = ("lead_m",)


def strip_dataset(strip: ElevationStrip, utc: bool = True) -> xarray.Dataset:
    """Return a strip as a labelled data set: units, names, CRS and provenance in attributes."""
    import xarray

    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, object]]] = {}
    for name, (dimensions, units, long_name, standard) in _VARIABLES.items():
        if getattr(strip, name) is None:
            continue
        values = np.asarray(getattr(strip, name))
        if name == "shadow":
            values = values.astype(np.int8)
        elif len(dimensions) == 2:
            values = values.astype(np.float32, copy=False)
        attributes: dict[str, object] = {"long_name": long_name}
        if name == "time_s":
            attributes["units"] = "seconds since 1970-01-01T00:00:00Z" if utc else "s"
        else:
            attributes["units"] = units
        if standard:
            attributes["standard_name"] = standard
        variables[name] = (dimensions, values, attributes)
    if strip.flags is not None:
        variables["flags"] = (("line", "column"), strip.flags.astype(np.uint8), _flag_attributes())
    return xarray.Dataset(
        variables,
        attrs={
            "Conventions": "CF-1.11",
            "title": "elevation strip of one side-scan pass",
            "crs": strip.crs,
            "source": strip.source,
            "pass_index": int(strip.pass_index),
        },
    )


def _flag_attributes() -> dict[str, object]:
    """Return what CF asks of a variable of bits: a mask and a word for each."""
    return {
        "long_name": "quality flags",
        "flag_masks": np.array([flag.value for flag in CellFlag], np.uint8),
        "flag_meanings": " ".join(str(flag.name).lower() for flag in CellFlag),
    }


def write_strip(path: Path, strip: ElevationStrip, utc: bool = True) -> None:
    """Write a strip to `path` (NetCDF-4), whole or not at all."""
    data = strip_dataset(strip, utc)
    # Chunks of whole lines: a tile of the map reads the lines that touch it, not the strip.
    lines, columns = strip.elevation_m.shape
    squeezed: dict[str, object] = {
        "zlib": True,
        "complevel": 1,
        "chunksizes": (min(lines, CHUNK_LINES), columns),
    }
    encoding: dict[str, dict[str, object]] = {
        name: squeezed for name, (dimensions, *_) in _VARIABLES.items() if len(dimensions) == 2
    }
    with whole_file(path) as temporary:
        try:
            data.to_netcdf(temporary, engine="netcdf4", encoding=encoding)
        except RuntimeError as error:  # netCDF's word for a full disk
            raise InputError(f"{path}: cannot be written ({error}); is the disk full?") from error


def read_strip(path: Path) -> ElevationStrip:
    """Read a strip that `write_strip` wrote.

    Raises
    ------
    InputError
        Not a NetCDF file, or one without a strip's variables.
    """
    import xarray

    path = existing_file(path)
    try:
        with xarray.open_dataset(path, engine="netcdf4", decode_times=False) as data:
            missing = [name for name in _VARIABLES if name not in data and name not in _OPTIONAL]
            if missing:
                raise InputError(
                    f"{path}: lacks {missing[0]}; give a strip written by `bathynav strips`"
                )
            values = {name: data[name].to_numpy() for name in _VARIABLES if name in data}
            if "flags" in data:
                values["flags"] = data["flags"].to_numpy().astype(np.uint8)
            attributes = dict(data.attrs)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is not a NetCDF strip ({error})") from error
    values["shadow"] = values["shadow"].astype(bool)
    return ElevationStrip(
        **values,
        crs=str(attributes.get("crs", "")),
        source=str(attributes.get("source", "")),
        pass_index=int(attributes.get("pass_index", 0)),
    )
