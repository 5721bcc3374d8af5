"""Trajectory files: what is written comes back, and a wrong value is named."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from mapping.trajectories import read_trajectory, write_trajectory
from perception.records import InputError, Trajectory


def a_trajectory(utc: bool = True) -> Trajectory:
    n = 4
    return Trajectory(
        time_s=1.7e9 + np.array([0.0, 0.25, 0.5, 1.123456]),
        easting_m=4e5 + np.arange(n) * 0.5,
        northing_m=5.5e6 + np.arange(n) * 0.25,
        depth_m=np.array([10.0, 10.5, np.nan, 11.0]),
        heading_rad=np.radians([0.0, 90.0, 180.0, 359.999999]),
        sigma_easting_m=np.full(n, 0.5),
        sigma_northing_m=np.full(n, 0.25),
        cov_en_m2=np.full(n, -0.01),
        utc=utc,
        ping=np.arange(n),
        pass_index=np.array([0, 0, -1, 1]),
        status=("converged", "searching", "dead-reckoning", "lost"),
        protection_m=np.array([1.0, 2.0, 3.0, np.nan]),
    )


@pytest.mark.parametrize("utc", [True, False])
def test_a_trajectory_comes_back_as_it_was_written(tmp_path: Path, utc: bool) -> None:
    there = a_trajectory(utc)
    write_trajectory(tmp_path / "trajectory.csv", there)
    back = read_trajectory(tmp_path / "trajectory.csv")
    assert back.utc == utc
    for f in fields(Trajectory):
        want, got = getattr(there, f.name), getattr(back, f.name)
        if f.name == "heading_rad":
            # 1e-4 deg is the file's last digit; the circle has no jump at north.
            np.testing.assert_allclose(np.cos(got - want), 1.0, atol=1e-9)
        elif isinstance(want, np.ndarray):
            np.testing.assert_allclose(got, want, atol=1e-4)
        else:
            assert got == want


def test_time_is_iso_only_where_the_clock_is_absolute(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "a.csv", a_trajectory(utc=True))
    write_trajectory(tmp_path / "b.csv", a_trajectory(utc=False))
    first_row = (tmp_path / "a.csv").read_text().splitlines()[1]
    assert first_row.startswith("2023-11-14T22:13:20.000000Z,1700000000.000000,400000.0000")
    assert (tmp_path / "b.csv").read_text().splitlines()[1].startswith("1700000000.000000,")


def test_heading_never_prints_as_360(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "t.csv", a_trajectory())
    assert ",360.0" not in (tmp_path / "t.csv").read_text()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time_s,easting_m\n0,1\n", "northing_m"),
        ("easting_m,northing_m\n0,1\n", "time_s"),
        ("time_s,easting_m,northing_m\n", "no row"),
        ("time_s,easting_m,northing_m\n0,1,2\n1,x,2\n", "line 3: easting_m is 'x'"),
        ("time,easting_m,northing_m\nyesterday,1,2\n", "line 2: time is 'yesterday'"),
    ],
)
def test_a_file_that_is_no_trajectory_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_trajectory(path)
