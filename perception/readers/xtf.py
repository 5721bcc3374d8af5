"""XTF (Triton): headers and packet layouts by pyxtf, walked and indexed by `xtf_packets`.

pyxtf's own `xtf_read` stops at the first corrupt byte, refuses a file cut in mid-packet and loads all
samples; its structures are right, and they are what is used here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from perception.readers.orientation import JUDGED_TOGETHER, near_end_evidence
from perception.readers.raw import (
    RawFile,
    RawPings,
    blank_samples,
    floats,
    plural,
    spread_rows,
    valid_degrees,
)
from perception.readers.xtf_attitude import attitude_at, positions_at
from perception.readers.xtf_channels import (
    channel_frequency_hz,
    chosen_channels,
    keep_channels,
    merge_split_pings,
    text_of,
)
from perception.readers.xtf_packets import (
    ATTITUDE,
    NAVIGATION,
    RAW_NAVIGATION,
    Walker,
    XtfIndex,
)
from perception.readers.xtf_samples import SampleKind, decode, sample_kind
from perception.readers.xtf_time import ping_times
from perception.records import FloatArray, InputError, IntArray, Progress

_FILE_FORMAT = 0x7B
_JUDGED = 200  # pings by which orientation and sample kind are decided


def recognises(path: Path, head: bytes) -> bool:
    """Return whether the file starts as XTF; a file of that name is tried whatever it starts with."""
    return head[:1] == bytes([_FILE_FORMAT]) and (
        path.suffix.lower() == ".xtf" or head[1024:1026] == b"\xce\xfa"
    )


@dataclass(frozen=True)
class Side:
    """One side's records: for each ping the samples' offset and count, and how to read them."""

    channel: int
    offset: IntArray  # (n,) byte offset; -1 no record
    count: IntArray  # (n,)
    weight: FloatArray  # (n,) factor that undoes the recorder's block scaling
    kind: SampleKind
    far_first: bool


@dataclass(frozen=True)
class XtfFile(RawFile):
    """A scanned XTF file."""

    port: Side | None = None
    starboard: Side | None = None

    def samples(self, rows: IntArray, width: int) -> tuple[FloatArray, FloatArray]:
        """Read echo amplitudes of the pings `rows`; see `RawFile.samples`."""
        out = blank_samples(len(rows), width)
        with self.path.open("rb", buffering=1 << 18) as stream:
            for values, side in zip(out, (self.port, self.starboard), strict=True):
                if side is None:
                    continue
                for line, row in enumerate(rows):
                    count = int(side.count[row])
                    if side.offset[row] < 0 or count == 0:
                        continue
                    stream.seek(int(side.offset[row]))
                    data = stream.read(count * side.kind.size)
                    level = decode(data, side.kind)
                    if side.far_first:
                        level = level[::-1]
                    if side.weight[row] != 1.0:
                        level = level * np.float32(side.weight[row])
                    n = min(len(level), width)
                    values[line, :n] = level[:n]
        return out


def scan(path: Path, progress: Progress) -> XtfFile:
    """Scan an XTF file's packet headers.

    Raises
    ------
    InputError
        No packet at all, or no side-scan in it.
    """
    size = path.stat().st_size
    with path.open("rb", buffering=1 << 18) as stream:
        index = Walker(stream, size, progress).walk()
    if len(index.pings) == 0:
        held = ", ".join(f"{n} {kind}" for kind, n in index.packets.items()) or "no whole packet"
        raise InputError(
            f"{path}: holds no side-scan ping ({held}); give a file with side-scan channels"
        )
    return _file_of(path, index)


def _file_of(path: Path, index: XtfIndex) -> XtfFile:
    defects = list(index.defects)
    port_number, starboard_number = chosen_channels(path, index, defects)
    index = keep_channels(index, (port_number, starboard_number))
    index = merge_split_pings(index, defects)
    columns = RawPings.empty(len(index.pings))
    records = {}
    for name, number in (("port", port_number), ("starboard", starboard_number)):
        records[name] = None if number is None else _rows_of(index, number)
    utc = _fill_headers(columns, index, defects)
    crs = _fill_positions(columns, index, utc, defects)
    _fill_ranges(columns, index, records)
    sides = {
        name: None if rows is None else _side(path, index, columns, name, rows, defects)
        for name, rows in records.items()
    }
    chosen = [s for s in sides.values() if s is not None]
    header = index.header
    return XtfFile(
        path=path,
        format="XTF",
        sonar=text_of(header.SonarName) or text_of(header.RecordingProgramName),
        pings=RawPings(**columns),
        crs=crs,
        utc=utc,
        frequency_hz=channel_frequency_hz(index, chosen[0].channel) if chosen else float("nan"),
        bits=", ".join(sorted({s.kind.label for s in chosen})),
        packets=index.packets,
        defects=tuple(defects),
        notes=_notes(index, sides),
        port=sides["port"],
        starboard=sides["starboard"],
    )


def _rows_of(index: XtfIndex, number: int) -> IntArray:
    """Return for each ping the row of its record of channel `number`, -1 for none."""
    rows = np.full(len(index.pings), -1, np.int64)
    mine = np.flatnonzero(index.channel_records["ChannelNumber"] == number)
    rows[index.channel_ping[mine]] = mine
    return rows


def _fill_headers(columns: dict[str, Any], index: XtfIndex, defects: list[str]) -> bool:
    """Fill time, attitude, depth, altitude, speed; return whether the clock is UTC."""
    pings = index.pings
    columns["time_s"], utc = ping_times(pings, defects)
    columns["number"] = pings["PingNumber"].astype(np.int64)
    heading = _first_filled(pings, ("SensorHeading", "ShipGyro"))
    columns["heading_deg"] = np.where(abs(heading) <= 720, heading, np.nan)
    for name, source in (("pitch_deg", "SensorPitch"), ("roll_deg", "SensorRoll")):
        angle = floats(pings[source])
        columns[name] = np.where(abs(angle) <= 90, angle, np.nan)
    attitude = index.kept.get(ATTITUDE)
    if attitude is not None and len(attitude):
        attitude_at(columns, pings, attitude, utc, defects)
    depth = _first_filled(pings, ("SensorDepth", "ShipDepth"), decimetres=("ShipDepth",))
    columns["depth_m"] = np.where((depth > -100) & (depth < 12000), depth, np.nan)
    if not np.any(depth[np.isfinite(depth)]):
        columns["depth_m"][:] = np.nan
    altitude = _first_filled(
        pings,
        ("SensorPrimaryAltitude", "SensorAuxAltitude", "ShipAltitude"),
        decimetres=("ShipAltitude",),
    )
    columns["altitude_m"] = np.where((altitude > 0) & (altitude < 12000), altitude, np.nan)
    columns["speed_m_s"] = _first_filled(pings, ("SensorSpeed", "ShipSpeed")) * 0.5144444
    columns["sound_speed_m_s"] = _sound_speed(pings, defects)
    return utc


def _first_filled(
    pings: npt.NDArray[Any], names: tuple[str, ...], decimetres: tuple[str, ...] = ()
) -> FloatArray:
    """Return the first of several fields that is not zero throughout; the first if all are."""
    for name in names:
        values = floats(pings[name]) * (0.1 if name in decimetres else 1.0)
        if np.any(values[np.isfinite(values)] != 0):
            return values
    return floats(pings[names[0]])


def _sound_speed(pings: npt.NDArray[Any], defects: list[str]) -> FloatArray:
    """Return the speed that the ranges were made with: some recorders store half of it."""
    speed = floats(pings["SoundVelocity"])
    if not np.any((speed > 600) & (speed < 1700)):
        speed = floats(pings["ComputedSoundVelocity"])
    half = (speed > 600) & (speed < 850)
    if half.any():
        defects.append(
            f"sound speed is stored halved ({np.median(speed[half]):g} m/s) "
            f"in {plural(int(half.sum()), 'ping')}: doubled"
        )
    speed = np.where(half, 2 * speed, speed)
    good = (speed > 1300) & (speed < 1700)
    if not good.all():
        stated = 1500.0 if not good.any() else float(np.median(speed[good]))
        defects.append(
            f"no sound speed in {plural(int((~good).sum()), 'ping')}: {stated:g} m/s assumed"
        )
        speed = np.where(good, speed, stated)
    return speed


def _fill_positions(columns: dict[str, Any], index: XtfIndex, utc: bool, defects: list[str]) -> str:
    """Fill x and y; return the CRS, empty for metres of an unknown grid."""
    pings = index.pings
    x = floats(pings["SensorXcoordinate"])
    y = floats(pings["SensorYcoordinate"])
    if not np.any(_placed(x, y)):
        x, y = floats(pings["ShipXcoordinate"]), floats(pings["ShipYcoordinate"])
        if np.any(_placed(x, y)):
            defects.append("no sensor position: the ship's is taken")
    if not np.any(_placed(x, y)):
        for kind in (NAVIGATION, RAW_NAVIGATION):
            packets = index.kept.get(kind)
            if packets is not None and len(packets) > 1:
                x, y = positions_at(columns["time_s"], packets, utc)
                defects.append("no position in the pings: taken from the navigation packets")
                break
    degrees = _in_degrees(x, y, columns["time_s"], int(index.header.NavUnits), defects)
    good = valid_degrees(x, y) if degrees else _placed(x, y)
    columns["x"] = np.where(good, x, np.nan)
    columns["y"] = np.where(good, y, np.nan)
    return "EPSG:4326" if degrees else ""


def _placed(x: FloatArray, y: FloatArray) -> npt.NDArray[np.bool_]:
    """Return where a position is there at all: finite, of this planet's size, not (0, 0)."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(x + y) & ~((x == 0) & (y == 0)) & (abs(x) < 1e8) & (abs(y) < 1e8)


def _in_degrees(
    x: FloatArray, y: FloatArray, time_s: FloatArray, units: int, defects: list[str]
) -> bool:
    """Decide whether positions are degrees: by the header, unless the numbers contradict it."""
    placed = _placed(x, y)
    if not placed.any():
        return units != 0
    fit = float(np.mean(valid_degrees(x[placed], y[placed])))
    if units == 3 and fit < 0.5:
        defects.append("positions are declared degrees but are no degrees: taken for metres")
        return False
    if units == 0:
        # A vehicle that moves less than 5 cm in over 5 s of "metres" is one that moves in degrees.
        extent = max(np.ptp(x[placed]), np.ptp(y[placed]))
        lasting = np.ptp(time_s[np.isfinite(time_s)]) if np.isfinite(time_s).any() else 0.0
        if fit > 0.95 and 0 < extent < 0.05 and lasting > 5.0 and placed.sum() >= 10:
            defects.append("positions are declared metres but move as degrees: taken for degrees")
            return True
        return False
    if units != 3:
        defects.append(
            f"unknown navigation units ({units}): taken for {'degrees' if fit > 0.95 else 'metres'}"
        )
    return fit > 0.95


def _fill_ranges(
    columns: dict[str, Any], index: XtfIndex, records: dict[str, IntArray | None]
) -> None:
    """Fill samples per side and the slant range that they span."""
    range_m, start_m = columns["range_m"], columns["start_m"]
    for name, rows in records.items():
        if rows is None:
            continue
        there = rows >= 0
        record = index.channel_records[rows[there]]
        columns[f"{name}_samples"][there] = record["NumSamples"].astype(np.int64)
        half_speed = columns["sound_speed_m_s"][there] / 2
        end, start = _spanned(record, half_speed)
        unset = ~np.isfinite(range_m[there])
        range_m[there] = np.where(unset, end, range_m[there])
        start_m[there] = np.where(unset, start, start_m[there])


def _spanned(record: npt.NDArray[Any], half_speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return slant range at the end of the last and the start of the first sample.

    The range field is the recording's length by custom, so with a delay before it the end lies
    further out; where range and duration show that it counts from the transmit, it is taken so.
    """
    stated = floats(record["SlantRange"])
    duration = floats(record["TimeDuration"])
    delay = np.nan_to_num(floats(record["TimeDelay"]), posinf=0, neginf=0)
    delay = np.where((delay > 0) & (delay < 1.0), delay, 0.0)
    with np.errstate(invalid="ignore"):
        by_time = np.where((duration > 0) & (duration < 20.0), duration * half_speed, np.nan)
        stated = np.where((stated > 0) & (stated < 20000.0), stated, np.nan)
        from_transmit = abs(by_time + delay * half_speed - stated) < abs(by_time - stated)
    start = delay * half_speed
    length = np.where(np.isfinite(stated), np.where(from_transmit, stated - start, stated), by_time)
    return start + length, start


def _side(
    path: Path,
    index: XtfIndex,
    columns: dict[str, Any],
    name: str,
    rows: IntArray,
    defects: list[str],
) -> Side:
    """Settle how one side's samples are coded and which way they run."""
    there = rows >= 0
    record = index.channel_records[np.where(there, rows, 0)]
    number = int(record["ChannelNumber"][there][0])
    count = np.where(there, record["NumSamples"], 0).astype(np.int64)
    offset = np.where(there, index.channel_data[np.where(there, rows, 0)], -1)
    size = index.sample_bytes.get(number, 2)
    judged = np.flatnonzero(there)[spread_rows(int(there.sum()), _JUDGED, JUDGED_TOGETHER)]
    raw = []
    with path.open("rb") as stream:
        for row in judged:
            stream.seek(int(offset[row]))
            raw.append(stream.read(int(min(count[row], 1 << 16)) * size))
    info = index.channels[number] if number < len(index.channels) else None
    kind = sample_kind(raw, size, int(info.SampleFormat) if info is not None else 0)
    fraction = columns["altitude_m"][judged] / columns["range_m"][judged]
    evidence = near_end_evidence([decode(data, kind) for data in raw], fraction)
    # Undecided echoes fall back on the format's custom: port runs far to near.
    far_first = evidence < 0 or (evidence == 0 and name == "port")
    if evidence == 0:
        defects.append(
            f"{name}: the echoes do not show which end is near; "
            f"{'far to near' if far_first else 'near to far'} assumed"
        )
    weight = np.where(there, record["Weight"], 0).astype(float)
    weight = np.exp2(-np.where(abs(weight) <= 31, weight, 0.0))
    return Side(number, offset, count, weight, kind, bool(far_first))


def _notes(index: XtfIndex, sides: dict[str, Side | None]) -> tuple[str, ...]:
    order = [
        f"{name} is stored {'far to near' if side.far_first else 'near to far'}"
        for name, side in sides.items()
        if side is not None
    ]
    return (", ".join(order),)
