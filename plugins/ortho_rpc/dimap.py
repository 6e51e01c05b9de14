"""The rigorous model in DIMAP metadata: orbit, attitude and look directions instead of an RPC.

Supported are version 1 of Pleiades (`Sensor_Model_Characteristics`) and version 2 of Pleiades, Pleiades Neo, SPOT 6 and
7 (`Refined_Model`). Conventions of the vendor:

- the *centre* of row 1 is exposed at START, the next ones every line period;
- positions (ECEF) are interpolated by Lagrange's polynomial through eight rows of the table; the velocities are not
  used, because they lack the rotation of the Earth;
- the attitude is a quaternion to ECEF, scalar first, to be normalised: each part a polynomial in (seconds of the day -
  OFFSET) / SCALE (Pleiades), or a table of them (Pleiades Neo, SPOT);
- a column looks along (psi_Y, -psi_X, 1): both are polynomials in the column counted from 0 at the first centre, and
  are used as they are, without a tangent;
- no light time, no aberration, no refraction; for Pleiades Neo refraction is added.

Checked: version 1 against the vendor's own location grid (0.2 mm). In version 2 the rays of the corners pass the
vendor's own vertices within 1.5 mm (Pleiades, where they are the outer corners of the pixels) and 5 mm (SPOT 6, where
they are centres, all at one height; a microsecond of its times is 7 mm); with tangents they miss them by 0.2 m, and
by 0.6 m and 28 m of height. Of Pleiades Neo the file at hand is without look angles: straight lines for both, drawn
through one row of the vendor's RPC to 0.002 px (with tangents 0.25 px), agree with it over 600 rows and 200 m up and
down to 0.006 px, without refraction to 0.04 px. Where its look angles count from is held against the RPC of each scene
(`ortho_rpc.rigorous`).
"""

from __future__ import annotations

import re
from dataclasses import replace
from os import PathLike
from xml.etree.ElementTree import Element

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ortho_pipeline.plugin import (
    InputError,
    LineCamera,
    Pushbroom,
    SplineForm,
    place,
    pushbroom_of_tables,
    read_bounded,
    reads,
    require_view,
)
from ortho_rpc.dimap_file import MAX_SIZE, DimapFile
from ortho_rpc.scan import FIRST, SECOND, first_version, second_version

Array = NDArray[np.float64]

#: Height range (m) of the ground if not stated.
HEIGHTS = (-100.0, 3000.0)


def has_dimap_pushbroom(path: str | PathLike[str]) -> bool:
    """Return whether a file is DIMAP metadata with a rigorous model, from its text alone."""
    try:
        data = read_bounded(path, MAX_SIZE)
    except InputError:
        return False
    models = (b"<Sensor_Model_Characteristics", b"<Refined_Model")
    return len(data) <= MAX_SIZE and b"Dimap_Document" in data[:2000] and any(name in data for name in models)


@reads("copy the metadata again from the delivery, or use the RPC")
def read_dimap_pushbroom(
    source: str | PathLike[str] | DimapFile, *, image: str | None = None, heights: tuple[float, float] | None = None
) -> Pushbroom:
    """Read the rigorous model of a Pleiades or SPOT 6/7 product. Its parameters are offsets and drifts of the attitude.

    Parameters
    ----------
    source : path or DimapFile
    image : str, optional
        Name of a tile in the metadata: return its model in its own pixels, instead of that of the whole scene.
    heights : (float, float), optional
        Range of ellipsoidal heights (m) of the ground if the metadata have none.

    Raises
    ------
    InputError
        If the file is not such metadata, a value is missing or impossible, or its conventions are not supported.
    """
    file = source if isinstance(source, DimapFile) else DimapFile(place(source))
    if file.has(FIRST):
        scan = first_version(file)
    elif file.has(SECOND):
        scan = second_version(file)
    else:
        raise file.error("this file has no rigorous model", SECOND, "use the RPC")
    left, top, columns, rows = tile_of(file, image) or (0, 0, scan.columns, scan.rows)
    # Columns count from 0 at the first pixel centre of the whole image.
    across, along = (Polynomial(psi)(Polynomial([left - 0.5, 1.0])).coef for psi in (scan.psi_x, scan.psi_y))
    first = scan.start + (top - 0.5) * scan.period
    times, turns = scan.attitude(first, rows * scan.period)
    try:
        model = pushbroom_of_tables(
            LineCamera.of_polynomials(columns, rows, across, along),
            line_period=scan.period,
            first_time=0.0,
            orbit=(scan.orbit[0] - first, scan.orbit[1]),
            attitude=(times - first, turns),
            heights=_heights(file) or heights or HEIGHTS,
            splines=SplineForm(3, attitude=scan.pieces),
        )
        model = replace(model, light=scan.light)
        require_view(model)  # damaged numbers can give a camera that looks into the sky
    except InputError as error:
        raise InputError(error.message, file=file.path, field=error.field, remedy=error.remedy) from error
    return model


def images_of(file: DimapFile) -> dict[str, Element]:
    """Return the images of the metadata, by file name in lower case."""
    listed = {}
    for entry in file.all("Raster_Data/Data_Access/Data_Files/Data_File"):
        path = entry.find("DATA_FILE_PATH")
        if path is not None and (name := (path.get("href") or "").replace("\\", "/").rpartition("/")[2].lower()):
            listed[name] = entry
    return listed


def tile_of(file: DimapFile, image: str | None) -> tuple[int, int, int, int] | None:
    """Return first column, first row, columns and rows of a tile; None if the image is not a tile."""
    listed = images_of(file)
    entry = listed.get((image or "").lower())
    tiling = file.root.find("Raster_Data/Raster_Dimensions/Tile_Set/Regular_Tiling")
    if entry is None or tiling is None or len(listed) < 2:
        return None
    field = "Tile_Set/Regular_Tiling"
    if any((tiling.findtext(f"OVERLAP_{name}") or "0").strip() not in ("0", "0.0") for name in ("ROW", "COL")):
        raise file.error("the tiles overlap; such products are not supported", field)
    size = tiling.find("NTILES_SIZE")
    texts = [] if size is None else [size.get("ncols"), size.get("nrows")]
    texts += [entry.get("tile_C"), entry.get("tile_R")]
    if len(texts) != 4 or not all(text and re.fullmatch(r"\d{1,8}", text, re.ASCII) for text in texts):
        raise file.error("size or position of the tiles is missing", field)
    columns, rows, column, row = (int(text or 0) for text in texts)
    left, top = columns * (column - 1), rows * (row - 1)
    width = min(columns, file.integer("Raster_Data/Raster_Dimensions/NCOLS") - left)
    height = min(rows, file.integer("Raster_Data/Raster_Dimensions/NROWS") - top)
    if min(left, top) < 0 or min(width, height) < 1:
        raise file.error(f"tile {row}, {column} is outside the scene", field)
    return left, top, width, height


def _heights(file: DimapFile) -> tuple[float, float] | None:
    """Return the range of heights for which the RPC of the same file is meant, if it has one."""
    path = "Geoposition/Rational_Sensor_Model/Global_RFM/RFM_Validity/Alt"
    if not file.has(path):
        return None
    scale, offset = file.number(f"{path}/A"), file.number(f"{path}/B")
    if not 0 < abs(scale) < 20_000 or abs(offset) > 20_000:
        return None
    return offset - abs(scale), offset + abs(scale)
