"""nav.csv: what is read, and what is refused with the value."""

from __future__ import annotations

from pathlib import Path

import navsets
import numpy as np
import pytest

from localization.measurements import read_sensors
from localization.navchecks import check_against_map, off_the_map
from localization.navfile import nav_table, read_nav
from perception.records import FloatArray, InputError


def written(path: Path, columns: dict[str, FloatArray]) -> Path:
    names = list(columns)
    rows = zip(*columns.values(), strict=True)
    lines = [
        ",".join(names),
        *(",".join("" if v != v else repr(float(v)) for v in r) for r in rows),
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def columns_of(rows: int = 20) -> dict[str, FloatArray]:
    return navsets.mission(np.random.default_rng(0), rows=rows)[0]


def test_a_written_table_comes_back(tmp_path: Path) -> None:
    columns = columns_of()
    columns["beam2_m"][3] = np.nan
    columns["beam3_m"][4] = 0.0
    nav = read_nav(written(tmp_path / "nav.csv", columns))
    assert nav.slant_range_m.shape == (20, 4)
    assert np.isnan(nav.slant_range_m[3, 1])
    assert np.isnan(nav.slant_range_m[4, 2]), "zero is no return"
    np.testing.assert_allclose(np.degrees(nav.heading_rad), columns["heading_deg"])


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    columns = columns_of()
    del columns["depth_m"]
    with pytest.raises(InputError, match="lacks the column depth_m"):
        read_nav(written(tmp_path / "nav.csv", columns))


def test_text_is_named_with_its_line(tmp_path: Path) -> None:
    path = written(tmp_path / "nav.csv", columns_of())
    lines = path.read_text().splitlines()
    lines[5] = lines[5].replace(lines[5].split(",")[3], "deep", 1)
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"line 6: depth_m is 'deep'"):
        read_nav(path)


@pytest.mark.parametrize(
    ("name", "factor", "words"),
    [
        ("depth_m", 1000.0, "depth_m is 4.08e.04 m"),
        ("beam1_m", 1000.0, "millimetres"),
        ("easting_m", 1000.0, "move at"),
    ],
)
def test_units_a_thousand_times_off_are_refused_with_the_value(
    name: str, factor: float, words: str
) -> None:
    columns = columns_of()
    columns[name] = columns[name] * factor
    with pytest.raises(InputError, match=words):
        nav_table(columns)


def test_time_in_milliseconds_is_refused_where_the_speed_tells() -> None:
    columns = columns_of()
    columns["speed_m_s"] = np.full(20, 1.5)
    columns["time_s"] = columns["time_s"] * 1000
    with pytest.raises(InputError, match="thousandths"):
        nav_table(columns)


def test_time_in_milliseconds_is_refused_where_the_rows_tell() -> None:
    columns = columns_of()
    columns["time_s"] = columns["time_s"] * 1000
    with pytest.raises(InputError, match="milliseconds"):
        nav_table(columns)


@pytest.mark.parametrize(
    ("names", "factor", "words"),
    [
        (("depth_m", "beam"), 1e-3, "depth_m is 0.04.* and the ranges .*kilometres"),
        (("depth_m",), 1e-3, "depth_m is 0.04.*kilometres"),
        (("beam",), 1e-3, "the ranges are 0.0.*kilometres"),
        (("beam",), 100.0, ""),
    ],
)
def test_the_map_tells_a_wrong_unit_from_a_wrong_place(
    names: tuple[str, ...], factor: float, words: str
) -> None:
    columns = columns_of()
    for name in columns:
        if name.startswith(names):
            columns[name] = columns[name] * factor
    if not words:  # no unit makes these meet the map
        check_against_map(nav_table(columns), -100.0, 5.0)
        return
    with pytest.raises(InputError, match=words):
        check_against_map(nav_table(columns), -100.0, 5.0)


def test_headings_in_radians_are_refused_where_the_course_tells() -> None:
    columns = columns_of()
    turning = np.linspace(0.0, 4.0, 20)
    columns["easting_m"] = np.cumsum(4.5 * np.sin(turning))
    columns["northing_m"] = np.cumsum(4.5 * np.cos(turning))
    nav_table({**columns, "heading_deg": np.degrees(turning)})
    with pytest.raises(InputError, match="radians"):
        nav_table({**columns, "heading_deg": turning})


def test_rows_in_reverse_are_refused() -> None:
    columns = {name: values[::-1].copy() for name, values in columns_of().items()}
    with pytest.raises(InputError, match="runs backwards"):
        nav_table(columns)


def test_one_row_is_refused() -> None:
    with pytest.raises(InputError, match="at least 2"):
        nav_table({name: values[:1] for name, values in columns_of().items()})


def test_sensors_take_the_place_of_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "sensors.toml"
    path.write_text(
        "[[beam]]\nazimuth_deg = 0\noff_nadir_deg = 20\n[[beam]]\nazimuth_deg = 180\n"
        "off_nadir_deg = 20\n[sigma]\nstart_m = 5\nheading_deg = 1.0\n"
    )
    sensors = read_sensors(path)
    assert len(sensors.beams) == 2
    assert sensors.start_m == 5
    assert np.degrees(sensors.heading_rad) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[sigma]\nsart_m = 5\n", "unknown key 'sart_m'"),
        ("[[beam]]\nazimuth_deg = 0\n", "lacks off_nadir_deg"),
        ("[sigma]\nstart_m = -5\n", "got -5"),
    ],
)
def test_a_wrong_sensors_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "sensors.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_sensors(path)


def test_beams_and_directions_must_be_as_many(tmp_path: Path) -> None:
    path = tmp_path / "sensors.toml"
    path.write_text("[[beam]]\nazimuth_deg = 0\noff_nadir_deg = 20\n")
    with pytest.raises(InputError, match="4 beam columns"):
        nav_table(columns_of(), read_sensors(path))


@pytest.mark.parametrize(
    ("sign", "raised_m", "words"),
    [(1.0, 0.0, ""), (1.0, 30.0, ""), (-1.0, 0.0, "82 m above"), (1.0, -200.0, "200 m above")],
)
def test_soundings_far_from_all_of_the_map_are_told(
    sign: float, raised_m: float, words: str
) -> None:
    """Depth negated raises the soundings by twice the depth; a map too deep leaves them above it."""
    columns = columns_of()
    columns["depth_m"] = sign * columns["depth_m"]
    nav = nav_table(columns)
    level = -float(
        np.median(
            columns_of()["depth_m"][:, None]
            + nav.slant_range_m * np.cos(nav.sensors.beams[0].off_nadir_rad)
        )
    )
    heights = (
        level + raised_m + 8.0 * np.random.default_rng(0).standard_normal((40, 40)).clip(-2, 2)
    )
    found = off_the_map(nav, heights, 8.0, 0.3)
    assert (words in found) if words else not found
