"""The grid stage against known distances and scipy's own Dijkstra."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from planning.cost import CostTerms
from planning.field import search
from planning.limits import VehicleLimits
from planning.moves import neighbourhood
from planning.surface import Surface, build_surface
from tests.planning.terrains import canyon, flat, grid_of


def surface_of(z: np.ndarray, weight: np.ndarray | None = None) -> Surface:
    return build_surface(grid_of(z), VehicleLimits(), CostTerms(), weight)


def _edge(
    z: np.ndarray, w: np.ndarray, a: np.ndarray, b: np.ndarray, dr: int, dc: int
) -> np.ndarray:
    """Integrate weight over length in space along straight moves, linear between grid lines."""
    cuts = {0.0, 1.0} | {k / abs(n) for n in (dr, dc) if n for k in range(abs(n))}
    t = np.array(sorted(cuts))
    at = np.array([a[:, None] + dr * t, b[:, None] + dc * t])
    heights, weights = (ndimage.map_coordinates(v, at, order=1, mode="nearest") for v in (z, w))
    length = np.sqrt(np.diff(t) ** 2 * (dr**2 + dc**2) + np.diff(heights, axis=1) ** 2)
    return (0.5 * (weights[:, 1:] + weights[:, :-1]) * length).sum(axis=1)


def _reference(surface: Surface, source: tuple[int, int], n: int) -> np.ndarray:
    """Dijkstra by scipy over an explicit graph, bars checked move by move."""
    moves, passed, first = neighbourhood(n)
    rows, cols = surface.shape
    r, c = np.mgrid[:rows, :cols]
    z, w = surface.stack[..., 0].astype(float), surface.stack[..., 2].astype(float)
    heads, tails, costs = [], [], []
    for m, (dr, dc) in enumerate(moves):
        rr, cc = r + dr, c + dc
        good = (rr >= 0) & (cc >= 0) & (rr < rows) & (cc < cols) & ~surface.barred
        a, b = r[good], c[good]
        ok = ~surface.barred[a + dr, b + dc]
        for i, j in passed[first[m] : first[m + 1]]:
            ok &= ~surface.barred[a + i, b + j]
        a, b = a[ok], b[ok]
        heads.append(a * cols + b)
        tails.append((a + dr) * cols + b + dc)
        costs.append(_edge(z, w, a, b, int(dr), int(dc)))
    shape = (rows * cols, rows * cols)
    graph = coo_matrix(
        (np.concatenate(costs), (np.concatenate(heads), np.concatenate(tails))), shape
    ).tocsr()
    return dijkstra(graph, indices=source[0] * cols + source[1]).reshape(rows, cols)


@pytest.mark.parametrize("neighbours", [8, 16, 32])
def test_costs_agree_with_scipys_dijkstra(neighbours):
    rng = np.random.default_rng(3)
    z = canyon(60, seed=3)
    z[20:40, 30] = np.nan
    z[45, 5:50] = np.nan
    surface = surface_of(z, rng.uniform(1.0, 2.0, z.shape))
    field = search(surface, (5, 7), neighbours=neighbours)
    expected = _reference(surface, (5, 7), neighbours)
    assert_allclose(np.where(surface.barred, np.inf, field.cost), expected, rtol=2e-6)
    aimed = search(surface, (5, 7), (55, 50), neighbours)
    assert_allclose(aimed.cost[55, 50], expected[55, 50], rtol=2e-6)


def test_thirty_two_neighbours_stay_within_their_known_error_on_flat_ground():
    field = search(surface_of(flat(81, 81)), (40, 40))
    row, col = np.mgrid[:81, :81] - 40
    ratio = field.cost / np.maximum(np.hypot(row, col), 1e-9)
    ratio[40, 40] = 1.0
    # The widest gap between the 32 directions is that from (0, 1) to (1, 3): 18.4 deg, 1 / cos of half of it.
    assert ratio.min() >= 1 - 1e-6
    assert ratio.max() <= 1 / np.cos(np.radians(18.44 / 2)) + 1e-3


def test_the_path_is_the_one_that_the_cost_is_of():
    surface = surface_of(canyon(80, seed=4))
    field = search(surface, (3, 3), (70, 75))
    path = field.path(70, 75)
    assert tuple(path[0]) == (3, 3) and tuple(path[-1]) == (70, 75)
    z, w = surface.lower_m, np.ones(surface.shape)
    legs = [
        _edge(z, w, path[i : i + 1, 0], path[i : i + 1, 1], *np.diff(path[i : i + 2], axis=0)[0])[0]
        for i in range(len(path) - 1)
    ]
    assert_allclose(field.cost[70, 75], sum(legs), rtol=1e-5)


def test_no_move_slips_through_a_wall_of_one_cell_or_across_its_corners():
    z = flat(40, 40)
    z[20, :] = np.nan
    assert not np.isfinite(search(surface_of(z), (5, 20)).cost[30, 20])
    z = flat(40, 40)
    np.fill_diagonal(z, np.nan)
    assert not np.isfinite(search(surface_of(z), (5, 20)).cost[30, 10])
