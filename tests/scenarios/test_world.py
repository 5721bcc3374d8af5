"""The true floor: spectra, shapes, objects and prior maps, each against what was planted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from perception.records import Grid, InputError
from scenarios.schema import scenario_of
from scenarios.sections import PriorSection, WorldSection
from scenarios.world.build import build_world, frame_of
from scenarios.world.fields import spectral_field
from scenarios.world.prior import block_mean, prior_map


def world(*terrain, seed=0, rasters=None, **keys):
    tree = {"size_east_m": 100.0, "size_north_m": 80.0, "cell_m": 0.5, "terrain": list(terrain)}
    section = scenario_of(
        {"mission": {"lines": [[0, 0, 1, 0]]}, "world": {**tree, **keys}}, "test"
    ).world
    return build_world(section, rng=np.random.default_rng(seed), rasters=rasters)


def relief(made):
    return made.floor.elevation_m - made.floor.elevation_m.mean()


def at(made, east, north):
    return float(made.floor.sample(560000.0 + east, 5550000.0 + north))


def test_fractal_relief_has_its_stated_slope():
    """A profile's spectrum falls as k^-slope between the wavelengths."""
    frame = Grid(np.zeros((512, 512)), 0.0, 0.0, 1.0)
    for slope in (2.0, 3.0):
        power = 0.0
        for seed in range(4):
            field = spectral_field(
                frame, rms=1.0, slope=slope, longest_m=256.0, shortest_m=4.0,
                rng=np.random.default_rng(seed),
            )  # fmt: skip
            window = np.hanning(512)
            power = power + (np.abs(np.fft.rfft(field * window, axis=1)) ** 2).mean(axis=0)
        k = np.arange(len(power))
        middle = slice(6, 60)  # within the band, away from its ends
        fit = np.polyfit(np.log(k[middle]), np.log(power[middle]), 1)[0]
        assert_allclose(fit, -slope, atol=0.3)


def test_a_field_is_the_same_at_every_resolution():
    keys = {"rms": 1.0, "slope": 2.5, "longest_m": 60.0, "shortest_m": 4.0}
    coarse = Grid(np.zeros((80, 100)), 0.0, 80.0, 1.0)
    fine = Grid(np.zeros((240, 300)), 0.0, 80.0, 1 / 3)
    a = spectral_field(coarse, rng=np.random.default_rng(1), **keys)
    b = spectral_field(fine, rng=np.random.default_rng(1), **keys)
    # Every third fine cell has its centre on a coarse one's.
    assert_allclose(b[1::3, 1::3], a, atol=0.01)


def test_a_field_has_its_rms_over_its_period():
    frame = Grid(np.zeros((400, 400)), 0.0, 0.0, 1.0)
    field = spectral_field(
        frame, rms=2.0, slope=2.0, longest_m=20.0, shortest_m=4.0, rng=np.random.default_rng(2)
    )
    assert_allclose(field.std(), 2.0, rtol=0.05)


def test_plane_falls_toward_its_azimuth():
    made = world({"kind": "plane", "slope_deg": 5.0, "toward_deg": 90.0})
    assert_allclose(at(made, 20, 0) - at(made, -20, 0), -40 * np.tan(np.deg2rad(5)), rtol=1e-6)
    assert_allclose(at(made, 0, 20), at(made, 0, -20), atol=1e-9)


def test_canyon_and_ridge_have_their_depth_width_and_pass():
    canyon = world(
        {"kind": "canyon", "azimuth_deg": 90.0, "depth_m": 6.0, "width_m": 10.0, "wall_m": 12.0}
    )
    assert_allclose(
        [at(canyon, 30, n) + 60 for n in (0, 4.5, 11.0, 17.5)], [-6, -6, -3, 0], atol=0.02
    )
    ridge = world(
        {"kind": "ridge", "azimuth_deg": 0.0, "height_m": 5.0, "gaps_m": [10.0], "gap_width_m": 8.0, "wall_m": 8.0}
    )  # fmt: skip
    assert_allclose(at(ridge, 0, -25) + 60, 5.0, atol=0.02)
    assert_allclose(at(ridge, 0, 10) + 60, 0.0, atol=0.02)


def test_sand_waves_have_their_height_and_length():
    made = world({"kind": "sand-waves", "azimuth_deg": 0.0, "height_m": 2.0, "length_m": 20.0})
    z = made.floor.elevation_m[0]
    assert_allclose(np.ptp(z), 2.0, atol=0.02)
    assert_allclose(z[:-40], z[40:], atol=1e-6)  # 40 cells of 0.5 m are one wavelength


@pytest.mark.parametrize("kind", ["boulders", "mounds", "pockmarks"])
def test_scattered_objects_stand_where_the_truth_says_and_as_high(kind):
    made = world(
        {"kind": kind, "count": 6, "spacing_m": 16.0, "size_east_m": 70.0, "size_north_m": 50.0,
         "height_min_m": 2.0, "height_max_m": 3.0, "aspect_min": 2.0, "aspect_max": 2.5},
        cell_m=0.25,
    )  # fmt: skip
    assert len(made.objects) == 6
    for item in made.objects:
        height = float(made.floor.sample(item.easting_m, item.northing_m)) + 60.0
        sign = -1 if kind == "pockmarks" else 1
        assert item.kind == ("crater" if sign < 0 else "hill")
        assert_allclose(height, sign * item.height_m, atol=0.05)
        beside = float(made.floor.sample(item.easting_m + item.radius_m + 0.5, item.northing_m))
        assert_allclose(beside, -60.0, atol=1e-9)


def test_box_has_its_volume():
    made = world(
        {"kind": "object", "shape": "box", "height_m": 2.0, "length_m": 8.0, "width_m": 3.0,
         "azimuth_deg": 30.0},
        cell_m=0.25,
    )  # fmt: skip
    volume = (made.floor.elevation_m + 60.0).sum() * 0.25**2
    assert_allclose(volume, 2.0 * 8.0 * 3.0, rtol=0.02)


def test_raster_is_laid_out_and_stretched_as_stated():
    rng = np.random.default_rng(0)
    source = Grid(gaussian_filter(rng.normal(size=(60, 60)), 4.0), 0.0, 0.0, 5.0)
    made = world(
        {"kind": "raster", "path": "r.tif", "cell_m": 2.0, "rms_m": 1.5}, rasters={"r.tif": source}
    )
    z = source.elevation_m
    expected = (z - z.mean()) * 1.5 / z.std()
    # The raster's middle lies on the origin: cell (29, 29) has its centre 1 m west and north of it.
    assert_allclose(at(made, -1.0, 1.0) + 60.0, expected[29, 29], atol=0.02)
    assert_allclose(at(made, 9.0, -5.0) + 60.0, expected[32, 34], atol=0.02)
    with pytest.raises(InputError, match=r"r.tif: covers 60 x 60 m, less than"):
        world({"kind": "raster", "path": "r.tif", "cell_m": 1.0}, rasters={"r.tif": source})


def test_terrain_above_the_surface_and_crowded_objects_are_refused():
    with pytest.raises(InputError, match=r"rises .* above the surface"):
        world({"kind": "ridge", "height_m": 70.0})
    with pytest.raises(InputError, match="objects fit into"):
        world({"kind": "boulders", "count": 60, "spacing_m": 60.0})


def test_another_component_leaves_the_first_ones_draws_alone():
    first = {"kind": "fractal", "rms_m": 1.0, "longest_m": 50.0}
    a, b = world(first), world(first, {"kind": "plane", "slope_deg": 0.0})
    assert_allclose(a.floor.elevation_m, b.floor.elevation_m, atol=1e-12)
    assert (a.albedo == b.albedo).all()


def test_albedo_has_its_rms():
    made = world(albedo={"rms_db": 2.0, "length_m": 10.0})
    assert_allclose((10 * np.log10(made.albedo)).std(), 2.0, rtol=0.15)


def test_prior_map_has_the_stated_error_and_holes():
    made = world(
        {"kind": "plane", "slope_deg": 2.0}, size_east_m=400.0, size_north_m=400.0, cell_m=1.0
    )
    section = WorldSection(size_east_m=400.0, size_north_m=400.0, cell_m=1.0)
    config = PriorSection(
        cell_m=4.0, white_sigma_m=0.3, correlated_sigma_m=0.4, correlated_length_m=40.0,
        datum_offset_m=1.0, holes=3, hole_radius_m=20.0,
    )  # fmt: skip
    prior = prior_map(made.floor, section, config, rng=np.random.default_rng(1))
    truth = block_mean(made.floor, section, 4.0)
    error = prior.elevation_m - truth.elevation_m
    assert_allclose(np.nanmean(error), 1.0, atol=0.1)
    assert_allclose(np.nanstd(error), 0.5, rtol=0.1)
    assert_allclose(np.nanmax(prior.sigma_m), 0.5, rtol=1e-6)
    hole_area = np.isnan(error).sum() * 16.0
    assert 0.3 * 3 * np.pi * 400 < hole_area <= 3.2 * np.pi * 400


def test_block_mean_keeps_the_mean_height_of_each_cell():
    made = world({"kind": "fractal", "rms_m": 1.0, "longest_m": 40.0})
    section = WorldSection(size_east_m=100.0, size_north_m=80.0, cell_m=0.5)
    coarse = block_mean(made.floor, section, 2.0)
    by_hand = made.floor.elevation_m.reshape(40, 4, 50, 4).mean(axis=(1, 3))
    assert_allclose(coarse.elevation_m, by_hand, atol=1e-9)
    assert coarse.west_m % 2.0 == 0 and coarse.north_m % 2.0 == 0


def test_world_too_large_for_memory_is_refused_before_it_is_made():
    with pytest.raises(InputError, match="more than this simulator holds"):
        frame_of(WorldSection(size_east_m=20000.0, size_north_m=20000.0))
