"""Echo of one bump or pit on a flat floor: the model whose shadow and shading are fitted to an object.

A smooth hill's shadow starts below its summit, a box's at its far edge, a crater's end bounds its depth from
below: each relation has its own bias. Two families of profiles over ``q = (x-x0)^2/sx^2 + (y-y0)^2/sy^2`` cover them:

- generalised Gaussians ``z = A exp(-q^beta / 2)``: beta 1 is a Gaussian, 6 a flat top with steep walls;
- profiles that end, ``z = A (1 - q^(power/2))^beta``: power 2 a half sphere (beta 1/2), a paraboloid (1) or
  a cosine's bell (about 2), power 1 a cone;

A < 0 a crater. Facets along each ping's line are lit or hidden by the ray geometry and summed into slant bins
(Lambert), relative to the flat floor; a ping is the mean of rays across its horizontal beam, about the heading it had.

The profile and the law of incidence are powers, which cost more than all the rest of a facet: each set of
parameters tabulates them once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from perception.records import FloatArray

# Parameters in the order of the vector: x0, y0, log|A|, log sx, log sy, log beta, log kappa; then the log level
# of the surroundings and its slopes over half the patch, across and along. Kappa is the exponent of the floor's
# angular law, cos^kappa of the incidence (Lambert: 2).
N_SHAPE, N_PARAMETERS = 7, 10

# Steps of the tables of profile and incidence; linear between, to 1e-5 of the height.
_TABLE = 256
# Rays across the horizontal beam, in its standard deviations, and their parts (Gauss-Hermite, three points).
_RAYS, _PARTS = (-(3.0**0.5), 0.0, 3.0**0.5), (1 / 6, 2 / 3, 1 / 6)


class Form(NamedTuple):
    """What a fit does not move: kind, outline and family, numbers for the kernels' sake.

    `sign` 1 hill, -1 crater; `corner` exponent of the footprint's outline: 2 an ellipse, 4 a rectangle with
    rounded corners; `power` 0 a generalised Gaussian, else the power of a profile that ends.
    """

    sign: float
    corner: float
    power: float


class Scene(NamedTuple):
    """Where the sonar looks from, and the bins it hears in.

    `drop_m`, `along_m` (n,): height of the sonar above the floor and place along the track, per ping. `start_m`,
    `step_m`: near edge of the first bin, width of a bin, slant. `leak`: level inside shadows. `facet_m`: ground
    length of a facet. `yaw`: (n,) how far each ping looks ahead of square to the track (rad). `beam`: spread of the
    horizontal beam (1-sigma, rad); 0 looks along a line.
    """

    drop_m: FloatArray
    along_m: FloatArray
    start_m: float
    step_m: float
    leak: float
    facet_m: float
    yaw: FloatArray
    beam: float


@njit(cache=True, nogil=True, error_model="numpy")
def predict(parameters: FloatArray, form: Form, scene: Scene, out: FloatArray) -> FloatArray:
    """Fill `out` (n, m) with the mean echo per slant bin, 1 where the flat floor shows, and return it.

    `parameters`: (7,) or more, x0, y0, log|A|, log sx, log sy, log beta, log kappa (metres; x is ground range).
    """
    x0, y0 = parameters[0], parameters[1]
    sx, sy, beta = np.exp(parameters[3]), np.exp(parameters[4]), np.exp(parameters[5])
    # A Gaussian ends where it is 1/500 of its height; outside only its shadow remains.
    rho_end = 12.4 ** (0.5 / beta) if form.power == 0.0 else 1.0
    height = form.sign * np.exp(parameters[2])
    profile, law = _tables(height, beta, form.power, np.exp(parameters[6]), rho_end)
    ray = np.empty(out.shape[1])
    rays = len(_RAYS) if scene.beam > 0.0 else 1
    for i in range(out.shape[0]):
        out[i, :] = 0.0
        beside = 0.0
        for j in range(rays):
            part, bearing = 1.0, scene.yaw[i]
            if rays > 1:
                part, bearing = _PARTS[j], bearing + _RAYS[j] * scene.beam
            dy = abs(scene.along_m[i] + x0 * bearing - y0) / sy
            x_low = x_high = 0.0
            if dy < rho_end:
                half = sx * (rho_end**form.corner - dy**form.corner) ** (1.0 / form.corner)
                x_low, x_high = max(x0 - half, 0.02 * scene.drop_m[i]), x0 + half
            if x_high <= x_low:
                beside += part
                continue
            ray[:] = 0.0
            resume = _trace(
                ray, x_low, x_high, dy, x0, sx, form.corner, profile, rho_end, law,
                scene.drop_m[i], scene.start_m, scene.step_m, scene.facet_m,
            )  # fmt: skip
            _add_floor(ray, x_low, resume, law, scene.drop_m[i], scene)
            for k in range(len(ray)):
                out[i, k] += part * ray[k]
        if beside > 0.0:
            for k in range(len(ray)):
                out[i, k] += beside * (1.0 + scene.leak)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _add_floor(row, x_low, resume, law, drop, scene):  # type: ignore[no-untyped-def]
    """Turn the facets' energy of one line into power over nominal, and add the floor beside the object."""
    r_low, r_resume = (x_low**2 + drop**2) ** 0.5, (resume**2 + drop**2) ** 0.5
    step_m = scene.step_m
    for k in range(len(row)):
        near, far = scene.start_m + k * step_m, scene.start_m + (k + 1) * step_m
        floor = max(min(far, r_low) - near, 0.0) + max(far - max(near, r_resume), 0.0)
        if row[k] > 0.0:
            ray = 0.5 * (near + far)
            ground = max(ray * ray - drop * drop, 0.25 * step_m * step_m) ** 0.5
            # Flat floor: cos^kappa of the incidence times the ground length of a bin.
            row[k] /= _at(law, drop / ray * _TABLE) * step_m * ray / ground
        row[k] += min(floor / step_m, 1.0) + scene.leak


@njit(cache=True, nogil=True, error_model="numpy")
def _tables(height, beta, power, kappa, rho_end):  # type: ignore[no-untyped-def]
    """Return the profile over radius (0 to `rho_end`) and cos^kappa over the cosine (0 to 1)."""
    profile, law = np.empty(_TABLE + 2), np.empty(_TABLE + 2)
    for j in range(_TABLE + 2):
        at = j / _TABLE
        if power == 0.0:
            profile[j] = height * np.exp(-0.5 * (at * rho_end) ** (2.0 * beta))
        else:
            profile[j] = height * max(1.0 - at**power, 0.0) ** beta
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


def radius_at(part: float, log_beta: float, power: float) -> float:
    """Return the radius, in sizes, at which a profile has fallen to `part` (0 to 1) of its extreme."""
    beta = float(np.exp(log_beta))
    if power == 0.0:
        return float((-2 * np.log(part)) ** (0.5 / beta))
    return float((1 - part ** (1 / beta)) ** (1 / power))
