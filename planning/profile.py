"""The best depth profile along a given horizontal path, in closed form and linear time.

Two envelopes do it. The lowest profile that keeps the floor and the pitch limits is the upper envelope
of cones standing on the path's least heights. Where a trough is tighter than the cost is worth, the
optimum bridges it: away from the bottom the Euler equation of ``(w + a h) sqrt(1 + z'^2)`` gives
``z'' = a / w``, so the best profile is the smallest majorant with ``z'' <= a / w``, which is the upper
concave hull of ``z - a s^2 / 2 w`` (docs/planning.md).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from planning.currents import through_water


@njit(cache=True)
def cone_envelope(s, lower, n, slope_up, slope_down, z):  # type: ignore[no-untyped-def]
    """Fill `z` with the least profile >= lower that climbs and dives no steeper than allowed."""
    z[0] = lower[0]
    for i in range(1, n):
        z[i] = max(lower[i], z[i - 1] - slope_down * (s[i] - s[i - 1]))
    for i in range(n - 2, -1, -1):
        z[i] = max(z[i], z[i + 1] - slope_up * (s[i + 1] - s[i]))


@njit(cache=True)
def bridge_troughs(s, z, upper, n, bend, stack):  # type: ignore[no-untyped-def]
    """Raise `z` to its smallest majorant with second derivative <= bend, below `upper`.

    A trough whose bridge would break the ceiling is left as it is.
    """
    if bend <= 0.0 or n < 3:
        return
    top = 0
    for i in range(n):
        q_i = z[i] - 0.5 * bend * s[i] * s[i]
        while top >= 2:
            a, b = stack[top - 2], stack[top - 1]
            q_a = z[a] - 0.5 * bend * s[a] * s[a]
            q_b = z[b] - 0.5 * bend * s[b] * s[b]
            if (q_b - q_a) * (s[i] - s[a]) <= (q_i - q_a) * (s[b] - s[a]):
                top -= 1
            else:
                break
        stack[top] = i
        top += 1
    for m in range(top - 1):
        a, b = stack[m], stack[m + 1]
        if b == a + 1:
            continue
        run = s[b] - s[a]
        fits = True
        for i in range(a + 1, b):
            v = (s[i] - s[a]) / run
            bridge = z[a] + v * (z[b] - z[a]) - 0.5 * bend * (s[i] - s[a]) * (s[b] - s[i])
            if bridge > upper[i]:
                fits = False
                break
        if fits:
            for i in range(a + 1, b):
                v = (s[i] - s[a]) / run
                bridge = z[a] + v * (z[b] - z[a]) - 0.5 * bend * (s[i] - s[a]) * (s[b] - s[i])
                z[i] = max(z[i], bridge)


@njit(cache=True)
def sample_stack(stack, width, height, x, y):  # type: ignore[no-untyped-def]
    """Return bilinear (lower, bottom, weight, bar) at local (x, y); outside, bar grows."""
    rows, cols = stack.shape[0], stack.shape[1]
    col, row = x / width, y / height
    outside = 0.0
    if col < 0.0:
        outside -= col * width
        col = 0.0
    elif col > cols - 1:
        outside += (col - cols + 1) * width
        col = cols - 1.0
    if row < 0.0:
        outside -= row * height
        row = 0.0
    elif row > rows - 1:
        outside += (row - rows + 1) * height
        row = rows - 1.0
    c0, r0 = int(col), int(row)
    c1, r1 = min(c0 + 1, cols - 1), min(r0 + 1, rows - 1)
    fc, fr = col - c0, row - r0
    w00, w01 = (1.0 - fr) * (1.0 - fc), (1.0 - fr) * fc
    w10, w11 = fr * (1.0 - fc), fr * fc
    a, b, c, d = stack[r0, c0], stack[r0, c1], stack[r1, c0], stack[r1, c1]
    return (
        w00 * a[0] + w01 * b[0] + w10 * c[0] + w11 * d[0],
        w00 * a[1] + w01 * b[1] + w10 * c[1] + w11 * d[1],
        w00 * a[2] + w01 * b[2] + w10 * c[2] + w11 * d[2],
        w00 * a[3] + w01 * b[3] + w10 * c[3] + w11 * d[3] + outside,
    )


@njit(cache=True)
def _drift(stack, width, height, x, y):  # type: ignore[no-untyped-def]
    """Return the current of the nearest cell at local (x, y): fields of currents are smooth."""
    r = min(max(round(y / height), 0), stack.shape[0] - 1)
    c = min(max(round(x / width), 0), stack.shape[1] - 1)
    return stack[r, c, 4], stack[r, c, 5]


@njit(cache=True)
def water_per_ground(stack, width, height, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Return metres of water per metre of ground between two local positions; 1 without a current."""
    if stack.shape[2] < 6:
        return 1.0
    ux, uy = _drift(stack, width, height, 0.5 * (x0 + x1), 0.5 * (y0 + y1))
    return through_water(x1 - x0, y1 - y0, ux, uy)


# Price of breaking a limit while the search is still on its way to keeping it, per metre of path and
# metre of excess: far above any honest cost density, so that the optimum breaks nothing.
EXCESS_PRICE = 50.0
BAR_PRICE = 100.0


@njit(cache=True)
def path_cost(stack, width, height, px, py, n, rules, work, hull):  # type: ignore[no-untyped-def]
    """Return (cost, breach) of the path with its best profile.

    Parameters
    ----------
    px, py : (>= n,) local coordinates of the samples.
    rules : (9,) price a, slope up, slope down, floor, ceiling, least height, top, margin, price of
        excess over the ceiling.
    work : (>= n, 6) scratch; on return column 0 holds the distance, column 3 the heights.
    hull : (>= n,) integer scratch.

    Returns
    -------
    cost : with the prices of breaches in it.
    breach : the integral of ceiling excess and barred depth alone; 0 for an allowed path.
    """
    a, up, down = rules[0], rules[1], rules[2]
    s, lower, upper, z = work[:, 0], work[:, 1], work[:, 2], work[:, 3]
    density = work[:, 4]
    mean_w = 0.0
    bar_total = 0.0
    s[0] = 0.0
    for i in range(n):
        lo, bottom, w, bar = sample_stack(stack, width, height, px[i], py[i])
        lower[i] = max(lo, rules[5]) + rules[7]
        upper[i] = min(bottom + rules[4], rules[6]) - rules[7]
        density[i] = w - a * (bottom + rules[3])
        mean_w += w
        if i > 0:
            s[i] = s[i - 1] + math.hypot(px[i] - px[i - 1], py[i] - py[i - 1])
            bar_total += bar * (s[i] - s[i - 1])
        else:
            bar_total += bar
    cone_envelope(s, lower, n, up, down, z)
    bridge_troughs(s, z, upper, n, a * n / mean_w, hull)
    cost = 0.0
    excess_total = 0.0
    for i in range(1, n):
        ds = s[i] - s[i - 1]
        dz = z[i] - z[i - 1]
        # density + a z is w + a (altitude - floor), never below w since z >= bottom + floor.
        rate = 0.5 * (density[i] + density[i - 1] + a * (z[i] + z[i - 1]))
        rate *= water_per_ground(stack, width, height, px[i - 1], py[i - 1], px[i], py[i])
        cost += rate * math.sqrt(ds * ds + dz * dz)
        excess_total += max(0.0, z[i] - upper[i]) * ds
    return (
        cost + rules[8] * excess_total + BAR_PRICE * bar_total,
        excess_total + bar_total,
    )


def make_work(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return scratch for `path_cost` of up to n samples."""
    return np.empty((n, 6)), np.empty(n, np.int64)
