"""Lowrance SL2 and SL3: little-endian frames of one channel each, as the open notes on them say.

Side-scan comes as two channels (left and right) or as one composite row, left far to near and then right
near to far. Many logs hold echo sounder and down imaging only: those are told, not mapped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from perception.readers.raw import RawFile, RawPings, blank_samples, floats, plural
from perception.records import FloatArray, InputError, IntArray, Progress

_CHANNELS = {0: "primary", 1: "secondary", 2: "downscan", 3: "left side-scan", 4: "right side-scan",
             5: "composite side-scan"}  # fmt: skip
_LEFT, _RIGHT, _COMPOSITE = 3, 4, 5
_FOOT_M = 0.3048
# The unit's Mercator is a sphere of the polar radius.
_RADIUS_M = 6356752.3142
_SOUND_SPEED_M_S = 1500.0
_FILE_BYTES = 8
_NAMES = (
    "offset", "frame_bytes", "channel", "packet_bytes", "number", "upper_ft", "lower_ft",
    "unix_s", "depth_ft", "speed_kn", "east", "north", "heading", "ms",
)  # fmt: skip
_FORMATS = ("<u4", "<u2", "<u2", "<u2", "<u4", "<f4", "<f4", "<u4", "<f4", "<f4", "<i4", "<i4",
            "<f4", "<u4")  # fmt: skip
_FRAMES = {
    2: np.dtype(
        {
            "names": _NAMES,
            "formats": _FORMATS,
            "offsets": (0, 28, 32, 34, 36, 40, 44, 60, 64, 100, 108, 112, 128, 140),
            "itemsize": 144,
        }
    ),
    3: np.dtype(
        {
            "names": _NAMES,
            "formats": _FORMATS,
            "offsets": (0, 8, 12, 44, 16, 20, 24, 40, 48, 84, 92, 96, 112, 124),
            "itemsize": 168,
        }
    ),
}


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the file is an SL2 or SL3 log: its number, and a first frame that fits."""
    if len(head) < _FILE_BYTES + 16 or path.suffix.lower() not in (".sl2", ".sl3"):
        return False
    return int.from_bytes(head[:2], "little") in _FRAMES


@dataclass(frozen=True)
class LowranceFile(RawFile):
    """A scanned log: per side the offset (n,) of each ping's samples, -1 for none."""

    offsets: tuple[IntArray, ...] = ()
    port_far_first: bool = False

    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows`; see `RawFile.samples`."""
        out = blank_samples(len(rows), width)
        counts = (self.pings.port_samples, self.pings.starboard_samples)
        with self.path.open("rb", buffering=1 << 18) as stream:
            for side, (values, offset, count) in enumerate(
                zip(out, self.offsets, counts, strict=True)
            ):
                for line, row in enumerate(rows):
                    if offset[row] < 0:
                        continue
                    stream.seek(int(offset[row]))
                    level = np.frombuffer(stream.read(int(count[row])), np.uint8)
                    if side == 0 and self.port_far_first:
                        level = level[::-1]
                    n = min(len(level), width)
                    values[line, :n] = level[:n]
        return out


def scan(path: Path, progress: Progress) -> LowranceFile:
    """Scan a log's frames; one without side-scan comes back without pings, to be told by `info`.

    Raises
    ------
    InputError
        No whole frame in it.
    """
    size = path.stat().st_size
    with path.open("rb", buffering=1 << 18) as stream:
        kind = int.from_bytes(stream.read(2), "little")
        frames, where, defects = _walk(stream, size, _FRAMES[kind], progress)
    if len(frames) == 0:
        raise InputError(f"{path}: holds no whole frame; was it copied whole?")
    numbers, counts = np.unique(frames["channel"], return_counts=True)
    held = {
        _CHANNELS.get(int(n), f"channel {n}"): int(c) for n, c in zip(numbers, counts, strict=True)
    }
    return _file_of(path, frames, where, held, defects)


def _file_of(
    path: Path,
    frames: npt.NDArray[Any],
    where: IntArray,
    held: dict[str, int],
    defects: list[str],
) -> LowranceFile:
    composite = bool((frames["channel"] == _COMPOSITE).any())
    lead = frames["channel"] == (_COMPOSITE if composite else _LEFT)
    if not composite and not lead.any():
        lead = frames["channel"] == _RIGHT
    mine = frames[lead]
    columns = RawPings.empty(len(mine))
    _fill(columns, mine)
    port = np.full(len(mine), -1, np.int64)
    starboard = port.copy()
    if composite:
        half = mine["packet_bytes"].astype(np.int64) // 2
        columns["port_samples"], columns["starboard_samples"] = half, half.copy()
        port, starboard = where[lead], where[lead] + half
    else:
        for channel, name, offset in ((_LEFT, "port", port), (_RIGHT, "starboard", starboard)):
            side = frames["channel"] == channel
            at = _same_number(mine["number"], frames["number"][side])
            offset[at >= 0] = where[side][at[at >= 0]]
            sizes = frames["packet_bytes"][side].astype(np.int64)
            columns[f"{name}_samples"][at >= 0] = sizes[at[at >= 0]]
    if len(mine):
        defects.append(f"no sound speed in the file: {_SOUND_SPEED_M_S:g} m/s assumed")
    seconds = frames["unix_s"][frames["unix_s"] > 0]
    return LowranceFile(
        path=path,
        format="Lowrance SL2/SL3",
        sonar="Lowrance",
        pings=RawPings(**columns),
        crs="EPSG:4326",
        utc=len(seconds) > 0,
        bits="8-bit integer",
        packets=held,
        defects=tuple(defects),
        notes=_notes(frames),
        offsets=(port, starboard),
        port_far_first=composite,
    )


def _same_number(wanted: npt.NDArray[Any], numbers: npt.NDArray[Any]) -> IntArray:
    """Return for each wanted frame number the index of the nearest in `numbers` within 3, or -1."""
    if len(numbers) == 0:
        return np.full(len(wanted), -1, np.int64)
    wanted, numbers = wanted.astype(np.int64), numbers.astype(np.int64)
    order = np.argsort(numbers, kind="stable")
    place = np.searchsorted(numbers[order], wanted)
    choices = np.stack([order[np.clip(place + k, 0, len(order) - 1)] for k in (-1, 0)])
    best = abs(numbers[choices] - wanted).argmin(axis=0)
    nearest = choices[best, np.arange(len(wanted))]
    return np.where(abs(numbers[nearest] - wanted) <= 3, nearest, -1)


def _fill(columns: dict[str, Any], frames: npt.NDArray[Any]) -> None:
    start_s = float(frames["unix_s"][0]) if len(frames) else 0.0
    columns["time_s"] = start_s + frames["ms"] / 1e3
    columns["number"] = frames["number"].astype(np.int64)
    columns["x"], columns["y"] = _geographic(frames)
    # Headings in radians; without a compass the field is zero throughout, which is mended later.
    columns["heading_deg"] = np.degrees(floats(frames["heading"])) % 360.0
    depth_m = frames["depth_ft"] * _FOOT_M
    columns["altitude_m"] = np.where((depth_m > 0) & (depth_m < 12000), depth_m, np.nan)
    lower_m = floats(frames["lower_ft"]) * _FOOT_M
    columns["range_m"] = np.where((lower_m > 0) & (lower_m < 3000), lower_m, np.nan)
    columns["start_m"][:] = 0.0
    columns["sound_speed_m_s"][:] = _SOUND_SPEED_M_S


def _geographic(frames: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    east, north = floats(frames["east"]), floats(frames["north"])
    nowhere = (east == 0) & (north == 0)
    latitude = np.degrees(2 * np.arctan(np.exp(np.clip(north / _RADIUS_M, -9, 9))) - np.pi / 2)
    return (
        np.where(nowhere, np.nan, np.degrees(east / _RADIUS_M)),
        np.where(nowhere, np.nan, latitude),
    )


def _notes(frames: npt.NDArray[Any]) -> tuple[str, ...]:
    """Tell of the whole log what an echo sounder gives: time, depth, place."""
    depth_m = floats(frames["depth_ft"]) * _FOOT_M
    depth_m = depth_m[np.isfinite(depth_m) & (depth_m > 0) & (depth_m < 12000)]
    lon, lat = _geographic(frames)
    notes = [f"{plural(len(frames), 'frame')} over {np.ptp(frames['ms']) / 1e3:.1f} s"]
    if len(depth_m):
        notes.append(f"water depth {depth_m.min():.2f} to {depth_m.max():.2f} m")
    if np.isfinite(lon).any():
        notes.append(
            f"near latitude {np.nanmedian(lat):.5f}, longitude {np.nanmedian(lon):.5f} deg"
        )
    return tuple(notes)


def _walk(
    stream: BinaryIO, size: int, frame: np.dtype[Any], progress: Progress
) -> tuple[npt.NDArray[Any], IntArray, list[str]]:
    """Return the frames' headers and the offsets of their samples; each frame names its own offset."""
    heads = bytearray()
    where: list[int] = []
    defects: list[str] = []
    at, broken = _FILE_BYTES, 0
    while at + frame.itemsize <= size:
        if len(where) % 4096 == 0:
            progress("reading headers", at, size)
        stream.seek(at)
        head = stream.read(frame.itemsize)
        fields = np.frombuffer(head, frame)[0]
        length, packet = int(fields["frame_bytes"]), int(fields["packet_bytes"])
        # SL3 aligns frames and may leave the packet's size 0: the rest of the frame then.
        packet = packet or max(length - frame.itemsize, 0)
        sound = int(fields["offset"]) == at and frame.itemsize <= length and packet <= length
        if not sound:
            broken += 1
            following = _next_frame(stream, at + 1, size)
            if following is None:
                break
            at = following
            continue
        if at + frame.itemsize + packet > size:
            defects.append("the file stops in mid-frame: all before is kept")
            break
        heads += head
        where.append(at + frame.itemsize)
        at += length
    progress("reading headers", size, size)
    if broken:
        defects.append(f"{plural(broken, 'corrupt place')} in the file: skipped to the next frame")
    return np.frombuffer(bytes(heads), frame), np.array(where, np.int64), defects


def _next_frame(stream: BinaryIO, at: int, size: int) -> int | None:
    """Return the next place that holds its own offset, as every frame starts with it."""
    while at + 4 <= size:
        stream.seek(at)
        block = stream.read(1 << 18)
        count = len(block) - 3
        data = np.frombuffer(block, np.uint8).astype(np.uint32)
        words = (
            data[:count]
            | data[1 : count + 1] << 8
            | data[2 : count + 2] << 16
            | data[3 : count + 3] << 24
        )
        found = np.flatnonzero(words == np.arange(at, at + count, dtype=np.uint32))
        if len(found):
            return at + int(found[0])
        if len(block) < 1 << 18:
            return None
        at += count
    return None
