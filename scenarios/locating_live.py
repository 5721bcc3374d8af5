"""`locate --follow`: estimates as rows come in, and a state to go on from."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from localization.live import estimate_line, measurement_of, restore_state, rows_of, save_state
from localization.measurements import Sensors, read_sensors
from localization.navfile import nav_table
from localization.navigator import Navigator, NavigatorConfig
from localization.terrain import terrain_map
from perception.geodesy import convergence, is_local
from perception.records import InputError
from scenarios.locating import LocateOptions, prior_with_sigma

STATE_NAME = "navigator.npz"
_SAVE_EVERY = 100


def follow_input(
    options: LocateOptions, out: Path | None, lines: Iterable[str], write: Callable[[str], None]
) -> None:
    """Read rows as they come and write one JSON line for each.

    With an output folder the state is saved there every hundred rows and at the end, and taken up
    again by the next run.
    """
    rows = rows_of(lines)
    first = next(rows, None)
    if first is None:
        raise InputError("standard input: holds no row; pipe nav.csv or JSON lines into --follow")
    sensors = Sensors() if options.sensors is None else read_sensors(options.sensors)
    columns = {name: np.zeros(2) for name in first if name == "altitude_m" or name[:4] == "beam"}
    still = {name: np.array([0.0, 1.0]) for name in ("time_s", "easting_m", "northing_m")}
    sensors = nav_table(
        {**still, "depth_m": np.zeros(2), "heading_deg": np.zeros(2), **columns}, sensors,
        "standard input",
    ).sensors  # fmt: skip
    prior, _ = prior_with_sigma(options.prior, options.map_sigma_m)
    terrain = terrain_map(prior, options.map_error_length_m)
    navigator = Navigator(
        terrain, sensors, np.random.default_rng(options.seed),
        NavigatorConfig(particles=options.particles),
    )  # fmt: skip
    state = None if out is None else out / STATE_NAME
    if state is not None and state.exists():
        restore_state(state, navigator)
    turn: float | None = 0.0 if is_local(prior.crs) else None
    for number, row in enumerate(itertools.chain([first], rows), start=1):
        measurement = measurement_of(row, sensors)
        if turn is None and np.isfinite(measurement.easting_m + measurement.northing_m):
            place = (np.array([measurement.easting_m]), np.array([measurement.northing_m]))
            turn = float(np.nan_to_num(convergence(*place, prior.crs)[0]))
        write(estimate_line(navigator.update(measurement_of(row, sensors, turn or 0.0))))
        if state is not None and number % _SAVE_EVERY == 0:
            save_state(state, navigator)
    if state is not None:
        save_state(state, navigator)
