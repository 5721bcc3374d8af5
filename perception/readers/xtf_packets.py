"""Walking an XTF file from packet to packet, around what is broken, keeping headers only."""

from __future__ import annotations

import ctypes
import struct
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from numpy.lib.recfunctions import repack_fields
from pyxtf import XTFAttitudeData, XTFFileHeader, XTFHeaderNavigation, XTFPingHeader
from pyxtf.enumerations import XTFHeaderType
from pyxtf.xtf_ctypes import XTFChanInfo, XTFPingChanHeader, XTFPosRawNavigation

from perception.records import Progress

MAGIC = b"\xce\xfa"
_START = struct.Struct("<HBBHHHI")
_PING_BYTES = ctypes.sizeof(XTFPingHeader)
_CHANNEL_BYTES = ctypes.sizeof(XTFPingChanHeader)
_CHANNEL_COUNT_AT = XTFPingChanHeader.NumSamples.offset
# A ping of 4 channels of 65,536 samples of 4 bytes is 1 MB; multibeam records reach a few. A longer
# record is a corrupt length, and following it would skip good packets.
_MOST_BYTES = 1 << 26
_BUFFER = 1 << 18
_CHUNK = 4096

SONAR = int(XTFHeaderType.sonar)
ATTITUDE = int(XTFHeaderType.attitude)
NAVIGATION = int(XTFHeaderType.navigation)
RAW_NAVIGATION = int(XTFHeaderType.pos_raw_navigation)
_KEPT = {
    ATTITUDE: XTFAttitudeData,
    NAVIGATION: XTFHeaderNavigation,
    RAW_NAVIGATION: XTFPosRawNavigation,
}

PING_FIELDS = (
    "Year", "Month", "Day", "Hour", "Minute", "Second", "HSeconds", "PingNumber", "SoundVelocity",
    "ComputedSoundVelocity", "ShipGyro", "ShipSpeed", "ShipXcoordinate", "ShipYcoordinate",
    "ShipAltitude", "ShipDepth", "SensorSpeed", "SensorXcoordinate", "SensorYcoordinate",
    "SensorDepth", "SensorPrimaryAltitude", "SensorAuxAltitude", "SensorPitch", "SensorRoll",
    "SensorHeading", "AttitudeTimeTag", "Layback",
)  # fmt: skip
CHANNEL_FIELDS = (
    "ChannelNumber", "SlantRange", "TimeDelay", "TimeDuration", "SecondsPerPing", "Frequency",
    "NumSamples", "Weight",
)  # fmt: skip


class HeaderColumns:
    """Chosen fields of many equal headers, packed as they come so that memory stays small."""

    def __init__(self, kind: type[ctypes.Structure], names: tuple[str, ...]) -> None:
        self._whole = np.dtype(
            {
                "names": list(names),
                "formats": [_field_type(kind, name) for name in names],
                "offsets": [getattr(kind, name).offset for name in names],
                "itemsize": ctypes.sizeof(kind),
            }
        )
        self._waiting = bytearray()
        self._packed: list[npt.NDArray[Any]] = []

    def add(self, header: bytes) -> None:
        self._waiting += header
        if len(self._waiting) >= _CHUNK * self._whole.itemsize:
            self._pack()

    def _pack(self) -> None:
        rows = np.frombuffer(bytes(self._waiting), self._whole)
        self._packed.append(repack_fields(rows))
        self._waiting.clear()

    def columns(self) -> npt.NDArray[Any]:
        """Return the fields of all headers as one structured array."""
        self._pack()
        self._packed = [np.concatenate(self._packed)]
        return self._packed[0]


@dataclass
class XtfIndex:
    """Where everything is in one XTF file.

    `channel_ping[i]` is the row in `pings` that channel record i belongs to, `channel_data[i]` the
    byte offset of its samples.
    """

    header: Any
    channels: list[Any]
    sample_bytes: dict[int, int]
    pings: npt.NDArray[Any]
    channel_records: npt.NDArray[Any]
    channel_ping: npt.NDArray[np.int64]
    channel_data: npt.NDArray[np.int64]
    kept: dict[int, npt.NDArray[Any]]
    packets: dict[str, int]
    defects: list[str] = field(default_factory=list)


def read_file_header(head: bytes) -> tuple[Any, list[Any], int]:
    """Return the file header, the channels' descriptions, and the offset of the first packet."""
    head = head.ljust(1024, b"\0")
    header = XTFFileHeader.create_from_buffer(head[:1024])
    count = header.channel_count()
    channels = list(header.ChanInfo)
    end = 1024
    # Above six channels the header grows by 1024 bytes for each eight further descriptions.
    while count > len(channels) and end + 1024 <= len(head) and head[end : end + 2] != MAGIC:
        size = ctypes.sizeof(XTFChanInfo)
        block = head[end : end + 1024]
        channels += [
            XTFChanInfo.from_buffer_copy(block[i : i + size]) for i in range(0, 1024, size)
        ]
        end += 1024
    return header, channels, end


class Walker:
    """One pass over the packets of an XTF file; `walk` gives the index."""

    def __init__(self, stream: BinaryIO, size: int, progress: Progress) -> None:
        self._stream = stream
        self._size = size
        self._progress = progress
        head = stream.read(4096)
        self.header, self.channels, self._first = read_file_header(head)
        self._declared = {i: int(c.BytesPerSample) for i, c in enumerate(self.channels)}
        self._bytes: dict[int, int] = {}
        self._pings = HeaderColumns(XTFPingHeader, PING_FIELDS)
        self._records = HeaderColumns(XTFPingChanHeader, CHANNEL_FIELDS)
        self._owner: list[npt.NDArray[np.int64]] = []
        self._waiting: list[tuple[int, int]] = []
        self._kept = {
            kind: HeaderColumns(structure, tuple(name for name, _ in structure._fields_))
            for kind, structure in _KEPT.items()
        }
        self._n_pings = 0
        # End of what the last packet surely holds: a search never starts before it, and starts there
        # when the packet's own length turns out to lead nowhere.
        self._used_to = self._first
        self._counts: dict[int, int] = {}
        self._broken = 0
        self._skipped_bytes = 0
        self.defects: list[str] = []

    def walk(self) -> XtfIndex:
        at = self._first
        step = max(self._size // 200, 1)
        told = 0
        while at + _START.size <= self._size:
            at = self._packet(at)
            if at - told >= step:
                told = at
                self._progress("reading headers", at, self._size)
        self._progress("reading headers", self._size, self._size)
        if self._broken:
            self.defects.append(
                f"{self._broken:,} corrupt place{'s' * (self._broken > 1)} in the file: "
                f"{self._skipped_bytes:,} bytes skipped up to the next good packet"
            )
        self._flush()
        owner = np.concatenate(self._owner) if self._owner else np.zeros((0, 2), np.int64)
        return XtfIndex(
            header=self.header,
            channels=self.channels,
            sample_bytes={**self._declared, **self._bytes},
            pings=self._pings.columns(),
            channel_records=self._records.columns(),
            channel_ping=owner[:, 0],
            channel_data=owner[:, 1],
            kept={kind: columns.columns() for kind, columns in self._kept.items()},
            packets={_kind_name(k): n for k, n in sorted(self._counts.items())},
            defects=self.defects,
        )

    def _packet(self, at: int) -> int:
        """Take the packet at `at`; return where the next one is looked for."""
        self._stream.seek(at)
        start = self._stream.read(_START.size)
        magic, kind, _, n_channels, _, _, length = _START.unpack(start)
        if magic == 0xFACE and kind == SONAR and length < _PING_BYTES:
            length = self._implied_length(at, n_channels)
        sound = magic == 0xFACE and _START.size <= length <= _MOST_BYTES
        if sound and at + length > self._size:
            if self._magic_after(at + 2) is None:
                self.defects.append(
                    f"the file stops in mid-packet ({self._size - at:,} of {length:,} bytes): "
                    "all before is kept"
                )
                return self._size
            sound = False
        if not sound:
            return self._resync(self._used_to)
        if not self._take(at, kind, n_channels, length):
            return self._resync(at + 1)
        return at + length

    def _implied_length(self, at: int, n_channels: int) -> int:
        """Return the length that the channel headers imply, for writers that leave the field empty.

        0 where no packet and no end of the file follows there.
        """
        records = self._channel_records(at, n_channels, min(self._size - at, _MOST_BYTES), False)
        if not records:
            return 0
        _, data, size = records[-1]
        self._stream.seek(data + size)
        following = self._stream.read(2)
        return data + size - at if following in (MAGIC, b"") else 0

    def _take(self, at: int, kind: int, n_channels: int, length: int) -> bool:
        if kind == SONAR:
            if length < _PING_BYTES:
                return False
            self._stream.seek(at)
            header = self._stream.read(_PING_BYTES)
            records = self._channel_records(at, n_channels, length)
            if records is None:
                return False
            self._pings.add(header)
            for record, data, _ in records:
                self._records.add(record)
                self._waiting.append((self._n_pings, data))
            if len(self._waiting) >= _CHUNK:
                self._flush()
            self._n_pings += 1
            last = records[-1] if records else None
            self._used_to = at + _PING_BYTES if last is None else last[1] + last[2]
        elif kind in self._kept:
            size = ctypes.sizeof(_KEPT[kind])
            if length >= size:
                self._stream.seek(at)
                self._kept[kind].add(self._stream.read(size))
            self._used_to = at + min(size, length)
        else:
            self._used_to = at + _START.size
        self._counts[kind] = self._counts.get(kind, 0) + 1
        return True

    def _flush(self) -> None:
        if self._waiting:
            self._owner.append(np.array(self._waiting, np.int64))
            self._waiting = []

    def _channel_records(
        self, at: int, n_channels: int, length: int, length_known: bool = True
    ) -> list[tuple[bytes, int, int]] | None:
        """Return (channel header, offset and bytes of its samples) of one ping; None if unfit.

        A count of samples left empty follows from the packet's length, where that is known.
        """
        if n_channels == 0:
            n_channels = int(self.header.NumberOfSonarChannels)
        records: list[tuple[bytes, int, int]] = []
        numbers: set[int] = set()
        inside = _PING_BYTES
        for place in range(n_channels):
            if inside + _CHANNEL_BYTES > length:
                return None
            self._stream.seek(at + inside)
            record = self._stream.read(_CHANNEL_BYTES)
            number = int.from_bytes(record[:2], "little")
            if number in numbers:
                # Careless writers leave every channel's number 0: then its place counts.
                number = place
                record = number.to_bytes(2, "little") + record[2:]
            numbers.add(number)
            count = int.from_bytes(record[_CHANNEL_COUNT_AT : _CHANNEL_COUNT_AT + 4], "little")
            inside += _CHANNEL_BYTES
            room = length - inside
            each = self._bytes.get(number)
            if each is None:
                each = self._settle_bytes(number, count, room, n_channels)
            if count == 0 and not length_known:
                return None
            if count == 0:
                # Old recorders leave the count to the size of the packet.
                count = (room - (n_channels - 1) * _CHANNEL_BYTES) // (each * n_channels)
                count = max(count, 0)
                record = (
                    record[:_CHANNEL_COUNT_AT]
                    + count.to_bytes(4, "little")
                    + record[_CHANNEL_COUNT_AT + 4 :]
                )
            if count * each > room:
                return None
            records.append((record, at + inside, count * each))
            inside += count * each
        return records

    def _settle_bytes(self, number: int, count: int, room: int, n_channels: int) -> int:
        """Choose a channel's bytes per sample: as declared where that fits the packet, else as fits."""
        declared = self._declared.get(number, 0)
        share = (room - (n_channels - 1) * _CHANNEL_BYTES) // max(n_channels, 1)
        if declared not in (1, 2, 4, 8) or (count and declared * count > room):
            fitting = [b for b in (4, 2, 1) if b * count <= share]
            found = fitting[0] if fitting and count else 2
            self.defects.append(
                f"channel {number} declares {declared} bytes a sample; {found} fit its packets"
            )
            declared = found
        self._bytes[number] = declared
        return declared

    def _magic_after(self, at: int) -> int | None:
        """Return the next place where a plausible packet starts, chained to another or to the end."""
        while at < self._size:
            self._stream.seek(at)
            block = self._stream.read(_BUFFER)
            found = block.find(MAGIC)
            while found >= 0:
                if self._plausible(at + found):
                    return at + found
                found = block.find(MAGIC, found + 1)
            if len(block) < _BUFFER:
                return None
            at += len(block) - 1
        return None

    def _plausible(self, at: int) -> bool:
        self._stream.seek(at)
        start = self._stream.read(_START.size)
        if len(start) < _START.size:
            return False
        _, kind, _, n_channels, _, _, length = _START.unpack(start)
        if not _START.size <= length <= _MOST_BYTES or n_channels > 64:
            return False
        end = at + length
        if end == self._size:
            return True
        if end > self._size:
            # The last packet, cut short: believed for a sonar ping that starts after padding alone.
            return False
        self._stream.seek(end)
        return self._stream.read(2) == MAGIC or (kind == SONAR and length % 64 == 0)

    def _resync(self, at: int) -> int:
        following = self._magic_after(at)
        end = self._size if following is None else following
        self._used_to = end + 1
        self._broken += 1
        self._skipped_bytes += end - at
        return end


def _field_type(kind: type[ctypes.Structure], name: str) -> Any:
    """Return the ctypes type of a field, which may be a base structure's."""
    for structure in kind.__mro__:
        for field_name, field_type, *_ in structure.__dict__.get("_fields_", ()):
            if field_name == name:
                return field_type
    raise KeyError(name)


def _kind_name(kind: int) -> str:
    try:
        return XTFHeaderType(kind).name.replace("_", " ")
    except ValueError:
        return f"type {kind}"
