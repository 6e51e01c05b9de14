"""A STAC item for an orthoimage: where and when it is, how it was seen, how accurate it is, and a checksum.

Extensions: projection 2.0, raster 1.1, eo 1.1, view 1.0, file 2.1, accuracy 1.0 beta 1 (its only published version).
Accuracy comes from check points or leave-one-out residuals; control points only tell of the fit, and are left out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import sha256, staged, whole_or_nothing, write_json
from ortho_pipeline.geodesy.distortion import metres_of_steps
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.raster.valid_area import to_geojson, valid_outline
from ortho_pipeline.report.matching import is_relative
from ortho_pipeline.report.records import SceneReport, View
from ortho_pipeline.report.wording import refuted

if TYPE_CHECKING:
    from ortho_pipeline.raster.source import Grid

_EXTENSIONS = "https://stac-extensions.github.io"
_URIS = {
    "proj": f"{_EXTENSIONS}/projection/v2.0.0/schema.json",
    "raster": f"{_EXTENSIONS}/raster/v1.1.0/schema.json",
    "eo": f"{_EXTENSIONS}/eo/v1.1.0/schema.json",
    "view": f"{_EXTENSIONS}/view/v1.0.0/schema.json",
    "file": f"{_EXTENSIONS}/file/v2.1.0/schema.json",
    "accuracy": f"{_EXTENSIONS}/accuracy/v1.0.0-beta.1/schema.json",
}
#: Multihash: the code of SHA-256 and its length in bytes.
_SHA256 = "1220"
#: Longer side in pixels of the pictures of an item, by their key among the files.
_PICTURES = {"thumbnail": 256, "overview": 1024}
_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
#: Files next to the ortho: key, title, media type, roles.
_ASSETS = (
    ("thumbnail", "Orthoimage, small", "image/png", ["thumbnail"]),
    ("overview", "Orthoimage, reduced", "image/png", ["overview", "visual"]),
    ("report", "Accuracy report", "application/json", ["metadata"]),
    ("html", "Accuracy report as a page", "text/html", ["metadata"]),
    ("model", "Adjusted sensor model", "application/json", ["metadata"]),
    ("visibility", "Visible (1), hidden (2), outside (3) and void (4) pixels", _COG, ["metadata"]),
    ("angles", "Angles of view and of the sun at each place", _COG, ["data", "metadata"]),
    ("shadow", "Pixels in the sun (1), in shadow (2), void (4)", _COG, ["metadata"]),
    ("accuracy", "Accuracy of each place", _COG, ["data", "metadata"]),
    ("residuals", "Residuals of the points", "application/geo+json", ["metadata"]),
)


def acquisition_time(facts: Mapping[str, Any], given: str | None = None) -> datetime:
    """Return the time at which a scene was taken, UTC where nothing else is said.

    Parameters
    ----------
    facts : mapping
        What the sensor says of the scene; ``acquired`` counts.
    given : str, optional
        What the user says, which counts more.

    Raises
    ------
    InputError
        If there is none, or it is not a time: STAC has no item without one.
    """
    text = given if given is not None else facts.get("acquired")
    if not text:
        raise InputError(
            "a STAC item needs the time of acquisition, and the metadata of this scene have none",
            field="output.acquired",
            remedy=Text("give it, for example ", Setting("output.acquired", "2005-08-03T08:12:31Z")),
        )
    try:
        time = datetime.fromisoformat(str(text).strip())
        return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    except (ValueError, OverflowError) as error:
        # Overflow: the last hours of the last year, in a zone in which they are the next year in UTC.
        raise InputError(
            f"{str(text)[:40]!r} is not a time of acquisition",
            field="output.acquired",
            remedy="for example 2005-08-03T08:12:31Z",
        ) from error


def write_item(path: Path, report: SceneReport, files: Mapping[str, Path], acquired: datetime, name: str) -> None:
    """Write the STAC item of an ortho, and its pictures.

    Parameters
    ----------
    path : Path
        Next to the ortho, to which it refers by relative links.
    report : SceneReport
        The accuracy report of the ortho.
    files : mapping of str to Path
        Outputs by what they are; ``ortho`` has to be there, ``thumbnail`` and ``overview`` are made of it (PNG,
        8 bits, stretched for the eye), the others become assets where they are.
    name : str
        Id of the item.

    Raises
    ------
    InputError
        If the ortho has no valid pixel, and therefore no place.
    """
    properties = {**_view(report.scene.view), **_accuracy(report), **_filled(report)}
    facts = report.scene.facts
    if isinstance(facts.get("satellite"), str):
        properties["platform"] = facts["satellite"].lower()
    pixel = report.scene.ground_pixel_m
    if pixel is not None:
        properties["gsd"] = round(float(np.mean(pixel)), 4)
    for key, side in _PICTURES.items():
        if key in files:
            with whole_or_nothing(files[key]) as temporary:
                temporary.write_bytes(preview_png(staged(files["ortho"]), side=side))
    write_ortho_item(path, files, acquired, name, properties)


def write_ortho_item(
    path: Path, files: Mapping[str, Path], acquired: datetime, name: str, properties: Mapping[str, Any]
) -> None:
    """Write the STAC item of an ortho with given properties, and with its projection, outline and checksum.

    Raises
    ------
    InputError
        If the ortho has no valid pixel, and therefore no place.
    """
    import pystac

    ortho = staged(files["ortho"])
    grid, outline = grid_of(ortho), valid_outline(ortho)
    if outline.is_empty:
        raise InputError("no pixel of the ortho is valid: it has no place", file=files["ortho"])
    geometry, box = to_geojson(outline, grid.crs)
    properties = {**_projection(grid, outline), **properties}
    prefixes = {"file", "raster", *(name.partition(":")[0] for name in properties)}
    item = pystac.Item(
        name, geometry, box, acquired, properties, stac_extensions=[_URIS[key] for key in _URIS if key in prefixes]
    )
    item.add_asset("ortho", _ortho_asset(files["ortho"], path.parent))
    for key, title, media, roles in _ASSETS:
        if key in files and staged(files[key]).is_file():
            item.add_asset(key, pystac.Asset(_href(files[key], path.parent), title, media_type=media, roles=roles))
    document = item.to_dict(include_self_link=False, transform_hrefs=False)
    write_json(path, document, ascii_only=False)


def write_catalog(path: Path, items: Sequence[Path], title: str) -> None:
    """Write a catalog of items, with relative links to them."""
    import pystac

    catalog = pystac.Catalog(path.parent.name, f"Orthoimages of {title}", title=title)
    for item in items:
        catalog.add_link(pystac.Link("item", _href(item, path.parent), "application/geo+json"))
    document = catalog.to_dict(include_self_link=False, transform_hrefs=False)
    document["links"] = [
        {"rel": "root", "href": f"./{path.name}", "type": "application/json"},
        *(link for link in document["links"] if link["rel"] == "item"),
    ]
    write_json(path, document, ascii_only=False)


def _href(path: Path, folder: Path) -> str:
    return f"./{path.relative_to(folder).as_posix()}"


def _ortho_asset(path: Path, folder: Path) -> Any:
    import pystac

    content = staged(path)
    source = RasterSource(content)
    band: dict[str, Any] = {"data_type": source.dtype.name, "sampling": "area"}
    grid = grid_of(content)
    x, y = grid.xy(np.array([grid.width / 2]), np.array([grid.height / 2]))
    pixel = metres_of_steps(grid.crs, np.stack([x, y, np.zeros(1)], axis=1), np.array([grid.dx, grid.dy]))
    if np.isfinite(pixel).all():
        band["spatial_resolution"] = float(f"{pixel.mean():.3g}")
    bands = []
    for nodata in source.nodata:
        value = {} if nodata is None else {"nodata": "nan" if math.isnan(nodata) else nodata}
        bands.append({**band, **value})
    layout = source.dataset.GetMetadata("IMAGE_STRUCTURE").get("LAYOUT")
    return pystac.Asset(
        _href(path, folder),
        "Orthoimage",
        media_type=pystac.MediaType.COG if layout == "COG" else pystac.MediaType.GEOTIFF,
        roles=["data"],
        extra_fields={
            "raster:bands": bands,
            "file:size": content.stat().st_size,
            "file:checksum": _SHA256 + sha256(content),
        },
    )


def _projection(grid: Grid, outline: Any) -> dict[str, Any]:
    authority = grid.crs.to_authority()
    known = {"proj:code": ":".join(authority)} if authority else {"proj:wkt2": grid.crs.to_wkt()}
    return {
        **known,
        "proj:bbox": [float(value) for value in grid.extent],
        "proj:shape": [grid.height, grid.width],
        "proj:transform": [grid.dx, 0.0, grid.left, 0.0, -grid.dy, grid.top],
        "proj:geometry": json.loads(shapely.to_geojson(outline)),
    }


def _view(view: View | None) -> dict[str, Any]:
    """Return incidence and azimuth at the scene: as the extension has it, from the point below the sensor onwards."""
    if view is None:
        return {}
    angles: dict[str, Any] = {"view:incidence_angle": round(view.incidence_deg, 4)}
    if view.sensor_azimuth_deg is not None:
        angles["view:azimuth"] = round((view.sensor_azimuth_deg + 180) % 360, 4)
    return angles


def _filled(report: SceneReport) -> dict[str, Any]:
    """Return which share of what the image reaches is hidden, and which is another ortho's."""
    warp = report.warp
    if warp is None or warp.hidden_share is None:
        return {}
    found: dict[str, Any] = {"ortho:hidden_share": round(warp.hidden_share, 6)}
    if warp.filled_share is not None:
        other = (report.provenance.options or {}).get("output", {}).get("fill_from")
        found |= {"ortho:filled_share": round(warp.filled_share, 6), "ortho:filled_from": Path(str(other)).name}
    return found


def _accuracy(report: SceneReport) -> dict[str, Any]:
    """Return what points that took no part say: a radial RMSE in metres, bias and spread of check points."""
    found: dict[str, Any] = {}
    if refuted(report.notices):
        return found
    if report.matching or is_relative(report.adjustment):
        # Matches say nothing of where the reference lies; only points that somebody measured do.
        tested = report.matching and report.matching.absolute
        if not tested or tested.m is None:
            return {}
        return {
            "accuracy:geometric_rmse": round(tested.m, 4),
            "ortho:accuracy_from": "check points",
            "ortho:accuracy_points": tested.n,
        }
    for rmse, what in ((report.rmse_m.check, "check points"), (report.rmse_m.loo, "leave-one-out residuals")):
        if rmse:
            found = {
                "accuracy:geometric_rmse": round(rmse.total, 4),
                "ortho:accuracy_from": what,
                "ortho:accuracy_points": rmse.n,
            }
            break
    points = report.adjustment.points
    shifts = np.array([point.residual_m for point in points if point.role == "check" and point.residual_m])
    if len(shifts) > 1:
        for axis, values in zip("xy", shifts.T, strict=True):
            found[f"accuracy:geometric_{axis}_bias"] = round(float(values.mean()), 4)
            found[f"accuracy:geometric_{axis}_stddev"] = round(float(values.std(ddof=1)), 4)
    return found


def ortho_accuracy(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a STAC item that a verified ortho adds: extensions and properties.

    As above, an accuracy relative to a reference does not say where the ortho is: it gets a field of its own.
    """
    what = next((name for name in ("points", "absolute", "relative") if document[name] is not None), None)
    if what is None:
        return {"stac_extensions": [], "properties": {}}
    found = document[what]
    if what == "relative":
        fields = {"ortho:relative_rmse": round(found["rmse_m"]["value"], 4), "ortho:accuracy_from": "reference"}
        return {"stac_extensions": [], "properties": fields}
    places = found["residuals"] if what == "points" else document["field"]["cells"]
    spread = np.array([[one["east_m"], one["north_m"]] for one in places]).std(axis=0, ddof=1)
    fields = {"accuracy:geometric_rmse": round(found["rmse_m"]["value"], 4)}
    for axis, name, deviation in zip("xy", ("east", "north"), spread.tolist(), strict=True):
        fields[f"accuracy:geometric_{axis}_bias"] = round(found[f"bias_{name}_m"]["value"], 4)
        fields[f"accuracy:geometric_{axis}_stddev"] = round(deviation, 4)
    if what == "points":
        fields |= {"ortho:accuracy_from": "check points", "ortho:accuracy_points": found["count"]}
    else:
        fields["ortho:accuracy_from"] = "reference of known accuracy"
    return {"stac_extensions": [_URIS["accuracy"]], "properties": fields}
