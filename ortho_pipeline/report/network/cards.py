"""A card of each image of a block: its picture with the residuals on it, how it was seen, and how well its rays fit."""

from __future__ import annotations

import base64
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from ortho_pipeline.block.fit import Ray
from ortho_pipeline.display.numbers import px, size_m
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.records import is_known
from ortho_pipeline.points.rows import ROLES
from ortho_pipeline.report.block_records import BlockReport

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
    pixel: str | None
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
    wrong = {
        (one.point, label) for one in report.adjustment.rejected if one.what != "ground" and one.image in (None, label)
    }
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
        rays=rays_text(rays, roles, wrong),
        pixel=None if image.ground_pixel_m is None else " × ".join(map(size_m, image.ground_pixel_m)),
        view=view,
        covered=image.covered,
        worst=f"{max(sizes)[1]}, {px(max(sizes)[0])}" if sizes else None,
    )


def rays_text(rays: Sequence[Ray], roles: Mapping[str, str], wrong: Collection[tuple[str, str]]) -> str:
    """Say how many rays of an image took part, by the roles of their points, and why others did not.

    Parameters
    ----------
    wrong : collection of (str, str)
        Point and image of measurements that were left out as gross errors.
    """
    found = [f"{number} {role}" for role in ROLES if (number := sum(roles[ray.id] == role for ray in rays if ray.used))]
    unused = [ray for ray in rays if not ray.used]
    left = sum((ray.id, ray.image) in wrong for ray in unused)
    # Matches that check take part in nothing, so that they test what the others make.
    held = sum(roles[ray.id] == "check" and (ray.id, ray.image) not in wrong for ray in unused)
    said = [", ".join(found or ["none"])]
    said += [f"{held} reserved for checking"] if held else []
    said += [f"{counted(left, 'measurement')} rejected"] if left else []
    if rest := len(unused) - left - held:
        said.append(f"{rest} without effect")
    return "; ".join(said)


def rays_by_image(report: BlockReport) -> Mapping[str, tuple[Ray, ...]]:
    """Return the rays of each image."""
    found: dict[str, list[Ray]] = {label: [] for label in report.images}
    for ray in report.adjustment.rays:
        found[ray.image].append(ray)
    return {label: tuple(rays) for label, rays in found.items()}
