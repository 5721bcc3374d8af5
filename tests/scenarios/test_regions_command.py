"""`bathynav regions` from the door: files, table, refusals in one line."""

import json

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner
from rasterio.transform import from_origin

from mapping.rasters import write_map
from perception.records import Grid, InputError
from scenarios.commands.regions import _compiled, _length, command


def write(path, z, sigma=None):
    write_map(path, Grid(np.asarray(z, float), 500000.0, 7000000.0, 1.0, "EPSG:32602", sigma))
    return path


def run(*arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=True)


def hill(n=64):
    y, x = np.mgrid[:n, :n] - n / 2
    z = 5 * np.exp(-(x**2 + y**2) / 200) - 40
    return z + np.random.default_rng(1).normal(0, 0.03, z.shape)


def test_a_map_becomes_every_file_of_the_contract(tmp_path):
    path = write(tmp_path / "map.tif", hill())
    done = run(path, "--out", tmp_path / "out", "--levels", 2)
    assert done.exit_code == 0, done.output
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert {
        "regions.tif", "regions.gpkg", "regions.qml", "curvature.tif", "legend.png", "regions.png",
        "metrics.json", "config.toml", "regions-level-2.tif",
    } <= names  # fmt: skip
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["share_peak"] > 0
    assert "peak" in done.output


def test_quiet_prints_nothing(tmp_path):
    path = write(tmp_path / "map.tif", hill(32))
    assert run(path, "--out", tmp_path / "out", "-q").output == ""


@pytest.mark.parametrize(
    "z",
    [np.full((1, 1), -3.0), np.full((1, 30), -3.0), np.full((40, 40), -3.0), hill(40) + 3e6],
    ids=["one cell", "one row", "constant", "millions"],
)
@pytest.mark.parametrize("scale", [None, 1000.0], ids=["chosen", "wider than the map"])
def test_odd_maps_give_a_clear_result(tmp_path, z, scale):
    path = write(tmp_path / "map.tif", z)
    more = () if scale is None else ("--scale", scale)
    done = run(path, "--out", tmp_path / "out", *more)
    assert done.exit_code == 0, (done.output, done.exception)
    with rasterio.open(tmp_path / "out" / "regions.tif") as source:
        assert (source.read(1) > 0).all()


@pytest.mark.parametrize(
    "options",
    [
        ("--method", "difference"),
        ("--method", "least-squares"),
        ("--window", 9),
        ("--method", "box", "--window", 5000),
        ("--detail", 0),
        ("--detail", 1e6),
    ],
    ids=str,
)
def test_every_method_gives_a_whole_result(tmp_path, options):
    path = write(tmp_path / "map.tif", hill(40))
    done = run(path, "--out", tmp_path / "out", *options, "--levels", 2)
    assert done.exit_code == 0, (done.output, done.exception)
    with rasterio.open(tmp_path / "out" / "regions.tif") as source:
        assert (source.read(1) > 0).all()
    with rasterio.open(tmp_path / "out" / "curvature.tif") as source:
        bands = source.read()
    assert np.isfinite(bands).all()
    assert bands[0, 12:28, 12:28].mean() < 0  # a summit by any method, noise averaged out


def test_a_window_is_what_the_textbook_fit_gives(tmp_path):
    z = hill(40)
    path = write(tmp_path / "map.tif", z)
    run(path, "--out", tmp_path / "out", "--window", 3)
    run(path, "--out", tmp_path / "same", "--method", "least-squares")
    found = [rasterio.open(tmp_path / name / "curvature.tif").read() for name in ("out", "same")]
    inner = np.s_[:2, 1:-1, 1:-1]
    np.testing.assert_allclose(found[0][inner], found[1][inner], rtol=1e-4, atol=1e-6)


def test_an_odd_sigma_band_is_no_obstacle(tmp_path):
    sigma = np.full((64, 64), 0.03)
    sigma[:10] = 0
    sigma[10:20] = -1
    sigma[20:30] = np.nan
    path = write(tmp_path / "map.tif", hill(), sigma)
    assert run(path, "--out", tmp_path / "out").exit_code == 0


def refused(*arguments):
    done = run(*arguments)
    assert isinstance(done.exception, InputError), done.exception
    return str(done.exception)


def test_a_map_of_nan_is_refused(tmp_path):
    path = write(tmp_path / "map.tif", np.full((9, 9), np.nan))
    assert "no height" in refused(path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_degrees_are_refused_with_the_way_out(tmp_path):
    path = tmp_path / "degrees.tif"
    profile = dict(driver="GTiff", width=8, height=8, count=1, dtype="float32", crs="EPSG:4326")
    with rasterio.open(path, "w", transform=from_origin(10, 50, 0.01, 0.01), **profile) as target:
        target.write(np.zeros((8, 8), np.float32), 1)
    assert "gdalwarp" in refused(path, "--out", tmp_path / "out")


@pytest.mark.parametrize("option", ["--scale", "--window", "--detail", "--map-sigma"])
def test_lengths_below_zero_are_wrong_usage(tmp_path, option):
    done = run(tmp_path / "map.tif", "--out", tmp_path / "out", option, -2)
    assert done.exit_code == 2 and option in done.output and not (tmp_path / "out").exists()


def test_impossible_options_and_missing_files_are_refused(tmp_path):
    path = write(tmp_path / "map.tif", hill(32))
    out = tmp_path / "out"
    assert "exclude" in refused(path, "--out", out, "--scale", 2, "--window", 5)
    assert "needs a --window" in refused(path, "--out", out, "--method", "box")
    assert "goes with" in refused(path, "--out", out, "--method", "difference", "--window", 5)
    assert "no such file" in refused(tmp_path / "none.tif", "--out", tmp_path / "out")
    missing = tmp_path / "objects.gpkg"
    assert "objects.gpkg" in refused(path, "--out", tmp_path / "out", "--objects", missing)


def test_objects_become_a_layer_of_their_own(tmp_path):
    z = hill()
    z[10:13, 50:53] += 3
    path = write(tmp_path / "map.tif", z)
    objects = tmp_path / "objects.csv"
    objects.write_text("easting_m,northing_m,kind,height_m\n500051.5,6999988.5,hill,3\n")
    done = run(path, "--out", tmp_path / "out", "--objects", objects)
    assert done.exit_code == 0, (done.output, done.exception)
    import pyogrio.raw

    meta, _, _, values = pyogrio.raw.read(tmp_path / "out" / "objects.gpkg")
    found = dict(zip(meta["fields"], values, strict=True))
    assert found["height_over_floor_m"][0] == pytest.approx(3, abs=0.3)


def test_lengths_of_rounding_are_told_in_words():
    assert _length(8e-15, "none seen") == "none seen"
    assert _length(0.25, "none") == "0.25 m"


def test_a_first_run_knows_itself_by_the_kernels_that_are_missing(tmp_path):
    (tmp_path / "curvature.differentiate-1.py311.nbi").touch()
    assert not _compiled(tmp_path)
    (tmp_path / "scale._mix-1.py311.nbi").touch()
    assert _compiled(tmp_path)
