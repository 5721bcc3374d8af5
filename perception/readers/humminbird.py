"""Humminbird: a DAT file and, beside it, one SON file per channel (IDX files are not needed).

Records are big-endian, each `C0 DE AB 21`, tagged values, `21`, then samples. Positions are a Mercator
projection of the 1924 ellipsoid; heading and speed are in tenths, depth in decimetres. No field
holds the range: the length of a sample follows from the frequency, as PyHum and PINGMapper take it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from perception.readers.raw import RawFile, RawPings, blank_samples, plural
from perception.records import FloatArray, InputError, IntArray, Progress

_MAGIC = b"\xc0\xde\xab\x21"
_END = 0x21
_CHANNELS = {0: "down-looking", 1: "down-looking (second)", 2: "port", 3: "starboard",
             4: "down imaging"}  # fmt: skip
_RECORD, _TIME, _EAST, _NORTH = 0x80, 0x81, 0x82, 0x83
_HEADING, _SPEED, _DEPTH, _FREQUENCY, _COUNT, _CHANNEL = 0x84, 0x85, 0x87, 0x92, 0xA0, 0x50
_TAGS = (_RECORD, _TIME, _EAST, _NORTH, _HEADING, _SPEED, _DEPTH, _FREQUENCY, _COUNT, _CHANNEL)
_MOST_HEAD = 512
_MOST_SAMPLES = 1 << 15
_RADIUS_M = 6378388.0  # semi-major axis of the International 1924 ellipsoid
_FLATTENING = 1 / 297.0
_TRANSDUCER_M = 0.108  # length of the transducer, from which the sample's length is derived
_SOUND_SPEED_M_S = 1500.0


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the path is a SON file, or a DAT file or folder with SON files to it."""
    return head.startswith(_MAGIC) or bool(_channel_files(path))


def _channel_files(path: Path) -> list[Path]:
    if path.is_dir():
        folders = [path]
    elif path.suffix.lower() == ".dat":
        folders = [path.with_suffix(""), path.parent]
    elif path.suffix.lower() in (".son", ".idx"):
        folders = [path.parent]
    else:
        return []
    for folder in folders:
        if folder.is_dir():
            found = [p for p in sorted(folder.iterdir()) if p.suffix.lower() == ".son"]
            if found:
                return found
    return []


@dataclass(frozen=True)
class Channel:
    """The records of one SON file: values (n, tags), and offset (n,) of the samples."""

    path: Path
    values: npt.NDArray[np.int64]
    offset: IntArray
    broken: int

    def column(self, tag: int) -> npt.NDArray[np.int64]:
        values: npt.NDArray[np.int64] = self.values[:, _TAGS.index(tag)]
        return values


@dataclass(frozen=True)
class HumminbirdFile(RawFile):
    """A scanned recording: for each side the file and each ping's record in it, -1 for none."""

    sides: tuple[tuple[Channel | None, IntArray], ...] = ()

    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows`; see `RawFile.samples`."""
        out = blank_samples(len(rows), width)
        for values, (channel, record) in zip(out, self.sides, strict=True):
            if channel is None:
                continue
            counts = channel.column(_COUNT)
            with channel.path.open("rb", buffering=1 << 18) as stream:
                for line, at in enumerate(record[rows]):
                    if at < 0:
                        continue
                    stream.seek(int(channel.offset[at]))
                    levels = np.frombuffer(stream.read(min(int(counts[at]), width)), np.uint8)
                    values[line, : len(levels)] = levels
        return out


def scan(path: Path, progress: Progress) -> HumminbirdFile:
    """Scan a recording's channels.

    Raises
    ------
    InputError
        No record in any SON file, or none of port and starboard.
    """
    files = _channel_files(path) or [path]
    found: dict[int, Channel] = {}
    for number, son in enumerate(files):
        progress("reading headers", number, len(files))
        channel = _read_channel(son)
        if len(channel.values):
            found[int(channel.column(_CHANNEL)[0])] = channel
    progress("reading headers", len(files), len(files))
    held = {_CHANNELS.get(n, f"channel {n}"): len(c.values) for n, c in sorted(found.items())}
    sides = [found.get(2), found.get(3)]
    lead = sides[0] or sides[1]
    if lead is None:
        what = ", ".join(f"{n} {name}" for name, n in held.items()) or "no record"
        raise InputError(
            f"{path}: holds no side-scan ({what}); give a recording with port or starboard"
        )
    records = [_paired(lead, side) for side in sides]
    return _file_of(path, lead, list(zip(sides, records, strict=True)), held)


def _file_of(
    path: Path, lead: Channel, sides: list[tuple[Channel | None, IntArray]], held: dict[str, int]
) -> HumminbirdFile:
    n = len(lead.values)
    columns = RawPings.empty(n)
    start_s = _start_of(path, lead)
    columns["time_s"] = lead.column(_TIME) / 1e3 + (start_s or 0.0)
    x, y = _geographic(lead.column(_EAST), lead.column(_NORTH))
    columns["x"], columns["y"] = x, y
    # The upper half of these words is a flag of the GPS.
    columns["heading_deg"] = (lead.column(_HEADING) & 0xFFFF) / 10.0
    columns["speed_m_s"] = (lead.column(_SPEED) & 0xFFFF) / 10.0
    depth = lead.column(_DEPTH) / 10.0
    columns["altitude_m"] = np.where(depth > 0, depth, np.nan)
    columns["number"] = lead.column(_RECORD)
    for name, (side, record) in zip(("port", "starboard"), sides, strict=True):
        if side is not None:
            counts = side.column(_COUNT)
            columns[f"{name}_samples"] = np.where(record >= 0, counts[record], 0)
    frequency_hz = float(np.median(lead.column(_FREQUENCY)))
    longest = np.maximum(columns["port_samples"], columns["starboard_samples"])
    columns["range_m"] = longest * _sample_m(frequency_hz)
    columns["start_m"][:] = 0.0
    columns["sound_speed_m_s"][:] = _SOUND_SPEED_M_S
    defects = [
        f"no sound speed in the file: {_SOUND_SPEED_M_S:g} m/s assumed",
        "no range in the file: samples are taken for "
        f"{100 * _sample_m(frequency_hz):.2f} cm, from the frequency",
    ]
    broken = sum(side.broken for side, _ in sides if side is not None)
    if broken:
        defects.append(f"{plural(broken, 'corrupt record')}: skipped")
    return HumminbirdFile(
        path=path,
        format="Humminbird",
        sonar="Humminbird",
        pings=RawPings(**columns),
        crs="EPSG:4326",
        utc=start_s is not None,
        frequency_hz=frequency_hz,
        bits="8-bit integer",
        packets=held,
        defects=tuple(defects),
        notes=("the depth field is water depth under the boat: it serves as altitude",),
        sides=tuple(sides),
    )


def _read_channel(path: Path) -> Channel:
    values, offsets, broken = [], [], 0
    size = path.stat().st_size
    with path.open("rb", buffering=1 << 18) as stream:
        at = 0
        while at + len(_MAGIC) < size:
            head = _head_at(stream, at)
            if head is None:
                following = _next_magic(stream, at + 1)
                broken += 1
                if following is None:
                    break
                at = following
                continue
            row, length = head
            count = row[_TAGS.index(_COUNT)]
            if at + length + count > size:
                broken += 1
                break
            values.append(row)
            offsets.append(at + length)
            at += length + count
    table = np.array(values, np.int64).reshape(-1, len(_TAGS))
    return Channel(path, table, np.array(offsets, np.int64), broken)


def _head_at(stream: BinaryIO, at: int) -> tuple[list[int], int] | None:
    """Return the values of `_TAGS` and the head's length; None if no head starts here."""
    stream.seek(at)
    head = stream.read(_MOST_HEAD)
    if not head.startswith(_MAGIC):
        return None
    found = dict.fromkeys(_TAGS, 0)
    inside = len(_MAGIC)
    while inside < len(head) and head[inside] != _END:
        tag = head[inside]
        # Tags from 0x80 on carry four bytes, the others one.
        length = 4 if tag >= 0x80 else 1
        if tag in found:
            found[tag] = int.from_bytes(
                head[inside + 1 : inside + 1 + length], "big", signed=length == 4
            )
        inside += 1 + length
    if inside >= len(head) or not 0 < found[_COUNT] <= _MOST_SAMPLES:
        return None
    return [found[tag] for tag in _TAGS], inside + 1


def _next_magic(stream: BinaryIO, at: int) -> int | None:
    while True:
        stream.seek(at)
        block = stream.read(1 << 16)
        found = block.find(_MAGIC)
        if found >= 0:
            return at + found
        if len(block) < 1 << 16:
            return None
        at += len(block) - len(_MAGIC) + 1


def _paired(lead: Channel, side: Channel | None) -> IntArray:
    """Return for each record of `lead` the one of the other side nearest by record number, or -1.

    All channels share one counter, so the sides of one ping are within a few numbers.
    """
    n = len(lead.values)
    if side is None:
        return np.full(n, -1, np.int64)
    if side is lead:
        return np.arange(n)
    mine, others = lead.column(_RECORD), side.column(_RECORD)
    order = np.argsort(others, kind="stable")
    place = np.clip(np.searchsorted(others[order], mine), 1, max(len(others) - 1, 1))
    before, after = order[place - 1], order[np.minimum(place, len(others) - 1)]
    nearer = np.where(abs(others[before] - mine) <= abs(others[after] - mine), before, after)
    return np.where(abs(others[nearer] - mine) <= 8, nearer, -1)


def _geographic(
    east: npt.NDArray[np.int64], north: npt.NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return longitude and latitude in degrees of the unit's Mercator metres; NaN where both are 0."""
    conformal = 2 * np.arctan(np.exp(north / _RADIUS_M)) - np.pi / 2
    # Conformal to geodetic latitude, by its series to second order in the flattening (0.01 m).
    e2 = _FLATTENING * (2 - _FLATTENING)
    latitude = (
        conformal
        + (e2 / 2 + 5 * e2**2 / 24) * np.sin(2 * conformal)
        + 7 * e2**2 / 48 * np.sin(4 * conformal)
    )
    nowhere = (east == 0) & (north == 0)
    return (
        np.where(nowhere, np.nan, np.degrees(east / _RADIUS_M)),
        np.where(nowhere, np.nan, np.degrees(latitude)),
    )


def _sample_m(frequency_hz: float) -> float:
    """Return the slant range of one sample: 2/pi of the beam's half-power angle over one metre."""
    if not 1e5 < frequency_hz < 2e6:
        frequency_hz = 455e3
    angle = np.arcsin(_SOUND_SPEED_M_S / (_TRANSDUCER_M * frequency_hz))
    return float(2 / np.pi * angle)


def _start_of(path: Path, lead: Channel) -> float | None:
    """Return the recording's start (seconds since 1970) from the DAT file; None if there is none."""
    near = lead.path.parent
    choices = [path] if path.suffix.lower() == ".dat" else []
    choices += [near.with_suffix(".DAT"), *sorted(near.glob("*.[Dd][Aa][Tt]"))]
    for dat in choices:
        if dat.is_file() and dat.stat().st_size >= 64:
            words = struct.unpack(">16i", dat.read_bytes()[:64])
            east, north = lead.column(_EAST)[0], lead.column(_NORTH)[0]
            # The start position proves that the words are where they are believed to be.
            if words[5] > 631152000 and abs(words[6] - east) + abs(words[7] - north) < 1e5:
                return float(words[5])
    return None
