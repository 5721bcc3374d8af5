"""Echo of one bump or pit on a flat floor: the model whose shadow and shading are fitted to an object.

A smooth hill's shadow starts below its summit, a box's at its far edge, a crater's end bounds its depth from
below: each relation has its own bias. One family covers them: elliptic generalised Gaussians
``z = A exp(-(q^beta) / 2)``, ``q = (x-x0)^2/sx^2 + (y-y0)^2/sy^2``: beta 1 is a Gaussian, 2 about a half
sphere, 6 a flat top with steep walls; A < 0 a crater. Facets along each ping's line are lit or hidden
by the ray geometry and summed into slant bins (Lambert), relative to the flat floor.

The profile and the law of incidence are powers, which cost more than all the rest of a facet: each set of
parameters tabulates them once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

# Parameters in the order of the vector: x0, y0, log|A|, log sx, log sy, log beta, log kappa; then the log level
# of the surroundings and its slopes over half the patch, across and along. Kappa is the exponent of the floor's
# angular law, cos^kappa of the incidence (Lambert: 2).
N_SHAPE, N_PARAMETERS = 7, 10

# The likelihood takes no mean for darker than this. At a shadow's true level one lit sample where the family
# of shapes has none would outweigh fifty that agree; dark enough is dark.
LEAST_MEAN = 0.15

# Steps of the tables of profile and incidence; linear between, to 1e-5 of the height.
_TABLE = 256


@njit(cache=True, nogil=True, error_model="numpy")
def predict(parameters, sign, corner, drop_m, along_m, start_m, step_m, leak, facet_m, out):  # type: ignore[no-untyped-def]
    """Fill `out` (n, m) with the mean echo per slant bin, 1 where the flat floor shows.

    Parameters
    ----------
    parameters : (7,) x0, y0, log|A|, log sx, log sy, log beta, log kappa (metres; x is ground range).
    sign : 1 hill, -1 crater.
    corner : exponent of the footprint's outline: 2 an ellipse, 4 a rectangle with rounded corners.
    drop_m, along_m : (n,) height of the sonar above the floor and place along the track, per ping.
    start_m, step_m : near edge of the first bin, width of a bin, slant.
    leak : level inside shadows.
    facet_m : ground length of a facet.
    """
    n, m = out.shape
    x0, y0 = parameters[0], parameters[1]
    sx, sy, beta = np.exp(parameters[3]), np.exp(parameters[4]), np.exp(parameters[5])
    kappa = np.exp(parameters[6])
    # The bump ends where it is 1/500 of its height; outside only its shadow remains.
    rho_end = 12.4 ** (0.5 / beta)
    profile, law = _tables(sign * np.exp(parameters[2]), beta, kappa, rho_end)
    for i in range(n):
        drop = drop_m[i]
        dy = abs(along_m[i] - y0) / sy
        for k in range(m):
            out[i, k] = 0.0
        x_low = x_high = 1e9
        if dy < rho_end:
            if corner == 2.0:
                half = sx * (rho_end**2 - dy**2) ** 0.5
            else:
                half = sx * (rho_end**corner - dy**corner) ** (1.0 / corner)
            x_low, x_high = max(x0 - half, 0.02 * drop), x0 + half
        if x_high <= x_low or x_low >= 1e8:
            for k in range(m):
                out[i, k] = 1.0 + leak
            continue
        resume = _trace(
            out[i],
            x_low,
            x_high,
            dy,
            x0,
            sx,
            corner,
            profile,
            rho_end,
            law,
            drop,
            start_m,
            step_m,
            facet_m,
        )
        r_low, r_resume = (
            (x_low * x_low + drop * drop) ** 0.5,
            (resume * resume + drop * drop) ** 0.5,
        )
        for k in range(m):
            near, far = start_m + k * step_m, start_m + (k + 1) * step_m
            floor = max(min(far, r_low) - near, 0.0) + max(far - max(near, r_resume), 0.0)
            if out[i, k] > 0.0:
                ray = 0.5 * (near + far)
                ground = max(ray * ray - drop * drop, 0.25 * step_m * step_m) ** 0.5
                # Flat floor: cos^kappa of the incidence times the ground length of a bin.
                out[i, k] /= _at(law, drop / ray * _TABLE) * step_m * ray / ground
            out[i, k] += min(floor / step_m, 1.0) + leak
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _tables(height, beta, kappa, rho_end):  # type: ignore[no-untyped-def]
    """Return the profile over radius (0 to `rho_end`) and cos^kappa over the cosine (0 to 1)."""
    profile, law = np.empty(_TABLE + 2), np.empty(_TABLE + 2)
    for j in range(_TABLE + 2):
        at = j / _TABLE
        profile[j] = height * np.exp(-0.5 * (at * rho_end) ** (2.0 * beta))
        law[j] = min(at, 1.0) ** kappa
    return profile, law


@njit(cache=True, nogil=True, error_model="numpy")
def _at(table, place):  # type: ignore[no-untyped-def]
    """Interpolate a table at a place within it."""
    low = min(int(place), _TABLE)
    return table[low] + (place - low) * (table[low + 1] - table[low])


@njit(cache=True, nogil=True, error_model="numpy")
def _height(x, dy, x0, sx, corner, profile, rho_end):  # type: ignore[no-untyped-def]
    u = abs(x - x0) / sx
    if corner == 2.0:
        rho = (u * u + dy * dy) ** 0.5
    else:
        # A fourth root is two square roots; a general power would cost more than all the rest.
        u2, v2 = u * u, dy * dy
        rho = ((u2 * u2 + v2 * v2) ** 0.5) ** 0.5
    return _at(profile, rho / rho_end * _TABLE)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(  # type: ignore[no-untyped-def]
    row, x_low, x_high, dy, x0, sx, corner, profile, rho_end, law, drop, start_m, step_m, facet_m
):
    """Sum the lit facets of one line into `row`; return the ground range where the flat floor is lit again."""
    count = min(max(int((x_high - x_low) / facet_m) + 1, 16), 140)
    dx = (x_high - x_low) / count
    x_before, z_before = x_low, _height(x_low, dy, x0, sx, corner, profile, rho_end)
    r_before = (x_before * x_before + (drop - z_before) ** 2) ** 0.5
    # Tangent of the elevation angle; the largest so far hides all below it.
    horizon = min((z_before - drop) / x_before, -drop / x_before)
    over_before = 0.0
    for j in range(1, count + 1):
        x = x_low + j * dx
        z = _height(x, dy, x0, sx, corner, profile, rho_end)
        r = (x * x + (drop - z) ** 2) ** 0.5
        tangent = (z - drop) / x
        over = tangent - horizon
        seen = 1.0
        if over < 0.0:
            seen = 0.0
        elif over_before < 0.0:
            # Only the facet's part above the ray is lit.
            seen = over / (over - over_before)
        if over > 0.0:
            horizon = tangent
        if seen > 0.0:
            dz = z - z_before
            xm, dm = 0.5 * (x + x_before), drop - 0.5 * (z + z_before)
            length = (dx * dx + dz * dz) ** 0.5
            cosine = (dm * dx + xm * dz) / (length * (xm * xm + dm * dm) ** 0.5)
            if cosine > 0.0:
                energy = seen * _at(law, min(cosine, 1.0) * _TABLE) * length
                _deposit(row, r_before, r, energy, start_m, step_m)
        x_before, z_before, r_before = x, z, r
        over_before = min(over, 0.0)
    return max(x_high, -drop / horizon if horizon < 0 else 1e9)


@njit(cache=True, nogil=True, error_model="numpy")
def _deposit(row, r_a, r_b, energy, start_m, step_m):  # type: ignore[no-untyped-def]
    """Spread a facet's energy evenly over the bins between its two ends' slant ranges."""
    low = (min(r_a, r_b) - start_m) / step_m
    high = (max(r_a, r_b) - start_m) / step_m
    m = len(row)
    if high <= 0.0 or low >= m:
        return
    span = high - low
    if span < 1e-6:
        k = int(low)
        if 0 <= k < m:
            row[k] += energy
        return
    k0, k1 = int(np.floor(low)), int(np.floor(high))
    for k in range(max(k0, 0), min(k1, m - 1) + 1):
        part = (min(high, k + 1.0) - max(low, float(k))) / span
        if part > 0:
            row[k] += energy * part


@njit(cache=True, nogil=True, error_model="numpy")
def _soft(mean, cap):  # type: ignore[no-untyped-def]
    """Compress means above 0.6 cap smoothly: a hard cut would leave the fit no slope to climb."""
    bend = 0.6 * cap
    if mean <= bend:
        return mean
    return bend + bend * (1.0 - np.exp(-(mean - bend) / bend))


@njit(cache=True, nogil=True, error_model="numpy")
def _surroundings(parameters, n, m):  # type: ignore[no-untyped-def]
    """Return the level (n, m) of the floor around the object: albedo that the gain has not followed."""
    level = np.empty((n, m))
    for i in range(n):
        row = parameters[7] + parameters[9] * (2.0 * i / max(n - 1, 1) - 1.0)
        for k in range(m):
            level[i, k] = np.exp(row + parameters[8] * (2.0 * k / max(m - 1, 1) - 1.0))
    return level


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(  # type: ignore[no-untyped-def]
    parameters,
    sign,
    corner,
    drop_m,
    along_m,
    start_m,
    step_m,
    leak,
    facet_m,
    cap,
    base,
    around,
    mean,
):
    """Return the derivatives (10, n, m) of the mean by every parameter."""
    n, m = base.shape
    slopes = np.empty((N_PARAMETERS, n, m))
    moved = parameters.copy()
    for p in range(N_SHAPE):
        # Half a facet of position, or 2 % of a logarithm: smooth over the facets' own steps.
        h = 0.5 * facet_m if p < 2 else 0.02
        moved[p] = parameters[p] + h
        predict(moved, sign, corner, drop_m, along_m, start_m, step_m, leak, facet_m, slopes[p])
        moved[p] = parameters[p]
        for i in range(n):
            for k in range(m):
                if slopes[p, i, k] == base[i, k]:
                    slopes[p, i, k] = 0.0
                else:
                    after = max(_soft(slopes[p, i, k] * around[i, k], cap), LEAST_MEAN)
                    slopes[p, i, k] = (after - mean[i, k]) / h
    for i in range(n):
        for k in range(m):
            by_level = 0.0
            if mean[i, k] > LEAST_MEAN:
                by_level = (_soft(base[i, k] * around[i, k] * 1.02, cap) - mean[i, k]) / 0.02
            slopes[7, i, k] = by_level
            slopes[8, i, k] = by_level * (2.0 * k / max(m - 1, 1) - 1.0)
            slopes[9, i, k] = by_level * (2.0 * i / max(n - 1, 1) - 1.0)
    return slopes


@njit(cache=True, nogil=True, error_model="numpy")
def fisher_step(  # type: ignore[no-untyped-def]
    parameters, sign, corner, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
):
    """Return the log likelihood, its gradient (10,) and Fisher information (10, 10) of one patch.

    Samples are Gamma with the model's mean; data above `cap` are censored and the mean is compressed
    there, so the strength of a highlight (the object's own reflectivity) says little beyond "bright".
    `weight` is looks times the independent part of the samples; NaN samples say nothing.
    """
    n, m = ratio.shape
    base = np.empty((n, m))
    predict(parameters, sign, corner, drop_m, along_m, start_m, step_m, leak, facet_m, base)
    around = _surroundings(parameters, n, m)
    mean = np.empty((n, m))
    for i in range(n):
        for k in range(m):
            mean[i, k] = max(_soft(base[i, k] * around[i, k], cap), LEAST_MEAN)
    slopes = _slopes(
        parameters, sign, corner, drop_m, along_m, start_m, step_m, leak, facet_m, cap, base, around, mean
    )  # fmt: skip
    value = 0.0
    gradient = np.zeros(N_PARAMETERS)
    information = np.zeros((N_PARAMETERS, N_PARAMETERS))
    for i in range(n):
        for k in range(m):
            e = ratio[i, k]
            if np.isnan(e):
                continue
            mu = mean[i, k]
            # A datum above the cap is censored: it says "more than the cap" and no more.
            if e < cap:
                value -= weight * (e / mu + np.log(mu))
                pull = weight * (e - mu) / (mu * mu)
            else:
                value -= weight * cap / mu
                pull = weight * cap / (mu * mu)
            for p in range(N_PARAMETERS):
                s = slopes[p, i, k]
                if s == 0.0:
                    continue
                gradient[p] += pull * s
                for o in range(p + 1):
                    information[p, o] += weight * s * slopes[o, i, k] / (mu * mu)
    for p in range(N_PARAMETERS):
        for o in range(p):
            information[o, p] = information[p, o]
    return value, gradient, information


@njit(cache=True, nogil=True, error_model="numpy")
def log_likelihood(  # type: ignore[no-untyped-def]
    parameters, sign, corner, ratio, drop_m, along_m, start_m, step_m, leak, facet_m, cap, weight
):
    """Return the log likelihood of one patch, as `fisher_step` has it."""
    n, m = ratio.shape
    base = np.empty((n, m))
    predict(parameters, sign, corner, drop_m, along_m, start_m, step_m, leak, facet_m, base)
    around = _surroundings(parameters, n, m)
    value = 0.0
    for i in range(n):
        for k in range(m):
            e = ratio[i, k]
            if np.isnan(e):
                continue
            mu = max(_soft(base[i, k] * around[i, k], cap), LEAST_MEAN)
            value -= weight * (e / mu + np.log(mu) if e < cap else cap / mu)
    return value
