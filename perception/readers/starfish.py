"""StarFish scanline logs (.logdoc): little-endian records of one byte 0x01 and an opcode each.

No layout is published; this one was worked out from one file of a StarFish 453 (data sheet of the
development set), so other models may differ. The sonar record's fourth number is taken for the slant
range in metres: unverified.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from perception.readers.raw import RawFile, RawPings, blank_samples, plural
from perception.records import FloatArray, InputError, IntArray, Progress

_MARK = b"StarfishScanlineLog"
_HEAD = struct.Struct("<BBHBBBBHIH")
_POSITION, _HEADING, _DEPTH, _SPEED, _OTHER, _SONAR = 0x21, 0x20, 0x24, 0x22, 0x29, 0x26
_NAMES = {
    _POSITION: "position", _HEADING: "heading", _DEPTH: "depth", _SPEED: "speed",
    _OTHER: "unknown 0x29", _SONAR: "sonar",
}  # fmt: skip
_SIZES = {_POSITION: 43, _HEADING: 25, _DEPTH: 25, _SPEED: 25, _OTHER: 25}
_SIDE = struct.Struct("<4fI")
_MOST_SAMPLES = 1 << 15
# The file names no sound speed; the range setting is taken for metres at this one.
_SOUND_SPEED_M_S = 1500.0


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the file starts as a StarFish scanline log."""
    return head.startswith(_MARK)


@dataclass(frozen=True)
class StarfishFile(RawFile):
    """A scanned scanline log: `offset` (n,) of each ping's port samples."""

    offset: IntArray | None = None

    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows`; see `RawFile.samples`."""
        port, starboard = blank_samples(len(rows), width)
        assert self.offset is not None
        with self.path.open("rb", buffering=1 << 18) as stream:
            for line, row in enumerate(rows):
                count = int(self.pings.port_samples[row])
                other = int(self.pings.starboard_samples[row])
                stream.seek(int(self.offset[row]))
                data = stream.read(count + _SIDE.size + other)
                levels = np.frombuffer(data, np.uint8)
                n, m = min(count, width), min(other, width)
                port[line, :n] = levels[:n]
                starboard[line, :m] = levels[count + _SIDE.size :][:m]
        return port, starboard


def scan(path: Path, progress: Progress) -> StarfishFile:
    """Scan a log's records.

    Raises
    ------
    InputError
        No sonar record in it.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        rows, counts, foreign = _walk(data, progress)
    if not rows:
        raise InputError(f"{path}: holds no sonar record; give a StarFish log with echoes")
    table = np.array(rows, float)
    columns = RawPings.empty(len(table))
    zone = int(table[:, 2][np.isfinite(table[:, 2])][0]) if np.isfinite(table[:, 2]).any() else 0
    in_zone = table[:, 2] == zone
    columns["time_s"] = table[:, 0]
    columns["x"] = np.where(in_zone & (table[:, 3] != 0), table[:, 3], np.nan)
    columns["y"] = np.where(in_zone & (table[:, 4] != 0), table[:, 4], np.nan)
    columns["heading_deg"], columns["depth_m"] = table[:, 5], table[:, 6]
    columns["range_m"] = np.where(table[:, 8] > 0, table[:, 8], np.nan)
    columns["start_m"][:] = 0.0
    columns["sound_speed_m_s"][:] = _SOUND_SPEED_M_S
    columns["port_samples"] = table[:, 9].astype(np.int64)
    columns["starboard_samples"] = table[:, 10].astype(np.int64)
    defects = [f"no sound speed in the file: {_SOUND_SPEED_M_S:g} m/s assumed"]
    lost = int((np.isfinite(table[:, 2]) & ~in_zone).sum())
    if lost:
        defects.append(f"another UTM zone in {plural(lost, 'ping')}: no position there")
    south = zone < 0
    return StarfishFile(
        path=path,
        format="StarFish scanline log",
        sonar="StarFish",
        pings=RawPings(**columns),
        crs=f"EPSG:{(32700 if south else 32600) + abs(zone)}" if 1 <= abs(zone) <= 60 else "",
        utc=True,
        bits="8-bit integer",
        packets={_NAMES[k]: n for k, n in counts.items() if n},
        defects=tuple(defects),
        notes=(
            "the slant range is taken from a field of unverified meaning",
            f"{foreign:,} bytes are settings and other records",
        ),
        offset=table[:, 1].astype(np.int64),
    )


def _walk(
    data: mmap.mmap, progress: Progress
) -> tuple[list[tuple[float, ...]], dict[int, int], int]:
    """Return one row per ping, the count of each record, and the bytes that are none.

    A row is time, offset, UTM zone (negative south), easting, northing, heading, depth, speed,
    range, port and starboard samples; each ping takes the latest records before it.
    """
    rows: list[tuple[float, ...]] = []
    counts = dict.fromkeys(_NAMES, 0)
    last = {"zone": np.nan, "east": np.nan, "north": np.nan}
    value = {_HEADING: np.nan, _DEPTH: np.nan, _SPEED: np.nan, _OTHER: np.nan}
    at, foreign, size = 0, 0, len(data)
    while at + _HEAD.size < size:
        if len(rows) % 4096 == 0:
            progress("reading headers", at, size)
        time_s, opcode, length = _record(data, at, size)
        if length == 0:
            following = data.find(b"\x01", at + 1)
            following = size if following < 0 else following
            foreign += following - at
            at = following
            continue
        counts[opcode] += 1
        body = at + _HEAD.size
        if opcode == _POSITION:
            letter, number, north, east, _ = struct.unpack_from("<BBddd", data, body)
            last = {
                "zone": number * (1 if letter >= ord("N") else -1),
                "east": east,
                "north": north,
            }
        elif opcode == _SONAR:
            *_, range_m, count = _SIDE.unpack_from(data, body)
            *_, other = _SIDE.unpack_from(data, body + _SIDE.size + count)
            rows.append((
                time_s, body + _SIDE.size, last["zone"], last["east"], last["north"],
                value[_HEADING], value[_DEPTH], value[_SPEED], range_m, count, other,
            ))  # fmt: skip
        else:
            value[opcode] = struct.unpack_from("<d", data, body)[0]
        at += length
    progress("reading headers", size, size)
    return rows, counts, foreign


def _record(data: mmap.mmap, at: int, size: int) -> tuple[float, int, int]:
    """Return time, opcode and length of the record at `at`; length 0 if there is none."""
    mark, opcode, year, month, day, hour, minute, ms, _, zero = _HEAD.unpack_from(data, at)
    if mark != 1 or opcode not in _NAMES or zero != 0 or not 1990 <= year <= 2100 or ms >= 60000:
        return np.nan, 0, 0
    try:
        time_s = datetime(year, month, day, hour, minute, tzinfo=UTC).timestamp() + ms / 1e3
    except ValueError:
        return np.nan, 0, 0
    length = _SIZES.get(opcode, 0)
    if opcode == _SONAR:
        length = _sonar_length(data, at + _HEAD.size, size)
    return time_s, opcode, length if at + length <= size else 0


def _sonar_length(data: mmap.mmap, body: int, size: int) -> int:
    """Return the length of a sonar record: two sides, each four numbers, a count and samples."""
    inside = body
    for _ in range(2):
        if inside + _SIDE.size > size:
            return 0
        count = _SIDE.unpack_from(data, inside)[4]
        if count > _MOST_SAMPLES:
            return 0
        inside += _SIDE.size + count
    return inside + 1 - (body - _HEAD.size)
