"""Absolute position fixes: what the pose graph consumes and localization issues."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.files import existing_file, utc_seconds, write_text
from perception.records import InputError

_FIX_COLUMNS = ("time", "easting_m", "northing_m", "sigma_m")


@dataclass(frozen=True, slots=True)
class PositionFix:
    """One absolute horizontal position with its covariance.

    Attributes
    ----------
    time_s : seconds since 1970-01-01 UTC, or of the navigation file's own clock.
    cov_ee_m2, cov_en_m2, cov_nn_m2 : covariance of (easting, northing).
    kind : "gps", "usbl", "profile", "patch", "regions", ...
    accepted, reason : whether the fix may be used, and why not (or why).
    protection_m : horizontal distance that the error exceeds with the stated risk only.
    """

    time_s: float
    easting_m: float
    northing_m: float
    cov_ee_m2: float
    cov_en_m2: float
    cov_nn_m2: float
    kind: str
    accepted: bool = True
    reason: str = ""
    protection_m: float = float("nan")

    @property
    def covariance_m2(self) -> np.ndarray:
        """Return the (2, 2) covariance of (easting, northing)."""
        return np.array([[self.cov_ee_m2, self.cov_en_m2], [self.cov_en_m2, self.cov_nn_m2]])


def read_fixes(path: Path) -> list[PositionFix]:
    """Read absolute fixes for `map`: time (ISO 8601 UTC), easting_m, northing_m, sigma_m.

    Raises
    ------
    InputError
        A column is missing, or a value is no number, no time, or a sigma that is not positive.
    """
    path = existing_file(path)
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        rows = csv.DictReader(stream)
        missing = [c for c in _FIX_COLUMNS if c not in (rows.fieldnames or ())]
        if missing:
            raise InputError(
                f"{path}: lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
                f"a fixes file has {', '.join(_FIX_COLUMNS)}"
            )
        fixes = [_fix_of_row(path, line, row) for line, row in enumerate(rows, start=2)]
    if not fixes:
        raise InputError(f"{path}: holds no fix; leave --fixes out to go without")
    return sorted(fixes, key=lambda fix: fix.time_s)


def _fix_of_row(path: Path, line: int, row: dict[str, str]) -> PositionFix:
    try:
        time_s = utc_seconds(row["time"])
        easting_m, northing_m, sigma_m = (float(row[c]) for c in _FIX_COLUMNS[1:])
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: line {line}: {error}; mend or remove the line") from error
    if not np.isfinite([easting_m, northing_m]).all():
        raise InputError(f"{path}: line {line}: the position is not finite; remove the line")
    if not (np.isfinite(sigma_m) and sigma_m > 0):
        raise InputError(f"{path}: line {line}: sigma_m must be positive, got {sigma_m}")
    return PositionFix(time_s, easting_m, northing_m, sigma_m**2, 0.0, sigma_m**2, kind="absolute")


def write_fixes(path: Path, fixes: Sequence[PositionFix]) -> None:
    """Write `fixes.csv` as the contract has it."""
    header = "time_s,easting_m,northing_m,cov_ee_m2,cov_en_m2,cov_nn_m2,kind,accepted,reason,protection_m"
    lines = [header]
    for fix in fixes:
        reason = '"' + fix.reason.replace('"', "'") + '"'
        lines.append(
            f"{fix.time_s:.3f},{fix.easting_m:.3f},{fix.northing_m:.3f},{fix.cov_ee_m2:.5g},"
            f"{fix.cov_en_m2:.5g},{fix.cov_nn_m2:.5g},{fix.kind},"
            f"{'true' if fix.accepted else 'false'},{reason},"
            f"{'' if np.isnan(fix.protection_m) else format(fix.protection_m, '.3f')}"
        )
    write_text(path, "\n".join(lines) + "\n")
