"""Shortest turns: Dubins paths, with legs of least radius between two headings."""

from __future__ import annotations

import math

import numpy as np

from perception.records import FloatArray

_TAU = 2.0 * math.pi


def dubins(
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    radius_m: float,
    spacing_m: float,
) -> FloatArray:
    """Return (n, 2) points along the shortest path of bounded curvature between two poses.

    Parameters
    ----------
    start, goal : easting, northing, heading (rad, clockwise from north).

    Notes
    -----
    The six words LSL, RSR, LSR, RSL, RLR, LRL of Dubins (1957), in the normal form of Shkel and
    Lumelsky (2001).
    """
    # Mathematical angles: counterclockwise from east.
    a0, b0 = 0.5 * math.pi - start[2], 0.5 * math.pi - goal[2]
    dx, dy = (goal[0] - start[0]) / radius_m, (goal[1] - start[1]) / radius_m
    d, theta = math.hypot(dx, dy), math.atan2(dy, dx)
    alpha, beta = (a0 - theta) % _TAU, (b0 - theta) % _TAU
    words = [w for w in _words(alpha, beta, d) if w is not None]
    lengths, kinds = min(words, key=lambda w: sum(w[0]))
    return _trace(start[0], start[1], a0, lengths, kinds, radius_m, spacing_m)


def _words(
    a: float, b: float, d: float
) -> list[tuple[tuple[float, float, float], tuple[int, int, int]] | None]:
    sa, ca, sb, cb, cab = math.sin(a), math.cos(a), math.sin(b), math.cos(b), math.cos(a - b)
    out: list[tuple[tuple[float, float, float], tuple[int, int, int]] | None] = []
    p2 = 2 + d * d - 2 * cab + 2 * d * (sa - sb)
    if p2 >= 0:
        t = math.atan2(cb - ca, d + sa - sb)
        out.append((((t - a) % _TAU, math.sqrt(p2), (b - t) % _TAU), (1, 0, 1)))
    p2 = 2 + d * d - 2 * cab + 2 * d * (sb - sa)
    if p2 >= 0:
        t = math.atan2(ca - cb, d - sa + sb)
        out.append((((a - t) % _TAU, math.sqrt(p2), (t - b) % _TAU), (-1, 0, -1)))
    p2 = -2 + d * d + 2 * cab + 2 * d * (sa + sb)
    if p2 >= 0:
        p = math.sqrt(p2)
        t = math.atan2(-ca - cb, d + sa + sb) - math.atan2(-2.0, p)
        out.append((((t - a) % _TAU, p, (t - b) % _TAU), (1, 0, -1)))
    p2 = -2 + d * d + 2 * cab - 2 * d * (sa + sb)
    if p2 >= 0:
        p = math.sqrt(p2)
        t = math.atan2(ca + cb, d - sa - sb) - math.atan2(2.0, p)
        out.append((((a - t) % _TAU, p, (b - t) % _TAU), (-1, 0, 1)))
    c = (6 - d * d + 2 * cab + 2 * d * (sa - sb)) / 8
    if abs(c) <= 1:
        p = (_TAU - math.acos(c)) % _TAU
        t = (a - math.atan2(ca - cb, d - sa + sb) + 0.5 * p) % _TAU
        out.append(((t, p, (a - b - t + p) % _TAU), (-1, 1, -1)))
    c = (6 - d * d + 2 * cab + 2 * d * (sb - sa)) / 8
    if abs(c) <= 1:
        p = (_TAU - math.acos(c)) % _TAU
        t = (-a + math.atan2(-ca + cb, d + sa - sb) + 0.5 * p) % _TAU
        out.append(((t, p, (b - a - t + p) % _TAU), (1, -1, 1)))
    return out


def _trace(
    x: float, y: float, angle: float, lengths: tuple[float, ...], kinds: tuple[int, ...],
    radius: float, spacing: float,
) -> FloatArray:  # fmt: skip
    points = [(x, y)]
    for length, kind in zip(lengths, kinds, strict=True):
        n = max(1, math.ceil(length * radius / spacing))
        for i in range(1, n + 1):
            v = length * i / n
            if kind == 0:
                points.append((x + radius * v * math.cos(angle), y + radius * v * math.sin(angle)))
            else:
                turned = angle + kind * v
                points.append(
                    (
                        x + kind * radius * (math.sin(turned) - math.sin(angle)),
                        y - kind * radius * (math.cos(turned) - math.cos(angle)),
                    )
                )
        x, y = points[-1]
        angle += kind * length
    return np.array(points)
