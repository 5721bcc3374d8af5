"""What every command shares: the output folder."""

import click
import pytest
from click.testing import CliRunner

from perception.records import InputError
from scenarios.commands import scenarios as scenarios_command
from scenarios.commands import sensors as sensors_command
from scenarios.commands.console import FiniteRange, out_option, prepare_out, progress_lines


@click.command()
@out_option
@click.option("--fail", is_flag=True)
def working(out, fail):
    prepare_out(out)
    if fail:
        raise InputError("no")
    (out / "result.txt").write_text("there")


def test_a_command_that_fails_leaves_no_empty_folder_behind(tmp_path):
    out = tmp_path / "deep" / "out"
    CliRunner().invoke(working, ["--out", str(out), "--fail"])
    assert not (tmp_path / "deep").exists()


def test_a_folder_that_was_there_before_stays_even_when_empty(tmp_path):
    CliRunner().invoke(working, ["--out", str(tmp_path), "--fail"])
    assert tmp_path.is_dir()


def test_a_folder_with_results_stays(tmp_path):
    CliRunner().invoke(working, ["--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "result.txt").read_text() == "there"


def test_results_of_another_command_in_the_folder_are_told_of(tmp_path):
    for name in ("map.tif", "metrics.json"):
        (tmp_path / name).write_text("")
    told = CliRunner().invoke(working, ["--out", str(tmp_path)])
    assert told.exit_code == 0 and "holds results of map" in told.stderr
    (tmp_path / "map.tif").unlink()
    assert "note" not in CliRunner().invoke(working, ["--out", str(tmp_path)]).stderr


def test_lists_take_the_common_options():
    for module in (scenarios_command, sensors_command):
        assert CliRunner().invoke(module.command, ["-q"]).exit_code == 0


def test_a_pipe_is_told_of_long_steps_only_and_what_is_left_of_them(capsys):
    seconds = iter([0.0, 1.0, 5.0, 20.0, 21.0, 40.0, 80.0])
    report = progress_lines(lambda: next(seconds))
    for done in range(5):
        report("joint inversion", done, 4)
    # One at 20 s, with half of the work done in 19 s; none so soon after, none at the end.
    report("writing", 0, 2)
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.splitlines() == [
        "joint inversion: 2 of 4 after 19 s, about 19 s left",
        "writing: 0 of 2",
    ]


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "0", "-1"])
def test_a_length_that_is_no_number_or_out_of_bounds_is_wrong_usage(value):
    with pytest.raises(click.BadParameter):
        FiniteRange(min=0, min_open=True).convert(value, None, None)
    assert FiniteRange(min=0).convert("2.5", None, None) == 2.5
