"""What a linear bound cannot see, found by simulating lines over the map itself.

The Cramer-Rao bound of a cell (`localization.observability`) knows the ground's slopes along one line, and
counts soundings that share a map error as fewer. Two things it leaves out:

- over weak ground the likelihood has other hills, and a vehicle with 50 m of doubt ends up on them now
  and then: the error is larger;
- a stated error leaves its correlation open: the bound assumes one length, the soundings find theirs.

Both depend on the ground as a whole, so they are found there. Lines are drawn over the map, soundings are
simulated with noise and a map error of one of the correlation lengths it may have, and the place is
estimated as the search does it: the mean of the posterior of the shift on a grid, depth bias
marginalised, the map's error of that length counted by its sharing. How the mean square of what it misses rises with
the bound is fitted by isotonic regression, and applied to the raster.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from localization.terrain import lookup_many
from perception.records import FloatArray

# Reach of the grid of shifts in start sigmas, and its finest step: a hill narrower than that is the
# linear bound's to tell, and a wrong hill as narrow is never believed.
_REACH, _FINEST_M = 3.0, 5.0
_MOST_NODES = 49
# Draws of the noise on each line: the ground under a line is read once for all of them.
_DRAWS = 6

# Part of a line's soundings that may lie off the map at a place still thought of.
_MOST_OFF = 0.3

Frame = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Line:
    """Soundings along one line, and what is known beforehand.

    Attributes
    ----------
    east_m, north_m : (n,) footprints.
    covariance_m2 : (n, n) of the soundings' heights over the map, range noise and map error together.
    assumed_m2 : (n,) variance that the search assumes, as if they were independent.
    start_m, bias_m : 1-sigma of the position's axes, and of the depth.
    """

    east_m: FloatArray
    north_m: FloatArray
    covariance_m2: FloatArray
    assumed_m2: FloatArray
    start_m: float
    bias_m: float


def square_miss(
    height_m: FloatArray,
    frame: Frame,
    line: Line,
    bound_m: float,
    rng: np.random.Generator,
) -> float:
    """Mean square of the error of a place (m^2, both axes together) by one line's soundings.

    Parameters
    ----------
    height_m, frame : the ground as it is expected, as a `Reading` has it.
    bound_m : linear bound of the line: the least answer where it is finer than the grid.
    """
    n = len(line.east_m)
    noise = np.linalg.cholesky(line.covariance_m2) @ rng.standard_normal((n, _DRAWS))
    reach = _REACH * line.start_m
    number = int(np.clip(2 * reach / max(bound_m / 2, _FINEST_M), 15, _MOST_NODES))
    side = np.linspace(-reach, reach, number // 2 * 2 + 1)
    east, north = (a.ravel() for a in np.meshgrid(side, side))
    start = line.start_m * rng.standard_normal((2, _DRAWS))
    still = np.zeros(1)
    # The true place is a node; what is known beforehand lies off it.
    truth = _heights(height_m, frame, line, still, still)
    apart = truth - _heights(height_m, frame, line, east, north)
    off = ~np.isfinite(apart)
    apart[off] = 0.0
    weight = np.where(off, 0.0, 1.0 / line.assumed_m2[:, None])
    weighted = weight * apart
    square = np.sum(weighted * apart, axis=0) + 2 * noise.T @ weighted + noise.T**2 @ weight
    total = np.sum(weighted, axis=0) + noise.T @ weight
    whole = np.sum(weight, axis=0) + line.bias_m**-2
    # A sounding off the map costs what it costs on average; a place mostly off it is none, else lines
    # near the edge would be lost in nothing whenever their noise is larger than on average.
    log = -0.5 * (square - total**2 / whole + off.sum(axis=0))
    log[:, off.mean(axis=0) > _MOST_OFF] = -np.inf
    log -= (
        0.5 * ((east - start[0][:, None]) ** 2 + (north - start[1][:, None]) ** 2) / line.start_m**2
    )
    posterior = np.exp(log - log.max(axis=1, keepdims=True))
    posterior /= posterior.sum(axis=1, keepdims=True)
    miss = (posterior @ east) ** 2 + (posterior @ north) ** 2
    return max(float(miss.mean()), min(bound_m, _FINEST_M) ** 2)


def _heights(
    height_m: FloatArray, frame: Frame, line: Line, shift_e: FloatArray, shift_n: FloatArray
) -> FloatArray:
    """Heights (n, shifts) under the line's soundings, shifted."""
    at_e, at_n = line.east_m[:, None] + shift_e, line.north_m[:, None] + shift_n
    return lookup_many(height_m, frame, at_e.ravel(), at_n.ravel()).reshape(at_e.shape)


def risen(bound_m: FloatArray, square_m2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit a rising curve of the error over the bound; return its knots, both in metres.

    Parameters
    ----------
    bound_m, square_m2 : (n,) of the lines simulated.
    """
    order = np.argsort(bound_m)
    bound, square = bound_m[order], square_m2[order]
    # Relative errors are alike at all sizes: weights 1 / variance^2, in the bound's place.
    fit = optimize.isotonic_regression(square, weights=bound**-4.0)
    edges = np.asarray(fit.blocks)
    middle = np.array([np.sqrt(np.mean(bound[a:b] ** 2)) for a, b in itertools.pairwise(edges)])
    return middle, np.sqrt(np.asarray(fit.x)[edges[:-1]])


def corrected(bound_m: FloatArray, knots: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Apply a curve of `risen` to bounds of any shape: the ratio is interpolated over the logarithm."""
    at, error = knots
    return np.asarray(bound_m * np.interp(np.log(bound_m), np.log(at), error / at))
