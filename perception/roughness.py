"""How rough the sea floor is, learned from the soundings alone.

The structure function of the bottom track (mean squared difference against lag) is fitted by an
isotropic spectrum whose precision is ``p0 + p1 k^2 + p2 k^4``. A first return is the nearest point of
the floor, so the track is smoother than the floor; how much smoother is found by sounding random floors
of the fitted spectrum in the same way. What is seen is multiplied by the part that sounding takes of those, and
fitted again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import optimize, special

from perception.multigrid import Spectrum
from perception.rays import Soundings
from perception.records import FloatArray

# Rounds of sounding random floors; the correction settles in five.
_ROUNDS = 5
_RANDOM_CELLS = 768
# Sounding takes no more of a floor's structure than this and, but for chance, adds none.
_LEAST_TAKEN, _MOST_TAKEN = 0.5, 16.0


def learn_roughness(
    passes: Sequence[Soundings], noise_m: float, cell_m: float, rng: np.random.Generator
) -> Spectrum:
    """Fit the precision spectrum of the sea floor to the soundings' structure function.

    Parameters
    ----------
    passes : the bottom tracks.
    noise_m : 1-sigma of the noise of a sounding that is independent from one to the next.
    cell_m : cell of the map; shorter waves do not matter.
    """
    lines = [(p.easting_m, p.northing_m, p.up_m - p.range_m) for p in passes]
    lag, seen, count = structure_function(lines, cell_m)
    seen = np.maximum(seen - 2 * noise_m**2, 0.02 * seen + 1e-8)
    altitude = float(np.median(np.concatenate([p.range_m for p in passes])))
    spectrum = fit_spectrum(lag, seen, count, cell_m)
    for _ in range(_ROUNDS):
        sounded = sounded_structure(spectrum, lag, altitude, 0.5 * cell_m, rng)
        # Beyond a quarter of the random floor's width its periodic waves say nothing.
        usable = np.isfinite(sounded) & (lag < _RANDOM_CELLS * cell_m / 8)
        # The floor's own structure over the sounded one, not the seen over the sounded one: dunes have no spectrum of
        # this form, and a misfit handed on from round to round grows into relief that nobody saw.
        own = expected_structure(spectrum, lag, cell_m)
        taken = np.where(usable, own / np.where(usable, sounded, 1.0), 1.0)
        target = seen * np.clip(taken, _LEAST_TAKEN, _MOST_TAKEN)
        spectrum = fit_spectrum(lag, target, count, cell_m)
    return spectrum


def fit_spectrum(
    lag_m: FloatArray, value_m2: FloatArray, weight: FloatArray, cell_m: float
) -> Spectrum:
    """Return the spectrum whose structure function fits best, in log."""
    k, kernel = _structure_kernel(lag_m, cell_m)

    def misfit(parameters: FloatArray) -> FloatArray:
        p0, p1, p2 = np.exp(parameters)
        model = kernel @ (1 / (p0 + p1 * k**2 + p2 * k**4))
        power = 1 / (p0 + p1 * k**2 + p2 * k**4)
        variance = float(np.sum(k * power * np.gradient(k))) / (2 * np.pi)
        # Lines say nothing of waves much longer than themselves: those are not let loose.
        excess = max(0.0, float(np.log(variance / value_m2.max())))
        return np.append(np.sqrt(weight) * (np.log(model) - np.log(value_m2)), 5.0 * excess)

    level = float(value_m2.max())
    scale = float(lag_m[len(lag_m) // 2])
    start = np.log([1 / (level * scale**2), 1 / level, scale**2 / level])
    fits = [
        optimize.least_squares(misfit, start + shift, bounds=(start - 9, start + 9))
        # The three terms trade places: a smooth floor has hardly any of the middle one.
        for shift in (np.zeros(3), np.array([3.0, -4.0, 0.0]), np.array([-2.0, 2.0, -1.0]))
    ]
    p0, p1, p2 = np.exp(min(fits, key=lambda fit: fit.cost).x)
    return Spectrum(float(p0), float(p1), float(p2))


def expected_structure(spectrum: Spectrum, lag_m: FloatArray, cell_m: float) -> FloatArray:
    """Return the mean squared height difference, m^2, at each lag on a floor of the spectrum."""
    k, kernel = _structure_kernel(lag_m, cell_m)
    power = 1 / (spectrum.p0 + spectrum.p1 * k**2 + spectrum.p2 * k**4)
    return np.asarray(kernel @ power)


def _structure_kernel(lag_m: FloatArray, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Return wave numbers and the (lags, wave numbers) matrix from power to structure.

    ``D(h) = 1/pi * integral of k P(k) (1 - J0(k h)) dk`` for an isotropic spectrum P.
    """
    k = np.geomspace(2 * np.pi / (40 * lag_m[-1]), 2 * np.pi / cell_m, 400)
    return k, (1 - special.j0(np.outer(lag_m, k))) * k * np.gradient(k) / np.pi


def random_floor(
    spectrum: Spectrum, cell_m: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Draw a periodic random floor (count, count) of the spectrum, zero mean."""
    k = 2 * np.pi * np.hypot(*np.meshgrid(*(np.fft.fftfreq(count, cell_m),) * 2))
    k[0, 0] = np.inf
    power = 1 / (spectrum.p0 + spectrum.p1 * k**2 + spectrum.p2 * k**4)
    noise = np.fft.fft2(rng.standard_normal((count, count)))
    return np.asarray(np.fft.ifft2(noise * np.sqrt(power) / cell_m).real)


def sounded_structure(
    spectrum: Spectrum,
    lag_m: FloatArray,
    altitude_m: float,
    cell_m: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the structure function that first returns of random floors have at the lags."""
    floor = random_floor(spectrum, cell_m, _RANDOM_CELLS, rng)
    nearest = first_returns(floor, altitude_m, cell_m)
    out = np.full(len(lag_m), np.nan)
    for i, lag in enumerate(lag_m):
        shift = max(1, round(float(lag) / cell_m))
        if shift < _RANDOM_CELLS // 2:
            out[i] = np.mean((np.roll(nearest, shift, axis=0) - nearest) ** 2)
    return out


def first_returns(floor: FloatArray, altitude_m: float, cell_m: float) -> FloatArray:
    """Return the least slant range along some of the columns of a periodic floor (rows, lines)."""
    count = floor.shape[1]
    column = np.arange(0, count, max(1, count // 24))
    nearest = np.full((floor.shape[0], len(column)), np.inf)
    side = min(int(0.6 * altitude_m / cell_m), count // 2)
    for offset in range(-side, side + 1):
        drop = altitude_m - floor[:, (column + offset) % count]
        nearest = np.minimum(nearest, np.hypot(offset * cell_m, drop))
    return nearest


def structure_function(
    lines: Sequence[tuple[FloatArray, FloatArray, FloatArray]], cell_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (lag, mean squared height difference, weight) at about logarithmic lags."""
    longest = max(
        float(np.sum(np.hypot(np.diff(e), np.diff(n)))) if len(e) > 1 else 0.0 for e, n, _ in lines
    )
    top = max(0.4 * longest, 8 * cell_m)
    edges = np.geomspace(1.5 * cell_m, top, 13)
    total = np.zeros(len(edges) - 1)
    number = np.zeros(len(edges) - 1)
    for easting_m, northing_m, height_m in lines:
        good = np.isfinite(height_m)
        if good.sum() < 8:
            continue
        e, n, h = easting_m[good], northing_m[good], height_m[good]
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(e), np.diff(n)))])
        spacing = max(float(np.median(np.diff(distance))), 1e-3)
        for shift in np.unique(np.round(np.geomspace(1, max(top / spacing, 2), 80)).astype(int)):
            if shift >= len(h):
                continue
            # Straight separation, so that turns and gaps do not masquerade as along-line lags.
            lag = np.hypot(e[shift:] - e[:-shift], n[shift:] - n[:-shift])
            square = (h[shift:] - h[:-shift]) ** 2
            total += np.histogram(lag, edges, weights=square)[0]
            number += np.histogram(lag, edges)[0]
    used = number > 0
    centre = np.sqrt(edges[1:] * edges[:-1])[used]
    value = np.maximum(total[used] / number[used], 1e-8)
    # Few independent stretches at long lags: weigh a lag by how often it fits into the lines.
    return centre, value, np.minimum(longest / centre, 50.0)
