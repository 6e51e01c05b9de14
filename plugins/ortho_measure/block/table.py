"""Marks of several images as points of a block: the table for the adjustment, and the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ortho_measure.marks import GROUND_CRS, Mark, Marks, RayMark, checked, errors_of
from ortho_pipeline.block.points import BlockPoints, shape_of
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.points.geojson import feature_of
from ortho_pipeline.points.image_errors import says_more


def block_points(marks: Marks, labels: Sequence[str], source: str) -> BlockPoints:
    """Return the points of the adjustment: complete marks that are on, with the labels of their images."""
    used = [mark for mark in marks.by_id.values() if mark.counts]
    rays = [(k, label, mark.rays[label]) for k, mark in enumerate(used) for label in labels if label in mark.rays]
    sigma, covariance = errors_of([ray for _, _, ray in rays])
    return BlockPoints(
        ids=tuple(mark.id for mark in used),
        ground=np.array([_known(mark) for mark in used], dtype=float).reshape(-1, 3),
        roles=np.array([mark.role for mark in used], dtype="<U7"),
        sigma_ground=np.array([[mark.sigma_xy] * 2 + [mark.sigma_h] for mark in used], dtype=float).reshape(-1, 3),
        crs=horizontal(parse_crs(GROUND_CRS)),
        images=tuple(labels),
        point=np.array([k for k, _, _ in rays], dtype=np.int64),
        image=np.array([labels.index(label) for _, label, _ in rays], dtype=np.int64),
        measured=np.array([ray.image for _, _, ray in rays], dtype=float).reshape(-1, 2),
        sigma_image=sigma,
        source=source,
        shape_image=shape_of(covariance),
        sigma_common=np.array([mark.sigma_common for mark in used], dtype=float),
        groups=np.array([-1 if ray.group is None else ray.group for _, _, ray in rays], dtype=np.int64),
    )


def _known(mark: Mark) -> tuple[float, ...]:
    """Return the known ground of a mark; NaN for a tie."""
    return (np.nan,) * 3 if mark.role == "tie" or mark.ground is None else mark.ground


def document(marks: Marks, names: Mapping[str, str], source: str) -> dict[str, Any]:
    """Return the GeoJSON of the points: a feature for each ray, with its provenance, in the order of `block_points`.

    Parameters
    ----------
    names : mapping
        Labels of the images -> names in files.
    """
    table = block_points(marks, tuple(names), source)
    features = {label: {point.id: feature_of(point) for point in table.in_image(label)} for label in names}
    collected = []
    for name in table.ids:
        mark = marks.by_id[name]
        for label in names:
            if label not in mark.rays:
                continue
            ray, feature = mark.rays[label], features[label][name]
            feature["id"] = f"{name} in {names[label]}"
            feature["properties"] |= {
                "filename": names[label],
                "measured": ray.how,
                "score": ray.score,
                "at": mark.at,
                "ground_from": None if mark.role == "tie" else mark.ground_from,
                **({"note": mark.note} if mark.note else {}),
            }
            collected.append(feature)
    left = [mark.to_json() for mark in marks.by_id.values() if not mark.counts]
    return {"type": "FeatureCollection", "features": collected, **({"left_out": left} if left else {})}


def marks_of_block(points: BlockPoints, at: str) -> list[Mark]:
    """Return points of a file as marks, with the labels of `points` for images.

    Parameters
    ----------
    at : str
        Time of reading.
    """
    ground = ground_transform(points.crs, GROUND_CRS)(points.ground)
    covariance = points.covariance_image
    more = says_more(covariance)
    marks = []
    for k, name in enumerate(points.ids):
        rays = {}
        for ray in np.flatnonzero(points.point == k).tolist():
            (column, both), (_, row) = covariance[ray].tolist()
            rays[points.images[points.image[ray]]] = RayMark(
                image=tuple(points.measured[ray].tolist()),
                how="file",
                sigma_image=None if more[ray] else float(points.sigma_image[ray]),
                covariance=(column, row, both) if more[ray] else None,
                group=int(points.grouped[ray]) if points.grouped[ray] >= 0 else None,
            )
        known = bool(np.isfinite(ground[k]).all())
        marks.append(
            checked(
                Mark(
                    id=name,
                    ground=tuple(ground[k].tolist()) if known else None,
                    role=str(points.roles[k]),  # type: ignore[arg-type]
                    sigma_xy=float(points.sigma_ground[k, :2].max()),
                    sigma_h=float(points.sigma_ground[k, 2]),
                    sigma_common=float(points.sigma_common[k]),
                    how="file",
                    ground_from="file" if known else None,
                    rays=rays,
                    at=at,
                )
            )
        )
    return marks
