"""Live running: one row at a time, and a state that goes on where it was."""

from __future__ import annotations

import json
from pathlib import Path

import navsets
import numpy as np
import pytest

from localization.live import estimate_line, measurement_of, restore_state, rows_of, save_state
from localization.navfile import nav_table
from localization.navigator import Navigator
from localization.terrain import terrain_map
from perception.records import InputError


def test_csv_and_json_lines_give_the_same_rows() -> None:
    csv_rows = list(
        rows_of(["time_s,easting_m,northing_m,depth_m,heading_deg,beam1_m", "0,1,2,3,90,"])
    )
    json_rows = list(
        rows_of(
            [
                '{"time_s":0,"easting_m":1,"northing_m":2,"depth_m":3,"heading_deg":90,"beam1_m":null}'
            ]
        )
    )
    nav = nav_table({**{k: v[:2] for k, v in navsets.mission(np.random.default_rng(0))[0].items()}})
    one, two = (measurement_of(rows[0], nav.sensors) for rows in (csv_rows, json_rows))
    assert (one.time_s, one.easting_m, one.depth_m) == (two.time_s, two.easting_m, two.depth_m)
    assert np.isnan(one.slant_range_m).all()
    assert one.time_s == 0.0


def test_a_stream_without_the_columns_is_refused() -> None:
    with pytest.raises(InputError, match="lacks depth_m"):
        list(rows_of(["time_s,easting_m,northing_m,heading_deg", "0,1,2,3"]))


@pytest.mark.parametrize("cut", [2, 40])
def test_a_restored_navigator_goes_on_as_if_never_stopped(tmp_path: Path, cut: int) -> None:
    columns, _, _ = navsets.mission(np.random.default_rng(1), rows=60)
    nav = nav_table(columns)
    terrain = terrain_map(navsets.prior(np.random.default_rng(2)))
    whole = Navigator(terrain, nav.sensors, np.random.default_rng(3))
    expected = [whole.update(m) for m in nav]
    first = Navigator(terrain, nav.sensors, np.random.default_rng(3))
    for i in range(cut):
        first.update(nav.row(i))
    save_state(tmp_path / "state.npz", first)
    second = Navigator(terrain, nav.sensors, np.random.default_rng(99))
    restore_state(tmp_path / "state.npz", second)
    for i in range(cut, 60):
        estimate = second.update(nav.row(i))
    assert estimate.easting_m == pytest.approx(expected[-1].easting_m, abs=1e-6)
    np.testing.assert_allclose(estimate.covariance_m2, expected[-1].covariance_m2, rtol=1e-6)


def test_an_estimate_is_one_line_of_valid_json() -> None:
    columns, _, _ = navsets.mission(np.random.default_rng(1), rows=3)
    columns["easting_m"][0] = np.nan
    nav = nav_table(columns)
    navigator = Navigator(
        terrain_map(navsets.prior(np.random.default_rng(2))), nav.sensors, np.random.default_rng(3)
    )
    line = estimate_line(navigator.update(nav.row(0)))
    assert json.loads(line)["easting_m"] is None
    assert "\n" not in line


def test_a_strange_file_is_no_state(tmp_path: Path) -> None:
    (tmp_path / "x.npz").write_bytes(b"nothing")
    nav = nav_table(navsets.mission(np.random.default_rng(1), rows=3)[0])
    navigator = Navigator(
        terrain_map(navsets.prior(np.random.default_rng(2))), nav.sensors, np.random.default_rng(3)
    )
    with pytest.raises(InputError, match="not a saved state"):
        restore_state(tmp_path / "x.npz", navigator)
