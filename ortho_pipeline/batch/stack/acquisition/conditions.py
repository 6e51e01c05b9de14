"""Cloud cover and sun of an image: from a STAC item or report next to it, the facts of its sensor, or its metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ortho_pipeline.options import number_of

#: Names of the values in STAC items, in reports and in facts, with the factor to percent and degrees.
_CLOUDS = (("eo:cloud_cover", 1.0), ("cloud_cover_percent", 1.0), ("cloud_cover", 100.0))
_SUNS = (("view:sun_elevation", 1.0), ("sun_elevation_deg", 1.0))
#: Metadata with the cloud cover in percent: domain and item.
_ITEMS = (("IMAGERY", "CLOUDCOVER"), ("", "CLOUD_COVERAGE_ASSESSMENT"), ("", "CLOUD_COVER"))


@dataclass(frozen=True)
class Conditions:
    """Cloud cover (percent) and elevation of the sun (degrees) of an image; NaN if unknown."""

    cloud_percent: float = math.nan
    sun_elevation_deg: float = math.nan

    def stated(self) -> dict[str, float]:
        """Return the known values, as a STAC item names them."""
        values = {"eo:cloud_cover": self.cloud_percent, "view:sun_elevation": self.sun_elevation_deg}
        return {name: value for name, value in values.items() if not math.isnan(value)}


def conditions_of(facts: Sequence[Mapping[str, Any]], dataset: Any) -> Conditions:
    """Return the conditions that facts state, the first that does, or else the metadata of a raster."""
    clouds = [_value(one, _CLOUDS, 0.0, 100.0) for one in facts]
    for domain, name in _ITEMS:
        clouds.append(_value(dataset.GetMetadata(domain) or {}, ((name, 1.0),), 0.0, 100.0))
    suns = [_value(one, _SUNS, -90.0, 90.0) for one in facts]
    return Conditions(_first(clouds), _first(suns))


def _value(facts: Mapping[str, Any], names: Sequence[tuple[str, float]], low: float, high: float) -> float:
    """Return the first value within limits; NaN if none is. Vendors write 999 or -1 for an unknown one."""
    for name, factor in names:
        stated = facts.get(name)
        if isinstance(stated, str | int | float) and not isinstance(stated, bool):
            value = factor * number_of(stated)
            if low <= value <= high:
                return value
    return math.nan


def _first(values: Sequence[float]) -> float:
    return next((value for value in values if not math.isnan(value)), math.nan)
