"""Where the sensors sit, and what the water does: install.toml, tide and sound speed."""

from __future__ import annotations

from dataclasses import dataclass

from perception.readers.survey import PingTable


@dataclass(frozen=True, slots=True)
class Installation:
    """Lever arms, mounting, latencies, tow, tide, sound speed."""

    datum: str = ""

    def apply(self, table: PingTable) -> PingTable:
        """Return the table with every effect applied."""
        return table
