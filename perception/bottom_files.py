"""The bottom track as a CSV file: written for every ping, edited by hand, given back.

Columns: `time` (ISO 8601 UTC, or seconds of the file's clock), `pass`, `ping` (in the order of the survey's
files), `slant_range_m` (the first return), `altitude_m`, `sigma_m`, `flag` (`seen`, `carried`, `given`).
Given back, `altitude_m` rules (a first return longer than it is cut to it), `time` proves that the file belongs to the
survey, and a row replaces what the tracker found for its ping; a ping without a row, or with an empty
altitude, is interpolated between its neighbours.
"""

from __future__ import annotations

import csv
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from perception.bottom import BottomTrack
from perception.files import existing_file, utc_seconds, write_text
from perception.records import BoolArray, FloatArray, InputError, IntArray, Swath

# Rows this far from their pings in time belong to another record; clocks corrected otherwise differ by less.
_OTHER_RECORD_S = 10.0
_COLUMNS = ("time", "pass", "ping", "slant_range_m", "altitude_m", "sigma_m", "flag")


@dataclass(frozen=True, slots=True)
class GivenBottom:
    """A bottom track from a file, rows in order of `ping`; all (k,), NaN where the file is silent.

    Equality and name are those of the file's content: it is part of a strip's settings.
    """

    ping: IntArray = field(compare=False, repr=False)
    slant_range_m: FloatArray = field(compare=False, repr=False)
    altitude_m: FloatArray = field(compare=False, repr=False)
    sigma_m: FloatArray = field(compare=False, repr=False)
    seen: BoolArray = field(compare=False, repr=False)
    source: str
    digest: str
    time_s: FloatArray = field(compare=False, repr=False, default_factory=lambda: np.empty(0))

    def __hash__(self) -> int:
        return hash(self.digest)

    def of(self, swath: Swath) -> BottomTrack:
        """Return the track of one pass's pings.

        Raises
        ------
        InputError
            No row for any ping of the pass, an altitude beyond its range, or times of another record.
        """
        found = np.clip(np.searchsorted(self.ping, swath.ping), 0, len(self.ping) - 1)
        there = self.ping[found] == swath.ping
        altitude = np.where(there, self.altitude_m[found], np.nan)
        known = np.isfinite(altitude)
        if not known.any():
            raise InputError(
                f"{self.source}: no altitude for any ping of pass {swath.pass_index} (pings "
                f"{swath.ping[0]} to {swath.ping[-1]}); give rows for some, or drop --bottom"
            )
        self._refuse_other_record(swath, found, known)
        range_m = np.asarray(swath.sample_m, float) * swath.n_samples
        if np.any(altitude[known] >= range_m[known]):
            ping = int(swath.ping[known][np.argmax(altitude[known] >= range_m[known])])
            raise InputError(
                f"{self.source}: the altitude of ping {ping} is beyond its range of "
                f"{float(range_m.min()):.1f} m; altitudes are metres above the bottom"
            )
        index = np.arange(len(altitude))
        slant = np.where(there, self.slant_range_m[found], np.nan)
        # An altitude moved by hand takes the first return with it; it is never longer.
        slant = np.minimum(np.where(np.isfinite(slant), slant, altitude), altitude)
        sigma = np.where(there, self.sigma_m[found], np.nan)
        sigma = np.where(np.isfinite(sigma), sigma, 2 * np.asarray(swath.sample_m, float))
        filled = np.interp(index, index[known], altitude[known])
        between = np.where(
            known, sigma, np.interp(index, index[known], sigma[known]) + 0.02 * filled
        )
        return BottomTrack(
            altitude_m=filled,
            sigma_m=between,
            first_return_m=np.interp(index, index[known], slant[known]),
            valid=known & there & self.seen[found],
        )

    def _refuse_other_record(self, swath: Swath, row: IntArray, known: BoolArray) -> None:
        """Refuse a file whose rows were taken at other times than the pings that they number."""
        if not len(self.time_s):
            return
        apart = np.abs(self.time_s[row] - swath.time_s)[known]
        apart = apart[np.isfinite(apart)]
        if len(apart) and np.median(apart) > _OTHER_RECORD_S:
            raise InputError(
                f"{self.source}: its rows for pass {swath.pass_index} are {np.median(apart):.0f} s away from the "
                "pings they number: it belongs to another record, or the files were named in another order"
            )


def read_bottom(path: Path) -> GivenBottom:
    """Read a bottom track; `ping` and `altitude_m` are needed, the other columns may lack.

    Raises
    ------
    InputError
        A column lacks, or a value is no number, negative, or given twice for one ping.
    """
    path = existing_file(path)
    text = path.read_text(encoding="utf-8-sig")
    rows = csv.DictReader(text.splitlines())
    names = rows.fieldnames or []
    for name in ("ping", "altitude_m"):
        if name not in names:
            raise InputError(
                f"{path}: lacks the column {name}; edit the bottom.csv that strips wrote"
            )
    values, times = [], []
    for row in rows:
        numbers = [
            _number(path, rows.line_num, name, row.get(name))
            for name in ("ping", "slant_range_m", "altitude_m", "sigma_m")
        ]
        values.append([*numbers, float(row.get("flag") != "carried")])
        times.append(_seconds(row.get("time")))
    if not values:
        raise InputError(f"{path}: holds no row; edit the bottom.csv that strips wrote")
    table = np.array(values, float)
    if np.isnan(table[:, 0]).any():
        raise InputError(f"{path}: a row has no ping number; each altitude belongs to a ping")
    order = np.argsort(table[:, 0], kind="stable")
    table, time_s = table[order], np.array(times, float)[order]
    ping = table[:, 0].astype(np.int64)
    twice = np.flatnonzero(np.diff(ping) == 0)
    if len(twice):
        raise InputError(f"{path}: ping {ping[twice[0]]} has two rows; keep one")
    digest = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
    return GivenBottom(
        ping, table[:, 1], table[:, 2], table[:, 3], table[:, 4] > 0, path.name, digest, time_s
    )


def _seconds(text: str | None) -> float:
    """Return a time in seconds since 1970, or of the file's clock; NaN where it is neither."""
    for read in (float, utc_seconds):
        try:
            return read(text or "")
        except ValueError:
            continue
    return float("nan")


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    if text is None or not text.strip():
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    # An altitude or range of nothing is as wrong as a word; a ping counts from 0.
    if not np.isfinite(value) or value < 0 or (value == 0 and name != "ping"):
        raise InputError(
            f"{path}: line {line}: {name} is {text!r}; give a positive number or nothing"
        )
    return value


def bottom_rows(swath_time_s: FloatArray, ping: IntArray, pass_index: int, track: BottomTrack,
                utc: bool, given: bool) -> list[str]:  # fmt: skip
    """Return the file's lines of one pass; `given` says that the track came from such a file."""
    if utc:
        stamp = np.rint(np.asarray(swath_time_s) * 1000).astype(np.int64).astype("datetime64[ms]")
        times = [f"{text}Z" for text in np.datetime_as_string(stamp, unit="ms")]
    else:
        times = [f"{value:.3f}" for value in swath_time_s]
    seen = "given" if given else "seen"
    return [
        f"{time},{pass_index},{number},{first:.3f},{altitude:.3f},{sigma:.3f},"
        f"{seen if valid else 'carried'}"
        for time, number, first, altitude, sigma, valid in zip(
            times,
            ping,
            track.first_return_m,
            track.altitude_m,
            track.sigma_m,
            track.valid,
            strict=True,
        )
    ]


def write_bottom_csv(path: Path, rows: Sequence[str]) -> None:
    """Write the lines of all passes under the header."""
    write_text(path, "\n".join([",".join(_COLUMNS), *rows]) + "\n")
