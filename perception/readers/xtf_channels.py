"""Which channels of an XTF are port and starboard, and which packets make one ping."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pyxtf.enumerations import XTFChannelType

from perception.readers.raw import plural
from perception.readers.xtf_packets import XtfIndex
from perception.records import InputError


def text_of(raw: bytes) -> str:
    """Return the text of a fixed-width field."""
    return raw.split(b"\0")[0].decode("latin-1").strip()


def chosen_channels(
    path: Path, index: XtfIndex, defects: list[str]
) -> tuple[int | None, int | None]:
    """Return the numbers of the port and the starboard channel that are read.

    Of several pairs (dual frequency) the one with the most samples a ping is taken, then the higher
    frequency: the finer image.
    """
    numbers = np.unique(index.channel_records["ChannelNumber"])
    by_side: dict[int, list[tuple[float, float, int]]] = {1: [], 2: []}
    kinds = {int(n): _channel_type(index, int(n)) for n in numbers}
    # Careless writers leave every type 0, which says sub-bottom; a pair of those is taken for sides.
    untyped = [number for number, kind in kinds.items() if kind == 0]
    if not any(kind in by_side for kind in kinds.values()) and len(untyped) >= 2:
        kinds = dict(zip(untyped[:2], (1, 2), strict=True))
        defects.append(
            "no channel is declared port or starboard: "
            + " and ".join(f"channel {n} is taken for {_side_name(k)}" for n, k in kinds.items())
        )
    for number in (int(n) for n in numbers):
        if kinds.get(number) in by_side:
            mine = index.channel_records["ChannelNumber"] == number
            samples = float(np.median(index.channel_records["NumSamples"][mine]))
            by_side[kinds[number]].append((samples, channel_frequency_hz(index, number), number))
    picked: list[int | None] = []
    for side in (1, 2):
        best = max(by_side[side], key=lambda c: (c[0], np.nan_to_num(c[1]), -c[2]), default=None)
        picked.append(None if best is None else best[2])
    if picked == [None, None]:
        raise InputError(
            f"{path}: its {plural(len(index.pings), 'sonar ping')} hold no port or starboard "
            "channel (sub-bottom or bathymetry only); give a side-scan file"
        )
    for side, found in zip((1, 2), picked, strict=True):
        if found is None:
            defects.append(f"no {_side_name(side)} channel: that side is empty")
    return picked[0], picked[1]


def _side_name(kind: int) -> str:
    return {1: "port", 2: "starboard"}.get(kind, "neither side")


def _channel_type(index: XtfIndex, number: int) -> int:
    """Return 1 for a port channel, 2 for starboard, another number for the rest."""
    if number >= len(index.channels):
        return -1
    info = index.channels[number]
    kind = int(info.TypeOfChannel)
    if kind in (int(XTFChannelType.port), int(XTFChannelType.stbd)):
        return kind
    name = text_of(info.ChannelName).lower()
    if kind == 0 and name.startswith("port"):
        return 1
    if kind == 0 and name.startswith(("star", "stbd")):
        return 2
    return -1 if name or kind else 0


def channel_frequency_hz(index: XtfIndex, number: int) -> float:
    """Return a channel's frequency: the header fields are in kHz by custom, in Hz in some files."""
    mine = index.channel_records["ChannelNumber"] == number
    value = float(np.median(index.channel_records["Frequency"][mine])) if mine.any() else 0.0
    if value <= 0 and number < len(index.channels):
        value = float(index.channels[number].Frequency)
    if not np.isfinite(value) or value <= 0:
        return float("nan")
    return value * 1e3 if value < 1e4 else value


def merge_split_pings(index: XtfIndex, defects: list[str]) -> XtfIndex:
    """Join packets that hold one side each of the same ping, as some recorders write them."""
    n = len(index.pings)
    number = index.pings["PingNumber"]
    # Joined, at least two in five packets would go; without as many repeats there is nothing to join.
    if n < 2 or np.mean(number[1:] == number[:-1]) < 0.4:
        return index
    sides: list[set[int]] = [set() for _ in range(n)]
    for ping, channel in zip(
        index.channel_ping, index.channel_records["ChannelNumber"], strict=True
    ):
        sides[ping].add(int(channel))
    owner = np.arange(n)
    ping = 1
    while ping < n:
        if (
            number[ping] == number[ping - 1]
            and sides[ping]
            and sides[ping - 1].isdisjoint(sides[ping])
        ):
            owner[ping] = owner[ping - 1]
            sides[ping] = sides[ping] | sides[ping - 1]
        ping += 1
    leaders = np.unique(owner)
    # Chance repeats of a number (all zero in careless files) join whole pings no one meant to join.
    if len(leaders) > 0.6 * n:
        return index
    defects.append(
        f"port and starboard come in packets of their own: joined to {plural(len(leaders), 'ping')}"
    )
    row_of = np.searchsorted(leaders, owner)
    return replace(index, pings=index.pings[leaders], channel_ping=row_of[index.channel_ping])


def keep_channels(index: XtfIndex, numbers: tuple[int | None, int | None]) -> XtfIndex:
    """Keep the packets that hold a chosen channel: others (sub-bottom, a second frequency) are no pings."""
    chosen = np.isin(index.channel_records["ChannelNumber"], [n for n in numbers if n is not None])
    pings = np.unique(index.channel_ping[chosen])
    return replace(
        index,
        pings=index.pings[pings],
        channel_records=index.channel_records[chosen],
        channel_ping=np.searchsorted(pings, index.channel_ping[chosen]),
        channel_data=index.channel_data[chosen],
    )
