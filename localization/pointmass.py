"""Point-mass filter: the posterior of the offset on a grid, the depth bias marginalised at each node.

The plain and exhaustive rival of the particle filter, through the same likelihood: nothing is missed
inside its box, whatever the number of places that fit. Its price is a dimension or two: heading bias
and scale are not carried but widen the grid as the way grows (a convolution), so it serves the search,
not the tracking. Bergman, Ljung & Gustafsson (1999) is the pattern.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

from localization.likelihood import bias_marginal, sounding_noise
from localization.measurements import Soundings
from localization.terrain import TerrainMap
from perception.records import FloatArray


class PointMassFilter:
    """Grid posterior of (east, north); `start`, `predict`, `update`, `moments` as `ParticleFilter`.

    Parameters
    ----------
    nodes : number of nodes a side.
    """

    def __init__(self, terrain: TerrainMap, nodes: int = 121) -> None:
        self.terrain = terrain
        self.nodes = nodes
        cell = terrain.cell_m
        self.slope = float(np.sqrt(2 * terrain.structure_m2(np.array([cell]))[0])) / cell
        self.east: FloatArray = np.zeros(nodes)
        self.north: FloatArray = np.zeros(nodes)
        self.log_weight: FloatArray = np.zeros((nodes, nodes))
        self.bias: FloatArray = np.zeros((nodes, nodes))
        self.bias_var: FloatArray = np.ones((nodes, nodes))
        self.mean: FloatArray = np.zeros(5)
        self.spread: FloatArray = np.zeros(5)
        self.grown_m2 = 0.0

    def start(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Lay the grid over four sigmas of a Gaussian of (east, north, turn, scale, depth bias)."""
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        side = np.linspace(-4.0 * sigma, 4.0 * sigma, self.nodes)
        self.east, self.north = mean[0] + side, mean[1] + side
        apart = np.stack(np.meshgrid(side, side))
        inverse = np.linalg.inv(covariance[:2, :2])
        self.log_weight = -0.5 * np.einsum("iab,ij,jab->ab", apart, inverse, apart)
        self.bias = np.full((self.nodes, self.nodes), float(mean[4]))
        self.bias_var = np.full((self.nodes, self.nodes), float(covariance[4, 4]))
        self.mean, self.spread = mean, np.diag(covariance)
        self.grown_m2 = 0.0

    def predict(self, step_e: float, step_n: float, walk_m2: float) -> None:
        """Widen the posterior by what heading bias, scale and random walk make of a step."""
        self.east = self.east + self.mean[3] * step_e + self.mean[2] * step_n
        self.north = self.north + self.mean[3] * step_n - self.mean[2] * step_e
        way2 = step_e**2 + step_n**2
        # Errors of a constant rate add up as lengths; taken from step to step they are a diffusion
        # no slower once the blur is a node wide.
        self.grown_m2 += walk_m2 + way2 * (self.spread[2] + self.spread[3])
        node = float(self.east[1] - self.east[0])
        if self.grown_m2 > (0.5 * node) ** 2:
            weight = np.exp(self.log_weight - self.log_weight.max())
            blurred = ndimage.gaussian_filter(weight, np.sqrt(self.grown_m2) / node, mode="nearest")
            self.log_weight = np.log(np.maximum(blurred, 1e-300))
            self.grown_m2 = 0.0

    def update(
        self, soundings: Soundings, easting_m: float, northing_m: float, step_m: float,
        bias_walk_m2: float,
    ) -> float:  # fmt: skip
        """Weigh the nodes by an update's soundings; return the share of nodes where any fits."""
        noise = sounding_noise(soundings, self.terrain, self.slope, step_m)
        met: float = _weigh_nodes(
            self.terrain.height_m, self.terrain.frame, self.east, self.north, self.bias,
            self.bias_var, self.log_weight, easting_m, northing_m, soundings.east_m,
            soundings.north_m, soundings.elevation_m, noise.inflated_m2, bias_walk_m2,
            float(self.mean[2]),
        )  # fmt: skip
        return met

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (5,) and covariance (5, 5) of east, north, turn, scale and depth bias."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        weight /= weight.sum()
        east, north = np.meshgrid(self.east, self.north)
        layers = np.stack([east, north, self.bias]).reshape(3, -1)
        w = weight.ravel()
        mean = layers @ w
        apart = layers - mean[:, None]
        part = (apart * w) @ apart.T
        part[2, 2] += float(w @ self.bias_var.ravel())
        node2 = float(self.east[1] - self.east[0]) ** 2
        full = np.diag(np.asarray(self.spread, float))
        full[np.ix_([0, 1, 4], [0, 1, 4])] = part
        # A node stands for its square.
        full[0, 0] += node2 / 12 + self.grown_m2
        full[1, 1] += node2 / 12 + self.grown_m2
        return np.array([mean[0], mean[1], self.mean[2], self.mean[3], mean[2]]), full


@numba.njit(cache=True)
def _weigh_nodes(  # type: ignore[no-untyped-def]
    heights, frame, east, north, bias, bias_var, log_weight, pe, pn, oe, on, z, r, walk, turn
):
    met = 0
    for a in range(north.size):
        for b in range(east.size):
            gain, bias[a, b], bias_var[a, b], fitting = bias_marginal(
                heights, frame, east[b], north[a], turn, bias[a, b], bias_var[a, b], pe, pn, oe, on,
                z, r, walk,
            )  # fmt: skip
            log_weight[a, b] += gain
            met += fitting > 0
    return met / (north.size * east.size)
