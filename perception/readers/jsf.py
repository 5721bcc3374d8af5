"""EdgeTech JSF, from the published layout (EdgeTech 0004824): message 80, one side of one ping each.

Untested on real data: no JSF file was at hand. Tested on files made to the same layout.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from perception.readers.raw import RawFile, RawPings, blank_samples, floats, plural
from perception.records import FloatArray, InputError, IntArray, Progress

_MARK = b"\x01\x16"
_START = struct.Struct("<HBBHBBBBHI")
_SONAR = 80
_HEADER_BYTES = 240
_MOST_BYTES = 1 << 24
_PORT, _STARBOARD = 0, 1
_SUBSYSTEMS = {
    0: "sub-bottom",
    20: "side-scan low",
    21: "side-scan high",
    22: "side-scan very high",
}
_COMPLEX_FORMATS = (1, 9)  # two shorts a sample: real and imaginary part
# Bits of the validity word.
_POSITION, _HEADING, _ATTITUDE, _ALTITUDE, _DEPTH, _SOUND_SPEED = 0, 3, 5, 6, 9, 14

HEADER = np.dtype(
    {
        "names": [
            "time", "first_sample", "ping", "msb", "validity", "format", "x", "y", "units",
            "samples", "interval_ns", "start_10hz", "end_10hz", "depth_mm", "altitude_mm",
            "sound_speed", "weight", "heading_cdeg", "pitch", "roll", "ms_today",
        ],
        "formats": [
            "<i4", "<u4", "<u4", "<u2", "<u2", "<i2", "<i4", "<i4", "<i2",
            "<u2", "<u4", "<u2", "<u2", "<i4", "<i4",
            "<f4", "<i2", "<u2", "<i2", "<i2", "<u4",
        ],
        "offsets": [
            0, 4, 8, 16, 30, 34, 80, 84, 88, 114, 116, 126, 128, 136, 144, 148, 168, 172, 174, 176,
            200,
        ],
        "itemsize": _HEADER_BYTES,
    }
)  # fmt: skip


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the file starts with a JSF message."""
    if len(head) < _START.size or not head.startswith(_MARK):
        return False
    return path.suffix.lower() == ".jsf" or _START.unpack_from(head)[9] < _MOST_BYTES


@dataclass(frozen=True)
class JsfFile(RawFile):
    """A scanned JSF: per side the offset (n,) of each ping's samples (-1 none) and how to read them."""

    offsets: tuple[IntArray, ...] = ()
    weights: tuple[FloatArray, ...] = ()
    paired: bool = False

    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows`; see `RawFile.samples`."""
        out = blank_samples(len(rows), width)
        counts = (self.pings.port_samples, self.pings.starboard_samples)
        each = 4 if self.paired else 2
        with self.path.open("rb", buffering=1 << 18) as stream:
            for values, offset, weight, count in zip(
                out, self.offsets, self.weights, counts, strict=True
            ):
                for line, row in enumerate(rows):
                    if offset[row] < 0:
                        continue
                    stream.seek(int(offset[row]))
                    data = stream.read(int(min(count[row], width)) * each)
                    level = _amplitudes(data, self.paired) * np.float32(weight[row])
                    values[line, : len(level)] = level
        return out


def _amplitudes(data: bytes, paired: bool) -> FloatArray:
    """Return the envelope: shorts as they are, or the magnitude of complex ones."""
    if not paired:
        return np.frombuffer(data[: len(data) // 2 * 2], "<u2").astype(np.float32)
    parts = np.frombuffer(data[: len(data) // 4 * 4], "<i2").astype(np.float32).reshape(-1, 2)
    return np.hypot(parts[:, 0], parts[:, 1])


def scan(path: Path, progress: Progress) -> JsfFile:
    """Scan a JSF's messages.

    Raises
    ------
    InputError
        No side-scan message in it.
    """
    size = path.stat().st_size
    with path.open("rb", buffering=1 << 18) as stream:
        headers, where, kinds, defects = _walk(stream, size, progress)
    side_scan = (where[:, 1] >= 20) & (where[:, 2] <= 1)
    if not side_scan.any():
        held = ", ".join(f"{n} {name}" for name, n in kinds.items()) or "no whole message"
        raise InputError(
            f"{path}: holds no side-scan ({held}); give a file with side-scan channels"
        )
    subsystem = _finest(headers, where, side_scan)
    mine = side_scan & (where[:, 1] == subsystem)
    return _file_of(path, headers[mine], where[mine], subsystem, kinds, defects)


def _finest(headers: npt.NDArray[Any], where: IntArray, side_scan: npt.NDArray[np.bool_]) -> int:
    """Return the side-scan subsystem to read: the one of the finest samples, the image of most detail."""
    best: tuple[float, int] = (np.inf, -1)
    for subsystem in np.unique(where[side_scan, 1]):
        mine = side_scan & (where[:, 1] == subsystem)
        interval = float(np.median(headers["interval_ns"][mine]))
        # A subsystem with a few stray messages only is no image.
        if mine.sum() >= 0.2 * side_scan.sum() and interval > 0:
            best = min(best, (interval, int(subsystem)))
    return best[1] if best[1] >= 0 else int(where[side_scan, 1][0])


def _file_of(
    path: Path,
    headers: npt.NDArray[Any],
    where: IntArray,
    subsystem: int,
    kinds: dict[str, int],
    defects: list[str],
) -> JsfFile:
    pings, first = np.unique(headers["ping"], return_index=True)
    order = np.argsort(first)
    pings, first = pings[order], first[order]
    row_of = np.full(int(order.max(initial=0)) + 1, 0)
    row_of[order] = np.arange(len(order))
    row = row_of[np.searchsorted(np.sort(pings), headers["ping"])]
    columns = RawPings.empty(len(pings))
    crs = _fill(columns, headers[first], defects)
    paired = bool(np.isin(headers["format"], _COMPLEX_FORMATS).mean() > 0.5)
    offsets, weights = [], []
    for channel, name in ((_PORT, "port"), (_STARBOARD, "starboard")):
        mine = np.flatnonzero(where[:, 2] == channel)
        offset = np.full(len(pings), -1, np.int64)
        offset[row[mine]] = where[mine, 0]
        weight = np.ones(len(pings))
        weight[row[mine]] = np.exp2(-np.clip(floats(headers["weight"][mine]), -31, 31))
        stored = where[mine, 3] // (4 if paired else 2)
        columns[f"{name}_samples"][row[mine]] = np.minimum(_sample_count(headers[mine]), stored)
        offsets.append(offset)
        weights.append(weight)
    longest = np.maximum(columns["port_samples"], columns["starboard_samples"])
    columns["range_m"] = columns["start_m"] + longest * _sample_m(headers[first], columns)
    frequency = (floats(headers["start_10hz"]) + headers["end_10hz"]) / 2 * 10.0
    return JsfFile(
        path=path,
        format="JSF (EdgeTech)",
        sonar="EdgeTech",
        pings=RawPings(**columns),
        crs=crs,
        utc=bool(np.median(headers["time"]) > 0),
        frequency_hz=float(np.median(frequency)) or float("nan"),
        bits="16-bit complex" if paired else "16-bit integer",
        packets=kinds,
        defects=tuple(defects),
        notes=(
            f"read: {_SUBSYSTEMS.get(subsystem, f'subsystem {subsystem}')}",
            "this reader follows the published layout and is untested on real files",
        ),
        offsets=tuple(offsets),
        weights=tuple(weights),
        paired=paired,
    )


def _sample_count(headers: npt.NDArray[Any]) -> IntArray:
    """Return samples per message: sixteen bits and four more in the word of high bits."""
    high = (headers["msb"].astype(np.int64) >> 8) & 0xF
    return np.asarray(headers["samples"].astype(np.int64) + (high << 16))


def _sample_m(headers: npt.NDArray[Any], columns: dict[str, Any]) -> FloatArray:
    return np.asarray(headers["interval_ns"] * 1e-9 * columns["sound_speed_m_s"] / 2)


def _fill(columns: dict[str, Any], headers: npt.NDArray[Any], defects: list[str]) -> str:
    """Fill the columns that do not depend on the side; return the CRS."""
    valid = headers["validity"].astype(np.int64)

    def told(bit: int, values: npt.NDArray[Any]) -> FloatArray:
        """Values where the validity word vouches for them; all of them if it never does."""
        vouched = (valid >> bit) & 1 == 1
        if not vouched.any():
            return np.where(values != 0, values, np.nan)
        return np.where(vouched, values, np.nan)

    columns["time_s"] = headers["time"] + (headers["ms_today"] % 1000) / 1e3
    columns["number"] = headers["ping"].astype(np.int64)
    columns["heading_deg"] = told(_HEADING, headers["heading_cdeg"] / 100.0)
    columns["pitch_deg"] = np.nan_to_num(told(_ATTITUDE, headers["pitch"] * (180.0 / 32768)))
    columns["roll_deg"] = np.nan_to_num(told(_ATTITUDE, headers["roll"] * (180.0 / 32768)))
    columns["depth_m"] = told(_DEPTH, headers["depth_mm"] / 1000.0)
    altitude = told(_ALTITUDE, headers["altitude_mm"] / 1000.0)
    columns["altitude_m"] = np.where(altitude > 0, altitude, np.nan)
    speed = floats(headers["sound_speed"])
    good = (speed > 1300) & (speed < 1700)
    if not good.all():
        defects.append(f"no sound speed in {plural(int((~good).sum()), 'ping')}: 1500 m/s assumed")
    columns["sound_speed_m_s"] = np.where(good, speed, 1500.0)
    interval_s = headers["interval_ns"] * 1e-9
    columns["start_m"] = headers["first_sample"] * interval_s * columns["sound_speed_m_s"] / 2
    x, y = floats(headers["x"]), floats(headers["y"])
    placed = (x != 0) | (y != 0)
    if ((valid >> _POSITION) & 1).any():
        placed &= (valid >> _POSITION) & 1 == 1
    units = int(np.median(headers["units"]))
    # Units 2: minutes of arc by ten thousand; 1, 3, 4: millimetres, decimetres, centimetres.
    scale = {1: 1e-3, 2: 1 / 600000.0, 3: 0.1, 4: 0.01}.get(units, 1 / 600000.0)
    columns["x"], columns["y"] = np.where(placed, (x * scale, y * scale), np.nan)
    return "" if units in (1, 3, 4) else "EPSG:4326"


def _walk(
    stream: BinaryIO, size: int, progress: Progress
) -> tuple[npt.NDArray[Any], IntArray, dict[str, int], list[str]]:
    """Return sonar headers, (offset, subsystem, channel, bytes) of their samples, counts, defects."""
    headers = bytearray()
    where: list[tuple[int, int, int, int]] = []
    kinds: dict[str, int] = {}
    defects: list[str] = []
    at, broken = 0, 0
    while at + _START.size <= size:
        if len(where) % 4096 == 0:
            progress("reading headers", at, size)
        stream.seek(at)
        mark, _, _, kind, _, subsystem, channel, _, _, length = _START.unpack(
            stream.read(_START.size)
        )
        end = at + _START.size + length
        if mark != 0x1601 or length > _MOST_BYTES or end > size:
            following = _next_message(stream, at + 1, size)
            if mark == 0x1601 and following is None and end > size:
                defects.append("the file stops in mid-message: all before is kept")
                break
            broken += 1
            at = size if following is None else following
            continue
        if kind == _SONAR and length >= _HEADER_BYTES:
            headers += stream.read(_HEADER_BYTES)
            data = at + _START.size + _HEADER_BYTES
            where.append((data, subsystem, channel, length - _HEADER_BYTES))
        name = _SUBSYSTEMS.get(subsystem, "other sonar") if kind == _SONAR else f"message {kind}"
        kinds[name] = kinds.get(name, 0) + 1
        at = end
    progress("reading headers", size, size)
    if broken:
        defects.append(
            f"{plural(broken, 'corrupt place')} in the file: skipped to the next message"
        )
    table = np.frombuffer(bytes(headers), HEADER)
    return table, np.array(where, np.int64).reshape(-1, 4), kinds, defects


def _next_message(stream: BinaryIO, at: int, size: int) -> int | None:
    """Return the next place where a message starts that ends at another or at the file's end."""
    while at < size:
        stream.seek(at)
        block = stream.read(1 << 18)
        found = block.find(_MARK)
        while found >= 0:
            stream.seek(at + found)
            start = stream.read(_START.size)
            if len(start) == _START.size:
                end = at + found + _START.size + _START.unpack(start)[9]
                stream.seek(min(end, size))
                if end == size or (end < size and stream.read(2) == _MARK):
                    return at + found
            found = block.find(_MARK, found + 1)
        if len(block) < 1 << 18:
            return None
        at += len(block) - 1
    return None
