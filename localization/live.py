"""Running live: rows of CSV or line-delimited JSON in, one line of estimate out for each.

The first line decides: a header of column names means CSV, a brace means JSON. The navigator's state
can be saved at any row and restored, so a restarted process goes on where it was.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from localization.estimate import Estimate
from localization.measurements import Measurement, Sensors
from localization.navigator import Navigator
from localization.saved import bring_to, state_of
from perception.files import whole_file
from perception.records import InputError

NEEDED = ("time_s", "easting_m", "northing_m", "depth_m", "heading_deg")


def rows_of(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield one dictionary per row of a growing CSV or JSON-lines stream.

    Raises
    ------
    InputError
        The first row lacks a column, or a line is neither.
    """
    header: list[str] | None = None
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text:
            continue
        if text.startswith("{"):
            row = _json_row(text, number)
        elif header is None:
            header = [name.strip() for name in next(csv.reader([text]))]
            _refuse_lack(header, number)
            continue
        else:
            row = dict(zip(header, next(csv.reader([text])), strict=False))
        _refuse_lack(list(row), number)
        yield row


def _json_row(text: str, number: int) -> dict[str, Any]:
    try:
        row: dict[str, Any] = json.loads(text)
    except ValueError as error:
        raise InputError(f"standard input: line {number} is not valid JSON ({error})") from error
    return row


def _refuse_lack(names: list[str], number: int) -> None:
    lack = [name for name in NEEDED if name not in names]
    if lack:
        raise InputError(
            f"standard input: line {number} lacks {', '.join(lack)}; the first line names the "
            "columns (CSV), or every line is a JSON object"
        )


def measurement_of(
    row: dict[str, Any], sensors: Sensors, convergence_rad: float = 0.0
) -> Measurement:
    """Make a measurement of a row; what is missing or no number is NaN."""
    beams = len(sensors.beams) - (1 if "altitude_m" in row else 0)
    names = [f"beam{i + 1}_m" for i in range(beams)]
    if "altitude_m" in row:
        names = ["altitude_m", *names]
    return Measurement(
        time_s=_number(row, "time_s"),
        easting_m=_number(row, "easting_m"),
        northing_m=_number(row, "northing_m"),
        depth_m=_number(row, "depth_m"),
        heading_rad=math.radians(_number(row, "heading_deg")) - convergence_rad,
        pitch_rad=math.radians(_number(row, "pitch_deg")),
        roll_rad=math.radians(_number(row, "roll_deg")),
        slant_range_m=np.array([_number(row, name) for name in names]),
        speed_m_s=_number(row, "speed_m_s"),
    )


def _number(row: dict[str, Any], name: str) -> float:
    try:
        return float(row.get(name) or math.nan) if row.get(name) != 0 else 0.0
    except (TypeError, ValueError):
        return math.nan


def estimate_line(e: Estimate) -> str:
    """Write an estimate as one line of JSON."""
    c = e.covariance_m2
    record = {
        "time_s": e.time_s,
        "easting_m": round(e.easting_m, 3),
        "northing_m": round(e.northing_m, 3),
        "sigma_easting_m": round(math.sqrt(c[0, 0]), 4),
        "sigma_northing_m": round(math.sqrt(c[1, 1]), 4),
        "cov_en_m2": round(float(c[0, 1]), 5),
        "status": e.status,
        "protection_m": round(e.protection_m, 2),
        "reason": e.reason,
    }
    plain = {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()
    }
    return json.dumps(plain)


def save_state(path: Path, navigator: Navigator) -> None:
    """Save a navigator so that `restore_state` goes on where it was."""
    arrays, words = state_of(navigator)
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, words=np.array(json.dumps(words)), **arrays)  # type: ignore[arg-type]


def restore_state(path: Path, navigator: Navigator) -> None:
    """Bring a navigator, built with the same map and sensors, to a saved state.

    Raises
    ------
    InputError
        The file is no saved state, or of another number of beams or hypotheses.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            words = json.loads(str(stored["words"]))
            arrays = {name: stored[name] for name in stored.files if name != "words"}
        bring_to(navigator, arrays, words)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: is not a saved state of this map and these sensors ({error})"
        ) from error
