"""Shading: what a surface should have echoed, ray by ray, against what came back.

A ray is one line of echoes (pings close together, stacked) on one side. The surface under it is cut
into facets; each visible facet sends ``cos(incidence)^n`` times its length into the slant ranges it
covers, and facets at the same range add up (layover). The log of observed over predicted power,
averaged per cell of the map, is the datum; its derivative by the surface is taken *at fixed slant
range*, since that is where the echo was recorded:

    ln I(r) = G(phi) + T(r) + ln mu + h(t),   t = r dphi/dr = tan(grazing),
    h(t) = n ln t - (n - 1)/2 ln(1 + t^2)

with phi the ray's angle from the vertical. A height change dz at a point of ground range g, drop d
and outward slope p turns its ray by ``dz / (g - d p)``; hence the two coefficients of a datum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from perception.rays import Rays
from perception.records import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Rows:
    """Data of the linear problem: one row per look and cell.

    Attributes
    ----------
    cell : index of the dual cell (the square between four nodes).
    c_east, c_north, c_level : derivative of the log power by the surface's gradient and height there.
    ratio : log of observed over predicted power.
    ground_m, drop_m, slope : mean geometry of the facets (g, d, p above).
    angle_rad : angle from the sonar's nadir in its rolled frame; `slant_m` the slant range.
    share : part of the echo that is the cell's own (less than 1 under layover).
    samples : number of echo samples averaged.
    side, look : where the row comes from.
    """

    cell: IntArray
    c_east: FloatArray
    c_north: FloatArray
    c_level: FloatArray
    ratio: FloatArray
    ground_m: FloatArray
    drop_m: FloatArray
    slope: FloatArray
    angle_rad: FloatArray
    slant_m: FloatArray
    share: FloatArray
    samples: FloatArray
    side: IntArray
    look: IntArray


# Columns of the sums that `trace_rays` fills, after the weight itself.
_COLUMNS = (
    "c_east", "c_north", "c_level", "ratio", "ground_m", "drop_m", "slope", "angle_rad", "slant_m",
    "share",
)  # fmt: skip
# Facets are half a cell long: shorter ones see no more of a surface that is bilinear between nodes.
_FACETS_PER_CELL = 2
# Least tangent of the grazing angle that a prediction may have: the model of power fails in grazing.
_LEAST_TANGENT = 0.02


def trace(
    surface: FloatArray,
    west_m: float,
    south_m: float,
    cell_m: float,
    rays: Sequence[Rays],
    exponent: float,
    dark: Sequence[BoolArray],
) -> tuple[Rows, BoolArray]:
    """Compare all rays' echoes with what the surface should have echoed.

    Parameters
    ----------
    surface : (rows, cols) heights of the nodes, south to north; node (0, 0) at (west_m, south_m).
    exponent : n of the angle law ``cos(incidence)^n``.
    dark : per rays (n, m) True where the sample is shadow and tells nothing of slope.

    Returns
    -------
    Rows
        One row per look and dual cell that echoed.
    (rows - 1, cols - 1) array
        True where a ray passed, lit or in shadow.
    """
    rows, cols = surface.shape
    sums = np.zeros(((rows - 1) * (cols - 1), len(_COLUMNS) + 1))
    passed = np.zeros((rows - 1) * (cols - 1), np.bool_)
    parts: dict[str, list[npt.NDArray[Any]]] = {
        name: [] for name in (*_COLUMNS, "cell", "samples", "side", "look")
    }
    for ray, hidden in zip(rays, dark, strict=True):
        sums[:] = 0.0
        trace_rays(
            surface, west_m, south_m, cell_m, ray.easting_m, ray.northing_m, ray.up_m,
            ray.azimuth_rad, ray.tilt_rad, ray.power, ray.sample_m, exponent,
            cell_m / _FACETS_PER_CELL, _LEAST_TANGENT, hidden, sums, passed,
        )  # fmt: skip
        cell = np.flatnonzero(sums[:, 0] > 0)
        weight = sums[cell, 0]
        for column, name in enumerate(_COLUMNS, start=1):
            parts[name].append((sums[cell, column] / weight).astype(np.float32))
        parts["cell"].append(cell)
        parts["samples"].append(weight.astype(np.float32))
        parts["side"].append(np.full(len(cell), ray.side, np.int8))
        parts["look"].append(np.full(len(cell), ray.look, np.int16))
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    return Rows(**joined), passed.reshape(rows - 1, cols - 1)


@njit(cache=True)
def trace_rays(  # type: ignore[no-untyped-def]
    z, west, south, cell, east, north, up, azimuth, tilt, power, sample_m, exponent, step, floor,
    dark, sums, passed,
):  # fmt: skip
    """Add the facets of all rays to `sums` (dual cells, weight and `_COLUMNS`), mark `passed`."""
    n, m = power.shape
    rows, cols = z.shape
    n_max = 0
    for i in range(n):
        n_max = max(n_max, int(m * sample_m[i] / step) + 2)
    zed = np.empty(n_max)
    phi = np.empty(n_max)
    slant = np.empty(n_max)
    begin = np.empty(n_max)
    energy = np.empty(n_max)
    predicted = np.empty(m + 1)
    observed = np.empty(m + 1)
    known = np.empty(m + 1)
    for i in range(n):
        ds = sample_m[i]
        ux = np.sin(azimuth[i])
        uy = np.cos(azimuth[i])
        r_max = m * ds
        last = 0
        for j in range(n_max):
            g = (j + 0.5) * step
            x = (east[i] + ux * g - west) / cell
            y = (north[i] + uy * g - south) / cell
            c = int(np.floor(x))
            r = int(np.floor(y))
            if c < 0 or r < 0 or c >= cols - 1 or r >= rows - 1:
                break
            fx = x - c
            fy = y - r
            zed[j] = (1 - fy) * ((1 - fx) * z[r, c] + fx * z[r, c + 1]) + fy * (
                (1 - fx) * z[r + 1, c] + fx * z[r + 1, c + 1]
            )
            d = up[i] - zed[j]
            if d < 0.05 * step:
                break
            slant[j] = np.sqrt(g * g + d * d)
            phi[j] = np.arctan2(g, d)
            last = j + 1
            passed[r * (cols - 1) + c] = True
            if slant[j] >= r_max:
                break
        if last < 3:
            continue
        for k in range(m + 1):
            predicted[k] = 0.0
        observed[0] = 0.0
        known[0] = 0.0
        for k in range(m):
            v = power[i, k]
            observed[k + 1] = observed[k] + (np.sqrt(v) if v >= 0 else 0.0)
            known[k + 1] = known[k] + (1.0 if v >= 0 else 0.0)
        top = phi[0]
        for j in range(last - 1):
            begin[j] = -1.0
            if phi[j + 1] <= top:
                continue
            f = 1.0
            if phi[j] < top:
                f = (phi[j + 1] - top) / (phi[j + 1] - phi[j])
            begin[j] = 1.0 - f
            top = phi[j + 1]
            p = (zed[j + 1] - zed[j]) / step
            g = (j + 1) * step
            d = up[i] - 0.5 * (zed[j] + zed[j + 1])
            s = np.sqrt(1 + p * p)
            cosine = (d + g * p) / (np.sqrt(g * g + d * d) * s)
            if cosine <= 0:
                begin[j] = -1.0
                continue
            energy[j] = cosine**exponent * s * step * f
            ra = slant[j] + (1 - f) * (slant[j + 1] - slant[j])
            rb = slant[j + 1]
            if rb < ra:
                ra, rb = rb, ra
            if rb - ra < ds:
                mid = 0.5 * (ra + rb)
                ra = mid - 0.5 * ds
                rb = mid + 0.5 * ds
            density = energy[j] / (rb - ra)
            k0 = int(ra / ds)
            k1 = int(rb / ds)
            for k in range(max(k0, 0), min(k1, m - 1) + 1):
                a = max(ra, k * ds)
                b = min(rb, (k + 1) * ds)
                if b > a:
                    predicted[k + 1] += density * (b - a)
        for k in range(m):
            predicted[k + 1] = predicted[k] + np.sqrt(predicted[k + 1] / ds)
        for j in range(last - 1):
            if begin[j] < 0:
                continue
            f = 1.0 - begin[j]
            ra = slant[j] + (1 - f) * (slant[j + 1] - slant[j])
            rb = slant[j + 1]
            if rb < ra:
                ra, rb = rb, ra
            if rb - ra < ds:
                mid = 0.5 * (ra + rb)
                ra = mid - 0.5 * ds
                rb = mid + 0.5 * ds
            if ra < 0 or rb >= r_max:
                continue
            ka = ra / ds
            kb = rb / ds
            ia = int(ka)
            ib = int(kb)
            fa = ka - ia
            fb = kb - ib
            obs = (observed[ib] + fb * (observed[ib + 1] - observed[ib])
                   - observed[ia] - fa * (observed[ia + 1] - observed[ia]))  # fmt: skip
            pre = (predicted[ib] + fb * (predicted[ib + 1] - predicted[ib])
                   - predicted[ia] - fa * (predicted[ia + 1] - predicted[ia]))  # fmt: skip
            num = (known[ib] + fb * (known[ib + 1] - known[ib])
                   - known[ia] - fa * (known[ia + 1] - known[ia]))  # fmt: skip
            if num < 0.9 * (kb - ka) or pre <= 0 or dark[i, (ia + ib) // 2]:
                continue
            p = (zed[j + 1] - zed[j]) / step
            g = (j + 1) * step
            d = up[i] - 0.5 * (zed[j] + zed[j + 1])
            r2 = g * g + d * d
            lever = g - d * p
            if lever < 0.2 * g:
                continue
            t = (d + g * p) / lever
            if t < floor:
                t = floor
            width = kb - ka
            share = min(energy[j] / (rb - ra) / (pre / width) ** 2, 1.0)
            slope_h = exponent / t - (exponent - 1) * t / (1 + t * t)
            ratio = 2 * np.log(max(obs, 1e-3 * floor * pre) / pre)
            weight = num * f
            c = int(np.floor((east[i] + ux * g - west) / cell))
            r = int(np.floor((north[i] + uy * g - south) / cell))
            if c < 0 or r < 0 or c >= cols - 1 or r >= rows - 1:
                continue
            q = r * (cols - 1) + c
            cs = share * slope_h * r2 / (lever * lever)
            # A floor that rises meets the same ranges nearer, where it slopes otherwise: how echoes of
            # one feature from two sides tell its height.
            bend = 0.0
            if j >= 2 and j + 3 < last:
                bend = (zed[j + 3] - zed[j + 2] - zed[j - 1] + zed[j - 2]) / (4 * step * step)
            c0 = -share * slope_h * r2 * (1 + p * p - d * bend) / (lever * lever * lever)
            sums[q, 0] += weight
            sums[q, 1] += weight * cs * ux
            sums[q, 2] += weight * cs * uy
            sums[q, 3] += weight * c0
            sums[q, 4] += weight * ratio
            sums[q, 5] += weight * g
            sums[q, 6] += weight * d
            sums[q, 7] += weight * p
            sums[q, 8] += weight * (np.arctan2(g, d) + tilt[i])
            sums[q, 9] += weight * np.sqrt(r2)
            sums[q, 10] += weight * share
