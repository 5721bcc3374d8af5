"""Trajectory files: `trajectory.csv` as the contract has it, written and read."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from perception.files import existing_file, write_text
from perception.geodesy import convergence
from perception.records import FloatArray, InputError, Trajectory

# Tenths of a millimetre and microseconds: below any sensor, and short lines for long surveys.
_FORMATS = {
    "time_s": "%.6f",
    "easting_m": "%.4f",
    "northing_m": "%.4f",
    "depth_m": "%.4f",
    "heading_deg": "%.4f",
    "sigma_easting_m": "%.5g",
    "sigma_northing_m": "%.5g",
    "cov_en_m2": "%.5g",
    "protection_m": "%.3f",
    "ping": "%d",
    "pass": "%d",
}


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write `trajectory.csv`; a value that is not known (NaN) is left empty.

    Column `time` is ISO 8601 UTC where the clock is absolute and seconds where it is not; `time_s`
    is seconds always. `ping`, `pass`, `status` and `protection_m` are written where they are present.
    """
    columns: dict[str, npt.NDArray[Any]] = {
        "time_s": trajectory.time_s,
        "easting_m": trajectory.easting_m,
        "northing_m": trajectory.northing_m,
        "depth_m": trajectory.depth_m,
        # 359.99999 must not print as 360.0000.
        "heading_deg": np.round(np.degrees(trajectory.heading_rad), 4) % 360.0,
        "sigma_easting_m": trajectory.sigma_easting_m,
        "sigma_northing_m": trajectory.sigma_northing_m,
        "cov_en_m2": trajectory.cov_en_m2,
    }
    if trajectory.ping is not None:
        columns["ping"] = trajectory.ping
    if trajectory.pass_index is not None:
        columns["pass"] = trajectory.pass_index
    if trajectory.protection_m is not None:
        columns["protection_m"] = trajectory.protection_m
    texts = {name: _texts(values, _FORMATS[name]) for name, values in columns.items()}
    texts = {
        "time": iso_times(trajectory.time_s) if trajectory.utc else texts["time_s"],
        **texts,
    }
    if trajectory.status is not None:
        texts["status"] = list(trajectory.status)
    lines = [",".join(texts), *map(",".join, zip(*texts.values(), strict=True))]
    write_text(path, "\n".join(lines) + "\n")


def _texts(values: npt.NDArray[Any], form: str) -> list[str]:
    return ["" if value != value else form % value for value in values.tolist()]


def iso_times(time_s: FloatArray) -> list[str]:
    """Return seconds since 1970 as ISO 8601 UTC with microseconds; empty where not finite."""
    known = np.isfinite(time_s)
    micro = np.round(np.where(known, time_s, 0.0) * 1e6).astype("datetime64[us]")
    texts = np.datetime_as_string(micro, unit="us")
    return [f"{text}Z" if ok else "" for text, ok in zip(texts.tolist(), known, strict=True)]


def from_true_north(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with headings from true north, as files have them; inside, grid north rules."""
    if not trajectory.crs:
        return trajectory
    turn_rad = convergence(trajectory.easting_m, trajectory.northing_m, trajectory.crs)
    heading_rad = (trajectory.heading_rad + np.nan_to_num(turn_rad)) % (2 * np.pi)
    return replace(trajectory, heading_rad=heading_rad)


def read_trajectory(path: Path, crs: str = "") -> Trajectory:
    """Read a `trajectory.csv`, ours or another program's with the same column names.

    Needs `easting_m`, `northing_m` and one of `time_s` and `time`; every other column may be absent
    (NaN, or None for `ping`, `pass`, `status`, `protection_m`).

    Parameters
    ----------
    crs : the coordinate system to note in the record; the file names none.

    Raises
    ------
    InputError
        A needed column is missing, a value is neither number nor time, or there is no row.
    """
    path = existing_file(path)
    table = _read_table(path)
    missing = [name for name in ("easting_m", "northing_m") if name not in table]
    if missing or not {"time", "time_s"} & set(table):
        missing = missing or ["time_s (or time)"]
        raise InputError(
            f"{path}: lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            "a trajectory has time, easting_m, northing_m, depth_m, heading_deg"
        )
    time_s, utc = _times(path, table)
    n = len(table)

    def column(name: str) -> FloatArray:
        return _numbers(path, table, name) if name in table else np.full(n, np.nan)

    return Trajectory(
        time_s=time_s,
        easting_m=column("easting_m"),
        northing_m=column("northing_m"),
        depth_m=column("depth_m"),
        heading_rad=np.radians(column("heading_deg")),
        sigma_easting_m=column("sigma_easting_m"),
        sigma_northing_m=column("sigma_northing_m"),
        cov_en_m2=column("cov_en_m2"),
        crs=crs,
        utc=utc,
        ping=_whole_numbers(path, table, "ping"),
        pass_index=_whole_numbers(path, table, "pass"),
        status=tuple(table["status"]) if "status" in table else None,
        protection_m=column("protection_m") if "protection_m" in table else None,
    )


def _read_table(path: Path) -> pd.DataFrame:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
        # Everything as text first, so that a wrong value can be named with its line.
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False, comment="#")
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise InputError(f"{path}: is not a table of comma-separated values ({error})") from error
    table.columns = [str(name).strip() for name in table.columns]
    if not len(table):
        raise InputError(f"{path}: holds no row; was it written to the end?")
    return table


def _times(path: Path, table: pd.DataFrame) -> tuple[FloatArray, bool]:
    if "time" not in table:
        return _numbers(path, table, "time_s"), False
    try:
        plain = _numbers(path, table, "time")
    except InputError:
        stamps = pd.to_datetime(table["time"], utc=True, format="ISO8601", errors="coerce")
        # An empty time is a pose whose time is not known, as `write_trajectory` writes it.
        bad = stamps.isna().to_numpy() & (table["time"].str.strip() != "").to_numpy()
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(
                f"{path}: line {row + 2}: time is {table['time'].iloc[row]!r}; "
                "give ISO 8601 UTC (2026-01-31T12:00:00Z) or seconds"
            ) from None
        seconds = stamps.to_numpy("datetime64[us]").astype(np.int64) * 1e-6
        seconds = np.where(stamps.isna().to_numpy(), np.nan, seconds)
        return seconds, True
    return (_numbers(path, table, "time_s") if "time_s" in table else plain), False


def _numbers(path: Path, table: pd.DataFrame, name: str) -> FloatArray:
    texts = table[name].str.strip()
    values = pd.to_numeric(texts, errors="coerce").to_numpy(float)
    bad = np.isnan(values) & ~texts.str.lower().isin(["", "nan"]).to_numpy()
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{path}: line {row + 2}: {name} is {texts.iloc[row]!r}, not a number; "
            "mend or remove the line"
        )
    return values


def _whole_numbers(path: Path, table: pd.DataFrame, name: str) -> npt.NDArray[np.int64] | None:
    if name not in table:
        return None
    values = _numbers(path, table, name)
    return np.where(np.isfinite(values), values, -1).astype(np.int64)
