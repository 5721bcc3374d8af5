"""`bathynav diff`: planted differences come back, and maps that cannot be compared are refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio

from mapping.rasters import write_map
from perception.records import Grid
from scenarios import commands

CRS = "EPSG:32630"


def a_map(shift_east_m: float = 0.0, crs: str = CRS, sigma_m: float = 0.1) -> Grid:
    rows, cols = 60, 80
    north, east = np.mgrid[rows:0:-1, 0:cols] - 0.5
    return Grid(
        elevation_m=-30.0 + 0.05 * east - 0.02 * north,
        west_m=500_000.0 + shift_east_m,
        north_m=5_600_060.0,
        cell_m=1.0,
        crs=crs,
        sigma_m=np.full((rows, cols), sigma_m),
    )


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["bathynav", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        commands.main()
    return int(ended.value.code or 0)


def test_a_planted_mound_is_the_one_changed_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = a_map(), a_map()
    after.elevation_m[20:30, 40:50] += 1.0
    write_map(tmp_path / "a.tif", before)
    write_map(tmp_path / "b.tif", after)
    out = tmp_path / "out"
    assert run(monkeypatch, "diff", tmp_path / "a.tif", tmp_path / "b.tif", "--out", out, "-q") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["changed_places"] == 1
    assert metrics["mae_m"] == pytest.approx(100 / 4800, abs=1e-6)
    meta, _, geometry, fields = pyogrio.raw.read(out / "changes.gpkg")
    assert len(geometry) == 1
    largest = fields[list(meta["fields"]).index("largest_m")]
    np.testing.assert_allclose(largest, 1.0, atol=1e-5)
    with rasterio.open(out / "difference.tif") as raster:
        assert raster.descriptions == ("difference", "sigma")
        np.testing.assert_allclose(raster.read(1)[25, 45], 1.0, atol=1e-5)
    assert (out / "difference.png").stat().st_size > 10_000


def test_a_shifted_grid_of_the_same_plane_does_not_differ(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bilinear interpolation of a plane is exact, so only the borders fall away."""
    other = a_map(shift_east_m=0.4)
    write_map(tmp_path / "a.tif", a_map())
    write_map(tmp_path / "b.tif", Grid(
        other.elevation_m + 0.4 * 0.05, other.west_m, other.north_m, 1.0, crs=CRS
    ))  # fmt: skip
    out = tmp_path / "out"
    assert run(monkeypatch, "diff", tmp_path / "a.tif", tmp_path / "b.tif", "--out", out, "-q") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["largest_m"] < 1e-4
    assert metrics["changed_places"] == 0


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (a_map(crs="EPSG:32631"), "different coordinate systems"),
        (a_map(shift_east_m=5_000.0), "no cell in common"),
    ],
)
def test_maps_that_cannot_be_compared_are_refused_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    other: Grid,
    said: str,
) -> None:
    write_map(tmp_path / "a.tif", a_map())
    write_map(tmp_path / "b.tif", other)
    out = tmp_path / "out"
    assert run(monkeypatch, "diff", tmp_path / "a.tif", tmp_path / "b.tif", "--out", out) == 1
    message = capsys.readouterr().err
    assert said in message and message.count("\n") == 1
    assert not out.exists() or not any(out.iterdir())
