"""The tiled survey's own parts: where its overview lies, what is refused first, whose Dask settings change."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapping.gridding import Window
from mapping.rasters import write_map
from mapping.tile_plan import TilePlan
from mapping.tile_store import TileStore
from perception.readers.netcdf import write_netcdf
from perception.records import Grid, InputError
from scenarios import survey_tiles
from scenarios.cluster import open_cluster
from scenarios.map_loop import check_prior
from scenarios.survey_tiles import TiledSurvey
from tests.perception.echo_fixtures import Survey as Pings
from tests.perception.echo_fixtures import flat, make_swath
from tests.scenarios.command_line import run_command


def slope(east_m: Any, north_m: Any) -> Any:
    return -30.0 + 0.1 * east_m + 0.03 * north_m


@pytest.mark.parametrize("most", [400, 90, 10**6])
def test_the_overview_of_a_tilted_plane_lies_where_the_plane_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """Cells left out at every step, tiles and rows that the step does not divide."""
    plan = TilePlan(0.5, "", "", Window(-37, 211, 101, 83), 32, ())
    store = TileStore.create(tmp_path, plan)
    east = plan.west_m + (np.arange(83) + 0.5) * 0.5
    north = plan.north_m - (np.arange(101) + 0.5) * 0.5
    height = slope(east[None, :], north[:, None]).astype(np.float32)
    for tile in plan.tiles():
        where = plan.slices(tile)
        part = height[where]
        store.write(where, {name: part for name in ("elevation", "sigma", "count", "echo")})
    monkeypatch.setattr(survey_tiles, "_PICTURE_CELLS", most)
    nothing: Any = None
    survey = TiledSurvey(plan, store, {}, 0, nothing, nothing, nothing, ())
    for name in ("elevation", "echo"):
        grid = survey.overview(name)
        assert (grid.cell_m > 0.5) == (most < 8000)
        expected = slope(*np.meshgrid(*grid.centres()))
        np.testing.assert_allclose(grid.elevation_m, expected, atol=1e-5)


def test_a_prior_map_of_another_frame_is_refused_before_the_work() -> None:
    prior = Grid(np.zeros((2, 2)), 0.0, 2.0, 1.0, "EPSG:32631", datum="MSL")
    with pytest.raises(InputError, match="different coordinate systems"):
        check_prior(prior, "EPSG:32630", "MSL")
    with pytest.raises(InputError, match="different vertical datums"):
        check_prior(prior, "EPSG:32631", "LAT")
    for crs, datum in (("EPSG:32631", "MSL"), ("", ""), ("EPSG:32631", "")):
        check_prior(prior, crs, datum)
    check_prior(None, "EPSG:32630", "MSL")


def test_the_command_refuses_such_a_prior_map_before_any_strip_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*arguments: object, **more: object) -> None:
        raise AssertionError("a pass was read")

    monkeypatch.setattr("perception.readers.Survey.swath", never)
    swath = make_swath(flat, Pings(n_pings=80, n_samples=300), np.random.default_rng(0))
    write_netcdf(tmp_path / "line.nc", swath)
    prior = Grid(np.zeros((8, 8)), 500_000.0, 5_600_008.0, 1.0, "EPSG:32601", np.ones((8, 8)))
    write_map(tmp_path / "prior.tif", prior)
    for more in ((), ("--tiles",)):
        done = run_command(
            capsys, "map", tmp_path / "line.nc", "--out", tmp_path / "map", "--prior",
            tmp_path / "prior.tif", *more,
        )  # fmt: skip
        assert done.status == 1 and "different coordinate systems" in done.complaint, done.err


def test_a_local_cluster_gives_dask_its_settings_back() -> None:
    import dask
    import distributed  # noqa: F401  (its import sets the defaults)

    before = dask.config.get("distributed.worker.memory.terminate")
    with open_cluster(n_workers=1) as client:
        assert dask.config.get("distributed.worker.memory.terminate") is False
        assert client.submit(abs, -3).result() == 3
    assert dask.config.get("distributed.worker.memory.terminate") == before
