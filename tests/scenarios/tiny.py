"""A survey small enough for a test and whole enough for every stage: three passes, one crossing."""

from pathlib import Path

SCENARIO = """
name = "tiny"
seed = 5

[world]
size_east_m = 220.0
size_north_m = 180.0
depth_m = 40.0
cell_m = 0.5

[[world.terrain]]
kind = "fractal"
rms_m = 0.6
slope = 2.6
longest_m = 60.0
shortest_m = 4.0

[[world.terrain]]
kind = "boulders"
count = 5
height_min_m = 1.0
height_max_m = 1.5
aspect_min = 1.0
aspect_max = 1.5
spacing_m = 14.0
size_east_m = 90.0
size_north_m = 60.0

[sonar]
range_m = 40.0
samples = 256
ping_period_s = 0.5
azimuths = 3

[[mission.block]]
heading_deg = 90.0
count = 2
spacing_m = 30.0
length_m = 110.0

[[mission.block]]
heading_deg = 0.0
count = 1
length_m = 90.0

[prior]
cell_m = 4.0

[locate]
legs = [[-50.0, -30.0], [50.0, -20.0], [50.0, 20.0], [-40.0, 25.0]]
start_sigma_m = 10.0
side_scan = false

[plan]
start = [-40.0, 10.0]
goal = [40.0, -10.0]
"""


def write_tiny(folder: Path, extra: str = "") -> Path:
    """Write the scenario into `folder`, with further tables appended."""
    path = folder / "tiny.toml"
    path.write_text(SCENARIO + extra)
    return path
