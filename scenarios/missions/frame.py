"""From the scenario's projected CRS to what sonar and navigation files hold."""

from __future__ import annotations

import numpy as np
import pyproj

from perception.records import FloatArray, InputError


class FileFrame:
    """From the scenario's CRS to degrees and true north, as files have them."""

    def __init__(self, crs: str) -> None:
        try:
            projected = pyproj.CRS.from_user_input(crs)
        except pyproj.exceptions.CRSError as error:
            raise InputError(f"world.crs = {crs!r}: is no CRS; give one like EPSG:32630") from error
        if not projected.is_projected or projected.axis_info[0].unit_conversion_factor != 1.0:
            raise InputError(
                f"world.crs = {crs!r}: is not a projected CRS in metres; give one like EPSG:32630"
            )
        self._inverse = pyproj.Transformer.from_crs(projected, "EPSG:4326", always_xy=True)
        self._factors = pyproj.Proj(projected).get_factors

    def degrees(
        self, easting_m: FloatArray, northing_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return longitude and latitude."""
        longitude, latitude = self._inverse.transform(easting_m, northing_m)
        return np.asarray(longitude), np.asarray(latitude)

    def true_heading_deg(
        self, heading_rad: FloatArray, easting_m: FloatArray, northing_m: FloatArray
    ) -> FloatArray:
        """Return headings from true north: grid heading plus meridian convergence."""
        longitude, latitude = self.degrees(easting_m, northing_m)
        convergence = self._factors(longitude, latitude).meridian_convergence
        return (np.rad2deg(heading_rad) + np.asarray(convergence)) % 360.0
