"""The ortho that fills what another one leaves empty."""

from __future__ import annotations

from ortho_pipeline.commands.placement import Placement
from ortho_pipeline.errors import InputError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.regridded import Regridded
from ortho_pipeline.raster.source import RasterSource


def other_of(placed: Placement, source: RasterSource) -> Regridded | None:
    """Return the ortho that fills hidden pixels; None where none is given.

    Raises
    ------
    InputError
        If it lies elsewhere, has other bands or another type, or nothing would be left empty; and if the ortho cannot
        be of the type that is asked for.
    """
    output = placed.request.output
    profile = Profile.of(source, output.dtype, output.nodata)
    if output.fill_from is None:
        return None
    if output.visibility != "nodata":
        raise InputError(
            "another ortho only fills hidden pixels, and these are not left empty",
            field="output.fill_from",
            remedy=Text("add ", Setting("output.visibility", "nodata"), ", or leave it out"),
        )
    with completed(field="output.fill_from"):
        access = placed.request.scene.access
        other = Regridded(output.fill_from, placed.grid, resampling=output.resampling, memory=output.memory, **access)
        other.require(profile)
    return other
