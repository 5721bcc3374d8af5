"""Absolute position fixes: what the pose graph consumes and localization issues."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perception.files import existing_file, utc_seconds, write_text
from perception.records import InputError

_TIMES = ("time", "time_s")
_PLACE = ("easting_m", "northing_m")
_COVARIANCE = ("cov_ee_m2", "cov_en_m2", "cov_nn_m2")


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
    """Read absolute fixes for `map`, in time order.

    A row has a time (`time`, ISO 8601 UTC, or `time_s`, seconds of the survey's clock), `easting_m`,
    `northing_m`, and either `sigma_m` or a covariance (`cov_ee_m2`, `cov_en_m2`, `cov_nn_m2`). So the
    `fixes.csv` that `locate` writes is read as well; what it says was not accepted is left out.

    Raises
    ------
    InputError
        A column is missing, or a value is no number, no time, or a sigma that is not positive.
    """
    path = existing_file(path)
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        rows = csv.DictReader(stream)
        _refuse_lack(path, list(rows.fieldnames or ()))
        read = [_fix_of_row(path, line, row) for line, row in enumerate(rows, start=2)]
    fixes = [fix for fix in read if fix.accepted]
    if not fixes:
        refused = f" of {len(read)} that was accepted" if read else ""
        raise InputError(f"{path}: holds no fix{refused}; leave --fixes out to go without")
    return sorted(fixes, key=lambda fix: fix.time_s)


def _refuse_lack(path: Path, names: list[str]) -> None:
    missing = [c for c in _PLACE if c not in names]
    if not any(c in names for c in _TIMES):
        missing = ["time", *missing]
    if "sigma_m" not in names and not all(c in names for c in _COVARIANCE):
        missing.append("sigma_m")
    if missing:
        raise InputError(
            f"{path}: lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            "a fixes file has time, easting_m, northing_m, sigma_m, or is the fixes.csv of locate"
        )


def _fix_of_row(path: Path, line: int, row: dict[str, str]) -> PositionFix:
    accepted = (row.get("accepted") or "true").strip().lower() == "true"
    try:
        time_s = utc_seconds(row["time"]) if row.get("time") else float(row["time_s"])
        easting_m, northing_m = (float(row[c]) for c in _PLACE)
        if row.get("sigma_m") is not None:
            sigma_m = float(row["sigma_m"])
            covariance = (sigma_m**2, 0.0, sigma_m**2)
        else:
            ee, en, nn = (float(row[c]) for c in _COVARIANCE)
            covariance = (ee, en, nn)
            # The smaller axis of the ellipse, NaN where the three are no covariance.
            half = np.hypot(0.5 * (ee - nn), en)
            sigma_m = float(np.sqrt(max(0.5 * (ee + nn) - half, 0.0)))
        protection_m = float(row.get("protection_m") or "nan")
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: line {line}: {error}; mend or remove the line") from error
    if not np.isfinite([time_s, easting_m, northing_m]).all():
        raise InputError(f"{path}: line {line}: the position is not finite; remove the line")
    if not (np.isfinite(sigma_m) and sigma_m > 0):
        raise InputError(f"{path}: line {line}: sigma_m must be positive, got {sigma_m}")
    return PositionFix(
        time_s, easting_m, northing_m, *covariance, row.get("kind") or "absolute", accepted,
        row.get("reason") or "", protection_m,
    )  # fmt: skip


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
