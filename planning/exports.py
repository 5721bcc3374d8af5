"""The same waypoints for charts and autopilots: GPX 1.1 and QGroundControl's .plan.

Every waypoint of `route.csv` is exported, none dropped or moved: positions agree with the plan within a
millimetre (nine decimals of a degree), depths within a tenth of one.
"""

from __future__ import annotations

import json
from pathlib import Path
from xml.sax.saxutils import quoteattr

from pyproj import CRS, Transformer

from perception.files import write_text
from perception.geodesy import is_local
from perception.records import FloatArray
from planning.route import Route

# MAVLink's numbers: NAV_WAYPOINT, and positions with altitude above the geoid's sea level.
_NAV_WAYPOINT, _FRAME_GLOBAL = 16, 0
# QGroundControl's: firmware ArduPilot, vehicle type submarine.
_ARDUPILOT, _SUBMARINE = 3, 12


def lonlat(route: Route) -> tuple[FloatArray, FloatArray]:
    """Return longitude and latitude (deg, WGS 84) of the waypoints; needs the route's CRS."""
    transformer = Transformer.from_crs(CRS.from_user_input(route.crs), 4326, always_xy=True)
    lon_deg, lat_deg = transformer.transform(route.easting_m, route.northing_m)
    return lon_deg, lat_deg


def write_exports(out: Path, route: Route, speed_m_s: float) -> bool:
    """Write route.gpx and route.plan; return False (and write nothing) without a place on Earth."""
    if is_local(route.crs):
        return False
    write_text(out / "route.gpx", gpx(route))
    write_text(out / "route.plan", qgc_plan(route, speed_m_s))
    return True


def gpx(route: Route, name: str = "bathynav route") -> str:
    """Return a GPX route; `ele` is height above the datum, minus the depth."""
    lon_deg, lat_deg = lonlat(route)
    points = "\n".join(
        f'    <rtept lat="{lat:.9f}" lon="{lon:.9f}"><ele>{-depth:.4f}</ele><name>{i}</name></rtept>'
        for i, (lon, lat, depth) in enumerate(zip(lon_deg, lat_deg, route.depth_m, strict=True))
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="bathynav" xmlns="http://www.topografix.com/GPX/1/1">\n'
        f"  <rte>\n    <name>{quoteattr(name)[1:-1]}</name>\n{points}\n  </rte>\n</gpx>\n"
    )


def qgc_plan(route: Route, speed_m_s: float) -> str:
    """Return a QGroundControl mission of one waypoint per row, altitude minus the depth."""
    lon_deg, lat_deg = lonlat(route)
    items = [
        {
            "type": "SimpleItem", "autoContinue": True, "command": _NAV_WAYPOINT,
            "doJumpId": i + 1, "frame": _FRAME_GLOBAL,
            "params": [0, 0, 0, None, round(float(lat), 9), round(float(lon), 9), round(-float(depth), 4)],
        }
        for i, (lon, lat, depth) in enumerate(zip(lon_deg, lat_deg, route.depth_m, strict=True))
    ]  # fmt: skip
    home = [round(float(lat_deg[0]), 9), round(float(lon_deg[0]), 9), 0]
    document = {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        "mission": {
            "version": 2, "firmwareType": _ARDUPILOT, "vehicleType": _SUBMARINE,
            "cruiseSpeed": speed_m_s, "hoverSpeed": speed_m_s,
            "plannedHomePosition": home, "items": items,
        },
    }  # fmt: skip
    return json.dumps(document, indent=1) + "\n"
