"""Parts of images: an image delivered in pieces, each with its own model, and a crop of an image."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.models.base import Array, Constraints, SensorModel, as_ground, as_image, model_from_dict
from ortho_pipeline.models.correction import OverAnother


@dataclass(frozen=True, eq=False)
class Pieces(SensorModel):
    """The models of the pieces of one image as one model, in the pixels of the first piece.

    A ground point belongs to the piece that shows it, or to the nearest one. At seams the models may disagree, so use
    this to adjust a correction that all pieces share, not for resampling.

    Parameters
    ----------
    models : tuple of SensorModel
        With one CRS, each in the pixels of its piece.
    offsets : tuple of (float, float)
        Column and row of the first corner of each piece in the pixels of the first.
    sizes : tuple of (int, int)
        Columns and rows of each piece.
    """

    kind: ClassVar[str] = "pieces"

    models: tuple[SensorModel, ...]
    offsets: tuple[tuple[float, float], ...]
    sizes: tuple[tuple[int, int], ...]

    def __post_init__(self) -> None:
        for name in ("models", "offsets", "sizes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not self.models or not len(self.models) == len(self.offsets) == len(self.sizes):
            raise InputError("each piece needs a model, an offset and a size", field="models, offsets, sizes")
        if len({model.crs for model in self.models}) != 1:
            raise InputError("the models of the pieces have different CRSs", field="models")

    @property
    def first(self) -> SensorModel:
        """The model of the first piece."""
        return self.models[0]

    @property
    def crs(self) -> str:
        return self.first.crs

    @property
    def domain(self) -> tuple[Array, Array]:
        boxes = [model.domain for model in self.models]
        if parse_crs(self.crs).is_geographic:
            # Near the antimeridian a piece may count its longitudes from the other side.
            turn = np.array([360.0, 0.0, 0.0])
            boxes = [(at - turn * np.round((at - boxes[0][0])[0] / 360.0), half) for at, half in boxes]
        low = np.min([centre - half for centre, half in boxes], axis=0)
        high = np.max([centre + half for centre, half in boxes], axis=0)
        return (low + high) / 2, (high - low) / 2

    def with_heights(self, low: float, high: float) -> Self:
        return self._replace(models=tuple(model.with_heights(low, high) for model in self.models))

    @property
    def stated_accuracy(self) -> float | None:
        return self.first.stated_accuracy

    @property
    def corners(self) -> Array:
        return np.concatenate([model.corners for model in self.models])

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self._seen(as_ground(ground))[0]

    def ground_partials(self, ground: ArrayLike) -> Array:
        ground = as_ground(ground)
        # Each point has the slope of its own piece: a difference across a seam is no slope.
        owner = self._seen(ground)[1]
        partials = np.full((len(ground), 2, 3), np.nan)
        for k, model in enumerate(self.models):
            partials[owner == k] = model.ground_partials(ground[owner == k])
        return partials

    def _seen(self, ground: Array) -> tuple[Array, NDArray[np.intp]]:
        """Return image points ``(N, 2)`` and the numbers of their pieces ``(N,)``, -1 if no piece sees the point."""
        image = np.full((len(ground), 2), np.nan)
        owner = np.full(len(ground), -1)
        nearest = np.full(len(ground), np.inf)
        for k, (model, offset, size) in enumerate(zip(self.models, self.offsets, self.sizes, strict=True)):
            seen = model.ground_to_image(ground)
            outside = np.maximum(-seen, seen - size).max(axis=1, initial=0.0)
            better = outside < nearest  # False for NaN
            image[better] = seen[better] + offset
            nearest[better], owner[better] = outside[better], k
        return image, owner

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        models = tuple(map(model_from_dict, data.get("models", ())))
        pairs = {name: tuple(map(tuple, data.get(name, ()))) for name in ("offsets", "sizes")}
        return super().from_dict({**data, "models": models, **pairs})


@dataclass(frozen=True, eq=False)
class Cropped(OverAnother):
    """The model of a crop; its parameters are those of the larger image's model.

    Parameters
    ----------
    model : SensorModel
        Model of the larger image.
    offset : (float, float)
        Column and row of the crop's first corner in the larger image.
    """

    kind: ClassVar[str] = "cropped"

    offset: tuple[float, float]

    def __post_init__(self) -> None:
        offset = np.asarray(self.offset, dtype=np.float64)
        if offset.shape != (2,) or not np.isfinite(offset).all():
            raise InputError("the offset of a crop must be a column and a row", field="offset")
        object.__setattr__(self, "offset", (float(offset[0]), float(offset[1])))

    # -- parameters --------------------------------------------------------------------------------------------------

    @property
    def param_names(self) -> tuple[str, ...]:
        return self.model.param_names

    @property
    def params(self) -> Array:
        return self.model.params

    def with_params(self, params: ArrayLike) -> Self:
        return self._replace(model=self.model.with_params(params))

    @property
    def minimum_points(self) -> int:
        return self.model.minimum_points

    @property
    def removable(self) -> tuple[str, ...]:
        return self.model.removable

    def without(self, names: Iterable[str]) -> Self:
        return self._replace(model=self.model.without(names))

    def constraints(self) -> Constraints:
        return self.model.constraints()

    # -- maps --------------------------------------------------------------------------------------------------------

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self.model.ground_to_image(ground) - self.offset

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        return self.model.image_to_ground(as_image(image) + self.offset, height)

    def ground_partials(self, ground: ArrayLike) -> Array:
        return self.model.ground_partials(ground)

    def param_partials(self, ground: ArrayLike) -> Array:
        return self.model.param_partials(ground)

    def projected(self, ground: ArrayLike) -> tuple[Array, Array]:
        image, partials = self.model.projected(ground)
        return image - self.offset, partials

    def linearised(self, ground: ArrayLike) -> tuple[Array, Array, Array]:
        image, by_ground, by_params = self.model.linearised(ground)
        return image - self.offset, by_ground, by_params


def relative_scale(model: SensorModel, other: SensorModel, size: tuple[int, int]) -> float | None:
    """Return the pixel size of another model in pixels of `model`; None if they see different ground.

    Parameters
    ----------
    other : SensorModel
        With the same CRS.
    size : (int, int)
        Columns and rows of the image of `other`.

    Examples
    --------
    >>> pan, red = (op.read_rpc(f"sample_data/ikonos/po_39001_{band}_0000000_rpc.txt") for band in ("pan", "red"))
    >>> round(relative_scale(pan, red, (250, 250)), 3)
    4.0
    """
    ground = other.image_to_ground([[size[0] / 2, size[1] / 2]], other.reference_height)
    if not np.isfinite(model.ground_to_image(ground)).all():
        return None
    partials = [one.ground_partials(ground)[0, :, :2] for one in (model, other)]
    if not np.isfinite(partials).all():
        return None
    areas = [abs(float(np.linalg.det(part))) for part in partials]
    if not min(areas) > 0:
        return None
    return math.sqrt(areas[0] / areas[1])
