"""Horizontal paths that a vehicle can turn: straight legs joined by arcs of the turning radius.

A path is a control polygon; each inner corner of angle phi is rounded by an arc of radius R that begins
and ends ``R tan(phi / 2)`` from the corner. Where every such tangent fits in its half of the legs beside
it, the curve's radius is R or infinite everywhere; what does not fit is the `overlap`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from perception.records import FloatArray


@njit(cache=True)
def _corner(points, i, first, last, radius):  # type: ignore[no-untyped-def]
    """Return (tangent length, radius used, signed turn, overlap) of corner i of first..last."""
    ux, uy = points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1]
    vx, vy = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
    lu, lv = math.hypot(ux, uy), math.hypot(vx, vy)
    turn = math.atan2(ux * vy - uy * vx, ux * vx + uy * vy)
    if radius <= 0.0 or abs(turn) < 1e-9:
        return 0.0, 0.0, turn, 0.0
    half = math.tan(min(abs(turn), 3.0) / 2.0)
    room = min(lu if i - 1 == 0 else 0.5 * lu, lv if i + 1 == len(points) - 1 else 0.5 * lv)
    tangent = radius * half
    if tangent <= room:
        return tangent, radius, turn, 0.0
    return room, room / half, turn, tangent - room


@njit(cache=True)
def sample_curve(points, first, last, radius, step, out_x, out_y):  # type: ignore[no-untyped-def]
    """Sample the rounded polygon between corners first and last, at most `step` apart.

    The rounding of the corners `first` and `last` themselves is left out. Legs and arcs are divided
    each on their own, so that a change of one leaves the samples of the others where they were.

    Returns
    -------
    (number of samples, total overlap); the number is -1 where `out_x` is too short.
    """
    room = len(out_x)
    n = 0
    overlap = 0.0
    x, y = points[first, 0], points[first, 1]
    out_x[0], out_y[0] = x, y
    n = 1
    for i in range(first + 1, last + 1):
        ux, uy = points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1]
        length = math.hypot(ux, uy)
        if length > 0.0:
            ux, uy = ux / length, uy / length
        tangent = used = turn = over = 0.0
        if i < last:
            tangent, used, turn, over = _corner(points, i, first, last, radius)
        overlap += over
        ex, ey = points[i, 0] - tangent * ux, points[i, 1] - tangent * uy
        leg = math.hypot(ex - x, ey - y)
        pieces = math.ceil(leg / step - 1e-9)
        arc = used * abs(turn)
        arcs = math.ceil(arc / step - 1e-9) if tangent > 0.0 else 0
        if n + pieces + arcs > room:
            return -1, overlap
        for k in range(1, pieces + 1):
            v = k / pieces
            out_x[n], out_y[n] = x + v * (ex - x), y + v * (ey - y)
            n += 1
        x, y = ex, ey
        if arcs > 0:
            side = 1.0 if turn > 0 else -1.0
            cx, cy = x - side * used * uy, y + side * used * ux
            dx, dy = x - cx, y - cy
            for k in range(1, arcs + 1):
                angle = turn * k / arcs
                cos_a, sin_a = math.cos(angle), math.sin(angle)
                out_x[n] = cx + cos_a * dx - sin_a * dy
                out_y[n] = cy + sin_a * dx + cos_a * dy
                n += 1
            x, y = out_x[n - 1], out_y[n - 1]
    return n, overlap


def _pieces(points: FloatArray, radius: float) -> list[tuple[float, ...]]:
    """Return legs and arcs as (length, kind, ...) in order; kind 0 a leg, 1 an arc."""
    pieces: list[tuple[float, ...]] = []
    x, y = points[0]
    last = len(points) - 1
    for i in range(1, last + 1):
        direction = points[i] - points[i - 1]
        length = float(np.hypot(*direction))
        unit = direction / length if length > 0 else np.zeros(2)
        tangent, used, turn, _ = (
            _corner(points, i, 0, last, radius) if i < last else (0.0, 0.0, 0.0, 0.0)
        )
        end = points[i] - tangent * unit
        leg = math.hypot(end[0] - x, end[1] - y)
        if leg > 0:
            pieces.append((leg, 0, x, y, (end[0] - x) / leg, (end[1] - y) / leg))
        x, y = end
        if tangent > 0 and used > 0:
            side = math.copysign(1.0, turn)
            cx, cy = x - side * used * unit[1], y + side * used * unit[0]
            pieces.append((used * abs(turn), 1, cx, cy, x - cx, y - cy, turn))
            cos_a, sin_a = math.cos(turn), math.sin(turn)
            dx, dy = x - cx, y - cy
            x, y = cx + cos_a * dx - sin_a * dy, cy + sin_a * dx + cos_a * dy
    return pieces


def waypoints(points: FloatArray, radius: float, spacing: float) -> FloatArray:
    """Return (n, 2) waypoints at equal distances along the rounded polygon, ends exact.

    Equal spacing keeps what a checker computes from three neighbours well conditioned: a short piece
    between arcs would turn rounded digits into false curvature.
    """
    pieces = _pieces(points, radius)
    lengths = np.array([p[0] for p in pieces])
    total = float(lengths.sum())
    n = max(1, math.ceil(total / spacing))
    starts = np.concatenate([[0.0], np.cumsum(lengths)])
    stations = np.linspace(0.0, total, n + 1)
    which = np.clip(np.searchsorted(starts, stations, side="right") - 1, 0, len(pieces) - 1)
    out = np.empty((n + 1, 2))
    for k, (s, i) in enumerate(zip(stations, which, strict=True)):
        piece = pieces[i]
        along = s - starts[i]
        if piece[1] == 0:
            out[k] = piece[2] + along * piece[4], piece[3] + along * piece[5]
        else:
            angle = piece[6] * along / piece[0]
            cos_a, sin_a = math.cos(angle), math.sin(angle)
            dx, dy = piece[4], piece[5]
            out[k] = piece[2] + cos_a * dx - sin_a * dy, piece[3] + sin_a * dx + cos_a * dy
    out[0], out[-1] = points[0], points[-1]
    return out
