"""Echoes of a surface along rays, facet by facet: the kernels of `perception.shading`.

Per ray: sample the surface, find the facets that the sonar sees, sum their predicted echoes by slant range, and
compare what each returns with what was recorded there.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def trace_rays(z, frame, window, rays, power, dark, law, weights, sums, passed):
    """Add the facets of all rays to `weights` and `sums` (cells of the window, columns), mark `passed`.

    Parameters
    ----------
    z : (rows, cols) nodes.
    frame : west, south, cell (metres).
    window : first row and column, rows and columns of the dual cells that `sums` and `passed` cover.
    rays : (6, n) easting, northing, height, azimuth, tilt, metres per sample.
    power, dark : (n, m).
    law : exponent, length of a facet, least tangent of grazing.
    """
    n, m = power.shape
    step = law[1]
    most = 0
    for i in range(n):
        most = max(most, int(m * rays[5, i] / step) + 2)
    height, angle, slant = np.empty(most), np.empty(most), np.empty(most)
    begin, energy = np.empty(most), np.empty(most)
    place = np.empty(most, np.int64)
    predicted, observed, known = np.empty(m + 1), np.empty(m + 1), np.empty(m + 1)
    for i in range(n):
        ray = rays[:, i]
        last = sample_surface(z, frame, window, ray, step, m * ray[5], height, angle, slant, place)
        for j in range(last):
            if place[j] >= 0:
                passed[place[j]] = True
        if last < 3:
            continue
        sum_echoes(power[i], observed, known)
        predict(ray, law, height, angle, slant, last, begin, energy, predicted)
        compare(
            ray, frame, window, law, height, slant, begin, energy, last, predicted, observed, known,
            dark[i], weights, sums,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def cell_at(x, y, window):
    """Return the place in the window of the dual cell at (column, row) of the nodes, -1 outside."""
    r, c = int(np.floor(y)) - window[0], int(np.floor(x)) - window[1]
    if r < 0 or c < 0 or r >= window[2] or c >= window[3]:
        return -1
    return r * window[3] + c


@njit(cache=True, nogil=True)
def sample_surface(z, frame, window, ray, step, reach, height, angle, slant, place):
    """Write height, angle from the vertical, slant range and cell of points along a ray; return their number."""
    rows, cols = z.shape
    ux, uy = np.sin(ray[3]), np.cos(ray[3])
    last = 0
    for j in range(len(height)):
        g = (j + 0.5) * step
        x = (ray[0] + ux * g - frame[0]) / frame[2]
        y = (ray[1] + uy * g - frame[1]) / frame[2]
        c, r = int(np.floor(x)), int(np.floor(y))
        if c < 0 or r < 0 or c >= cols - 1 or r >= rows - 1:
            break
        fx, fy = x - c, y - r
        height[j] = (1 - fy) * ((1 - fx) * z[r, c] + fx * z[r, c + 1]) + fy * (
            (1 - fx) * z[r + 1, c] + fx * z[r + 1, c + 1]
        )
        d = ray[2] - height[j]
        if d < 0.05 * step:
            break
        slant[j] = np.sqrt(g * g + d * d)
        angle[j] = np.arctan2(g, d)
        place[j] = cell_at(x, y, window)
        last = j + 1
        if slant[j] >= reach:
            break
    return last


@njit(cache=True, nogil=True)
def sum_echoes(power, observed, known):
    """Write the running sums of amplitude and of samples that are known."""
    observed[0] = 0.0
    known[0] = 0.0
    for k in range(len(power)):
        v = power[k]
        observed[k + 1] = observed[k] + (np.sqrt(v) if v >= 0 else 0.0)
        known[k + 1] = known[k] + (1.0 if v >= 0 else 0.0)


@njit(cache=True, nogil=True)
def extent(slant, j, begin, sample):
    """Return the slant ranges between which the lit part of facet j echoes: at least one sample wide."""
    near = slant[j] + begin * (slant[j + 1] - slant[j])
    far = slant[j + 1]
    if far < near:
        near, far = far, near
    if far - near < sample:
        middle = 0.5 * (near + far)
        near, far = middle - 0.5 * sample, middle + 0.5 * sample
    return near, far


@njit(cache=True, nogil=True)
def predict(ray, law, height, angle, slant, last, begin, energy, predicted):
    """Write each facet's energy, where its lit part begins (-1: unseen), and the running sum of amplitude."""
    step, sample = law[1], ray[5]
    m = len(predicted) - 1
    predicted[:] = 0.0
    top = angle[0]
    for j in range(last - 1):
        begin[j] = -1.0
        if angle[j + 1] <= top:
            continue
        lit = 1.0
        if angle[j] < top:
            lit = (angle[j + 1] - top) / (angle[j + 1] - angle[j])
        top = angle[j + 1]
        p = (height[j + 1] - height[j]) / step
        g = (j + 1) * step
        d = ray[2] - 0.5 * (height[j] + height[j + 1])
        s = np.sqrt(1 + p * p)
        cosine = (d + g * p) / (np.sqrt(g * g + d * d) * s)
        if cosine <= 0:
            continue
        begin[j] = 1.0 - lit
        energy[j] = cosine ** law[0] * s * step * lit
        near, far = extent(slant, j, begin[j], sample)
        density = energy[j] / (far - near)
        for k in range(max(int(near / sample), 0), min(int(far / sample), m - 1) + 1):
            width = min(far, (k + 1) * sample) - max(near, k * sample)
            if width > 0:
                predicted[k + 1] += density * width
    for k in range(m):
        predicted[k + 1] = predicted[k] + np.sqrt(predicted[k + 1] / sample)


@njit(cache=True, nogil=True)
def between(running, a, b):
    """Return what a running sum gained between two fractional places, up to its last."""
    # A range just short of the last sample's end may round to that end, behind which nothing is stored.
    most = len(running) - 2
    i, j = min(int(a), most), min(int(b), most)
    return (running[j] + (b - j) * (running[j + 1] - running[j])
            - running[i] - (a - i) * (running[i + 1] - running[i]))  # fmt: skip


@njit(cache=True, nogil=True)
def curvature(height, j, last, step):
    """Return how the slope changes along the ray at facet j, per metre, from the facets a cell before and after.

    A floor that rises meets the same ranges nearer, where it slopes otherwise: with this term echoes of one feature
    from two sides tell its height; without it maps of rough floors crept upwards.
    """
    if j < 2 or j + 3 >= last:
        return 0.0
    return (height[j + 3] - height[j + 2] - height[j - 1] + height[j - 2]) / (4 * step * step)


@njit(cache=True, nogil=True)
def compare(
    ray, frame, window, law, height, slant, begin, energy, last, predicted, observed, known, dark,
    weights, sums,
):  # fmt: skip
    """Add each lit facet's comparison to the sums of its cell."""
    exponent, step, floor = law
    sample = ray[5]
    ux, uy = np.sin(ray[3]), np.cos(ray[3])
    for j in range(last - 1):
        if begin[j] < 0:
            continue
        near, far = extent(slant, j, begin[j], sample)
        if near < 0 or far >= (len(predicted) - 1) * sample:
            continue
        a, b = near / sample, far / sample
        pre, num = between(predicted, a, b), between(known, a, b)
        if num < 0.9 * (b - a) or pre <= 0 or dark[(int(a) + int(b)) // 2]:
            continue
        p = (height[j + 1] - height[j]) / step
        g = (j + 1) * step
        d = ray[2] - 0.5 * (height[j] + height[j + 1])
        lever = g - d * p
        if lever < 0.2 * g:
            continue
        q = cell_at(
            (ray[0] + ux * g - frame[0]) / frame[2], (ray[1] + uy * g - frame[1]) / frame[2], window
        )
        if q < 0:
            continue
        r2 = g * g + d * d
        t = max((d + g * p) / lever, floor)
        share = min(energy[j] / (far - near) / (pre / (b - a)) ** 2, 1.0)
        bend = share * (exponent / t - (exponent - 1) * t / (1 + t * t)) * r2 / (lever * lever)
        ratio = 2 * np.log(max(between(observed, a, b), 1e-3 * floor * pre) / pre)
        weight = num * (1.0 - begin[j])
        weights[q] += weight
        line = sums[q]
        line[0] += weight * bend * ux
        line[1] += weight * bend * uy
        rise = 1 + p * p - d * curvature(height, j, last, step)
        line[2] -= weight * bend * rise / lever
        line[3] += weight * ratio
        line[4] += weight * g
        line[5] += weight * d
        line[6] += weight * p
        line[7] += weight * (np.arctan2(g, d) + ray[4])
        line[8] += weight * np.sqrt(r2)
        line[9] += weight * share
