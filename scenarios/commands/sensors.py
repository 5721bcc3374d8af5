"""`bathynav sensors`: the sonars and navigation sensors, and the files that can be read."""

from __future__ import annotations

import click

from scenarios.commands.console import common_options, set_verbosity


@click.command()
@common_options
def command(quiet: bool, verbose: bool) -> None:
    """List the sonars and sensors with their figures, and the formats of sonar files."""
    from perception.sonars import SENSORS, SONARS

    set_verbosity(quiet, verbose)
    header = (
        "sonar", "kind", "kHz", "beam deg", "tilt deg", "range m", "cell cm", "sector deg", "image s",
    )  # fmt: skip
    rows = [
        (
            sonar.name,
            sonar.kind,
            f"{sonar.frequency_hz / 1e3:g}",
            f"{sonar.horizontal_deg:g} x {sonar.vertical_deg:g}",
            f"{sonar.tilt_deg:g}",
            f"{sonar.range_m:g}",
            f"{100 * sonar.resolution_m:g}",
            f"{sonar.sector_deg:g}" if sonar.sector_deg else "-",
            f"{sonar.image_s:g}" if sonar.image_s else "-",
        )
        for sonar in SONARS
    ]
    _print_columns([header, *rows])
    click.echo()
    for sonar in SONARS:
        click.echo(f"  {sonar.name}: {sonar.source}")
    click.echo()
    _print_columns(
        [
            ("sensor", "column of nav.csv", "default 1-sigma", "note"),
            *[(s.name, s.column, s.sigma, s.note) for s in SENSORS],
        ]
    )
    click.echo()
    from perception.readers import FORMATS

    click.echo("sonar files: " + ", ".join(FORMATS.values()))


def _print_columns(rows: list[tuple[str, ...]]) -> None:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        line = "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True))
        click.echo(line.rstrip())
