"""Image points of all rays of a block with their partials: of RPCs by one compiled loop, of other models one by one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.local_frame import GEODETIC, Places
from ortho_pipeline.block.points import Index
from ortho_pipeline.block.projection import projection_kernel
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.models.correction import COEFFICIENTS
from ortho_pipeline.runtime.process_limits import parts_of, side_by_side

#: Rays that are worth a thread.
_SHARE = 10_000


@dataclass(frozen=True, eq=False)
class Projected:
    """Image points ``(M, 2)`` of rays, and their partials by the points ``(M, 2, 3)`` and parameters ``(M, 2, p)``.

    Partials are over the sigmas of the rays. NaN for rays that lead out of their model, and zero for those of no image.
    """

    image: Array
    by_point: Array
    by_params: Array


def linearised(
    places: Places,
    models: Sequence[SensorModel],
    of_images: Sequence[Index],
    point: Index,
    scale: Array,
    widest: int,
    zeros: Callable[[tuple[int, ...]], Array] = np.zeros,
) -> Projected:
    """Project rays.

    Parameters
    ----------
    of_images : sequence of ndarray
        Rays of each model.
    point : ndarray (M,)
        Their places.
    scale : ndarray (M,)
        What partials are multiplied with.
    widest : int
        Columns p of partials by parameters, 0 for none of them.
    zeros : callable
        What makes the arrays.
    """
    count = len(point)
    found = Projected(zeros((count, 2)), zeros((count, 2, 3)), zeros((count, 2, widest)))
    rational = [n for n, model in enumerate(models) if _rpc_of(model) is not None and len(of_images[n])]
    if rational:
        parts = [of_images[n] for n in rational]
        starts = np.cumsum([0, *map(len, parts)])
        rays, images = np.concatenate(parts), _tables([models[n] for n in rational], widest)
        at, made = (point, places.in_crs(GEODETIC), places.partials(GEODETIC)), (found.image, found.by_point)
        side_by_side(
            lambda _, begin, end: projection_kernel.linearise(
                images, begin, end, starts, rays, at, scale, *made, found.by_params
            ),
            parts_of(len(rational), max(_SHARE * len(rational) // max(len(rays), 1), 1)),
        )
    for model, used in zip(models, of_images, strict=True):
        if not len(used) or _rpc_of(model) is not None:
            continue
        if widest:
            found.image[used], by_point, by_params = places.linearised(model, point[used])
            found.by_params[used, :, : by_params.shape[2]] = by_params * scale[used, None, None]
        else:
            found.image[used], by_point = places.projected(model, point[used])
        found.by_point[used] = by_point * scale[used, None, None]
    return found


def _rpc_of(model: SensorModel) -> RPC | None:
    """Return the RPC that a model is, or corrects; None for others."""
    inner = model.model if type(model) is ImageCorrection else model
    return inner if type(inner) is RPC else None


def _tables(models: Sequence[SensorModel], widest: int) -> projection_kernel.Images:
    tables = [rpc.tables for model in models if (rpc := _rpc_of(model)) is not None]
    offsets, scales, polynomials, limits = (np.stack(part) for part in zip(*tables, strict=True))
    origins, coefficients = np.zeros((len(models), 2)), np.zeros((len(models), 6))
    columns = np.full((len(models), 6), -1)
    for n, model in enumerate(models):
        if isinstance(model, ImageCorrection):
            origins[n], coefficients[n] = model.origin, model.coefficients
            if widest:
                columns[n, [COEFFICIENTS.index(name) for name in model.param_names]] = range(len(model.param_names))
    return projection_kernel.Images(offsets, scales, polynomials, limits, origins, coefficients, columns)
