"""Makes small XTF files with a known content, through pyxtf's structures."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from pyxtf import XTFAttitudeData, XTFFileHeader, XTFHeaderNavigation, XTFPingHeader
from pyxtf.xtf_ctypes import XTFPingChanHeader

START = datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)


@dataclass
class Plan:
    """What the file is to hold; `track(t)` gives x, y, heading in degrees after t seconds."""

    n: int = 60
    samples: int = 256
    range_m: float = 30.0
    altitude_m: float = 6.0
    dt_s: float = 0.2
    speed_m_s: float = 2.0
    track: Callable[[float], tuple[float, float, float]] | None = None
    nav_units: int = 3
    dtype: Any = np.uint16
    sample_format: int = 0
    port_far_first: bool = True
    starboard_far_first: bool = False
    channel_types: tuple[int, ...] = (1, 2)
    tweak: Callable[[int, XTFPingHeader, list[XTFPingChanHeader]], None] | None = None
    start: datetime = START
    seed: int = 0
    before_ping: dict[int, list[bytes]] = field(default_factory=dict)
    scale: float = 1.0


def echo(plan: Plan, rng: np.random.Generator, side: int) -> np.ndarray:
    """One side of one ping, near to far: transmit pulse, quiet water, bottom with speckle.

    Starboard is twice as loud, so that sides cannot be swapped unseen.
    """
    range_m = (np.arange(plan.samples) + 0.5) * plan.range_m / plan.samples
    bottom = range_m >= plan.altitude_m
    level = np.where(bottom, 4000.0 * (plan.altitude_m / range_m) ** 1.5, 40.0)
    level[: max(plan.samples // 128, 1)] = 30000.0
    level = level * np.sqrt(rng.exponential(1.0, plan.samples)) * (1 + side)
    return np.clip(level * plan.scale, 0, 60000 * plan.scale)


def line(plan: Plan) -> Callable[[float], tuple[float, float, float]]:
    """A straight line north from 48.5 N 68.8 W (degrees) or from 500000, 5000000 (metres)."""

    def at(t: float) -> tuple[float, float, float]:
        north_m = plan.speed_m_s * t
        if plan.nav_units == 3:
            return -68.8, 48.5 + north_m / 111200.0, 0.0
        return 500000.0, 5000000.0 + north_m, 0.0

    return at


def file_header(plan: Plan) -> XTFFileHeader:
    header = XTFFileHeader()
    header.SonarName = b"TEST"
    header.NavUnits = plan.nav_units
    header.NumberOfSonarChannels = len(plan.channel_types)
    for i, kind in enumerate(plan.channel_types):
        info = header.ChanInfo[i]
        info.TypeOfChannel = kind
        info.SubChannelNumber = i
        info.BytesPerSample = np.dtype(plan.dtype).itemsize
        info.SampleFormat = plan.sample_format
        info.Frequency = 600.0
    return header


def stamp(packet: Any, when: datetime) -> None:
    packet.Year, packet.Month, packet.Day = when.year, when.month, when.day
    packet.Hour, packet.Minute, packet.Second = when.hour, when.minute, when.second


def ping_bytes(plan: Plan, i: int, rng: np.random.Generator) -> bytes:
    t = i * plan.dt_s
    when = plan.start + timedelta(seconds=t)
    x, y, heading = (plan.track or line(plan))(t)
    ping = XTFPingHeader()
    stamp(ping, when)
    ping.HSeconds = when.microsecond // 10000
    ping.PingNumber = i
    ping.NumChansToFollow = len(plan.channel_types)
    ping.SoundVelocity = 1500.0
    ping.SensorXcoordinate, ping.SensorYcoordinate = x, y
    ping.SensorHeading = heading % 360.0
    ping.SensorDepth = 10.0
    ping.SensorPrimaryAltitude = plan.altitude_m
    ping.SensorPitch, ping.SensorRoll = 1.5, -2.5
    channels, data = [], []
    for number, kind in enumerate(plan.channel_types):
        channel = XTFPingChanHeader()
        channel.ChannelNumber = number
        channel.SlantRange = plan.range_m
        channel.TimeDuration = plan.range_m / 750.0
        channel.Frequency = 600
        channel.NumSamples = plan.samples
        channels.append(channel)
        level = echo(plan, rng, 1 if kind == 2 else 0)
        far_first = plan.starboard_far_first if kind == 2 else plan.port_far_first
        data.append((level[::-1] if far_first else level).astype(plan.dtype))
    if plan.tweak is not None:
        plan.tweak(i, ping, channels)
    body = b"".join(
        bytes(c) + d[: c.NumSamples].tobytes() for c, d in zip(channels, data, strict=True)
    )
    length = ctypes.sizeof(ping) + len(body)
    padding = -length % 64
    ping.NumBytesThisRecord = length + padding
    return bytes(ping) + body + b"\0" * padding


def xtf_packets(plan: Plan) -> list[bytes]:
    """The file as a list of its header and packets, for tests that damage one of them."""
    rng = np.random.default_rng(plan.seed)
    packets = [bytes(file_header(plan))]
    for i in range(plan.n):
        packets += plan.before_ping.get(i, [])
        packets.append(ping_bytes(plan, i, rng))
    return packets


def make_xtf(path: Path, plan: Plan | None = None) -> Path:
    path.write_bytes(b"".join(xtf_packets(plan or Plan())))
    return path


def attitude_bytes(when: datetime, roll: float, pitch: float, heading: float) -> bytes:
    packet = XTFAttitudeData()
    stamp(packet, when)
    packet.Millisecond = when.microsecond // 1000
    packet.Roll, packet.Pitch, packet.Heading = roll, pitch, heading
    packet.NumBytesThisRecord = 64
    return bytes(packet)


def navigation_bytes(when: datetime, x: float, y: float) -> bytes:
    packet = XTFHeaderNavigation()
    stamp(packet, when)
    packet.Microsecond = when.microsecond
    packet.RawXcoordinate, packet.RawYcoordinate = x, y
    packet.NumBytesThisRecord = 64
    return bytes(packet)
