"""Write a survey as XTF, the file that side-scan recorders exchange.

Positions are WGS84 degrees (NavUnits 3), headings from true north, angles degrees, depths metres;
amplitudes are 16-bit. pyxtf gives the format's structures; whole packets are filled as one array.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyxtf

from perception.files import whole_file
from perception.records import FloatArray

_SONAR_PACKET = 0
_MAGIC = 0xFACE
_SHIP_FIELDS_DM = 10.0  # ShipAltitude and ShipDepth count decimetres


@dataclass(frozen=True, slots=True)
class SonarLog:
    """What a recorder stores of each ping, in the file's units.

    Arrays are (n,), `counts` (n, 2, samples) with port first, near to far.
    """

    time_s: FloatArray
    longitude_deg: FloatArray
    latitude_deg: FloatArray
    heading_deg: FloatArray
    pitch_deg: FloatArray
    roll_deg: FloatArray
    depth_m: FloatArray
    altitude_m: FloatArray
    speed_m_s: FloatArray
    counts: npt.NDArray[np.uint16]
    range_m: float
    ping_period_s: float
    sound_speed_m_s: float
    frequency_khz: float
    horizontal_beam_deg: float
    vertical_beam_deg: float
    tilt_deg: float
    port_far_to_near: bool = False
    first_ping: int = 0
    name: str = "bathynav"


def write_xtf(path: Path, log: SonarLog) -> None:
    """Write the log to `path`, whole or not at all."""
    packets = _packets(log)
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(_file_header(log, path.name))
        packets.tofile(stream)


def _file_header(log: SonarLog, name: str) -> bytes:
    header = pyxtf.XTFFileHeader()
    header.RecordingProgramName = b"bathynav"
    header.RecordingProgramVersion = b"1"
    header.SonarName = log.name.encode("ascii", "replace")[:15]
    header.SonarType = 0
    header.ThisFileName = name.encode("ascii", "replace")[:63]
    header.NavUnits = 3
    header.NumberOfSonarChannels = 2
    for index, (kind, label) in enumerate(((1, b"Port"), (2, b"Starboard"))):
        channel = header.ChanInfo[index]
        channel.TypeOfChannel = kind
        channel.SubChannelNumber = index
        channel.CorrectionFlags = 1  # slant range
        channel.UniPolar = 1
        channel.BytesPerSample = 2
        channel.ChannelName = label
        channel.Frequency = log.frequency_khz
        channel.HorizBeamAngle = log.horizontal_beam_deg
        channel.TiltAngle = log.tilt_deg
        channel.BeamWidth = log.vertical_beam_deg
        channel.SampleFormat = 0
    data: bytes = header.to_bytes()
    return data


def _dtype(structure: Any) -> np.dtype[Any]:
    """Return the packed layout of one of pyxtf's structures, inherited fields first."""
    fields: list[tuple[str, Any]] = []
    for part in reversed(structure.__mro__):
        fields.extend((name, np.dtype(kind)) for name, kind in part.__dict__.get("_fields_", ()))
    return np.dtype(fields)


def _packets(log: SonarLog) -> npt.NDArray[Any]:
    n, _, samples = log.counts.shape
    ping = _dtype(pyxtf.XTFPingHeader)
    channel = _dtype(pyxtf.XTFPingChanHeader)
    size = ping.itemsize + 2 * (channel.itemsize + 2 * samples)
    padding = -size % 64  # packets are whole multiples of 64 bytes
    packets = np.zeros(
        n,
        np.dtype(
            [
                ("ping", ping),
                ("port_header", channel),
                ("port", "<u2", (samples,)),
                ("starboard_header", channel),
                ("starboard", "<u2", (samples,)),
                ("padding", "u1", (padding,)),
            ]
        ),
    )
    _fill_ping(packets["ping"], log, size + padding)
    for index, side in enumerate(("port", "starboard")):
        _fill_channel(packets[f"{side}_header"], log, index, samples)
        packets[side] = log.counts[:, index]
    if log.port_far_to_near:
        packets["port"] = log.counts[:, 0, ::-1]
    return packets


def _fill_ping(ping: npt.NDArray[Any], log: SonarLog, size: int) -> None:
    ping["MagicNumber"] = _MAGIC
    ping["HeaderType"] = _SONAR_PACKET
    ping["NumChansToFollow"] = 2
    ping["NumBytesThisRecord"] = size
    _fill_time(ping, log.time_s)
    number = np.arange(len(ping)) + log.first_ping
    ping["PingNumber"] = number
    ping["EventNumber"] = number
    for name, values in (
        ("SoundVelocity", log.sound_speed_m_s),
        ("ComputedSoundVelocity", log.sound_speed_m_s),
        ("ShipYcoordinate", log.latitude_deg),
        ("ShipXcoordinate", log.longitude_deg),
        ("SensorYcoordinate", log.latitude_deg),
        ("SensorXcoordinate", log.longitude_deg),
        ("ShipGyro", log.heading_deg),
        ("SensorHeading", log.heading_deg),
        ("SensorPitch", log.pitch_deg),
        ("SensorRoll", log.roll_deg),
        ("SensorDepth", log.depth_m),
        ("SensorPrimaryAltitude", log.altitude_m),
        # Knots, as the format has it.
        ("SensorSpeed", log.speed_m_s / 0.514444),
        ("ShipSpeed", log.speed_m_s / 0.514444),
        ("ShipDepth", np.clip(np.rint(log.depth_m * _SHIP_FIELDS_DM), 0, 65535)),
        ("ShipAltitude", np.clip(np.rint(log.altitude_m * _SHIP_FIELDS_DM), 0, 65535)),
    ):
        ping[name] = values


def _fill_time(ping: npt.NDArray[Any], time_s: FloatArray) -> None:
    hundredths = np.rint(time_s * 100.0).astype(np.int64)
    moment = (hundredths // 100).astype("datetime64[s]")
    day = moment.astype("datetime64[D]")
    month = moment.astype("datetime64[M]")
    year = moment.astype("datetime64[Y]")
    seconds = (moment - day).astype(np.int64)
    for name, values in (
        ("Year", year.astype(np.int64) + 1970),
        ("Month", month.astype(np.int64) % 12 + 1),
        ("Day", (day - month).astype(np.int64) + 1),
        ("Hour", seconds // 3600),
        ("Minute", seconds // 60 % 60),
        ("Second", seconds % 60),
        ("HSeconds", hundredths % 100),
        ("JulianDay", (day - year).astype(np.int64) + 1),
    ):
        ping[name] = values
    for fix, name in (("FixTimeHour", "Hour"), ("FixTimeMinute", "Minute"),
                      ("FixTimeSecond", "Second"), ("FixTimeHsecond", "HSeconds")):  # fmt: skip
        ping[fix] = ping[name]


def _fill_channel(channel: npt.NDArray[Any], log: SonarLog, index: int, samples: int) -> None:
    channel["ChannelNumber"] = index
    channel["SlantRange"] = log.range_m
    channel["TimeDuration"] = 2.0 * log.range_m / log.sound_speed_m_s
    channel["SecondsPerPing"] = log.ping_period_s
    channel["Frequency"] = round(log.frequency_khz)
    channel["NumSamples"] = samples
