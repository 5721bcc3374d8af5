"""Terrains whose mean and Gaussian curvature are known exactly, to measure regions on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating[Any]]
Truth = dict[str, Array]
Formula = Callable[[Array, Array], Array]


def _curved(p: Array, q: Array, r: Array, s: Array, t: Array) -> tuple[Array, Array]:
    """Return H and K, written out here so that the truth owes nothing to what is measured."""
    w2 = 1 + p**2 + q**2
    mean = ((1 + q**2) * r - 2 * p * q * s + (1 + p**2) * t) / (2 * w2**1.5)
    return mean, (r * t - s**2) / w2**2


def bumps(n: int, rng: np.random.Generator, count: int = 60, relief_m: float = 31.0) -> Truth:
    """Return a sum of Gaussian bumps of 10 to 60 cells: heights `z`, exact `H` and `K`, (n, n) each."""
    x = np.arange(n) + 0.5
    sums = {name: np.zeros((n, n)) for name in "zpqrst"}
    for _ in range(count):
        (cx, cy), width, height = rng.uniform(0, n, 2), rng.uniform(10, 60), rng.uniform(-1, 1)
        u, v = (x - cx) / width, (cy - x) / width  # rows run south, y north
        g, h = np.exp(-(u**2) / 2), np.exp(-(v**2) / 2)
        g1, h1 = -u * g / width, -v * h / width
        g2, h2 = (u**2 - 1) * g / width**2, (v**2 - 1) * h / width**2
        parts = {"z": (h, g), "p": (h, g1), "q": (h1, g), "r": (h, g2), "s": (h1, g1), "t": (h2, g)}
        for name, (down, across) in parts.items():
            sums[name] += height * np.outer(down, across)
    z, p, q, r, s, t = (relief_m / np.ptp(sums["z"]) * sums[name] for name in "zpqrst")
    mean, gauss = _curved(p, q, r, s, t)
    return {"z": z, "H": mean, "K": gauss}


def of_formula(n: int, formula: Formula, relief_m: float | None) -> Truth:
    """Sample z = formula(x, y) and its curvature, differentiated a twentieth of a cell apart.

    Fourth-order differences of the formula itself: right to eight digits.
    """
    x, y = np.meshgrid(np.arange(n) + 0.5, n - 0.5 - np.arange(n))
    h = 0.05

    def f(i: int, j: int) -> Array:
        return formula(x + i * h, y + j * h)

    mid = f(0, 0)
    p = (8 * (f(1, 0) - f(-1, 0)) - (f(2, 0) - f(-2, 0))) / (12 * h)
    q = (8 * (f(0, 1) - f(0, -1)) - (f(0, 2) - f(0, -2))) / (12 * h)
    r = (16 * (f(1, 0) + f(-1, 0)) - f(2, 0) - f(-2, 0) - 30 * mid) / (12 * h**2)
    t = (16 * (f(0, 1) + f(0, -1)) - f(0, 2) - f(0, -2) - 30 * mid) / (12 * h**2)
    near = f(1, 1) + f(-1, -1) - f(1, -1) - f(-1, 1)
    far = f(2, 2) + f(-2, -2) - f(2, -2) - f(-2, 2)
    s = (16 * near - far) / (48 * h**2)
    factor = 1.0 if relief_m is None else relief_m / np.ptp(mid)
    mean, gauss = _curved(*(factor * d for d in (p, q, r, s, t)))
    return {"z": factor * mid, "H": mean, "K": gauss}


def spectrum(n: int, rng: np.random.Generator, exponent: float, relief_m: float = 31.0) -> Truth:
    """Return terrain of power f^-exponent, fading at 8 cells, differentiated in the spectrum."""
    from scipy import fft

    m = 2 * n  # twice as wide: the part shown does not repeat
    fx = 2 * np.pi * fft.rfftfreq(m)[None]
    fy = 2 * np.pi * fft.fftfreq(m)[:, None]
    f = np.hypot(fx, fy)
    f[0, 0] = 1
    part = fft.rfft2(rng.normal(size=(m, m))) * f ** (-exponent / 2)
    part *= np.exp(-0.5 * (f / (2 * np.pi / 8)) ** 4)
    part[0, 0] = 0

    def back(spectral: Array) -> Array:
        field: Array = fft.irfft2(spectral, s=(m, m))[:n, :n]
        return field

    z = back(part)
    factor = relief_m / np.ptp(z)
    p, q = back(1j * fx * part), -back(1j * fy * part)  # rows run south
    r, s, t = back(-(fx**2) * part), back(fx * fy * part), back(-(fy**2) * part)
    mean, gauss = _curved(*(factor * d for d in (p, q, r, s, t)))
    return {"z": factor * z, "H": mean, "K": gauss}


def dunes(n: int, rng: np.random.Generator) -> Truth:
    """Return sinuous, lopsided crests 40 to 90 cells apart, 8 m of relief."""
    azimuth, length = rng.uniform(0, np.pi), rng.uniform(40, 90)
    phase, wander = rng.uniform(0, 2 * np.pi, 3), rng.uniform(120, 300, 3)

    def formula(x: Array, y: Array) -> Array:
        u = x * np.cos(azimuth) + y * np.sin(azimuth)
        v = y * np.cos(azimuth) - x * np.sin(azimuth)
        bend = 1.2 * np.sin(2 * np.pi * v / wander[0] + phase[0])
        bend = bend + 0.6 * np.sin(2 * np.pi * (v + 0.3 * u) / wander[1] + phase[1])
        angle = 2 * np.pi * u / length + bend
        size = 1 + 0.4 * np.sin(2 * np.pi * v / wander[2] + phase[2])
        return size * np.sin(angle + 0.5 * np.sin(angle)) + 0.002 * u

    return of_formula(n, formula, 8.0)


def canyon(n: int, rng: np.random.Generator) -> Truth:
    """Return a meandering trough with steep walls and an undulating floor, 70 m of relief."""
    phase, swing = rng.uniform(0, 2 * np.pi, 3), rng.uniform(30, 70)
    length, width = rng.uniform(200, 350), rng.uniform(25, 45)

    def formula(x: Array, y: Array) -> Array:
        middle = n / 2 + swing * np.sin(2 * np.pi * x / length + phase[0])
        middle = middle + 0.3 * swing * np.sin(2 * np.pi * x / (0.43 * length) + phase[1])
        floor = 4 * np.sin(2 * np.pi * x / 170 + phase[2]) * np.cos(2 * np.pi * y / 210)
        return -60 / (1 + ((y - middle) / width) ** 4) + 0.03 * x + floor

    return of_formula(n, formula, 70.0)


def pockmarks(n: int, rng: np.random.Generator) -> Truth:
    """Return pits of 5 to 15 cells on wide swells, 20 m of relief."""
    count = 150
    centre = rng.uniform(0, n, (count + 15, 2))
    width = np.r_[rng.uniform(5, 15, count), rng.uniform(60, 150, 15)]
    height = np.r_[-rng.uniform(0.3, 1, count), rng.uniform(-8, 8, 15)]

    def formula(x: Array, y: Array) -> Array:
        total = np.zeros(x.shape)
        for (cx, cy), w, h in zip(centre, width, height, strict=True):
            down, across = np.exp(-(((y[:, 0] - cy) / w) ** 2) / 2), (x[0] - cx) / w
            total += h * np.outer(down, np.exp(-(across**2) / 2))
        return total

    return of_formula(n, formula, 20.0)


TERRAINS: dict[str, Callable[[int, np.random.Generator], Truth]] = {
    "spectrum f^-3": lambda n, rng: spectrum(n, rng, 3.0),
    "spectrum f^-4": lambda n, rng: spectrum(n, rng, 4.0),
    "spectrum f^-5": lambda n, rng: spectrum(n, rng, 5.0),
    "spectrum f^-6": lambda n, rng: spectrum(n, rng, 6.0),
    "dunes": dunes,
    "canyon": canyon,
    "pockmarks": pockmarks,
}

# Exact surfaces about the middle of n = 101 cells; lengths in cells of a metre.
_MIDDLE = 50.5
_TUBE_M, _RING_M = 120.0, 300.0


def _torus(x: Array, y: Array) -> Array:
    rho = np.hypot(x - _MIDDLE + _RING_M, y - _MIDDLE)
    return np.sqrt(_TUBE_M**2 - (rho - _RING_M) ** 2)


def turned(formula: Formula, azimuth_rad: float) -> Formula:
    """Return the surface turned about the middle."""
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)

    def f(x: Array, y: Array) -> Array:
        u, v = x - _MIDDLE, y - _MIDDLE
        return formula(c * u + s * v + _MIDDLE, c * v - s * u + _MIDDLE)

    return f


EXACT: dict[str, Formula] = {
    "plane": lambda x, y: -40 + 0.0 * x,
    "tilted plane": lambda x, y: -40 + 0.7 * x - 0.3 * y,
    "cylinder": lambda x, y: np.sqrt(150.0**2 - (x - _MIDDLE) ** 2) + 0 * y,
    "sphere cap": lambda x, y: np.sqrt(150.0**2 - (x - _MIDDLE) ** 2 - (y - _MIDDLE) ** 2),
    "saddle": lambda x, y: ((x - _MIDDLE) ** 2 - (y - _MIDDLE) ** 2) / 150.0,
    "saddle ridge": lambda x, y: (x - _MIDDLE) ** 2 / 400 - (y - _MIDDLE) ** 2 / 120,
    "torus patch": _torus,
    "Gaussian bump": lambda x, y: (
        8 * np.exp(-((x - _MIDDLE) ** 2 + (y - _MIDDLE) ** 2) / (2 * 20.0**2))
    ),
}
