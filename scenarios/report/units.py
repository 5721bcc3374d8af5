"""Metric keys to words: `map_mae_m` is "map mae" in m."""

from __future__ import annotations

# Longest first: `_m_s` must not be read as seconds.
_UNITS = (
    ("_m_per_sqrt_km", "m/√km"),
    ("_m_s", "m/s"),
    ("_m2", "m²"),
    ("_km", "km"),
    ("_deg", "°"),
    ("_mb", "MB"),
    ("_db", "dB"),
    ("_percent", "%"),
    ("_seconds", "s"),
    ("_m", "m"),
    ("_s", "s"),
)


def label_and_unit(key: str) -> tuple[str, str]:
    """Return the words and the unit of a metric's key.

    >>> label_and_unit("track_rms_before_m")
    ('track rms before', 'm')
    >>> label_and_unit("seconds")
    ('seconds', '')
    """
    for suffix, unit in _UNITS:
        if key.endswith(suffix) and len(key) > len(suffix):
            return key.removesuffix(suffix).replace("_", " "), unit
    return key.replace("_", " "), ""
