"""Strip files: what is written is read back, whole, with units."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import xarray

from perception.records import InputError
from perception.strip_files import read_strip, write_strip
from perception.strips import build_strip
from tests.perception.echo_fixtures import Survey, flat, make_swath


def test_a_strip_comes_back_as_it_was(tmp_path: Path) -> None:
    swath = make_swath(flat, Survey(n_pings=40, n_samples=300), np.random.default_rng(0))
    strip = build_strip(swath).strip
    path = tmp_path / "strip-000.nc"
    write_strip(path, strip)
    back = read_strip(path)
    for f in fields(strip):
        value, again = getattr(strip, f.name), getattr(back, f.name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(again, value, err_msg=f.name)
        else:
            assert again == value, f.name
    with xarray.open_dataset(path) as data:
        assert data.attrs["Conventions"].startswith("CF-")
        assert data.elevation_m.units == "m" and data.elevation_m.dims == ("line", "column")
        assert data.attrs["crs"] == swath.crs
    assert [p.name for p in tmp_path.iterdir()] == ["strip-000.nc"]


def test_what_is_no_strip_is_refused_by_name(tmp_path: Path) -> None:
    junk = tmp_path / "junk.nc"
    junk.write_bytes(b"not a NetCDF file at all")
    with pytest.raises(InputError, match="is not a NetCDF strip"):
        read_strip(junk)
    other = tmp_path / "other.nc"
    xarray.Dataset({"a": ("x", [1.0])}).to_netcdf(other)
    with pytest.raises(InputError, match="lacks elevation_m"):
        read_strip(other)
