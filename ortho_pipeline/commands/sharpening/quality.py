"""The quality of pan-sharpening at reduced resolution: both orthos are made coarser by the ratio of their pixel sizes.

Then the multispectral ortho itself is the truth. Upsampling alone is compared with the same truth.

Source: Wald, Ranchin and Mangolini 1997.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.commands.sharpening.samples import Sample
from ortho_pipeline.imaging.spectral_quality import QualitySums
from ortho_pipeline.raster.pansharpened import brovey, upsampled, within

#: Pixels of the reduced image at the rim of a window that are not compared: they need neighbours.
_RIM = 3


def reduced_quality(
    samples: Iterable[Sample], weights: Sequence[float], ratio: int, dtype: np.dtype[Any]
) -> dict[str, Any] | None:
    """Return the quality of sharpened and of upsampled windows as JSON values; None if the orthos are too small.

    `dtype` is the pixel type of the multispectral ortho, to whose range upsampled pixels keep.
    """
    sums = {"sharpened": QualitySums(len(weights)), "upsampled": QualitySums(len(weights))}
    for pan, colours in samples:
        rows, columns = (side // ratio for side in pan.shape)
        inner = pan.shape[0] - 2 * _RIM * ratio, pan.shape[1] - 2 * _RIM * ratio
        if min(inner) < 1 or (rows * ratio, columns * ratio) != pan.shape:
            continue
        # Where one pixel has no value, the mean has none.
        coarse = colours.reshape(len(colours), rows, ratio, columns, ratio).mean(axis=(2, 4))
        smooth = within(upsampled(coarse, *pan.shape), dtype)
        images = {"sharpened": brovey(pan, smooth, weights), "upsampled": smooth}
        rim = _RIM * ratio
        part = (slice(rim, -rim), slice(rim, -rim))
        valid: NDArray[np.bool_] = np.isfinite(np.concatenate([colours, *images.values()])).all(axis=0)
        for name, image in images.items():
            sums[name].add(colours[:, *part], np.nan_to_num(image)[:, *part], valid[part])
    found = {name: one.quality(ratio) for name, one in sums.items()}
    if any(quality is None for quality in found.values()):
        return None
    numbers = {name: quality.to_json() for name, quality in found.items() if quality is not None}
    return {"ratio": ratio, "pixels": sums["sharpened"].pixels, **numbers}
