"""How region maps look when they are opened: QGIS styles, and the classes' names and colours for GDAL.

Three doors, since no program reads all of them. QGIS takes `regions.qml` for a file of that name, and for a
layer of a GeoPackage its own table `layer_styles`; GDAL and the programs built on it take the raster
attribute table in `regions.tif.aux.xml`. A colour table inside the TIFF is out: TIFF has none for 32-bit cells.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

from perception.records import REGION_CLASSES

# Warm is up, cold is down, pale is neither; told apart by lightness too, for those who see no red.
CLASS_COLOURS = {
    1: "#b2182b", 2: "#053061", 3: "#ef8a62", 4: "#4393c3",
    5: "#fddbc7", 6: "#d1e5f0", 7: "#f7f7f7", 8: "#bdbdbd",
}  # fmt: skip

# The table that QGIS keeps styles in, as QGIS makes it.
_STYLES_TABLE = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT, f_table_catalog TEXT(256), f_table_schema TEXT(256),
    f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT,
    styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')))
"""


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of "#rrggbb"."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def qgis_style() -> str:
    """Return a QGIS style with a paletted raster renderer and a categorised vector renderer."""
    entries, categories, symbols = [], [], []
    for code, colour in CLASS_COLOURS.items():
        label = quoteattr(REGION_CLASSES[code])
        entries.append(f'<paletteEntry value="{code}" color="{colour}" label={label} alpha="255"/>')
        categories.append(
            f'<category value="{code}" symbol="{code}" label={label} render="true" type="long"/>'
        )
        symbols.append(_fill_symbol(code, colour))
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.22.0" styleCategories="Symbology">\n'
        '<pipe><rasterrenderer type="paletted" band="1" opacity="1" alphaBand="-1">'
        f"<colorPalette>{''.join(entries)}</colorPalette></rasterrenderer></pipe>\n"
        '<renderer-v2 type="categorizedSymbol" attr="class_code" enableorderby="0" '
        'symbollevels="0" forceraster="0">'
        f"<categories>{''.join(categories)}</categories><symbols>{''.join(symbols)}</symbols>"
        "</renderer-v2>\n</qgis>\n"
    )


def _fill_symbol(code: int, colour: str) -> str:
    red, green, blue = rgb(colour)
    properties = {
        "color": f"{red},{green},{blue},160",
        "style": "solid",
        "outline_color": "60,60,60,255",
        "outline_style": "solid",
        "outline_width": "0.1",
        "outline_width_unit": "MM",
    }
    # QGIS before 3.24 reads <prop>, later ones <Option>; each passes over the other.
    old = "".join(f'<prop k="{k}" v="{v}"/>' for k, v in properties.items())
    new = "".join(f'<Option name="{k}" type="QString" value="{v}"/>' for k, v in properties.items())
    return (
        f'<symbol name="{code}" type="fill" alpha="1" clip_to_extent="1">'
        '<layer class="SimpleFill" enabled="1" locked="0" pass="0">'
        f'<Option type="Map">{new}</Option>{old}</layer></symbol>'
    )


def raster_attributes() -> str:
    """Return the GDAL side file (PAM) with value, name and colour of each class for band 1."""
    # Types 0, 2: integer, text. Usages 5, 2: value, name; 6 to 8: red, green, blue.
    columns = (("value", 0, 5), ("class", 2, 2), ("red", 0, 6), ("green", 0, 7), ("blue", 0, 8))
    fields = "".join(
        f'<FieldDefn index="{k}"><Name>{name}</Name><Type>{kind}</Type><Usage>{usage}</Usage></FieldDefn>'
        for k, (name, kind, usage) in enumerate(columns)
    )
    rows = "".join(
        f'<Row index="{k}"><F>{code}</F><F>{escape(REGION_CLASSES[code])}</F>'
        + "".join(f"<F>{part}</F>" for part in rgb(colour))
        + "</Row>"
        for k, (code, colour) in enumerate(CLASS_COLOURS.items())
    )
    table = (
        f'<GDALRasterAttributeTable tableType="thematic">{fields}{rows}</GDALRasterAttributeTable>'
    )
    return f'<PAMDataset><PAMRasterBand band="1">{table}</PAMRasterBand></PAMDataset>\n'


def style_layers(path: Path, layers: Sequence[str]) -> None:
    """Give layers of a GeoPackage their default style, in the table where QGIS looks for it."""
    with sqlite3.connect(path) as file:
        file.execute(_STYLES_TABLE)
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) "
            "VALUES ('layer_styles', 'attributes', 'layer_styles')"
        )
        file.executemany(
            "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, "
            "f_geometry_column, styleName, styleQML, styleSLD, useAsDefault, description, owner) "
            "VALUES ('', '', ?, 'geom', 'H-K classes', ?, '', 1, 'classes by H and K', '')",
            [(layer, qgis_style()) for layer in layers],
        )
    file.close()
