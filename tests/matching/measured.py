"""Points that somebody measured, as the table that a fit takes."""

from __future__ import annotations

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.points import Points

Array = NDArray[np.float64]


def points_of(image: Array, ground: Array, sigma: float = 0.5) -> Points:
    """Return control points of image ``(N, 2)`` and lon, lat, height ``(N, 3)``, measured with a sigma in pixels."""
    count = len(image)
    return Points(
        ids=tuple(f"p{k}" for k in range(count)),
        image=image,
        ground=ground,
        roles=np.array(["control"] * count),
        sigma_image=np.full(count, sigma),
        sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS(4326),
        source="points.csv",
    )
