"""The recorder: speckle, noise, gain and arrivals, each against its stated figure."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from scenarios.sections import SonarSection
from scenarios.sonar import kernel
from scenarios.sonar.echoes import record, sonar_model

QUIET = {"leakage_db": -200.0, "surface_db": None, "multipath_db": None, "samples": 500}


def recorded(n=400, altitude=15.0, depth=40.0, seed=0, power=None, **keys):
    config = SonarSection(**{**QUIET, **keys})
    model = sonar_model(config, depth_m=60.0, cell_m=0.25)
    if power is None:
        power = kernel.floor_power(model.slant_range_m, altitude, model.beam)
    counts = record(
        np.broadcast_to(power, (n, 2, 500)).astype(np.float32), model, config,
        altitude_m=15.0, sonar_altitude_m=np.full(n, altitude), sonar_depth_m=np.full(n, depth),
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    return counts.astype(float), model


@pytest.mark.parametrize("looks", [1.0, 4.0])
def test_speckle_power_is_gamma_of_the_stated_looks(looks):
    counts, _ = recorded(looks=looks, snr_db=60.0)
    sample = counts[:, :, 350].ravel() ** 2
    sample /= sample.mean()
    assert stats.kstest(sample, stats.gamma(looks, scale=1 / looks).cdf).pvalue > 1e-3


def test_texture_makes_the_speckle_k_distributed():
    """Its intensity has the normalised second moment 2 (1 + 1/nu)."""
    counts, _ = recorded(n=4000, texture_shape=2.0, snr_db=60.0)
    power = counts[:, :, 350] ** 2
    assert_allclose((power**2).mean() / power.mean() ** 2, 3.0, rtol=0.15)


def test_shadows_hold_noise_at_the_stated_ratio():
    counts, _ = recorded(n=4000, snr_db=15.0)
    silent, _ = recorded(n=4000, power=np.zeros(500), snr_db=15.0)
    ratio = (counts[:, :, -2:] ** 2).mean() / (silent[:, :, -2:] ** 2).mean()
    # Floor plus noise over noise, at the last samples.
    assert_allclose(10 * np.log10(ratio - 1), 15.0, atol=0.3)


def test_shadows_hold_side_lobe_leakage_at_its_level():
    config = {"leakage_db": -20.0, "snr_db": 80.0}
    power = np.ones((100, 2, 500))
    power[50, 0, 300:320] = 0.0
    levels = []
    for seed in range(40):
        counts, _ = recorded(n=100, power=power, seed=seed, **config)
        levels.append(((counts[50, 0, 302:318] ** 2).mean(), (counts[49, 0, 302:318] ** 2).mean()))
    dark, lit = np.mean(levels, axis=0)
    assert_allclose(10 * np.log10(dark / lit), -20.0, atol=0.7)


def test_surface_and_second_bottom_arrive_at_depth_and_twice_the_altitude():
    counts, model = recorded(
        power=np.zeros(500),
        altitude=15.0,
        depth=22.0,
        surface_db=0.0,
        multipath_db=0.0,
        snr_db=60.0,
    )
    profile = (counts**2).mean(axis=(0, 1))
    # Counts of a few are rounded; an arrival is many times that.
    jumps = np.flatnonzero(np.diff(np.log(profile + 1e3)) > 1.0)
    assert_allclose(model.slant_range_m[jumps + 1], [22.0, 30.0], atol=model.beam.sample_m)


def test_gain_in_error_tilts_the_level_with_range_as_stated():
    exact, model = recorded(tvg_absorption_scale=1.0, snr_db=80.0, seed=1)
    weak, _ = recorded(tvg_absorption_scale=0.8, snr_db=80.0, seed=1)
    ratio_db = 20 * np.log10(
        weak[:, :, [200, 480]].mean(axis=(0, 1)) / exact[:, :, [200, 480]].mean(axis=(0, 1))
    )
    slope = np.diff(ratio_db)[0] / np.diff(model.slant_range_m[[200, 480]])[0]
    assert_allclose(slope, -0.2 * 2 * model.absorption_db_m, rtol=0.03)


def test_dropouts_leave_the_stated_part_of_pings_to_noise():
    counts, _ = recorded(n=1000, dropouts=0.2)
    lost = (counts[:, 0, 300:].mean(axis=1) < 500).mean()
    assert_allclose(lost, 0.2, atol=0.04)


def test_the_same_generator_gives_the_same_counts():
    a, _ = recorded(n=20, seed=5)
    b, _ = recorded(n=20, seed=5)
    c, _ = recorded(n=20, seed=6)
    assert (a == b).all() and (a != c).any()
