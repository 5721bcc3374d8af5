"""The landforms that a scenario's [[world.terrain]] may list, as validated records."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class _Component(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Fractal(_Component):
    """Relief with a power-law spectrum."""

    kind: Literal["fractal"]
    rms_m: float = Field(default=1.0, ge=0, description="root mean square height, m")
    slope: float = Field(default=2.5, ge=0, le=6, description="exponent of a profile's spectrum")
    longest_m: float = Field(default=200.0, gt=0, description="longest wavelength, m")
    shortest_m: float = Field(default=2.0, gt=0, description="shortest wavelength, m")


class Plane(_Component):
    """A tilt of the whole floor."""

    kind: Literal["plane"]
    slope_deg: float = Field(default=1.0, ge=0, lt=60, description="tilt, degrees")
    toward_deg: float = Field(default=90.0, description="azimuth toward which the floor falls")


class _Linear(_Component):
    east_m: float = Field(default=0.0, description="a point of the axis, m east")
    north_m: float = Field(default=0.0, description="a point of the axis, m north")
    azimuth_deg: float = Field(default=90.0, description="direction of the axis")
    meander_m: float = Field(default=0.0, ge=0, description="swing of the axis to either side, m")
    meander_length_m: float = Field(default=200.0, gt=0, description="wavelength of the swing, m")


class Canyon(_Linear):
    """A valley with a flat bottom and smooth walls."""

    kind: Literal["canyon"]
    depth_m: float = Field(default=8.0, ge=0, description="depth below the floor, m")
    width_m: float = Field(default=15.0, ge=0, description="width of the flat bottom, m")
    wall_m: float = Field(default=20.0, gt=0, description="horizontal extent of each wall, m")


class Ridge(_Linear):
    """A ridge with a flat crest and smooth flanks, with passes through it where wanted."""

    kind: Literal["ridge"]
    height_m: float = Field(default=6.0, ge=0, description="height above the floor, m")
    width_m: float = Field(default=5.0, ge=0, description="width of the flat crest, m")
    wall_m: float = Field(default=20.0, gt=0, description="horizontal extent of each flank, m")
    gaps_m: tuple[float, ...] = Field(default=(), description="passes: distances along the axis, m")
    gap_width_m: float = Field(default=25.0, gt=0, description="width of a pass's bottom, m")


class SandWaves(_Linear):
    """A train of waves; their crests run along the axis."""

    kind: Literal["sand-waves"]
    height_m: float = Field(default=1.0, ge=0, description="crest to trough, m")
    length_m: float = Field(default=20.0, gt=0, description="wavelength, m")
    asymmetry: float = Field(default=0.4, ge=0, lt=1, description="lean of the waves, 0 to 1")


class Scatter(_Component):
    """Round objects thrown at random: boulders, mounds or pockmarks, each in truth/objects.csv."""

    kind: Literal["boulders", "mounds", "pockmarks"]
    count: int = Field(default=10, ge=0, le=100000, description="number of objects")
    height_min_m: float = Field(default=0.5, gt=0, description="least height (depth), m")
    height_max_m: float = Field(default=1.5, gt=0, description="greatest height (depth), m")
    aspect_min: float = Field(default=0.8, gt=0, description="least radius over height")
    aspect_max: float = Field(default=1.5, gt=0, description="greatest radius over height")
    spacing_m: float = Field(
        default=10.0, ge=0, description="least distance from one to the next, m"
    )
    east_m: float = Field(default=0.0, description="middle of the area, m east")
    north_m: float = Field(default=0.0, description="middle of the area, m north")
    size_east_m: float = Field(default=300.0, gt=0, description="extent of the area to the east, m")
    size_north_m: float = Field(
        default=200.0, gt=0, description="extent of the area to the north, m"
    )


class Object(_Component):
    """One object at a stated place."""

    kind: Literal["object"]
    shape: Literal["boulder", "mound", "pockmark", "box"] = Field(
        default="boulder", description="its form"
    )
    east_m: float = Field(default=0.0, description="its centre, m east")
    north_m: float = Field(default=0.0, description="its centre, m north")
    height_m: float = Field(default=1.0, gt=0, description="height (depth of a pockmark), m")
    radius_m: float = Field(default=1.5, gt=0, description="radius of a round one, m")
    length_m: float = Field(default=6.0, gt=0, description="long side of a box, m")
    width_m: float = Field(default=3.0, gt=0, description="short side of a box, m")
    azimuth_deg: float = Field(default=0.0, description="direction of a box's long side")


class Raster(_Component):
    """A raster's relief, brought to a stated size: mean taken off, middle laid on the origin."""

    kind: Literal["raster"]
    path: str = Field(description="a raster that GDAL reads; relative to the scenario file")
    cell_m: float | None = Field(
        default=None, gt=0, description="cell to lay it out with, m; its own if absent"
    )
    rms_m: float | None = Field(
        default=None, gt=0, description="rms to stretch it to, m; its own if absent"
    )


Component = Annotated[
    Fractal | Plane | Canyon | Ridge | SandWaves | Scatter | Object | Raster,
    Field(discriminator="kind"),
]

KINDS: dict[str, type[BaseModel]] = {
    "fractal": Fractal,
    "plane": Plane,
    "canyon": Canyon,
    "ridge": Ridge,
    "sand-waves": SandWaves,
    "boulders": Scatter,
    "mounds": Scatter,
    "pockmarks": Scatter,
    "object": Object,
    "raster": Raster,
}
