"""Layers of view angles and sun angles of an ortho."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ortho_pipeline.commands.placement import Placement
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import write_text
from ortho_pipeline.options import OutputOptions
from ortho_pipeline.report.layers.angles import AnglesLayer, angles_style
from ortho_pipeline.runtime.process_limits import Resources

if TYPE_CHECKING:
    from ortho_pipeline.warp.quality.angles import Sun


def sun_of(facts: Mapping[str, Any], output: OutputOptions) -> Sun | None:
    """Return the position of the sun, from the user or the metadata; None if unknown or not needed.

    Raises
    ------
    InputError
        If the given sun is below the horizon, or angles were not requested.
    """
    if not output.angles:
        if output.sun is not None:
            raise InputError(
                "the position of the sun is only used for angles",
                field="output.sun",
                remedy=Text("add ", Setting("output.angles"), ", or leave it out"),
            )
        return None
    from ortho_pipeline.warp.quality.angles import Sun

    if output.sun is not None:
        return Sun(float(output.sun[0]), float(output.sun[1]))
    azimuth, elevation = facts.get("sun_azimuth_deg"), facts.get("sun_elevation_deg")
    if isinstance(azimuth, int | float) and isinstance(elevation, int | float):
        # Metadata of a night are no mistake of the user.
        with contextlib.suppress(InputError):
            return Sun(float(azimuth), float(elevation))
    return None


def write_angles(placed: Placement, sun: Sun | None, files: dict[str, Path]) -> AnglesLayer | None:
    """Write the layers of angles and of shadows, if they were asked for, and return what the report says of them.

    Without a sun there are no shadows, and they are taken out of `files`.
    """
    output = placed.request.output
    if not output.angles:
        return None
    from ortho_pipeline.warp.quality import angles
    from ortho_pipeline.warp.quality.sight import Sight

    sight, heights = Sight(placed.model, placed.grid), placed.footprint.heights
    resources = Resources(output.memory, output.threads)
    size = placed.scene.width, placed.scene.height
    result = angles.write_angles(
        sight,
        placed.surface,
        size,
        files["angles"],
        heights=heights,
        step=output.layer_step,
        sun=sun,
        resources=resources,
    )
    layer = AnglesLayer(view_zenith_deg=result.view_zenith_deg, sun_deg=None, shadow_share=None)
    write_text(files["angles_style"], angles_style(layer))
    if sun is None:
        del files["shadow"]
        return layer
    share = angles.write_shadows(
        sight, placed.surface, sun, files["shadow"], heights=heights, resources=resources, driver=output.format
    )
    return AnglesLayer(
        view_zenith_deg=result.view_zenith_deg, sun_deg=(sun.azimuth_deg, sun.elevation_deg), shadow_share=share
    )
