"""Echo of one bump or pit on a flat floor: the model whose shadow and shading are fitted to an object.

A smooth hill's shadow starts below its summit, a box's at its far edge, a crater's end bounds its depth from
below: each relation has its own bias. One family covers them: elliptic generalised Gaussians
``z = A exp(-(q^beta) / 2)``, ``q = (x-x0)^2/sx^2 + (y-y0)^2/sy^2``: beta 1 is a Gaussian, 2 about a half
sphere, 6 a flat top with steep walls; A < 0 a crater. Facets along each ping's line are lit or hidden
by the ray geometry and summed into slant bins (Lambert), relative to the flat floor.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Parameters in the order of the vector: x0, y0, log|A|, log sx, log sy, log beta.
N_PARAMETERS = 6


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def predict(parameters, sign, drop_m, along_m, start_m, step_m, leak, facet_m, out):  # type: ignore[no-untyped-def]
    """Fill `out` (n, m) with the mean echo per slant bin, 1 where the flat floor shows.

    Parameters
    ----------
    parameters : (6,) x0, y0, log|A|, log sx, log sy, log beta (metres; x is ground range).
    sign : 1 hill, -1 crater.
    drop_m, along_m : (n,) height of the sonar above the floor and place along the track, per ping.
    start_m, step_m : near edge of the first bin, width of a bin, slant.
    leak : level inside shadows.
    facet_m : ground length of a facet.
    """
    n, m = out.shape
    x0, y0 = parameters[0], parameters[1]
    height = sign * np.exp(parameters[2])
    sx, sy, beta = np.exp(parameters[3]), np.exp(parameters[4]), np.exp(parameters[5])
    stop_m = start_m + m * step_m
    for i in range(n):
        drop = drop_m[i]
        for k in range(m):
            out[i, k] = 0.0
        dy = ((along_m[i] - y0) / sy) ** 2
        # Facets begin before the patch: a hill nearer in casts its shadow into it, layover reaches out of it.
        near = max(start_m * start_m - drop * drop, 0.0) ** 0.5
        far = max(stop_m * stop_m - drop * drop, 0.01) ** 0.5
        x_low = max(near - 0.5 * facet_m - max(height, 0.0) * drop / max(near, drop), 0.01)
        x_high = far + max(-height, 0.0) * drop / max(far, drop) + facet_m
        count = int((x_high - x_low) / facet_m) + 1
        x_before = x_low
        z_before = _height(x_before, dy, x0, sx, height, beta)
        r_before = (x_before * x_before + (drop - z_before) ** 2) ** 0.5
        # Elevation angle's tangent; the largest so far hides all below it.
        horizon = (z_before - drop) / x_before
        over_before = 0.0
        for j in range(1, count + 1):
            x = x_low + j * facet_m
            z = _height(x, dy, x0, sx, height, beta)
            r = (x * x + (drop - z) ** 2) ** 0.5
            tangent = (z - drop) / x
            over = tangent - horizon
            seen = 1.0
            if over < 0.0:
                # The facet's part before the horizon is crossed.
                seen = 0.0
                if over_before >= 0.0 and over_before - over > 0:
                    seen = over_before / (over_before - over)
            elif over_before < 0.0:
                seen = over / (over - over_before)
            if over > 0.0:
                horizon = tangent
            if seen > 0.0:
                dx, dz = x - x_before, z - z_before
                xm, dm = 0.5 * (x + x_before), drop - 0.5 * (z + z_before)
                length = (dx * dx + dz * dz) ** 0.5
                ray = (xm * xm + dm * dm) ** 0.5
                cosine = (dm * dx + xm * dz) / (length * ray)
                if cosine > 0.0:
                    _deposit(out, i, r_before, r, seen * cosine * cosine * length, start_m, step_m)
            x_before, z_before, r_before = x, z, r
            over_before = min(over, 0.0) if over < 0.0 else 0.0
        for k in range(m):
            ray = start_m + (k + 0.5) * step_m
            ground = max(ray * ray - drop * drop, 0.25 * step_m * step_m) ** 0.5
            # Flat floor: cos^2 of incidence times the ground length of a bin.
            flat = (drop / ray) ** 2 * step_m * ray / ground
            out[i, k] = out[i, k] / flat + leak
    return out


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def _height(x, dy, x0, sx, height, beta):  # type: ignore[no-untyped-def]
    q = ((x - x0) / sx) ** 2 + dy
    if q <= 1e-12:
        return height
    power = q**beta
    if power > 60.0:
        return 0.0
    return height * np.exp(-0.5 * power)


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def _deposit(out, i, r_a, r_b, energy, start_m, step_m):  # type: ignore[no-untyped-def]
    """Spread a facet's energy evenly over the bins between its two ends' slant ranges."""
    low = (min(r_a, r_b) - start_m) / step_m
    high = (max(r_a, r_b) - start_m) / step_m
    m = out.shape[1]
    if high <= 0.0 or low >= m:
        return
    span = high - low
    if span < 1e-6:
        k = int(low)
        if 0 <= k < m:
            out[i, k] += energy
        return
    k0, k1 = int(np.floor(low)), int(np.floor(high))
    for k in range(max(k0, 0), min(k1, m - 1) + 1):
        part = (min(high, k + 1.0) - max(low, float(k))) / span
        if part > 0:
            out[i, k] += energy * part


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def _soft(mean, cap):  # type: ignore[no-untyped-def]
    """Compress a mean above 1 smoothly towards `cap`: a hard cut would leave the fit no slope to climb."""
    if mean <= 1.0:
        return mean
    return 1.0 + (cap - 1.0) * (1.0 - np.exp(-(mean - 1.0) / (cap - 1.0)))


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def fisher_step(
    parameters, sign, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
):  # type: ignore[no-untyped-def]
    """Return the log likelihood, its gradient (6,) and Fisher information (6, 6) of one patch.

    Samples are Gamma with the model's mean, compressed above nominal to at most `cap`, and data are cut
    to the cap, so the strength of a highlight (the object's own reflectivity) says little beyond "bright".
    `weight` is looks times the independent part of the samples; NaN samples say nothing.
    """
    n, m = ratio.shape
    base = np.empty((n, m))
    predict(parameters, sign, drop_m, along_m, start_m, step_m, leak, facet_m, base)
    slopes = np.empty((N_PARAMETERS, n, m))
    moved = parameters.copy()
    for p in range(N_PARAMETERS):
        # Half a facet of position, or 2 % of a logarithm: smooth over the facets' own steps.
        h = 0.5 * facet_m if p < 2 else 0.02
        moved[p] = parameters[p] + h
        predict(moved, sign, drop_m, along_m, start_m, step_m, leak, facet_m, slopes[p])
        moved[p] = parameters[p]
        for i in range(n):
            for k in range(m):
                slopes[p, i, k] = (_soft(slopes[p, i, k], cap) - _soft(base[i, k], cap)) / h
    value = 0.0
    gradient = np.zeros(N_PARAMETERS)
    information = np.zeros((N_PARAMETERS, N_PARAMETERS))
    for i in range(n):
        for k in range(m):
            e = ratio[i, k]
            if np.isnan(e):
                continue
            e = min(e, cap)
            mu = max(_soft(base[i, k], cap), leak)
            value -= weight * (e / mu + np.log(mu))
            for p in range(N_PARAMETERS):
                s = slopes[p, i, k]
                if s == 0.0:
                    continue
                gradient[p] += weight * s * (e - mu) / (mu * mu)
                for o in range(p + 1):
                    information[p, o] += weight * s * slopes[o, i, k] / (mu * mu)
    for p in range(N_PARAMETERS):
        for o in range(p):
            information[o, p] = information[p, o]
    return value, gradient, information


@njit(cache=True)  # type: ignore[untyped-decorator, unused-ignore]
def log_likelihood(
    parameters, sign, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
):  # type: ignore[no-untyped-def]
    """Return the log likelihood of one patch, as `fisher_step` has it."""
    n, m = ratio.shape
    base = np.empty((n, m))
    predict(parameters, sign, drop_m, along_m, start_m, step_m, leak, facet_m, base)
    value = 0.0
    for i in range(n):
        for k in range(m):
            e = ratio[i, k]
            if not np.isnan(e):
                mu = max(_soft(base[i, k], cap), leak)
                value -= weight * (min(e, cap) / mu + np.log(mu))
    return value
