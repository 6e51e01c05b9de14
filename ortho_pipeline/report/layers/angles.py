"""The layers of angles in the report."""

from __future__ import annotations

from ortho_pipeline.display.numbers import share
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.report.layers.styles import raster_style


class AnglesLayer(Record):
    """Least and greatest zenith angle of view; azimuth and elevation of the sun, and the share of the ortho in shadow.

    The last two are null where nobody knows where the sun stood.
    """

    view_zenith_deg: tuple[float, float]
    sun_deg: tuple[float, float] | None
    shadow_share: float | None

    @property
    def statement(self) -> str:
        """Return the angles in words."""
        low, high = self.view_zenith_deg
        said = f"line of sight {low:.2f}° to {high:.2f}° off the vertical"
        if self.sun_deg is None or self.shadow_share is None:
            return f"{said}; the position of the sun is unknown"
        azimuth, elevation = self.sun_deg
        return f"{said}; sun azimuth {azimuth:.1f}°, elevation {elevation:.1f}°; {share(self.shadow_share)} in shadow"


def angles_style(layer: AnglesLayer) -> str:
    """Return a QGIS style (QML) for the raster of angles: the zenith angle of view in five steps of colour."""
    return raster_style(1, *layer.view_zenith_deg, lambda angle: f"{angle:.2f}°")
