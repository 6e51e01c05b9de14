"""A card of each image of a block: its picture with the residuals on it, how it was seen, and how well its rays fit."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass

from ortho_pipeline.display.numbers import px
from ortho_pipeline.errors import counted
from ortho_pipeline.points.rows import ROLES
from ortho_pipeline.report.adjustment_records import is_known
from ortho_pipeline.report.block_records import BlockReport, Ray

#: Images that have a picture, and the longer side of one, px.
PICTURES, SIDE = 12, 420


@dataclass(frozen=True)
class Card:
    """What a page shows of an image; `picture` is a PNG in base64, `plot` the SVG that lies upon it."""

    label: str
    picture: str | None
    plot: str | None
    #: Left, top, width and height of the picture within the plot, per cent.
    place: tuple[float, float, float, float]
    rays: str
    view: str | None
    covered: float
    worst: str | None


def card(
    report: BlockReport,
    label: str,
    png: bytes | None,
    plot: str | None,
    place: tuple[float, float, float, float],
    rays: tuple[Ray, ...],
) -> Card:
    """Return the card of an image of a report; `rays` are those in it."""
    image, roles = report.images[label], {point.id: point.role for point in report.adjustment.points}
    used = [ray for ray in rays if ray.used]
    found = [f"{number} {role}" for role in ROLES if (number := sum(roles[ray.id] == role for ray in used))]
    left = len(rays) - len(used)
    sizes = [(math.hypot(*ray.residual), ray.id) for ray in used if is_known(ray.residual)]
    view = None
    if image.incidence_deg is not None:
        view = f"{image.incidence_deg:.1f}° off the vertical"
        if image.sensor_azimuth_deg is not None:
            view += f", sensor in azimuth {image.sensor_azimuth_deg:.0f}°"
    return Card(
        label=label,
        picture=None if png is None else base64.b64encode(png).decode(),
        plot=plot,
        place=place,
        rays=", ".join(found or ["none"]) + (f"; {counted(left, 'measurement')} left out" if left else ""),
        view=view,
        covered=image.covered,
        worst=f"{max(sizes)[1]}, {px(max(sizes)[0])}" if sizes else None,
    )


def rays_by_image(report: BlockReport) -> Mapping[str, tuple[Ray, ...]]:
    """Return the rays of each image."""
    found: dict[str, list[Ray]] = {label: [] for label in report.images}
    for ray in report.adjustment.rays:
        found[ray.image].append(ray)
    return {label: tuple(rays) for label, rays in found.items()}
