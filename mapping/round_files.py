"""`rounds.csv`: what each round of the survey's loop compared, believed and moved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mapping.survey_records import Round
from perception.files import write_text

_HEADER = (
    "round,floor,square_m,compared,accepted,used,beyond,evidence,moved_m,error_before,error_after,"
    "passes,anew"
)


def write_rounds(path: Path, rounds: Sequence[Round]) -> None:
    """Write one row a round, in order; the columns are the fields of `Round`."""
    lines = [_HEADER]
    for number, r in enumerate(rounds, start=1):
        lines.append(
            f"{number},{r.floor},{r.square_m:.2f},{r.compared},{r.accepted},{r.used},{r.beyond},"
            f"{r.evidence:.3f},{r.moved_m:.4f},{r.error_before:.3f},{r.error_after:.3f},"
            f"{r.passes},{r.anew}"
        )
    write_text(path, "\n".join(lines) + "\n")
