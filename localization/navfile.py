"""Read and check `nav.csv`: one `Measurement` per row, in the file's order."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from localization.measurements import Beam, Measurement, Sensors, default_beams
from localization.navchecks import check_nav
from perception.files import existing_file
from perception.records import FloatArray, InputError

logger = logging.getLogger(__name__)

_NEEDED = ("time_s", "easting_m", "northing_m", "depth_m", "heading_deg")
_OPTIONAL = ("pitch_deg", "roll_deg", "speed_m_s", "altitude_m")


@dataclass(frozen=True, slots=True)
class NavTable:
    """Columns of `nav.csv`, (n,) each, NaN where a value is missing; angles in radians.

    `slant_range_m` is (n, beams) in the order of `sensors.beams`, the altimeter first where there is
    one; `utc` tells whether `time_s` counts from 1970.
    """

    time_s: FloatArray
    easting_m: FloatArray
    northing_m: FloatArray
    depth_m: FloatArray
    heading_rad: FloatArray
    pitch_rad: FloatArray
    roll_rad: FloatArray
    speed_m_s: FloatArray
    slant_range_m: FloatArray
    sensors: Sensors
    source: str = "nav.csv"
    utc: bool = False

    def __len__(self) -> int:
        return len(self.time_s)

    def row(self, i: int) -> Measurement:
        """Return row i as a measurement."""
        return Measurement(
            float(self.time_s[i]), float(self.easting_m[i]), float(self.northing_m[i]),
            float(self.depth_m[i]), float(self.heading_rad[i]), float(self.pitch_rad[i]),
            float(self.roll_rad[i]), self.slant_range_m[i], float(self.speed_m_s[i]),
        )  # fmt: skip

    def __iter__(self) -> Iterator[Measurement]:
        return (self.row(i) for i in range(len(self)))


def read_nav(path: Path, sensors: Sensors | None = None) -> NavTable:
    """Read `nav.csv` and refuse what cannot be meant.

    Parameters
    ----------
    sensors : beam directions and noise; the contract's defaults if None.

    Raises
    ------
    InputError
        Missing columns, text that is no number, fewer than two positions, rows mostly out of time
        order, beams without directions, units a thousand times off.
    """
    path = existing_file(path)
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False, encoding_errors="replace")
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise InputError(f"{path}: is no table of comma-separated values ({error})") from error
    table.columns = [str(c).strip().lstrip("\ufeff") for c in table.columns]
    missing = [c for c in _NEEDED if c not in table.columns]
    if missing:
        raise InputError(
            f"{path}: lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            f"it has {', '.join(table.columns)}"
        )
    beam_names = sorted(
        (c for c in table.columns if re.fullmatch(r"beam\d+_m", c)), key=lambda c: int(c[4:-2])
    )
    wanted = [c for c in (*_NEEDED, *_OPTIONAL, *beam_names) if c in table.columns]
    columns = {name: _numbers(path, table, name) for name in wanted}
    return nav_table(columns, sensors, str(path))


def nav_table(
    columns: dict[str, FloatArray], sensors: Sensors | None = None, source: str = "nav.csv"
) -> NavTable:
    """Build a `NavTable` from columns named as in the contract; checks as `read_nav`."""
    n = len(columns["time_s"])
    nothing = np.full(n, np.nan)

    def of(name: str) -> FloatArray:
        return np.asarray(columns.get(name, nothing), float)

    sensors, ranges = _beams(columns, sensors or Sensors(), source)
    time_s = of("time_s")
    known = time_s[np.isfinite(time_s)]
    nav = NavTable(
        time_s=time_s,
        easting_m=of("easting_m"),
        northing_m=of("northing_m"),
        depth_m=of("depth_m"),
        heading_rad=np.radians(of("heading_deg")),
        pitch_rad=np.radians(of("pitch_deg")),
        roll_rad=np.radians(of("roll_deg")),
        speed_m_s=of("speed_m_s"),
        slant_range_m=ranges,
        sensors=sensors,
        source=source,
        # Seconds of a clock that counts from 1970 passed 1e9 in 2001; a file's own clock starts near 0.
        utc=bool(known.size and np.median(known) > 1e9),
    )
    check_nav(nav)
    return nav


def _beams(
    columns: dict[str, FloatArray], sensors: Sensors, source: str
) -> tuple[Sensors, FloatArray]:
    names = sorted(
        (c for c in columns if re.fullmatch(r"beam\d+_m", c)), key=lambda c: int(c[4:-2])
    )
    beams = sensors.beams
    if not beams:
        beams = default_beams(len(names))
        if len(names) not in (0, 4):
            logger.warning(
                "%s: %d beams without directions; taken as %s; give --sensors", source, len(names),
                "looking down" if len(names) == 1 else "evenly around, 30 degrees off nadir",
            )  # fmt: skip
    elif names and len(beams) != len(names):
        raise InputError(
            f"{source}: has {len(names)} beam columns and --sensors {len(beams)} [[beam]] tables; "
            "give one for each"
        )
    if not names:
        beams = ()
    if "altitude_m" in columns:
        beams, names = (Beam(0.0, 0.0), *beams), ["altitude_m", *names]
    n = len(columns["time_s"])
    ranges = np.full((n, len(names)), np.nan)
    for i, name in enumerate(names):
        ranges[:, i] = columns[name]
    # Sounders write 0 or a negative number for no return.
    ranges[~(ranges > 0)] = np.nan
    return replace(sensors, beams=beams), ranges


def _numbers(path: Path, table: pd.DataFrame, name: str) -> FloatArray:
    texts = table[name].str.strip()
    values = pd.to_numeric(texts, errors="coerce").to_numpy(float, copy=True)
    bad = np.isnan(values) & ~texts.str.lower().isin(["", "nan", "na", "none", "null"]).to_numpy()
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{path}: line {row + 2}: {name} is {texts.iloc[row]!r}, not a number; "
            "mend the line or leave the value empty"
        )
    values[~np.isfinite(values)] = np.nan
    return values
