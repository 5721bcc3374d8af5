"""Objects as `plan` tells of them: how many stand, how many bar their ground, and what the grey on the map is."""

from __future__ import annotations

import logging
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from perception.records import Grid
from planning.cost import CostTerms
from planning.limits import VehicleLimits
from planning.surface import build_surface
from scenarios.plots_routes import _draw_map
from scenarios.route_inputs import standing
from scenarios.route_outputs import objects_told

LIST = """easting_m,northing_m,kind,height_m,sigma_m,bound
10,10,hill,1.0,0.1,
20,20,hill,0.8,0.6,lower
30,30,crater,1.0,0.1,
15,30,hill,,,
99,99,hill,2.0,0.1,lower
"""


def _grid() -> Grid:
    return Grid(np.full((40, 40), -30.0), 0.0, 40.0, 1.0)


def test_objects_that_bar_their_ground_are_counted_apart(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text(LIST)
    obstacles, counted = standing(path, _grid())
    assert counted == (2, 1)
    on = obstacles(_grid())
    assert on is not None and on.barred.any()
    assert standing(None, _grid())[1] is None


def test_the_console_tells_how_many_bar_their_ground() -> None:
    assert objects_told(None, 0) == []
    assert objects_told(31, 0) == [("objects", "31 standing on the map, held clear of")]
    ((_, told),) = objects_told(31, 3)
    assert told == "31 standing on the map, 3 of them of least height only: their ground is barred"


def test_a_list_of_looks_beside_the_objects_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "objects.csv"
    path.write_text(LIST)
    with caplog.at_level(logging.WARNING):
        standing(path, _grid())
        assert not caplog.records
        (tmp_path / "objects.gpkg").touch()
        standing(path, _grid())
    (record,) = caplog.records
    assert "holds single looks" in record.getMessage() and "objects.gpkg" in record.getMessage()


@pytest.mark.parametrize("barred", [False, True])
def test_grey_ground_has_its_legend(barred: bool) -> None:
    forbidden = np.zeros((40, 40), bool)
    forbidden[10:14, 10:14] = barred
    surface = build_surface(_grid(), VehicleLimits(), CostTerms(), forbidden=forbidden)
    _, axes = plt.subplots()
    _draw_map(axes, surface, (0, 40, 0, 40))
    labels = axes.get_legend_handles_labels()[1]
    assert [label.startswith("barred") for label in labels] == [True] * barred
    plt.close("all")
