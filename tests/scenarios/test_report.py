"""The report is one page that needs nothing else, made of what a folder holds."""

import re

import pytest

from perception.records import InputError
from scenarios.outputs import write_metrics
from scenarios.report.page import write_report
from scenarios.report.units import label_and_unit


def _png(path):
    from matplotlib.figure import Figure

    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(1, 1))
    figure.subplots().plot([0, 1])
    figure.savefig(path)


def test_a_report_holds_every_stage_and_points_to_no_other_file(tmp_path):
    write_metrics(tmp_path, {"map_mae_m": 0.123456, "solved": True}, {"name": "try <it>"}, seed=3)
    for stage in ("map", "plan"):
        _png(tmp_path / stage / f"{stage}.png")
        write_metrics(tmp_path / stage, {"seconds": 1.5, "lost_m": float("nan")}, {})
    text = write_report(tmp_path).read_text()
    assert text.count("data:image/png;base64,") == 2
    assert not re.search(r'(src|href)="(?!data:|#)', text), "a link that leaves the page"
    assert "try &lt;it&gt;" in text, "names are escaped"
    assert ">0.1235<" in text and ">yes<" in text and ">–<" in text


def test_a_caption_says_what_a_picture_shows(tmp_path):
    _png(tmp_path / "strips" / "strip-003.png")
    _png(tmp_path / "strips" / "something-else.png")
    text = write_report(tmp_path).read_text()
    assert "Strip 003. One pass: the echoes by ping and slant range" in text
    assert "<figcaption>Something else</figcaption>" in text


def test_a_single_stage_folder_gets_a_report_too(tmp_path):
    write_metrics(tmp_path / "map", {"cells": 12}, {})
    assert "Map and track" in write_report(tmp_path / "map").read_text()


def test_a_foreign_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"holds no metrics\.json and no stage folder"):
        write_report(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        write_report(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("speed_m_s", ("speed", "m/s")),
        ("min_altitude_m", ("min altitude", "m")),
        ("cost", ("cost", "")),
        ("m", ("m", "")),
    ],
)
def test_units_are_read_from_the_end_of_a_key(key, expected):
    assert label_and_unit(key) == expected
