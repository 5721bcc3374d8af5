"""The echo kernel against analytic levels, planted shadows, symmetries and a plain twin."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter

from perception.records import Grid
from scenarios.benchmarks.simulation import plain_echo
from scenarios.sections import SonarSection
from scenarios.sonar import beams, kernel
from scenarios.sonar.echoes import facet_echoes, sonar_model

CELL_M = 0.25


def flat(size_m=110.0, depth_m=20.0):
    n = round(size_m / CELL_M)
    return Grid(np.full((n, n), -depth_m), -0.5 * size_m, 0.5 * size_m, CELL_M)


def pose(
    altitude_m=15.0, depth_m=20.0, heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0, at=(0.0, 0.0)
):
    angles = np.deg2rad([heading_deg, pitch_deg, roll_deg])
    return np.array([[*at, altitude_m - depth_m, *angles, 0.0, 0.0, 0.0, 0.0]])


def model_of(**keys):
    config = SonarSection(**{"samples": 512, "range_m": 50.0, "nadir_lobe_db": None, **keys})
    return sonar_model(config, depth_m=20.0, cell_m=CELL_M)


def echo(floor, poses, model, albedo=None):
    albedo = np.ones(floor.shape) if albedo is None else albedo
    return facet_echoes(floor, albedo, poses, model).astype(float)


def test_flat_floor_returns_the_analytic_level_within_two_tenths_of_a_decibel():
    """The level is integrated here on its own: area, Lambert and both patterns by quadrature."""
    altitude = 15.0
    model = model_of()
    got = echo(flat(), pose(altitude), model)[0]
    width, tilt, down = np.deg2rad(0.8), np.deg2rad(30.0), np.deg2rad(55.0)

    def one_way(angle, beam):
        return np.sinc(0.886 / beam * np.sin(angle)) ** 2

    across = quad(lambda a: one_way(a, width) ** 2, -1.05 * width, 1.05 * width)[0]

    def per_metre(v):
        slant = np.hypot(v, altitude)
        depression = np.arcsin(altitude / slant)
        return slant * (altitude / slant) ** 2 * one_way(depression - tilt, down) ** 2

    edges = np.sqrt(np.clip((np.arange(513) * 50.0 / 512) ** 2 - altitude**2, 0, None))
    # Where the pattern is above the floor that fills its nulls.
    for k in (165, 200, 300, 400, 511):
        expected = across * quad(per_metre, edges[k], edges[k + 1])[0]
        for side in (0, 1):
            assert abs(10 * np.log10(got[side, k] / expected)) < 0.2


def test_flat_floor_shows_no_ripple_from_bin_to_bin():
    """A moire of steps and bins would look like sand ripples to an estimator."""
    model = model_of(samples=1000)
    got = echo(flat(), pose(), model)[0, 1]
    level = kernel.floor_power(model.slant_range_m, 15.0, model.beam)
    past = model.slant_range_m > 16.0
    ratio_db = 10 * np.log10(got[past] / level[past])
    assert np.abs(np.diff(ratio_db)).max() < 0.05


def test_water_column_is_empty_and_the_first_return_is_the_altitude():
    model = model_of()
    got = echo(flat(), pose(12.3), model)[0, 0]
    first = np.flatnonzero(got > 0)[0]
    assert first == int(12.3 / model.beam.sample_m)


def test_a_wall_throws_the_shadow_of_the_paper_s_worked_example():
    """Rs 60, Ls 36, Hf 20 gives 7.5 m: a thin wall whose top's slant range is 60 m."""
    altitude, height = 20.0, 7.5
    floor = flat(240.0)
    ground = np.sqrt(60.0**2 - (altitude - height) ** 2)
    column = int((ground + 120.0) / CELL_M)
    floor.elevation_m[:, column] += height
    model = model_of(range_m=110.0, samples=2200, azimuths=1)
    got = echo(floor, pose(altitude, heading_deg=0.0), model)[0, 1]
    level = kernel.floor_power(model.slant_range_m, altitude, model.beam)
    dark = np.flatnonzero((got < 0.02 * level) & (model.slant_range_m > 65))
    top = np.hypot((column + 0.5) * CELL_M - 120.0, altitude - height)
    end = top * altitude / (altitude - height)  # similar triangles
    assert_allclose(model.slant_range_m[dark[-1]], end, atol=0.3)  # half a cell of the wall
    assert_allclose(end - top, 36.0, atol=0.3)
    # The shadow starts behind the foot of the wall: no echo from there to its end.
    assert (np.diff(dark) == 1).all()


def test_echoes_of_two_facets_at_one_range_add_up():
    """Layover: the sum over a wall's face and the floor before it holds both energies."""
    model = model_of(azimuths=1, samples=256)
    plain, walled = flat(), flat()
    walled.elevation_m[:, 260:263] += 3.0
    before, after = (echo(f, pose(), model)[0, 1] for f in (plain, walled))
    face = np.hypot((259.5 * CELL_M - 55.0), 12.0)  # the top lies nearer than its foot
    bins = int(face / model.beam.sample_m)
    assert after[bins : bins + 4].max() > 1.5 * before[bins : bins + 4].max()


def test_mirrored_world_swaps_port_and_starboard():
    rng = np.random.default_rng(3)
    floor = flat()
    floor.elevation_m[:] += np.cumsum(rng.normal(0, 0.02, floor.shape), axis=1)
    mirrored = Grid(floor.elevation_m[:, ::-1].copy(), floor.west_m, floor.north_m, CELL_M)
    model = model_of(motion_during_echo=False)
    a = echo(floor, pose(roll_deg=3.0), model)[0]
    b = echo(mirrored, pose(roll_deg=-3.0), model)[0]
    # Albedo is read at the nearest cell, heights between cells: rounding alone differs.
    assert_allclose(a[0], b[1], rtol=1e-4, atol=1e-6 * a.max())


def test_turned_world_gives_the_same_echo():
    """Turning floor and heading by a quarter leaves every echo as it was."""
    rng = np.random.default_rng(4)
    floor = flat()
    floor.elevation_m[:] += np.cumsum(rng.normal(0, 0.02, floor.shape), axis=1)
    turned = Grid(np.rot90(floor.elevation_m, -1).copy(), floor.west_m, floor.north_m, CELL_M)
    model = model_of()
    a = echo(floor, pose(heading_deg=20.0, pitch_deg=2.0, roll_deg=1.0), model)
    b = echo(turned, pose(heading_deg=110.0, pitch_deg=2.0, roll_deg=1.0), model)
    assert_allclose(a, b, rtol=1e-4, atol=1e-6 * a.max())


@pytest.mark.parametrize("pitch_deg", [-4.0, 0.0, 4.0])
def test_a_boulder_abeam_is_brightest_where_pitch_points_the_beam(pitch_deg):
    """Bow up by p the fan meets the floor h tan(p) ahead."""
    floor = flat(depth_m=20.0)
    model = model_of(motion_during_echo=False, azimuths=15)
    albedo = np.ones(floor.shape)
    # A bright spot 20 m to starboard of the track at north 0.
    spot = np.hypot(floor.centres()[0][None, :] - 20.0, floor.centres()[1][:, None]) < 0.5
    albedo[spot] = 1000.0
    along = np.arange(-3.0, 3.01, 0.1)
    poses = np.concatenate([pose(15.0, pitch_deg=pitch_deg, at=(0.0, n)) for n in along])
    energy = echo(floor, poses, model, albedo)[:, 1].sum(axis=1)
    energy -= energy.min()
    centre = (along * energy).sum() / energy.sum()
    assert_allclose(centre, -15.0 * np.tan(np.deg2rad(pitch_deg)), atol=0.05)


def test_roll_starboard_down_turns_the_pattern_toward_the_nadir():
    """With the axis 30 degrees down, rolling by 10 puts the starboard axis at 40."""
    model = model_of(vertical_beam_deg=20.0, samples=1024)
    level = kernel.floor_power(
        model.slant_range_m, 15.0, model.beam._replace(vertical=np.ones(361))
    )
    for roll_deg in (0.0, 10.0):
        got = echo(flat(), pose(roll_deg=roll_deg), model)[0, 1]
        past = model.slant_range_m > 16
        gain = np.where(past, got / np.maximum(level, 1e-12), 0)
        axis = np.rad2deg(np.arcsin(15.0 / model.slant_range_m[np.argmax(gain)]))
        assert_allclose(axis, 30.0 + roll_deg, atol=1.0)


def test_yaw_to_starboard_during_the_echo_dims_both_sides_and_way_does_too():
    model, still = model_of(), model_of(motion_during_echo=False)
    turning = pose()
    turning[0, 6] = np.deg2rad(10.0)
    a, b = echo(flat(), turning, model)[0], echo(flat(), turning, still)[0]
    far = slice(-50, None)
    lost_db = 10 * np.log10(a[:, far].sum(axis=1) / b[:, far].sum(axis=1))
    # 10 deg/s over 65 ms is 0.65 deg of a beam 0.8 deg wide: clearly less, the same on both sides.
    assert (lost_db < -1.5).all() and (lost_db > -4).all()
    assert_allclose(lost_db[0], lost_db[1], atol=0.1)


def test_kernel_agrees_with_its_plain_twin():
    rng = np.random.default_rng(5)
    floor = flat()
    floor.elevation_m[:] += np.cumsum(rng.normal(0, 0.03, floor.shape), axis=0)
    floor.elevation_m[180:186, 280:286] += 2.0
    model = model_of(nadir_lobe_db=3.0)
    for side in (-1.0, 1.0):
        at = pose(14.0, heading_deg=33.0, pitch_deg=2.0, roll_deg=-4.0, at=(3.0, -2.0))
        at[0, 6:] = (0.05, -0.02, 1.5, 0.1)
        fast = echo(floor, at, model)[0, int(side > 0)]
        plain = plain_echo(floor, np.ones(floor.shape), at[0], side, model)
        assert_allclose(fast, plain, rtol=1e-5, atol=1e-9)


def test_line_array_has_its_stated_width():
    width = np.deg2rad(1.0)
    assert_allclose(beams.line_array(np.array([0.5 * width]), width), 0.5, atol=0.002)


def test_absorption_agrees_with_published_values():
    """Ainslie & McColm at 10 C, 35 psu: near 10 dB/km at 50 kHz and 110 dB/km at 450 kHz."""
    water = {"temperature_c": 10.0, "salinity_psu": 35.0, "depth_m": 0.0}
    assert_allclose(beams.absorption_db_m(50.0, **water) * 1000, 15.0, rtol=0.2)
    assert_allclose(beams.absorption_db_m(450.0, **water) * 1000, 110.0, rtol=0.15)


def brute_force(floor, at, side, model, heading):
    """Return the echo per metre of slant range from facets on a plain map grid, seen by straight rays.

    Nothing of the kernel's walk: facets lie on a fine lattice, their angle to the array follows from
    dot products with the body's axes, and a facet is seen when no point of its ray lies below ground.
    """
    step = 0.05
    u, v = np.meshgrid(np.arange(-3, 3, step), np.arange(-14.0, 50.0, 2 * step), indexing="ij")
    sin_h, cos_h = np.sin(heading), np.cos(heading)
    e = at[0] + u * sin_h + side * v * cos_h
    n = at[1] + u * cos_h - side * v * sin_h
    z = floor.sample(e, n)
    d = 0.05
    slope_e = (floor.sample(e + d, n) - floor.sample(e - d, n)) / (2 * d)
    slope_n = (floor.sample(e, n + d) - floor.sample(e, n - d)) / (2 * d)
    ray = np.stack([e - at[0], n - at[1], z - at[2]], axis=-1)
    slant = np.linalg.norm(ray, axis=-1)
    ray /= slant[..., None]
    h, p, r = at[3:6]
    bow = np.array([np.sin(h) * np.cos(p), np.cos(h) * np.cos(p), np.sin(p)])
    level = np.array([np.cos(h), -np.sin(h), 0.0])  # starboard before roll
    down = np.cross(bow, level)  # forward x starboard is down
    starboard = level * np.cos(r) + down * np.sin(r)
    down = down * np.cos(r) - level * np.sin(r)
    off_plane = np.arcsin(ray @ bow)
    depression = np.arctan2(ray @ down, side * (ray @ starboard))
    width = model.beam.width
    horizontal = beams.line_array(off_plane, width) ** 2 * (np.abs(off_plane) < 1.05 * width)
    vertical = np.interp(np.rad2deg(depression), np.arange(-180, 181), model.beam.vertical)
    normal = np.stack([-slope_e, -slope_n, np.ones_like(z)], axis=-1)
    stretch = np.linalg.norm(normal, axis=-1)
    cosine = np.clip(-(ray * normal).sum(axis=-1) / stretch, 0.0, None)
    near = horizontal > 0
    seen = np.zeros(z.shape, bool)
    points = np.linspace(0.02, 0.99, 200)[:, None]
    along = [c + points * (t[near] - c) for c, t in zip(at[:3], (e, n, z), strict=True)]
    seen[near] = (along[2] > floor.sample(along[0], along[1])).all(axis=0)
    # The kernel walks inward to 45 degrees past the nadir only.
    energy = cosine**2 * stretch * horizontal * vertical * seen * step * 2 * step
    return np.histogram(slant[near], np.arange(0.0, 48.0, 1.0), weights=energy[near])[0]


@pytest.mark.parametrize(
    ("pitch_deg", "roll_deg", "side"), [(0.0, 0.0, 1.0), (3.0, 2.0, -1.0), (-4.0, -3.0, 1.0)]
)
def test_kernel_agrees_with_brute_force_facets_on_rough_ground(pitch_deg, roll_deg, side):
    """Per metre of slant range, past the first return, where a metre holds many facets."""
    rng = np.random.default_rng(8)
    floor = flat()
    floor.elevation_m[:] += gaussian_filter(rng.normal(size=floor.shape), 12) * 40.0
    model = model_of(motion_during_echo=False, azimuths=21, samples=480, range_m=48.0)
    at = pose(15.0, heading_deg=25.0, pitch_deg=pitch_deg, roll_deg=roll_deg)
    got = echo(floor, at, model)[0, int(side > 0)][:470].reshape(47, 10).sum(axis=1)
    expected = brute_force(floor, at[0], side, model, np.deg2rad(25.0))
    lit = (np.arange(47) > 15) & (expected > 0.05 * np.median(expected[16:]))
    assert lit.sum() > 20
    ratio_db = 10 * np.log10(got[lit] / expected[lit])
    assert np.abs(np.median(ratio_db)) < 0.1
    assert np.abs(ratio_db).max() < 1.0
    dark = (np.arange(47) > 15) & ~lit
    assert (got[dark] < 0.1 * np.median(expected[16:])).all()
