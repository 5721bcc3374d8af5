"""Scenario files: what is read, what is refused and in which words."""

from pathlib import Path

import pytest

from perception.records import InputError
from scenarios.schema import library, load_scenario, scenario_of, tree_of

LINE = {"mission": {"lines": [[0, 0, 10, 0]]}}


def complaint(tree):
    with pytest.raises(InputError) as caught:
        scenario_of({**LINE, **tree}, "my.toml")
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({"world": {"dpeth_m": 3}}, ["my.toml", "world.dpeth_m", "3", "did you mean depth_m"]),
        ({"wrold": {}}, ["wrold", "did you mean world"]),
        ({"sonar": {"range_m": -5.0}}, ["sonar.range_m", "-5.0", "greater than"]),
        ({"sonar": {"samples": "many"}}, ["sonar.samples", "'many'", "integer"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"locate": {"track": "circle"}}, ["locate.track", "'circle'", "return"]),
        (
            {"world": {"terrain": [{"kind": "ridge", "hieght_m": 2.0}]}},
            ["world.terrain[0].hieght_m", "2.0", "did you mean height_m"],
        ),
        (
            {"world": {"terrain": [{"kind": "volcano"}]}},
            ["world.terrain[0]", "volcano", "canyon"],
        ),
        ({"mission": {}}, ["mission", "no line"]),
        ({"mission": {"lines": [[0, 0, 10]]}}, ["mission.lines[0][3]", "missing"]),
        ({"vehicle": {"speed_m_s": float("nan")}}, ["vehicle.speed_m_s", "nan", "finite"]),
        ({"plan": {"start": [1.0, 2.0, 3.0]}}, ["plan.start"]),
        ({"world": 5}, ["world", "5"]),
        ({"sonar": {"ping_period_s": 0.01}}, ["sonar", "ping_period_s = 0.01", "0.067 s"]),
    ],
)
def test_a_wrong_key_or_value_is_refused_in_one_line_that_names_it(tree, words):
    message = complaint(tree)
    for word in words:
        assert word in message, message


def test_a_missing_file_and_an_unknown_name_are_told_apart(tmp_path):
    with pytest.raises(InputError, match="no such scenario; there are demo"):
        load_scenario("dmeo")
    with pytest.raises(InputError, match="no such file"):
        load_scenario(tmp_path / "none.toml")
    broken = tmp_path / "broken.toml"
    broken.write_text("seed = = 1")
    with pytest.raises(InputError, match=r"broken.toml: is not valid TOML.*line 1"):
        load_scenario(broken)


def test_a_resolved_scenario_reads_back_the_same():
    for name in library():
        scenario = load_scenario(name)
        assert scenario_of(tree_of(scenario), "again") == scenario


def test_the_library_starts_with_demo_and_each_has_a_summary():
    names = list(library())
    assert names[0] == "demo" and len(names) >= 6
    for name in names:
        scenario = load_scenario(name)
        assert scenario.name == name and scenario.summary


def test_the_page_of_keys_lists_every_key_with_unit_default_and_meaning():
    """docs/scenarios.md is written by scenarios.schema_page; remake it when this fails."""
    from scenarios.schema_page import schema_page

    page = Path(__file__).resolve().parents[2] / "docs" / "scenarios.md"
    assert page.read_text(encoding="utf-8") == schema_page(), (
        "remake it: python -m scenarios.schema_page > docs/scenarios.md"
    )


def test_a_sonar_s_sheet_fills_what_is_not_given():
    tree = {**LINE, "sonar": {"model": "starfish-453", "range_m": 50.0}}
    sonar = scenario_of(tree, "test").sonar
    assert (sonar.frequency_khz, sonar.horizontal_beam_deg, sonar.vertical_beam_deg) == (450, 2, 60)
    assert (sonar.range_m, sonar.samples) == (50.0, 2000)
    # Resolved, it says the same again.
    assert scenario_of(tree_of(scenario_of(tree, "test")), "again").sonar == sonar
    message = complaint({"sonar": {"model": "whiskers"}})
    assert "sonar" in message and "whiskers" in message and "starfish-453" in message
