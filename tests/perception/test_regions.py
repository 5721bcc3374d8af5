"""Regions of surfaces whose classes are known; labels, merging, graph and levels; odd maps."""

import numpy as np
import pytest

from perception.background import lift_objects
from perception.records import REGION_CLASSES, Grid, InputError
from perception.region_classes import classify, three_classes
from perception.region_detail import tiles
from perception.region_graph import neighbours
from perception.region_labels import fold_borders, fold_sums, label_and_sum, region_borders
from perception.region_merging import join_equal, merge_regions
from perception.regions import RegionConfig, segment, weight_map

RNG = np.random.default_rng


def grid_of(z, cell_m=1.0, **more):
    return Grid(np.asarray(z, float), 1000.0, 2000.0, cell_m, **more)


def hill(n=96, width=15.0, height=6.0, noise_m=0.02):
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    z = height * np.exp(-(x**2 + y**2) / (2 * width**2)) - 50
    return z + RNG(1).normal(0, noise_m, z.shape)


def name_at(regions, row, col):
    return REGION_CLASSES[regions.class_code[row, col]]


def test_a_hill_is_one_peak_and_a_hollow_one_pit():
    for sign, name in ((1, "peak"), (-1, "pit")):
        regions = segment(grid_of(sign * hill())).regions
        assert name_at(regions, 48, 48) == name
        row = regions.region[48, 48] - 1
        assert REGION_CLASSES[regions.table["class_code"][row]] == name
        # Gaussian curvature changes sign one width from the summit.
        assert regions.table["area_m2"][row] == pytest.approx(np.pi * 15.0**2, rel=0.25)
        assert regions.table["easting_m"][row] == pytest.approx(1048.0, abs=1.5)
        assert regions.table["northing_m"][row] == pytest.approx(1952.0, abs=1.5)


def test_a_long_crest_is_a_ridge_along_its_axis():
    n = 128
    y, x = np.mgrid[:n, :n].astype(float) - 64
    across = (x - y) / np.sqrt(2)  # rows run south: the crest runs from north-west to south-east
    z = 5 * np.exp(-(across**2) / (2 * 12.0**2)) + RNG(2).normal(0, 0.05, (n, n))
    regions = segment(grid_of(z)).regions
    assert name_at(regions, 64, 64) == "ridge"
    row = regions.region[64, 64] - 1
    assert np.degrees(regions.table["axis_rad"][row]) == pytest.approx(135, abs=5)
    assert regions.table["elongation"][row] > 3
    assert (three_classes(regions)[60:68, 60:68] == 3).any()


def test_noise_on_a_plane_is_flat():
    """The widest fit leaves a handful of independent patches, so chance is averaged over four maps."""
    y, x = np.mgrid[:128, :128]
    share = []
    for seed in range(4):
        z = 0.1 * x - 0.05 * y + RNG(seed).normal(0, 0.1, (128, 128))
        share.append(np.mean(segment(grid_of(z)).regions.class_code == 7))
    assert np.mean(share) > 0.75


def test_probabilities_add_up_and_choose_the_class():
    regions = segment(
        grid_of(hill()), RegionConfig(seed_probability=0.0, least_area_m2=0.0)
    ).regions
    assert regions.probability is not None
    np.testing.assert_allclose(regions.probability.sum(axis=0), 1, atol=1e-5)
    np.testing.assert_array_equal(regions.probability.argmax(axis=0), regions.class_code)


def test_class_probability_is_the_share_of_draws():
    """Against sampling: H and K drawn with their sigmas, each draw classed by its tolerances."""
    rng = RNG(4)
    mean, gauss, sigma_h, sigma_k = 0.8, -0.5, 1.0, 1.0
    planes = tuple(np.full((1, 1), v) for v in (mean, gauss, sigma_h, sigma_k))
    _, _, probability = classify(planes, k_sigma=1.0)
    h = rng.normal(mean, sigma_h, 200_000)
    k = rng.normal(gauss, sigma_k, 200_000)
    peak, saddle_valley, flat = (h < -1) & (k > 1), (h > 1) & (k < -1), (abs(h) <= 1) & (k >= -1)
    for code, drawn in ((1, peak), (6, saddle_valley), (7, flat)):
        assert probability[code, 0, 0] == pytest.approx(drawn.mean(), abs=0.004)


def test_labels_and_sums_agree_with_scipy():
    """Over seams between strips too, which lie every 64 rows."""
    ndimage = pytest.importorskip("scipy.ndimage")
    code = RNG(5).integers(0, 4, (150, 70)).astype(np.uint8)
    z = RNG(6).normal(size=code.shape)
    labels = label_and_sum(code, (z, z, z, z, z))
    region, count = labels.region, len(labels.class_of) - 1
    total = 0
    for c in (1, 2, 3):
        theirs, n = ndimage.label(code == c)
        total += n
        pairs = np.unique(np.stack([region[code == c], theirs[code == c]]), axis=1)
        assert pairs.shape[1] == n  # one to one
    assert count == total
    np.testing.assert_array_equal(labels.class_of[region], code)
    numbers = np.arange(1, count + 1)
    np.testing.assert_allclose(labels.sums[1:, 6], ndimage.sum(z, region, numbers), atol=1e-9)
    np.testing.assert_allclose(labels.sums[1:, 10], ndimage.minimum(z, region, numbers))
    np.testing.assert_allclose(labels.sums[1:, 11], ndimage.maximum(z, region, numbers))
    first_seen = np.unique(region[region > 0], return_index=True)[1]
    assert (np.diff(first_seen) > 0).all()


def test_merging_on_the_graph_is_what_labelling_the_merged_map_gives():
    rng = RNG(9)
    code = rng.integers(1, 4, (100, 60)).astype(np.uint8)
    z = rng.normal(size=code.shape)
    labels = label_and_sum(code, (z, z, z, z, z))
    edges, border_m = region_borders(labels.region, 2.0, 3.0)
    area = labels.sums[:, 0]
    weak = rng.uniform(size=len(area)) < 0.2
    parent = merge_regions(edges, border_m, area, np.full(len(area), 6.0), weak)
    number, class_of = join_equal(edges, parent, labels.class_of)
    merged = labels.class_of[parent][labels.region]
    again = label_and_sum(merged, (z, z, z, z, z))
    np.testing.assert_array_equal(number[labels.region], again.region)
    np.testing.assert_array_equal(class_of, again.class_of)
    np.testing.assert_allclose(fold_sums(labels.sums, number)[1:], again.sums[1:], atol=1e-9)
    found, expected = fold_borders(edges, border_m, number), region_borders(again.region, 2.0, 3.0)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1])


def test_hills_are_read_at_the_finest_scale_and_rough_ground_at_a_coarser():
    y, x = np.mgrid[:160, :160]
    waves = 3 * np.sin(x / 9.0) * np.sin(y / 11.0) + RNG(1).normal(0, 0.02, x.shape)
    assert segment(grid_of(waves)).detail_m == 0
    f = np.hypot(np.fft.fftfreq(160)[:, None], np.fft.fftfreq(160))
    f[0, 0] = 1
    rough = np.real(np.fft.ifft2(np.fft.fft2(RNG(2).normal(size=(160, 160))) * f**-2.2))
    rough *= 10 / rough.std()
    chosen, fine = segment(grid_of(rough)), segment(grid_of(rough), RegionConfig(detail_m=0.0))
    assert chosen.detail_m >= 2
    assert fine.detail_m == 0
    sizes = []
    for regions in (chosen.regions, fine.regions):
        area_m2 = np.sort(regions.table["area_m2"][regions.table["class_code"] != 7])
        running = np.cumsum(area_m2)
        sizes.append(area_m2[np.searchsorted(running, running[-1] / 2)])
    assert sizes[0] > 2 * sizes[1]
    # The curvature is what it is at any detail of the classes.
    np.testing.assert_array_equal(chosen.curvature.H, fine.curvature.H)


def test_borders_are_measured_in_metres():
    region = np.array([[1, 1, 2], [1, 3, 2]], np.int32)
    edges, border_m = region_borders(region, 2.0, 5.0)
    found = {tuple(pair): metres for pair, metres in zip(edges.tolist(), border_m, strict=True)}
    assert found == {(1, 2): 5.0, (1, 3): 7.0, (2, 3): 5.0}
    assert neighbours(edges, 3) == [[2, 3], [1, 3], [1, 2]]


def test_the_small_join_the_neighbour_of_the_longest_border():
    edges = np.array([[1, 2], [1, 3], [2, 3]])
    parent = merge_regions(
        edges,
        np.array([2.0, 9.0, 1.0]),
        np.array([0.0, 3.0, 50.0, 60.0]),
        np.full(4, 10.0),
        np.zeros(4, bool),
    )
    assert parent[1] == parent[3]
    assert parent[2] == 2


def test_no_region_is_smaller_than_asked():
    z = np.cumsum(np.cumsum(RNG(6).normal(size=(120, 120)), 0), 1) * 0.01
    regions = segment(grid_of(z), RegionConfig(least_area_m2=40.0)).regions
    assert regions.table["area_m2"].min() >= 40
    assert regions.table["area_m2"].sum() == pytest.approx(120 * 120)


def test_neighbouring_regions_differ_in_class():
    regions = segment(grid_of(hill())).regions
    code = regions.table["class_code"]
    assert (code[regions.edges[:, 0] - 1] != code[regions.edges[:, 1] - 1]).all()


def test_coarser_levels_have_fewer_regions_and_every_region_a_parent():
    z = np.cumsum(np.cumsum(RNG(7).normal(size=(160, 160)), 0), 1) * 0.01
    result = segment(grid_of(z + RNG(8).normal(0, 0.05, z.shape)), RegionConfig(levels=3))
    counts = [len(r.table["area_m2"]) for r in (result.regions, *result.coarser)]
    assert counts[0] >= counts[1] >= counts[2]
    for k, parents in enumerate(result.parents):
        assert len(parents) == counts[k]
        assert parents.min() >= 1
        assert parents.max() <= counts[k + 1]


def test_moving_the_map_moves_the_regions_only():
    z = hill()
    here = segment(Grid(z, 0.0, 0.0, 1.0)).regions
    there = segment(Grid(z, 5e5, 7e6, 1.0)).regions
    np.testing.assert_array_equal(here.region, there.region)
    np.testing.assert_allclose(there.table["easting_m"] - here.table["easting_m"], 5e5)


def test_a_hole_is_no_data_and_the_rest_is_as_without_it():
    z = hill()
    holed = z.copy()
    holed[5:15, 70:85] = np.nan
    whole, cut = segment(grid_of(z)), segment(grid_of(holed))
    missing = np.isnan(holed)
    assert (cut.regions.class_code[missing] == 0).all()
    assert (cut.regions.region[missing] == 0).all()
    assert np.isnan(cut.curvature.H[missing]).all()
    assert np.isfinite(cut.curvature.H[~missing]).all()
    assert np.mean(whole.regions.class_code[30:, :60] == cut.regions.class_code[30:, :60]) > 0.9


@pytest.mark.parametrize(
    "z",
    [
        np.full((1, 1), -10.0),
        np.full((1, 40), -10.0),
        np.linspace(0, 5, 40)[None] ** 2,
        np.linspace(0, 5, 40)[:, None] ** 2,
        np.full((30, 30), -10.0),
        np.array([[np.nan, -3.0], [np.nan, np.nan]]),
    ],
)
@pytest.mark.parametrize("scale_m", [None, 0.0, 500.0])
def test_maps_of_nothing_much_give_a_whole_result(z, scale_m):
    result = segment(grid_of(z), RegionConfig(scale_m=scale_m))
    known = np.isfinite(z)
    assert (result.regions.class_code[known] > 0).all()
    assert np.isfinite(result.curvature.H[known]).all()
    assert np.isfinite(result.curvature.sigma_H[known]).all()


def test_a_constant_map_is_flat_and_a_tilted_one_too():
    y, x = np.mgrid[:50, :60]
    for z in (np.full((50, 60), -7.0), -7 + 0.3 * x - 0.2 * y):
        assert (segment(grid_of(z)).regions.class_code == 7).all()


def test_heights_in_the_millions_keep_their_shape():
    z = hill()
    low, high = segment(grid_of(z)), segment(grid_of(z + 4e6))
    assert np.mean(low.regions.class_code == high.regions.class_code) > 0.99


def test_a_map_of_nan_is_refused():
    with pytest.raises(InputError, match="no height"):
        segment(grid_of(np.full((5, 5), np.nan)))


@pytest.mark.parametrize("scale_m", [-1.0, float("nan")])
def test_an_impossible_scale_is_refused(scale_m):
    with pytest.raises(InputError, match="scale"):
        RegionConfig(scale_m=scale_m)


def test_a_sigma_of_zeros_negatives_and_nan_changes_nothing():
    z = hill()
    odd = np.zeros(z.shape)
    odd[::2] = -1
    odd[::3] = np.nan
    without, with_odd = segment(grid_of(z)), segment(grid_of(z, sigma_m=odd))
    np.testing.assert_array_equal(without.regions.class_code, with_odd.regions.class_code)


def test_weights_are_expected_over_the_classes():
    regions = segment(grid_of(hill())).regions
    weights = np.array([0, 2, 1, 2, 1, 1.5, 1.25, 1, 1.5])
    expected = weight_map(regions, weights)
    assert expected.min() >= 1
    assert expected.max() <= 2 + 1e-6  # probabilities are single precision
    assert expected[48, 48] == pytest.approx(2, abs=0.01)


def test_a_lifted_boulder_leaves_the_slope_it_stood_on():
    y, x = np.mgrid[:80, :80].astype(float)
    floor = -20 + 0.05 * x + 0.002 * (y - 40) ** 2
    distance = np.hypot(x - 30, y - 50)
    z = floor + np.where(distance <= 3, 2.5, 0)
    grid = grid_of(z)
    east, north = grid.centres()
    lifted = lift_objects(grid, east[[30]], north[[50]], np.array([4.0]))
    np.testing.assert_allclose(lifted.background.elevation_m, floor, atol=1e-9)
    assert lifted.height_m[0] == pytest.approx(2.5, abs=1e-9)
    assert (lifted.footprint > 0).sum() == (distance <= 4).sum()
    off_map = lift_objects(grid, np.array([-500.0]), np.array([0.0]), np.array([4.0]))
    assert np.isnan(off_map.height_m[0])


def test_a_line_of_heights_across_a_large_empty_map_is_read_as_tiles_or_whole():
    z = np.full((1000, 1000), np.nan)
    # Between the cells of the thinned look.
    z[:, 500:503] = np.linspace(-40, -50, 1000)[:, None]
    assert len(tiles(grid_of(z))) > 0
    # And between the tiles themselves, of a map wider than they reach.
    wide = np.full((300, 4000), np.nan)
    wide[:, 300:303] = -40.0
    corners = {t.elevation_m.shape for t in tiles(grid_of(wide))}
    assert corners == {wide.shape}
