"""The Cramer-Rao bound of a causal position from terrain, along a known track."""

from __future__ import annotations

import numpy as np

from perception.records import FloatArray
from scenarios.benchmarks.navigation_sets import (
    Floor,
    NavigationSet,
    SetConfig,
    body_rays,
    body_to_grid,
)

# Step for the true slopes, to each side.
_HALF_M = 2.5


def causal_bound(floor: Floor, config: SetConfig, drawn: NavigationSet) -> FloatArray:
    """Bound (n,) on the rms error of a causal estimate at each row, m.

    Information on (east, north, heading error, scale, depth bias) adds up along the true track, from
    true slopes and white noise of ranges and map; offsets of the moment follow from the states at the
    start. Wild beams tell nothing. A correlated map error makes the true bound higher than this.
    """
    east, north, nav = drawn.truth_easting_m, drawn.truth_northing_m, drawn.nav
    rays_body = body_rays(config)
    heading = np.radians(nav["heading_deg"])
    level = np.zeros(len(heading))
    rays = np.einsum("nij,bj->nbi", body_to_grid(heading, level, level), rays_body)
    sigma = np.array(
        [config.start_m, config.start_m, np.radians(config.heading_deg), config.scale,
         config.depth_bias_m]
    )  # fmt: skip
    information = np.diag(1.0 / np.maximum(sigma, 1e-9) ** 2)
    far_e, far_n = east - east[0], north - north[0]
    names = [name for name in nav if name == "altitude_m" or name[:4] == "beam"]
    slant = np.stack([nav[name] for name in names], axis=1)
    usual = np.nanmedian(slant, axis=0)
    good = np.abs(slant - usual) < 0.8 * usual
    at_e, at_n = east[:, None] + slant * rays[..., 0], north[:, None] + slant * rays[..., 1]
    slope_e = floor.depth_m(at_e - _HALF_M, at_n) - floor.depth_m(at_e + _HALF_M, at_n)
    slope_n = floor.depth_m(at_e, at_n - _HALF_M) - floor.depth_m(at_e, at_n + _HALF_M)
    noise = (config.beam_noise * slant * rays_body[:, 2]) ** 2 + config.map_error_m**2
    out = np.empty(len(east))
    for i in range(len(east)):
        e, n = slope_e[i] / (2 * _HALF_M), slope_n[i] / (2 * _HALF_M)
        turn = e * far_n[i] - n * far_e[i]
        j = np.stack([e, n, turn, e * far_e[i] + n * far_n[i], np.ones(len(e))], axis=1)
        weight = np.where(good[i], 1.0 / noise[i], 0.0)
        j, weight = j[weight > 0], weight[weight > 0]
        information = information + (j * weight[:, None]).T @ j
        now = np.array([[1.0, 0, far_n[i], far_e[i], 0], [0, 1.0, -far_e[i], far_n[i], 0]])
        out[i] = np.sqrt(np.trace(now @ np.linalg.solve(information, now.T)))
    return out
