"""The linear algebra of the joint inversion against dense matrices and known statistics."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import sparse

from perception import bands, multigrid, posterior
from perception.coarse import level_matrix, prior_matrix
from perception.gain_basis import GainBasis
from perception.level_kernels import apply_corners, apply_features, prior_rows
from perception.multigrid import FeatureData, Spectrum, Tie, coarser, prolong, restrict
from perception.posterior import Problem
from perception.rays import Soundings
from perception.roughness import fit_spectrum, learn_roughness, random_floor, structure_function
from perception.soundings import bilinear_rows, sounding_equations


def small_problem(rng: np.random.Generator) -> Problem:
    shape = (9, 17)
    n = 400
    knot = np.stack([rng.integers(0, 3, n), np.full(n, 3)], axis=1)
    points = rng.uniform(1, 7, (20, 2))
    return Problem(
        cell_m=0.7,
        shape=shape,
        cell=rng.integers(0, 8 * 16, n),
        weight=rng.uniform(1, 20, n),
        c_east=rng.normal(0, 4, n),
        c_north=rng.normal(0, 4, n),
        c_level=rng.normal(0, 0.1, n),
        value=rng.normal(0, 0.5, n),
        knot=knot,
        share=np.tile([0.6, 0.4], (n, 1)),
        gain_precision=np.eye(5) * 0.1,
        rows=bilinear_rows(points[:, 0], points[:, 1], np.ones(20), shape),
        row_weight=np.full(20, 100.0),
        row_value=rng.normal(0, 1, 20),
        height=Spectrum(0.01, 0.5, 3.0),
        albedo=Spectrum(0.1, 1.0, 2.0),
        mean_height=np.full(shape, 0.3),
    )


def dense(problem: Problem) -> np.ndarray:
    """Return the normal matrix by applying the operator to every unit vector."""
    nodes = problem.shape[0] * problem.shape[1]
    size = 2 * nodes + len(problem.gain_precision)
    out = np.empty((size, size))
    for k in range(size):
        unit = np.zeros(size)
        unit[k] = 1
        z, a, g = problem.apply(
            unit[:nodes].reshape(problem.shape),
            unit[nodes : 2 * nodes].reshape(problem.shape),
            unit[2 * nodes :],
        )
        out[:, k] = np.concatenate([z.ravel(), a.ravel(), g])
    return out


def test_operator_is_symmetric_and_positive() -> None:
    matrix = dense(small_problem(np.random.default_rng(1)))
    assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[0] > 0


@pytest.mark.usefixtures("many_grids")
def test_solver_finds_the_dense_solution() -> None:
    problem = small_problem(np.random.default_rng(2))
    right = problem.right_side()
    start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(5))
    (z, a, g), steps = problem.solve(start, right, tolerance=1e-6, most=200)
    expected = np.linalg.solve(
        dense(problem), np.concatenate([right[0].ravel(), right[1].ravel(), right[2]])
    )
    found = np.concatenate([z.ravel(), a.ravel(), g])
    assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert steps < 80


def test_perturbations_spread_as_the_posterior_does() -> None:
    """The variance of perturbed solutions is the diagonal of the inverse, within sampling error."""
    rng = np.random.default_rng(3)
    problem = small_problem(rng)
    start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(5))
    draws = [
        problem.solve(start, problem.perturbation(rng), tolerance=1e-3, most=80)[0][0]
        for _ in range(40)
    ]
    nodes = problem.shape[0] * problem.shape[1]
    expected = np.sqrt(np.diag(np.linalg.inv(dense(problem)))[:nodes])
    ratio = np.std(draws, axis=0).ravel() / expected
    # 40 draws know a sigma to 11 %; the mean over nodes to a few per cent.
    assert 0.93 < ratio.mean() < 1.07


def test_restriction_is_the_transpose_of_prolongation() -> None:
    rng = np.random.default_rng(4)
    coarse, fine = rng.normal(size=(9, 5)), rng.normal(size=(17, 9))
    assert np.vdot(prolong(coarse), fine) == np.float64(np.vdot(coarse, restrict(fine))) or (
        abs(np.vdot(prolong(coarse), fine) - np.vdot(coarse, restrict(fine))) < 1e-9
    )


def test_bilinear_rows_read_a_plane_exactly() -> None:
    row, col = np.array([0.25, 3.9]), np.array([1.5, 2.1])
    r, c = np.indices((6, 5))
    plane = 2.0 + 0.5 * r - 0.3 * c
    assert_allclose(
        bilinear_rows(row, col, np.ones(2), (6, 5)) @ plane.ravel(), 2 + 0.5 * row - 0.3 * col
    )


def test_a_sounding_on_a_slope_is_an_equation_on_the_nearest_point() -> None:
    """On a plane dipping across the track the true plane satisfies the equation of its first return."""
    cell, slope, up = 0.5, 0.3, 15.0
    _, c = np.indices((81, 81))
    plane = slope * (c * cell - 20.0)
    least = up / np.hypot(1, slope)
    bottom = Soundings(*(np.array([v]) for v in (20.0, 20.0, up, 0.0, least, 0.05)))
    found = sounding_equations(plane, 0.0, 0.0, cell, bottom)
    # The search is on steps of 1/40 of the reach: its error in slant range is millimetres.
    assert_allclose(found.matrix @ plane.ravel(), found.value, atol=5e-3)


def test_roughness_of_a_random_floor_is_recovered() -> None:
    rng = np.random.default_rng(5)
    planted = Spectrum(1e-3, 0.5, 4.0)
    floor = random_floor(planted, 1.0, 512, rng)
    lines = [(np.full(512, 16.0 * i), np.arange(512.0), floor[:, 16 * i]) for i in range(32)]
    lag, value, weight = structure_function(lines, 1.0)
    fitted = fit_spectrum(lag, value, weight, 1.0)
    for k in (0.15, 0.5, 1.2):
        ratio = (fitted.p0 + fitted.p1 * k**2 + fitted.p2 * k**4) / (
            planted.p0 + planted.p1 * k**2 + planted.p2 * k**4
        )
        assert 0.6 < ratio < 1.7


def test_roughness_is_learned_through_the_first_return() -> None:
    """A first return is smoother than the floor; the learned floor is rougher than its soundings."""
    rng = np.random.default_rng(6)
    floor = random_floor(Spectrum(2e-3, 0.4, 2.0), 1.0, 512, rng)
    passes = []
    for line in range(4):
        column = 40 + 120 * line
        across = np.arange(-9, 10)
        least = np.min(np.hypot(across, 15.0 - floor[:, column + across]), axis=1)
        n = len(least)
        passes.append(
            Soundings(
                np.full(n, float(column)),
                np.arange(float(n)),
                np.full(n, 15.0),
                np.zeros(n),
                least,
                np.full(n, 0.05),
            )
        )
    learned = learn_roughness(passes, 0.0, 1.0, rng)
    lines = [(p.easting_m, p.northing_m, p.up_m - p.range_m) for p in passes]
    naive = fit_spectrum(*structure_function(lines, 1.0), 1.0)
    short = lambda s: s.p0 + s.p1 + s.p2  # noqa: E731
    assert short(learned) < short(naive)
    assert 0.4 < short(learned) / 2.402 < 2.5


def test_gain_knots_share_one_and_curves_keep_shape() -> None:
    basis = GainBasis(75.0)
    angle = np.linspace(0, 1.5, 50)
    knot, share = basis.place(angle, 30 + 0 * angle, np.zeros(50, np.int64))
    assert_allclose(share.sum(axis=1), 2.0)
    assert knot.max() < basis.size
    # A bent curve costs, a straight one nearly nothing.
    gain = np.zeros(basis.size)
    gain[:36] = 0.1 * np.sin(np.arange(36))
    bent = gain @ basis.precision() @ gain
    gain[:36] = 0.1
    assert gain @ basis.precision() @ gain < 0.01 * bent
    assert sparse.issparse(bilinear_rows(angle, angle, angle, (4, 4)))


@pytest.fixture
def many_grids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let small problems have coarser grids, which otherwise are solved directly at once."""
    monkeypatch.setattr(multigrid, "COARSEST_NODES", 150)


def crossed_problem(rng: np.random.Generator, crossed: bool = True) -> Problem:
    """Return slopes seen from both axes (or from one side alone), firmly, with soundings along two lines."""
    shape, cells = (33, 49), 32 * 48
    cell = np.concatenate([np.arange(cells)] * 4)
    n = len(cell)
    across = np.repeat([1.0, -1.0, 0.0, 0.0] if crossed else [1.0] * 4, cells)
    along = np.repeat([0.0, 0.0, 1.0, -1.0] if crossed else [0.0] * 4, cells)
    sense = rng.uniform(4, 40, n)
    angle = rng.uniform(0, 5.9, n)
    knot = np.stack([angle.astype(np.int64), angle.astype(np.int64) + 1], axis=1)
    line = np.arange(1.0, 31.0)
    return Problem(
        cell_m=1.0, shape=shape, cell=cell, weight=rng.uniform(1, 25, n), c_east=sense * across,
        c_north=sense * along, c_level=np.zeros(n), value=rng.normal(0, 1, n), knot=knot,
        share=np.stack([1 - angle % 1, angle % 1], axis=1), gain_precision=np.eye(7),
        rows=bilinear_rows(np.tile(line, 2), np.repeat([8.0, 40.0], 30), np.ones(60), shape),
        row_weight=np.full(60, 400.0), row_value=rng.normal(0, 1, 60),
        height=Spectrum(1e-4, 0.27, 3.0), albedo=Spectrum(0.04, 1.3, 10.0),
        mean_height=np.zeros(shape),
    )  # fmt: skip


@pytest.mark.usefixtures("many_grids")
def test_no_smoother_is_built_on_too_small_an_eigenvalue() -> None:
    """Too small a bound once made the preconditioner indefinite, and an inversion end at its first step."""
    problem = crossed_problem(np.random.default_rng(7))
    for level in problem.hierarchy.levels:
        z = np.random.default_rng(8).standard_normal(level.shape)
        a = z[::-1].copy()
        value = 0.0
        for _ in range(200):
            y_z, y_a = level.apply(z, a)
            y_z, y_a = y_z / level.diagonal[0], y_a / level.diagonal[1]
            value = float(np.sqrt(np.vdot(y_z, y_z) + np.vdot(y_a, y_a)))
            z, a = y_z / value, y_a / value
        # A Chebyshev polynomial stays a contraction a sixth beyond its range.
        assert value < 1.1 * level.largest


@pytest.mark.usefixtures("many_grids")
@pytest.mark.parametrize(("crossed", "most"), [(True, 18), (False, 90)])
def test_few_steps_solve_firm_slopes(crossed: bool, most: int) -> None:
    """Along both axes, and from one side alone, where slopes and gain explain the same echoes."""
    problem = crossed_problem(np.random.default_rng(9), crossed)
    start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(7))
    right = problem.right_side()
    near, steps = problem.solve(start, right)
    exact, _ = problem.solve(near, right, tolerance=1e-7, most=300)
    assert steps < most
    # Half a posterior sigma in all is next to nothing at any one node.
    assert np.abs(near[0] - exact[0]).max() < 0.02


@pytest.mark.usefixtures("many_grids")
def test_a_coarser_grid_has_the_energy_of_the_field_it_stands_for() -> None:
    problem = crossed_problem(np.random.default_rng(10))
    fine, coarse = problem.hierarchy.levels[:2]
    rng = np.random.default_rng(11)
    z, a = rng.normal(size=coarse.shape), rng.normal(size=coarse.shape)
    none = Spectrum(0.0, 0.0, 0.0)
    energy = []
    for level, u, v in ((coarse, z, a), (fine, prolong(z), prolong(a))):
        bare = replace(
            level, height=none, albedo=none, tie=Tie.of(level.tie.matrix[:0], level.tie.weight[:0])
        )
        out_z, out_a = bare.apply(u, v)
        energy.append(np.vdot(u, out_z) + np.vdot(v, out_a))
    # Single precision.
    assert_allclose(energy[0], energy[1], rtol=1e-6)


@pytest.mark.usefixtures("many_grids")
def test_the_coarse_matrix_is_the_operator_of_its_level() -> None:
    problem = crossed_problem(np.random.default_rng(12))
    rng = np.random.default_rng(13)
    for level in problem.hierarchy.levels:
        z, a = rng.normal(size=level.shape), rng.normal(size=level.shape)
        matrix = level_matrix(
            level.data.local(), level.height.coefficients(level.cell_m),
            level.albedo.coefficients(level.cell_m), level.tie.matrix, level.tie.weight,
        )  # fmt: skip
        found = matrix @ np.concatenate([z.ravel(), a.ravel()])
        applied = np.concatenate([part.ravel() for part in level.apply(z, a)])
        # The cells' matrices are kept in single precision.
        assert_allclose(found, applied, atol=1e-6 * np.abs(applied).max())


def test_the_prior_of_any_grid_is_its_matrix() -> None:
    """Down to grids of two nodes a side, where second differences do not exist."""
    rng = np.random.default_rng(14)
    for shape in ((2, 2), (2, 7), (3, 3), (4, 5), (9, 3), (6, 11)):
        z, out = rng.normal(size=shape), np.empty(shape)
        prior_rows(0, shape[0], z, (0.3, 1.7, 2.9), out)
        assert_allclose(out.ravel(), prior_matrix(shape, (0.3, 1.7, 2.9)) @ z.ravel(), atol=1e-12)


@pytest.mark.usefixtures("many_grids")
def test_the_cycle_is_symmetric_and_positive_with_gains() -> None:
    """Conjugate gradients need both; a coupling read one way only would break the first."""
    problem = crossed_problem(np.random.default_rng(15))
    rng = np.random.default_rng(16)

    def draw() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return rng.normal(size=problem.shape), rng.normal(size=problem.shape), rng.normal(size=7)

    u, v = draw(), draw()
    of_u, of_v = problem.hierarchy.cycle(*u), problem.hierarchy.cycle(*v)
    one = sum(np.vdot(x, y) for x, y in zip(u, of_v, strict=True))
    other = sum(np.vdot(x, y) for x, y in zip(v, of_u, strict=True))
    own = sum(np.vdot(x, y) for x, y in zip(u, of_u, strict=True))
    assert own > 0
    assert_allclose(one, other, rtol=1e-6, atol=1e-6 * own)


@pytest.mark.usefixtures("many_grids")
def test_a_grids_coupling_is_that_of_the_fields_it_interpolates_to() -> None:
    problem = crossed_problem(np.random.default_rng(17))
    rng = np.random.default_rng(18)
    none = np.zeros(problem.shape)
    gain = rng.normal(size=7)
    z, a, _ = problem.apply(none, none, gain)
    for depth, level in enumerate(problem.hierarchy.levels):
        if depth:
            z, a = restrict(z), restrict(a)
        found = level.coupling.fields_of(gain)
        for mine, exact in zip(found, (z, a), strict=True):
            assert_allclose(mine, exact, atol=1e-5 * np.abs(exact).max())
        # And its transpose.
        u, v = rng.normal(size=level.shape), rng.normal(size=level.shape)
        both = np.vdot(u, found[0]) + np.vdot(v, found[1])
        assert_allclose(level.coupling.gains_of(u, v) @ gain, both, rtol=1e-9)


def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = []
    for threads in (1, 3):
        monkeypatch.setattr(bands, "thread_count", lambda n=threads: n)
        monkeypatch.setattr(bands, "_WORTH", 10)
        bands._pool.cache_clear()
        problem = crossed_problem(np.random.default_rng(19))
        start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(7))
        answers.append(problem.solve(start, problem.right_side(), tolerance=1e-3)[0])
    bands._pool.cache_clear()
    for one, three in zip(*answers, strict=True):
        assert np.array_equal(one, three)


@pytest.mark.usefixtures("many_grids")
@pytest.mark.parametrize("factor", [-1.0, -30.0])
def test_a_cycle_that_is_not_positive_is_left_and_the_solution_still_found(
    factor: float, caplog: pytest.LogCaptureFixture
) -> None:
    """A negative product once met the stop test: a half-done solution was returned as if it were one."""
    problem = small_problem(np.random.default_rng(2))
    right = problem.right_side()
    problem.hierarchy.coarsest.gain_inverse *= factor
    start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(5))
    with caplog.at_level(logging.WARNING, "perception"):
        found, steps = problem.solve(start, right, tolerance=1e-6, most=200)
    assert [record.message.split(":")[0] for record in caplog.records] == ["joint inversion"]
    assert "not positive" in caplog.text and "apart" in caplog.text
    expected = np.linalg.solve(dense(problem), np.concatenate([part.ravel() for part in right]))
    solution = np.concatenate([part.ravel() for part in found])
    assert_allclose(solution, expected, atol=1e-5 * np.abs(expected).max())
    assert steps < 200


@pytest.mark.usefixtures("many_grids")
def test_a_solution_short_of_its_tolerance_is_told(caplog: pytest.LogCaptureFixture) -> None:
    problem = small_problem(np.random.default_rng(2))
    start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(5))
    with caplog.at_level(logging.WARNING, "perception"):
        exact, _ = problem.solve(start, problem.right_side(), tolerance=1e-6, most=200)
        assert not caplog.records
        # From the solution itself there is rounding to go on with at the most.
        problem.solve(exact, problem.right_side())
        assert not caplog.records
        _, steps = problem.solve(start, problem.right_side(), tolerance=1e-6, most=2)
    assert steps == 2 and "2 steps did not reach the tolerance" in caplog.text


# What every kernel of a grid makes of the same numbers.
_KERNELS = """
import hashlib
import numpy as np
from perception.level_kernels import apply_corners, apply_features, prior_rows
rng = np.random.default_rng(0)
z, a, oz, oa = rng.standard_normal((4, 33, 49))
moments = rng.random((10, 32, 48)).astype(np.float32)
local = rng.random((36, 32, 48)).astype(np.float32)
said = hashlib.sha256()
prior_rows(0, 33, z, (0.1, 0.5, 3.0), oz)
said.update(oz.tobytes())
apply_features(0, 33, moments, z, a, 0.7, (0.1, 0.5, 3.0), (0.1, 1.0, 2.0), oz, oa)
said.update(oz.tobytes() + oa.tobytes())
apply_corners(0, 33, local, z, a, (0.1, 0.5, 3.0), (0.1, 1.0, 2.0), oz, oa)
said.update(oz.tobytes() + oa.tobytes())
print(said.hexdigest())
"""


@pytest.mark.slow
def test_kernels_freshly_compiled_and_from_the_cache_agree_to_the_bit(tmp_path: Path) -> None:
    """The first map of a machine and its second once differed in the fifth decimal of a metre."""
    said = [
        subprocess.run(
            [sys.executable, "-c", _KERNELS], check=True, capture_output=True, text=True,
            cwd=Path(__file__).resolve().parents[2],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        ).stdout
        for _ in range(2)
    ]  # fmt: skip
    assert any(tmp_path.rglob("*.nbi"))
    assert said[0] == said[1]


def test_a_coarser_grids_data_are_exact_for_bilinear_fields() -> None:
    """What the wide cells' matrices make of a field is what the narrow cells' make of it, interpolated."""
    rng = np.random.default_rng(20)
    packed = np.empty((10, 16, 24), np.float32)
    for cell in np.ndindex(16, 24):
        root = rng.normal(size=(4, 4))
        packed[:, *cell] = (root @ root.T)[np.triu_indices(4)]
    data, none = FeatureData(packed, 0.7), (0.0, 0.0, 0.0)
    for _ in range(2):
        wide = coarser(data)
        shape = wide.shape[0] + 1, wide.shape[1] + 1
        z, a = rng.normal(size=shape), rng.normal(size=shape)
        found = np.empty(shape), np.empty(shape)
        apply_corners(0, shape[0], wide.packed, z, a, none, none, *found)
        fine = prolong(z), prolong(a)
        made = np.empty(fine[0].shape), np.empty(fine[0].shape)
        rows = fine[0].shape[0]
        if isinstance(data, FeatureData):
            apply_features(0, rows, data.moments, *fine, data.cell_m, none, none, *made)
        else:
            apply_corners(0, rows, data.packed, *fine, none, none, *made)
        for mine, exact in zip(found, made, strict=True):
            assert_allclose(mine, restrict(exact), atol=1e-5 * np.abs(mine).max())
        data = wide


def test_kernels_in_single_precision_are_those_in_double_rounded() -> None:
    rng = np.random.default_rng(21)
    z, a = rng.normal(size=(2, 33, 49))
    moments = rng.random((10, 32, 48)).astype(np.float32)
    local = rng.random((36, 32, 48)).astype(np.float32)
    priors = (0.1, 0.5, 3.0), (0.1, 1.0, 2.0)
    made = []
    for precision in (np.float64, np.float32):
        u, v = z.astype(precision), a.astype(precision)
        out = np.empty((6, 33, 49), precision)
        apply_features(0, 33, moments, u, v, 0.7, *priors, out[0], out[1])
        apply_corners(0, 33, local, u, v, *priors, out[2], out[3])
        out[4] = prolong(u[:17, :25])
        out[5, :17, :25] = restrict(u)
        out[5, 17:], out[5, :, 25:] = 0, 0
        assert prolong(u).dtype == precision
        made.append(out)
    assert_allclose(made[1], made[0], atol=2e-5 * np.abs(made[0]).max())


@pytest.mark.usefixtures("many_grids")
def test_a_large_maps_error_adds_up_over_its_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a posterior sigma in each patch: a map of four may be off by a whole one in all, and no more."""
    problem = crossed_problem(np.random.default_rng(22))
    start = (np.zeros(problem.shape), np.zeros(problem.shape), np.zeros(7))
    right = problem.right_side()
    exact, _ = problem.solve(start, right, tolerance=1e-6)
    steps = []
    for patches in (1, 4):
        monkeypatch.setattr(posterior, "_PATCH", exact[0].size / patches)
        found, used = problem.solve(start, right)
        off = tuple(x - y for x, y in zip(found, exact, strict=True))
        assert np.sqrt(multigrid.dot(off, problem.apply(*off))) < 0.5 * np.sqrt(patches)
        steps.append(used)
    assert steps[1] < steps[0]
