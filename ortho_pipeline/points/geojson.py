"""Points as GeoJSON, with the property ``ji`` = [column, row]."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.files import parse_json
from ortho_pipeline.points.image_errors import read_image_errors, says_more
from ortho_pipeline.points.rows import (
    CSV_ERRORS,
    OF_BLOCK,
    OF_IMAGE,
    ColumnRules,
    PointRow,
    Table,
    TablePoint,
    number,
    role_of,
    short,
    sigma_of,
)


def read_geojson(path: str | os.PathLike[str], text: str, expected: ColumnRules = OF_IMAGE) -> Table:
    """Read points with a property ``ji`` = [column, row] from the *centre* of the first pixel; lon, lat, height.

    Further properties: ``id``, ``role``, ``sigma_image``, ``sigma_xy``, ``sigma_h``, ``filename`` (the image), and
    those of `CSV_ERRORS`. GeoJSON heights are ellipsoidal. In a block ``ji`` may be a mapping of images to
    [column, row], and the geometry of a tie point is null. For ground points ``ji`` is ignored.
    """
    document = parse_json(text, path, "write a FeatureCollection of Points")
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError("this is not a GeoJSON FeatureCollection", file=path, field="features")
    table = Table("GeoJSON", crs=_geojson_crs(path, document), assumed_vertical="ellipsoid")
    for count, feature in enumerate(features):
        table.rows += _feature(path, f"features[{count}]", feature, expected)
    return table


def _geojson_crs(path: str | os.PathLike[str], document: dict[str, Any]) -> str:
    stated = document.get("crs")
    if stated is None:
        return "EPSG:4979"
    properties = stated.get("properties") if isinstance(stated, dict) else None
    name = str(properties.get("name", "")) if isinstance(properties, dict) else ""
    if not re.search(r"(CRS84h?|:4326|:4979)$", name):
        raise CrsError(
            f"the CRS {short(name)} of this GeoJSON is not WGS84",
            file=path,
            field="crs",
            remedy="convert the points to EPSG:4979",
        )
    return "EPSG:4979"


def _feature(path: str | os.PathLike[str], where: str, feature: Any, expected: ColumnRules) -> list[PointRow]:
    """Return a row for each image in which the point of a feature was measured."""
    properties = feature.get("properties") if isinstance(feature, dict) else None
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    tie = geometry is None and expected is OF_BLOCK
    if not isinstance(properties, dict) or not (
        tie or (isinstance(geometry, dict) and geometry.get("type") == "Point")
    ):
        raise InputError("this feature is not a Point with properties", file=path, field=where)
    ground = (math.nan,) * 3 if geometry is None else _place(path, where, geometry)
    properties, ground = _named(path, where, properties, ground, expected)

    def sigma(name: str, zero: bool) -> float | None:
        value = properties.get(name)
        return None if value is None else sigma_of(value, path, f"{where}.properties.{name}", zero=zero)

    name = properties.get("id", feature.get("id"))
    if name is not None and not isinstance(name, str | int):
        raise InputError(f"{short(name)} is not an id", file=path, field=f"{where}.properties.id")
    role = properties.get("role") or expected.role
    sigma_image = sigma("sigma_image", False)
    covariance, group, common, alike = read_image_errors(
        [properties.get(key) for key in CSV_ERRORS],
        path,
        [f"{where}.properties.{key}" for key in CSV_ERRORS],
        sigma_image,
    )
    row = PointRow(
        where=where,
        id=str(name) if name is not None else None,
        image=(math.nan, math.nan),
        ground=ground,
        role=role_of(role, path, f"{where}.properties.role") if role else "",
        sigma_image=sigma_image,
        sigma_xy=sigma("sigma_xy", True),
        sigma_h=sigma("sigma_h", True),
        covariance=covariance,
        group=group,
        sigma_common=common,
        sigma_alike=alike,
    )
    if "col" not in expected.needed:
        return [row]
    return [replace(row, image=at, image_name=image) for image, at in _measured(path, where, properties, expected)]


def _named(
    path: str | os.PathLike[str],
    where: str,
    properties: dict[str, Any],
    ground: tuple[float, ...],
    expected: ColumnRules,
) -> tuple[dict[str, Any], tuple[float, float, float]]:
    """Return properties by our names, and the ground with a height that is one of them, else that of the geometry."""
    x, y, height = ground
    of_heights = {"h": "h", **expected.aliases} if expected.aliases else {}
    # The name that comes first counts most.
    for alias, ours in reversed(of_heights.items()):
        value = next((value for key, value in properties.items() if key.lower().replace("_", "") == alias), None)
        if value is not None and ours != "h":
            properties = {ours: value, **properties}
        elif value is not None:
            height = number(value, path, f"{where}.properties, {alias}")
    return properties, (x, y, height)


def _place(path: str | os.PathLike[str], where: str, geometry: dict[str, Any]) -> tuple[float, float, float]:
    place = geometry.get("coordinates")
    if not isinstance(place, list) or len(place) not in (2, 3):
        raise InputError("the coordinates are not [lon, lat, height]", file=path, field=f"{where}.geometry.coordinates")
    ground = [number(value, path, f"{where}.geometry.coordinates[{k}]") for k, value in enumerate(place)]
    return ground[0], ground[1], ground[2] if len(ground) == 3 else math.nan


def _measured(
    path: str | os.PathLike[str], where: str, properties: dict[str, Any], expected: ColumnRules
) -> Iterator[tuple[str | None, tuple[float, float]]]:
    """Yield the image, and column and row from the corner of its first pixel, for each image of a point."""
    ji, file_name = properties.get("ji"), properties.get("filename")
    field = f"{where}.properties.ji"
    pairs = [(file_name if isinstance(file_name, str) else None, ji)]
    if isinstance(ji, dict) and expected is OF_BLOCK:
        pairs = list(ji.items())
    elif expected is OF_BLOCK and not isinstance(file_name, str):
        raise InputError(
            "this point does not name its image",
            file=path,
            field=field,
            remedy="give 'ji' as {image: [column, row]}, or as [column, row] with 'filename'",
        )
    for image, pair in pairs:
        if not isinstance(pair, list) or len(pair) != 2:
            raise InputError(
                "this point has no property 'ji' = [column, row]",
                file=path,
                field=field,
                remedy="measure it in the image, or delete it",
            )
        column, row = (number(pair[k], path, f"{field}[{k}]") for k in range(2))
        # From the centre of the first pixel to its corner.
        yield image, (column + 0.5, row + 0.5)


# -- writing ---------------------------------------------------------------------------------------------------------


def feature_of(point: TablePoint) -> dict[str, Any]:
    """Return the GeoJSON feature of a point whose ground is longitude, latitude and height."""
    place = list(point.ground if math.isfinite(point.ground[2]) else point.ground[:2])
    properties = {
        "id": point.id,
        "ji": [value - 0.5 for value in point.image],
        "role": point.role,
        "sigma_image": point.sigma_image,
        "sigma_xy": max(point.sigma_ground[:2]),
        "sigma_h": point.sigma_ground[2],
        **_error_properties(point),
    }
    geometry = {"type": "Point", "coordinates": place} if all(map(math.isfinite, place)) else None
    return {"type": "Feature", "id": point.id, "properties": properties, "geometry": geometry}


def _error_properties(point: TablePoint) -> dict[str, float]:
    """Return the properties `CSV_ERRORS` of a point that add information to `sigma_image`."""
    (column, both), (_, row) = point.covariance_image
    properties: dict[str, float] = {}
    if says_more(np.array([point.covariance_image]))[0]:
        properties.update(zip(CSV_ERRORS[:3], (column, row, both), strict=True))
    if point.group >= 0:
        properties[CSV_ERRORS[3]] = point.group
    if point.sigma_common:
        properties[CSV_ERRORS[4]] = point.sigma_common
    if point.sigma_alike:
        properties[CSV_ERRORS[5]] = point.sigma_alike
    return properties
