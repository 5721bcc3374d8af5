"""A compass that errs is told from a current that pushes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.installation import read_installation
from perception.readers import open_survey
from perception.readers.compass import compass_warning, heading_offsets
from perception.readers.netcdf import write_netcdf
from tests.perception.echo_fixtures import Survey, flat, make_swath


def _crab(course_deg: float, current_deg: float = 12.0) -> float:
    """Return the angle by which a bow points into a current from the north."""
    return current_deg * -np.sin(np.radians(course_deg))


@pytest.mark.parametrize("legs", [(90, 270), (90, 270, 91), (0, 120, 240), (45, 225, 135, 315)])
def test_a_current_is_no_compass_error_whatever_the_legs(legs: tuple[float, ...]) -> None:
    offset = np.radians([_crab(leg) for leg in legs])
    assert compass_warning(np.radians(legs), offset) is None


@pytest.mark.parametrize("legs", [(90, 270), (0, 120, 240), (45, 225, 135, 315)])
def test_a_constant_error_is_told_with_its_correction(legs: tuple[float, ...]) -> None:
    offset = np.radians([17.0 + _crab(leg, 5.0) for leg in legs])
    told = compass_warning(np.radians(legs), offset)
    assert told is not None and "17 deg" in told and "declination_deg = -17" in told


def test_one_direction_leaves_both_open_and_small_angles_are_not_told() -> None:
    told = compass_warning(np.radians([30.0, 33.0]), np.radians([-15.0, -15.0]))
    assert told is not None and "cross current" in told and "declination_deg = 15" in told
    assert compass_warning(np.radians([30.0]), np.radians([7.0])) is None
    assert compass_warning(np.zeros(0), np.zeros(0)) is None


@pytest.mark.parametrize("legs", [(90, 270, 90, 270), (45, 225, 135, 315), (30, 33, 31, 32)])
def test_a_compass_mounted_backwards_is_told(legs: tuple[float, ...]) -> None:
    offset = np.radians([179.0, -179.0, 178.0, -178.0])
    told = compass_warning(np.radians(legs), offset)
    assert (
        told is not None and "180 deg" in told and "declination_deg = " in told and "180 u" in told
    )


def test_the_suggested_declination_takes_the_place_of_the_one_given() -> None:
    legs, left = np.radians([90.0, 270.0]), np.radians([17.0, 17.0])
    for given, wanted in ((-20.0, -37), (-170.0, 173), (17.0, 0)):
        told = compass_warning(legs, left, given)
        assert told is not None and f"declination_deg = {wanted} under" in told
    told = compass_warning(np.radians([30.0]), np.radians([-15.0]), 5.0)
    assert told is not None and "declination_deg = 20 under" in told


def test_offsets_come_from_the_passes_alone() -> None:
    time = np.arange(60.0)
    east = np.where(time < 30, 1.5 * time, 45.0)
    north = np.where(time < 30, 0.0, 1.5 * (time - 30))
    heading = np.where(time < 30, np.radians(100), np.radians(10))
    number = np.where(time < 25, 0, np.where(time > 35, 1, -1))
    course, offset = heading_offsets(time, east, north, heading, number)
    assert np.degrees(course) == pytest.approx([90, 0], abs=8)
    assert np.degrees(offset) == pytest.approx([10, 10], abs=2)


def test_a_backward_compass_warns_and_its_declination_in_install_toml_ends_that(
    tmp_path: Path,
) -> None:
    swath = make_swath(flat, Survey(n_pings=60, n_samples=300), np.random.default_rng(0))
    noise = np.random.default_rng(1).normal(0, 0.02, 60)
    write_netcdf(tmp_path / "a.nc", replace(swath, heading_rad=np.mod(np.pi + noise, 2 * np.pi)))
    assert any(
        "180 deg off the track" in text for text in open_survey([tmp_path / "a.nc"]).warnings
    )
    (tmp_path / "install.toml").write_text("[compass]\ndeclination_deg = 180\n")
    mended = open_survey(
        [tmp_path / "a.nc"], installation=read_installation(tmp_path / "install.toml", None, None)
    )
    assert not mended.warnings


def test_files_with_and_without_depth_together_are_told(tmp_path: Path) -> None:
    swath = make_swath(flat, Survey(n_pings=60, n_samples=300), np.random.default_rng(0))
    later = replace(swath, time_s=swath.time_s + 600, northing_m=swath.northing_m + 30)
    write_netcdf(tmp_path / "deep.nc", swath)
    write_netcdf(tmp_path / "none.nc", replace(later, depth_m=np.full(60, np.nan)))
    mixed = open_survey([tmp_path / "deep.nc", tmp_path / "none.nc"]).warnings
    assert any("no depth in none.nc" in text and "map those files apart" in text for text in mixed)
    assert not any("no depth in" in text for text in open_survey([tmp_path / "deep.nc"]).warnings)
