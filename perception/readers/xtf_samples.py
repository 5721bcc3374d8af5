"""Samples of XTF: 8, 16 and 32 bits, integer or float, with or without sign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.records import FloatArray


@dataclass(frozen=True, slots=True)
class SampleKind:
    """How bytes become echo amplitudes."""

    code: str  # numpy's type string, or "ibm"
    size: int
    label: str


def sample_kind(rows: Sequence[bytes], size: int, declared: int) -> SampleKind:
    """Decide how samples of `size` bytes are coded, by declaration where it fits, else by their look.

    Parameters
    ----------
    rows : raw bytes of some pings.
    declared : XTF's SampleFormat: 1 IBM float, 2/3/8 integers, 5 IEEE float, 0 not said.
    """
    if declared == 1 and size == 4:
        return SampleKind("ibm", 4, "32-bit IBM float")
    if size == 8:
        return SampleKind("<f8", 8, "64-bit float")
    some = b"".join(row[: len(row) // size * size] for row in rows)
    if size == 4 and (declared == 5 or (declared not in (2,) and _looks_float(some))):
        return SampleKind("<f4", 4, "32-bit float")
    bits = 8 * size
    if _looks_signed(np.frombuffer(some, f"<i{size}"), bits):
        return SampleKind(f"<i{size}", size, f"{bits}-bit signed integer")
    return SampleKind(f"<u{size}", size, f"{bits}-bit integer")


def _looks_float(some: bytes) -> bool:
    values = np.frombuffer(some, "<f4")
    values = values[np.frombuffer(some, "<u4") != 0]
    if len(values) == 0:
        return False
    # Integers below 2^23 read as floats are denormal (< 1e-38): no recorder's amplitude.
    with np.errstate(invalid="ignore"):
        sane = np.isfinite(values) & (abs(values) > 1e-20) & (abs(values) < 1e20)
    return bool(sane.mean() > 0.95)


def _looks_signed(values: FloatArray, bits: int) -> bool:
    """Return whether integers swing about zero (a bipolar waveform) rather than fill the upper half.

    The header's UniPolar flag is left 0 by many writers of unsigned data, so the data are asked:
    swinging values are dense near 0 from both sides, unsigned loud ones are not dense near 2^bits.
    """
    if len(values) == 0:
        return False
    negative = float(np.mean(values < 0))
    small = float(np.mean(abs(values.astype(float)) < 2.0 ** (bits - 3)))
    return 0.25 < negative < 0.75 and small > 0.6


def decode(data: bytes, kind: SampleKind) -> FloatArray:
    """Turn bytes into amplitudes (n,) float32; a cut last sample is dropped, bad floats are NaN."""
    data = data[: len(data) // kind.size * kind.size]
    if kind.code == "ibm":
        values = _ibm_float(np.frombuffer(data, "<u4"))
    else:
        raw = np.frombuffer(data, kind.code)
        with np.errstate(over="ignore", invalid="ignore"):
            values = raw.astype(np.float32)
    if kind.code.startswith("<u"):
        return values
    values = np.abs(values)
    return np.where(values < np.float32(1e20), values, np.float32(np.nan))


def _ibm_float(words: np.ndarray) -> FloatArray:
    """Decode IBM System/360 floats: sign, base-16 exponent excess 64, 24-bit fraction."""
    fraction = (words & 0x00FFFFFF).astype(np.float64) / 2.0**24
    exponent = ((words >> 24) & 0x7F).astype(np.float64) - 64.0
    return np.asarray(fraction * 16.0**exponent, np.float32)
