"""The polish's kernels: shifts of a control polygon, kept where they lower the exact cost.

A scene is the tuple (stack, cell width, cell height, radius, step, rules, px, py, work, hull): the ground,
how a curve is sampled on it, what it costs, and scratch.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from planning.curve import sample_curve
from planning.profile import path_cost

# Price per metre by which the tangents of an arc do not fit: above what any shortcut can save.
OVERLAP_PRICE = 300.0
# Half widths of the shifts, in control points, wide ones first.
_WIDTHS = (16, 8, 4, 2, 1)
# Least shift that is tried, in samples: a twentieth of a cell changes no cost that matters.
_FINEST = 0.05
# Greatest shift, in control points' distances; what a success and a failure make of the next one.
_WIDEST, _GROW, _SHRINK = 8.0, 2.0, 0.4
# A sweep round that gains less than this share of the cost ends the descent.
_GAIN_SHARE = 2e-6


@njit(cache=True, nogil=True)
def curve_cost(scene, points, first, last):  # type: ignore[no-untyped-def]
    """Return (cost, breach) of the rounded polygon between two corners; infinite where it is too long."""
    stack, width, height, radius, step, rules, px, py, work, hull = scene
    n, overlap = sample_curve(points, first, last, radius, step, px, py)
    if n < 0:
        return np.inf, np.inf
    cost, breach = path_cost(stack, width, height, px, py, n, rules, work, hull)
    return cost + OVERLAP_PRICE * overlap, breach + overlap


@njit(cache=True)
def _direction(points, centre, along):  # type: ignore[no-untyped-def]
    """Return the unit vector along or square to the polygon at a point."""
    tx = points[centre + 1, 0] - points[centre - 1, 0]
    ty = points[centre + 1, 1] - points[centre - 1, 1]
    norm = max(math.hypot(tx, ty), 1e-9)
    if along:
        return tx / norm, ty / norm
    return -ty / norm, tx / norm


@njit(cache=True)
def _gain_of_shift(scene, points, saved, span, window, centre, half, d, along):  # type: ignore[no-untyped-def]
    """Shift the points of `span` by a hat of height d to the better side; return what that gains.

    They are left where they were, and 0 is returned, if neither side is better.
    """
    j0, j1 = span
    old, _ = curve_cost(scene, points, window[0], window[1])
    nx, ny = _direction(points, centre, along)
    for j in range(j0, j1 + 1):
        saved[j, 0], saved[j, 1] = points[j, 0], points[j, 1]
    for sign in (1.0, -1.0):
        for j in range(j0, j1 + 1):
            share = sign * d * (1.0 - abs(j - centre) / half)
            points[j, 0] = saved[j, 0] + share * nx
            points[j, 1] = saved[j, 1] + share * ny
        new, _ = curve_cost(scene, points, window[0], window[1])
        if new < old - 1e-7:
            return old - new
    for j in range(j0, j1 + 1):
        points[j, 0], points[j, 1] = saved[j, 0], saved[j, 1]
    return 0.0


@njit(cache=True, nogil=True)
def descend(scene, points, head, tail, sweeps, margin):  # type: ignore[no-untyped-def]
    """Move the control points until no shift lowers the cost; `head` and `tail` points stay.

    Parameters
    ----------
    margin : how far along the path (m) a change makes itself felt.
    """
    n = len(points)
    if n < 3:
        return
    step = scene[4]
    spacing = math.hypot(points[1, 0] - points[0, 0], points[1, 1] - points[0, 1])
    spacing = max(spacing, step)
    beyond = math.ceil(margin / spacing) + 2
    widths = np.array(_WIDTHS)
    finest = _FINEST * step
    delta = np.empty((len(widths), n))
    for level in range(len(widths)):
        delta[level, :] = min(0.25 * spacing * widths[level], _WIDEST * spacing)
    saved = np.empty((n, 2))
    for sweep in range(sweeps):
        gained = 0.0
        for level in range(len(widths)):
            half = widths[level]
            if half > 1 and half > n // 2:
                continue
            stride = max(1, half // 2)
            # Along the path too: room for an arc is gained by shifting its corner.
            along = half <= 2 and sweep % 3 == 2
            for centre in range(head + sweep % stride, n - tail, stride):
                d = delta[level, centre]
                if d < finest:
                    # Rested; look again now and then, since its neighbours move.
                    if sweep % 4 != 3:
                        continue
                    d = 4.0 * finest
                span = (max(head, centre - half + 1), min(n - 1 - tail, centre + half - 1))
                window = (max(0, span[0] - 1 - beyond), min(n - 1, span[1] + 1 + beyond))
                gain = _gain_of_shift(scene, points, saved, span, window, centre, half, d, along)
                gained += gain
                delta[level, centre] = (
                    min(_GROW * d, _WIDEST * spacing) if gain > 0.0 else _SHRINK * d
                )
        if sweep % 4 == 3:
            total, _ = curve_cost(scene, points, 0, n - 1)
            if gained < _GAIN_SHARE * total:
                break
