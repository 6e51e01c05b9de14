"""Errors of image points, including errors of their ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.points.image_errors import says_more

#: A perpendicular error below this part of the error along a direction is rounding.
_ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class ImageErrors:
    """A-priori errors of image measurements: Cholesky factors ``(n, 2, 2)`` px of their covariances, lower triangles.

    If column and row are independent, whitening divides by their standard deviations.
    """

    factor: Array

    def __getitem__(self, rows: np.ndarray | slice) -> ImageErrors:
        return ImageErrors(self.factor[rows])

    @classmethod
    def of(cls, model: SensorModel, points: Points) -> ImageErrors:
        """Return the errors of points in the CRS of the model, with the projected errors of their ground.

        Raises
        ------
        InputError
            If a point has a standard deviation of zero in some direction.
        """
        factor = _factors(points.sigma_image, points.covariance_image)
        known = (points.sigma_ground > 0).any(axis=1)
        if known.any():
            ground = points.ground[known]
            # On the ellipsoid: at heights on land, a metre differs by a thousandth at most.
            per_metre = map_from_enu(points.crs, ground * (1.0, 1.0, 0.0))
            moved = model.ground_partials(ground) @ (per_metre * points.sigma_ground[known][:, None, :])
            factor[known] = _summed(np.concatenate([factor[known], moved], axis=2))
        exact = (np.diagonal(factor, axis1=1, axis2=2) <= 0).any(axis=1)
        if exact.any():
            name = points.ids[int(np.flatnonzero(exact)[0])]
            raise InputError(
                f"the point {name} has a standard deviation of zero in one direction of the image",
                file=points.source or None,
                field="sigma_image",
                remedy="give each measurement a positive standard deviation",
            )
        return cls(factor)

    @property
    def sigma(self) -> Array:
        """Standard deviations ``(n, 2)`` px of column and row."""
        return np.asarray(np.linalg.norm(self.factor, axis=2))

    @property
    def covariance(self) -> Array:
        """Covariances ``(n, 2, 2)`` px^2."""
        return self.factor @ self.factor.transpose(0, 2, 1)

    def whitened(self, values: Array) -> Array:
        """Return values ``(n, 2)`` or ``(n, 2, P)`` in px as multiples of independent standard deviations."""
        factor = self.factor.reshape(-1, 2, 2, *(1,) * (values.ndim - 2))
        white = np.empty(values.shape)
        white[:, 0] = values[:, 0] / factor[:, 0, 0]
        white[:, 1] = (values[:, 1] - factor[:, 1, 0] * white[:, 0]) / factor[:, 1, 1]
        return white

    def restored(self, white: Array) -> Array:
        """Return whitened values ``(n, 2, ...)`` in px."""
        return np.einsum("nij,nj...->ni...", self.factor, white)

    def mean_square(self, white: Array) -> Array:
        """Return the mean square distance ``(n,)`` px^2 of errors whose whitened covariance is ``(n, 2, 2)``."""
        return np.einsum("nij,njk,nik->n", self.factor, white, self.factor)


def _factors(sigma: Array, covariance: Array) -> Array:
    """Return the Cholesky factors ``(n, 2, 2)`` of covariances; `sigma` ``(n,)`` counts if they are isotropic."""
    factor = np.zeros((len(sigma), 2, 2))
    factor[:, 0, 0] = factor[:, 1, 1] = sigma
    full = says_more(covariance)
    factor[full] = np.linalg.cholesky(covariance[full])
    return factor


def _summed(parts: Array) -> Array:
    """Return the Cholesky factors ``(n, 2, 2)`` of A A^T for each A ``(n, 2, k)``.

    Computed by orthogonalising the rows of A, not from A A^T: if one direction has a far larger error than the other
    (poorly known heights), the difference of squares would be lost to rounding.
    """
    column, row = parts[:, 0], parts[:, 1]
    first = np.linalg.norm(column, axis=1)
    axis = np.divide(column, first[:, None], out=np.zeros_like(column), where=first[:, None] > 0)
    along = (row * axis).sum(axis=1)
    across = np.linalg.norm(row - along[:, None] * axis, axis=1)
    across[across <= _ROUNDING * np.abs(along)] = 0.0
    return np.stack([np.stack([first, np.zeros_like(first)], axis=1), np.stack([along, across], axis=1)], axis=1)
