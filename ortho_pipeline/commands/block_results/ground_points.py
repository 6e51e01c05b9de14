"""The ground points of a block as files: CSV and GeoJSON."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files import json_text
from ortho_pipeline.files.json.values import json_position, json_value
from ortho_pipeline.models.base import Array


def ground_rows(
    points: BlockPoints, ground: Array, sigmas: Array, residuals: Array, angles_deg: Array | None = None
) -> list[dict[str, Any]]:
    """Return the ground points as JSON values: lon, lat, h, sigmas and known minus found in metres east, north, up."""
    rays = np.bincount(points.point, minlength=len(points))
    rows = []
    for k, name in enumerate(points.ids):
        row = {
            "id": name,
            "role": str(points.roles[k]),
            "rays": int(rays[k]),
            "ground": json_position(ground[k]),
            "sigma": json_position(sigmas[k]),
            "residual": json_position(residuals[k]),
        }
        if angles_deg is not None:
            row["angle_deg"] = json_value(angles_deg[k])
        rows.append(row)
    return rows


def writer_of(path: str | os.PathLike[str]) -> Any:
    writers = {".csv": csv_of, ".geojson": geojson_of}
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        raise InputError(
            "ground points cannot be written in this format", file=path, remedy=f"one of {', '.join(writers)}"
        )
    return writers[suffix]


def geojson_of(rows: Sequence[Mapping[str, Any]]) -> str:
    features = []
    for row in rows:
        geometry = None if row["ground"] is None else {"type": "Point", "coordinates": row["ground"]}
        properties: dict[str, Any] = {"id": row["id"], "kind": row["role"], "rays": row["rays"]}
        for name, values in (("sigma", row["sigma"]), ("residual", row["residual"])):
            for axis, value in zip(("e", "n", "h"), values or (None,) * 3, strict=True):
                properties[f"{name}_{axis}"] = value
        if "angle_deg" in row:
            properties["angle_deg"] = row["angle_deg"]
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    return json_text({"type": "FeatureCollection", "features": features})


def csv_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return determined points as a table that --gcps reads."""
    out = io.StringIO()
    out.write(f"#CRS: {GEODETIC}\n#vertical: ellipsoid\n")
    hidden = any(str(row["id"]).startswith("#") for row in rows)
    writer = csv.writer(out, lineterminator="\n", quoting=csv.QUOTE_ALL if hidden else csv.QUOTE_MINIMAL)
    writer.writerow(("id", "x", "y", "h", "sigma_xy", "sigma_h", "note"))
    for row in rows:
        if row["ground"] is None or row["sigma"] is None:
            continue
        note = f"{row['role']}, {counted(row['rays'], 'ray')}"
        sigma = max(row["sigma"][:2])
        writer.writerow([row["id"], *map(repr, (*row["ground"], sigma, row["sigma"][2])), note])
    return out.getvalue()
