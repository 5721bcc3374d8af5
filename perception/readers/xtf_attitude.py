"""Attitude and navigation packets of XTF, interpolated to the pings."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from perception.geodesy import wrap
from perception.readers.raw import floats, plural
from perception.readers.xtf_time import calendar_seconds
from perception.records import FloatArray

# Beyond this from the nearest packet the ping's own attitude is the better guess.
_REACH_S = 1.0
# Two compasses of one vehicle; a yaw field that is a deviation and no heading differs by more.
_SAME_HEADING_DEG = 25.0


def packet_times(packets: npt.NDArray[Any], utc: bool) -> FloatArray:
    """Return the times (n,) of attitude or navigation packets on the pings' clock; NaN unknown."""
    names = packets.dtype.names or ()
    if "Millisecond" in names:
        fraction = floats(packets["Millisecond"]) / 1e3
    else:
        fraction = floats(packets["Microsecond"]) / 1e6
        # The raw navigation packet counts tenths of milliseconds in sixteen bits.
        if packets["Microsecond"].dtype.itemsize == 2:
            fraction = floats(packets["Microsecond"]) / 1e4
    since_1970, of_day = calendar_seconds(packets, np.minimum(fraction, 0.9999))
    time_s = since_1970 if utc else of_day
    if utc and "SourceEpoch" in names and np.any(packets["SourceEpoch"]):
        epoch = floats(packets["SourceEpoch"])
        if "EpochMicroseconds" in names:
            epoch = epoch + packets["EpochMicroseconds"] / 1e6
        time_s = np.where(packets["SourceEpoch"] > 0, epoch, time_s)
    return np.asarray(time_s)


def attitude_at(
    columns: dict[str, Any],
    pings: npt.NDArray[Any],
    packets: npt.NDArray[Any],
    utc: bool,
    defects: list[str],
) -> None:
    """Replace roll, pitch and, where they agree, heading by the attitude packets' at ping time."""
    ping_s = columns["time_s"]
    packet_s = packet_times(packets, utc)
    tag = floats(pings["AttitudeTimeTag"]) / 1e3
    packet_tag = floats(packets["TimeTag"]) / 1e3
    if _overlap(tag, packet_tag) > 0.8 and np.ptp(packet_tag) > 0:
        # The recorder's millisecond counter ties both far better than hundredths of seconds.
        ping_s, packet_s = tag, packet_tag
    elif _overlap(ping_s, packet_s) < 0.5:
        defects.append(
            f"{plural(len(packets), 'attitude packet')} at other times than the pings: not used"
        )
        return
    angles = np.stack([floats(packets[n]) for n in ("Roll", "Pitch", "Heading")])
    sane = np.isfinite(packet_s) & np.isfinite(angles).all(0) & (abs(angles) <= 720).all(0)
    order = np.argsort(packet_s[sane], kind="stable")
    packet_s, angles = packet_s[sane][order], angles[:, sane][:, order]
    if len(packet_s) < 2:
        return
    near = _distance(ping_s, packet_s) <= _REACH_S
    for name, values in (("roll_deg", angles[0]), ("pitch_deg", angles[1])):
        if np.any(values):
            columns[name] = np.where(near, np.interp(ping_s, packet_s, values), columns[name])
    if np.any(angles[2]):
        turned = np.degrees(np.unwrap(np.radians(angles[2])))
        heading = np.interp(ping_s, packet_s, turned) % 360.0
        own = columns["heading_deg"]
        apart = abs(np.degrees(wrap(np.radians(heading - own))))
        if not np.any(np.nan_to_num(own)) or np.nanmedian(apart[near]) < _SAME_HEADING_DEG:
            columns["heading_deg"] = np.where(near, heading, own)
        else:
            defects.append("heading of attitude packets and of pings disagree: the pings' is kept")


def _overlap(ping_s: FloatArray, packet_s: FloatArray) -> float:
    """Return the share of pings within the packets' span of time."""
    packet_s = packet_s[np.isfinite(packet_s)]
    if len(packet_s) < 2:
        return 0.0
    with np.errstate(invalid="ignore"):
        inside = (ping_s >= packet_s.min() - _REACH_S) & (ping_s <= packet_s.max() + _REACH_S)
    return float(inside.mean())


def _distance(ping_s: FloatArray, packet_s: FloatArray) -> FloatArray:
    """Return the time from each ping to the nearest packet."""
    after = np.clip(np.searchsorted(packet_s, ping_s), 1, len(packet_s) - 1)
    return np.minimum(abs(ping_s - packet_s[after - 1]), abs(packet_s[after] - ping_s))


def positions_at(
    ping_s: FloatArray, packets: npt.NDArray[Any], utc: bool
) -> tuple[FloatArray, FloatArray]:
    """Interpolate the navigation packets' positions to the pings; NaN outside their time."""
    packet_s = packet_times(packets, utc)
    x, y = floats(packets["RawXcoordinate"]), floats(packets["RawYcoordinate"])
    good = np.isfinite(packet_s + x + y) & ~((x == 0) & (y == 0)) & (abs(x) < 1e8) & (abs(y) < 1e8)
    order = np.argsort(packet_s[good], kind="stable")
    packet_s, x, y = packet_s[good][order], x[good][order], y[good][order]
    if len(packet_s) < 2:
        nothing = np.full(len(ping_s), np.nan)
        return nothing, nothing.copy()
    return (
        np.interp(ping_s, packet_s, x, left=np.nan, right=np.nan),
        np.interp(ping_s, packet_s, y, left=np.nan, right=np.nan),
    )
