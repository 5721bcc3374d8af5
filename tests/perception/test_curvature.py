"""H and K of surfaces whose curvature is known, and their signs as the contract has them."""

import numpy as np
import pytest

from perception.curvature import derivatives_3x3, mean_and_gaussian


def axes(n=81, cell_m=1.0):
    x = (np.arange(n) - n // 2) * cell_m
    return np.meshgrid(x, -x)  # rows run north to south


def curvature(z, cell_m=1.0, cell_north_m=None, operator="difference"):
    return mean_and_gaussian(derivatives_3x3(z, cell_m, cell_north_m or cell_m, operator))


def worst(found, true, rim=0):
    error = np.abs(found - true)
    inner = error[rim : len(error) - rim or None, rim : len(error) - rim or None]
    return np.nanmax(inner)


@pytest.mark.parametrize("operator", ["difference", "least-squares"])
def test_a_tilted_plane_has_no_curvature_even_at_its_edges(operator):
    x, y = axes()
    mean, gauss = curvature(-40 + 0.7 * x - 0.3 * y, operator=operator)
    assert worst(mean, 0) < 1e-12
    assert worst(gauss, 0) < 1e-12


def test_a_sphere_has_its_own_curvature_on_its_flank_too():
    """The small-slope Laplacian would be off by a factor of two where the slope is 30 degrees."""
    x, y = axes(101)
    radius_m = 100.0
    mean, gauss = curvature(np.sqrt(radius_m**2 - x**2 - y**2))
    assert worst(mean, -1 / radius_m, rim=1) < 0.005 / radius_m
    assert worst(gauss, 1 / radius_m**2, rim=1) < 0.005 / radius_m**2


@pytest.mark.parametrize("azimuth_deg", [0, 17, 45, 80])
def test_a_cylinder_has_no_gaussian_curvature_whatever_its_azimuth(azimuth_deg):
    x, y = axes(61)
    across = x * np.cos(np.radians(azimuth_deg)) + y * np.sin(np.radians(azimuth_deg))
    radius_m = 120.0
    mean, gauss = curvature(np.sqrt(radius_m**2 - across**2))
    assert worst(mean, -0.5 / radius_m, rim=1) < 0.005 * 0.5 / radius_m
    assert worst(gauss, 0, rim=1) < 0.005 / radius_m**2


def test_a_torus_patch_has_the_curvature_of_its_radii():
    x, y = axes(41)
    tube_m, ring_m = 60.0, 200.0
    # The top of a torus lying flat, cut off centre: distance from the tube's circle.
    rho = np.hypot(x + ring_m, y)
    z = np.sqrt(tube_m**2 - (rho - ring_m) ** 2)
    mean, gauss = curvature(z)
    cosine = (rho - ring_m) / tube_m
    true_gauss = cosine / (tube_m * (ring_m + tube_m * cosine))
    true_mean = -(ring_m + 2 * tube_m * cosine) / (2 * tube_m * (ring_m + tube_m * cosine))
    np.testing.assert_allclose(mean[1:-1, 1:-1], true_mean[1:-1, 1:-1], rtol=0.005)
    assert worst(gauss, true_gauss, rim=1) < 0.005 * np.abs(true_gauss).max()


def test_signs_are_those_of_besl_and_jain_with_z_up():
    x, y = axes(21)
    middle = (10, 10)
    for shape, sign_h, sign_k in (
        (-(x**2) - y**2, -1, 1),
        (x**2 + y**2, 1, 1),
        (-2 * x**2 + y**2, -1, -1),
        (2 * x**2 - y**2, 1, -1),
    ):
        mean, gauss = curvature(0.01 * shape)
        assert (np.sign(mean[middle]), np.sign(gauss[middle])) == (sign_h, sign_k)


def gaussian_bump_error(cell_m):
    x, y = axes(int(160 / cell_m) + 1, cell_m)
    width_m, height_m = 20.0, 8.0
    z = height_m * np.exp(-(x**2 + y**2) / (2 * width_m**2))
    p, q = -x / width_m**2 * z, -y / width_m**2 * z
    r, t = (x**2 / width_m**2 - 1) * z / width_m**2, (y**2 / width_m**2 - 1) * z / width_m**2
    s = x * y / width_m**4 * z
    w2 = 1 + p**2 + q**2
    true = ((1 + q**2) * r - 2 * p * q * s + (1 + p**2) * t) / (2 * w2**1.5)
    mean, _ = curvature(z, cell_m)
    return worst(mean, true, rim=2) / np.abs(true).max()


def test_a_bump_converges_to_second_order():
    coarse, fine = gaussian_bump_error(2.0), gaussian_bump_error(1.0)
    assert coarse < 0.005
    assert 3.7 < coarse / fine < 4.3


def test_cells_need_not_be_square():
    n = 60
    x = (np.arange(n) - 30) * 1.0
    y = -(np.arange(n) - 30) * 1.7
    east, north = np.meshgrid(x, y)
    radius_m = 300.0
    mean, gauss = curvature(np.sqrt(radius_m**2 - east**2 - north**2), 1.0, 1.7)
    np.testing.assert_allclose(mean, -1 / radius_m, rtol=0.01)
    np.testing.assert_allclose(gauss, 1 / radius_m**2, rtol=0.02)


def test_rims_of_holes_and_edges_keep_a_quadratic_exact():
    x, y = axes(31)
    z = 0.01 * x**2 - 0.02 * x * y + 0.03 * y**2 + 0.1 * x
    z[12:15, 14:20] = np.nan
    d = derivatives_3x3(z, 1.0, 1.0)
    known = ~np.isnan(z)
    # The map's corners too, where only one quadrant is known.
    inner = known
    np.testing.assert_allclose(d.r[inner], 0.02, atol=1e-10)
    np.testing.assert_allclose(d.t[inner], 0.06, atol=1e-10)
    np.testing.assert_allclose(d.s[inner], -0.02, atol=1e-10)
    assert np.isnan(d.r[~known]).all()


def test_lifting_or_mirroring_the_surface_does_what_geometry_says():
    rng = np.random.default_rng(1)
    z = np.cumsum(np.cumsum(rng.normal(size=(30, 30)), 0), 1) * 0.01
    mean, gauss = curvature(z)
    lifted, _ = curvature(z - 5000)
    np.testing.assert_allclose(lifted, mean, atol=1e-9)
    turned, turned_gauss = curvature(-z)
    np.testing.assert_allclose(turned, -mean, atol=1e-12)
    np.testing.assert_allclose(turned_gauss, gauss, atol=1e-12)
    mirrored, _ = curvature(np.ascontiguousarray(z[:, ::-1]))
    np.testing.assert_allclose(mirrored[:, ::-1], mean, atol=1e-12)
