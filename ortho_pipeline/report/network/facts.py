"""What the report says of the network: outlines of images, pairs, angles, and which part of an image points cover."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.network import NetworkRecord, network_of
from ortho_pipeline.block.relative.joins import joins_of, weak_joins
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import size_m
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.ground_residuals import viewing
from ortho_pipeline.estimation.statistics import student_of
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.points.control_hull import COVERED, empty_parts
from ortho_pipeline.report.map_scale import MapScaleRecord, judge

if TYPE_CHECKING:
    from ortho_pipeline.block.start import Start

#: Fewest check points whose mean is tested, and the chance at which it is called systematic.
_FEWEST, _CHANCE = 10, 0.001


def found_network(fit: BlockFit, join_limit: float, dem_unused: bool) -> tuple[NetworkRecord, tuple[Notice, ...]]:
    """Return the network of a block, and notices if joins are weaker than a limit (px) or it falls into parts.

    `dem_unused`: the user gave a DEM whose heights are no observations.
    """
    joins = joins_of(fit, fit.adjusted_dem)
    network = network_of(fit, joins, join_limit)
    weak = weak_joins(joins, join_limit, dem_unused)
    if len(network.parts) < 2:
        return network, weak
    said = " and ".join(", ".join(part[:4]) + (" ..." if len(part) > 4 else "") for part in network.parts[:3])
    text = f"the images fall into {len(network.parts)} parts without points in common: {said}"
    return network, (*weak, Notice("block-in-parts", text, parts=[list(part) for part in network.parts]))


def thinly_covered(places: Mapping[str, Mapping[str, Any]]) -> tuple[Notice, ...]:
    """Return a notice if points cover only a part of some images."""
    part = {label: float(place["covered"]) for label, place in places.items() if place["covered"] < COVERED}
    if not part:
        return ()
    said = ", ".join(f"{100 * share:.0f} % of {label}" for label, share in list(part.items())[:6])
    said += "" if len(part) <= 6 else f" and less of {counted(len(part) - 6, 'more image')}"
    text = f"points cover {said}: the rest has no points"
    return (Notice("points-cover-part", text, share=part),)


def displaced_checks(fit: BlockFit) -> tuple[Notice, ...]:
    """Return a notice if the mean error of check points is more than chance explains, in an axis."""
    tested = fit.points.check & np.isfinite(fit.object_residuals).all(axis=1)
    errors, stated = -fit.object_residuals[tested], fit.ground_sigmas[tested]
    if len(errors) < _FEWEST:
        return ()
    mean, sigma = errors.mean(axis=0), errors.std(axis=0, ddof=1) / np.sqrt(len(errors))
    _, chance = student_of(mean, np.diag(sigma**2), len(errors) - 1)
    far = [
        f"{value:+.2f} m in {axis} (sigma of one point: {size_m(float(np.median(one)))}; points can share errors)"
        for value, axis, p, one in zip(mean, "xyz", chance, stated.T, strict=True)
        if p < _CHANCE
    ]
    if not far:
        return ()
    said = " and ".join(far).replace("-", "−")
    text = f"systematic errors remain: the mean error of {counted(len(errors), 'check point')} is {said}"
    return (Notice("systematic-errors", text, roles=["check"], mean_m=mean.tolist()),)


def placed(fit: BlockFit, starts: Mapping[str, Start]) -> dict[str, dict[str, Any]]:
    """Return of each image, by its adjusted model, its outline, its pixel, and the share that its points cover."""
    heights = fit.ground[np.isfinite(fit.ground).all(axis=1), 2]
    found = {}
    for k, (label, start) in enumerate(starts.items()):
        model, size = fit.models[label], (start.scene.width, start.scene.height)
        corners = np.array([(0, 0), (size[0], 0), size, (0, size[1])], dtype=float)
        level = float(np.median(heights)) if len(heights) else model.reference_height
        ground = ground_transform(model.crs, GEODETIC)(model.image_to_ground(corners, level))[:, :2]
        seen = viewing(model, *size)
        view = seen["view"] or {}
        rays = np.asarray(fit.used_rays) & (fit.points.image == k)
        found[label] = {
            "outline": tuple(map(tuple, ground.tolist())) if np.isfinite(ground).all() else None,
            "ground_pixel_m": seen["ground_pixel_m"],
            "incidence_deg": view.get("incidence_deg"),
            "sensor_azimuth_deg": view.get("sensor_azimuth_deg"),
            "covered": empty_parts(fit.points.measured[rays], size)[0],
        }
    return found


def suffices_for(fit: BlockFit, pixel: float | None) -> MapScaleRecord | None:
    """Return the map scales that check points and pixel (m) of a block suffice for in plan; None without points."""
    check = fit.points.check & np.isfinite(fit.object_residuals).all(axis=1)
    if not check.any():
        return None
    survey = np.nan_to_num(fit.points.sigma_ground[check, :2])
    return judge(fit.object_residuals[check, :2], "check", pixel, float(np.sqrt((survey**2).sum(axis=1).mean())))
