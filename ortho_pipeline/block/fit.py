"""Result of a bundle adjustment, and the section of the block's document that is made of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline.block.common_error import CommonError
from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.intersection import sigmas_of
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.reliability.known_points import ContradictedPoint
from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import root_mean_square
from ortho_pipeline.estimation.spatial.shared_errors import SharedErrors
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.options.texts import counted
from ortho_pipeline.points.rows import ROLES


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Result of a bundle adjustment of N points, M rays and P parameters.

    Reprojection residuals are measured minus predicted in pixels ``(M, 2)``: `residuals` those of the adjusted ground,
    `back_projected` those of the known ground (NaN for ties), `raw_residuals` the same with the models as they were.
    `object_residuals` ``(N, 3)`` are known minus adjusted ground in metres east, north, up. `ground` is lon, lat, h
    (EPSG:4979), NaN where the rays do not determine it; `ground_covariance` ``(N, 3, 3)`` m², east, north, up.
    `parameters` are (image, name) in the order of `covariance` ``(P, P)``, which `cofactors` has in parts. `sigma0` is
    the factor of the stated sigmas of measurements (None without redundancy), `variances` has it beside the sigmas of
    ground that states none. Covariances contain that these are uncertain, so that 1.96 sigmas are right 95 times of
    100 with few points too.
    `outlying` are known points that the block contradicts and that were left as they are. Where points have an error in
    common, `common_error` is that, covariances have its part, and residuals of known ground are what is left beside its
    estimate. Of images whose neighbouring measurements share errors, `shared_errors` says what they do, and covariances
    have grown by it.
    """

    models: dict[str, SensorModel]
    start: dict[str, SensorModel]
    points: BlockPoints
    ground: Array
    ground_covariance: Array
    residuals: Array
    back_projected: Array
    raw_residuals: Array
    object_residuals: Array
    used_rays: Mask
    used_ground: Mask
    parameters: tuple[tuple[str, str], ...]
    cofactors: Cofactors
    redundancy: int
    degrees_of_freedom: float
    sigma0: float | None
    gauge: str
    variances: Variances
    rejected: tuple[GrossError, ...] = ()
    outlying: tuple[ContradictedPoint, ...] = ()
    warnings: tuple[Notice, ...] = ()
    common_error: CommonError | None = None
    shared_errors: Mapping[str, SharedErrors] = field(default_factory=dict)
    condition: float = 1.0
    iterations: int = 0

    def __repr__(self) -> str:
        found = self.object_rms()
        checks = ""
        if found:
            checks = f"; RMSE {found['plan']:.2f} m, height {found['h']:.2f} m at {counted(found['n'], 'check point')}"
        sigma0 = "unknown" if self.sigma0 is None else f"{self.sigma0:.3g}"
        size = f"{counted(len(self.models), 'image')}, {counted(len(self.points), 'point')}"
        return f"<block of {size}: sigma0 {sigma0}{checks}>"

    @property
    def values(self) -> Array:
        """Adjusted parameters ``(P,)``."""
        return np.concatenate([np.zeros(0), *(model.params for model in self.models.values())])

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters ``(P, P)``; of a large block it is made when it is asked for."""
        return self.cofactors.matrix

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the parameters ``(P,)``."""
        return np.sqrt(self.cofactors.variances)

    @property
    def ground_sigmas(self) -> Array:
        """Standard deviations of the adjusted ground ``(N, 3)``: metres east, north, up."""
        return sigmas_of(self.ground_covariance)

    def ground_in(self, crs: str | pyproj.CRS) -> Array:
        """Return the adjusted ground ``(N, 3)`` in another CRS (EPSG:4978 is geocentric)."""
        return ground_transform(GEODETIC, crs)(self.ground)

    def known_in(self, crs: str | pyproj.CRS) -> Array:
        """Return the known ground ``(N, 3)`` in another CRS; NaN for ties."""
        return self.points.known_in(crs)

    def image_rms(self, image: str, role: str, which: str = "back_projected") -> dict[str, float | int] | None:
        """Return root mean squares (px) of reprojection residuals of an image over a role; None where there is none.

        Parameters
        ----------
        which : {'back_projected', 'residuals', 'raw_residuals'}
        """
        if which not in ("back_projected", "residuals", "raw_residuals"):
            raise InputError(f"there are no residuals {which!r}", field="which")
        rays = self.points.image == self.points.images.index(image)
        rays &= self.points.roles[self.points.point] == role
        if role == "control" or which == "residuals":
            rays &= self.used_rays
        if role == "control" and which != "residuals":
            rays &= self.used_ground[self.points.point]
        values = getattr(self, which)[rays]
        return root_mean_square(values[np.isfinite(values).all(axis=1)])

    def object_rms(self, role: str = "check") -> dict[str, Any] | None:
        """Return root mean squares, least and greatest of the object-space residuals (m) of a role; None for none."""
        values = self.object_residuals[self.points.roles == role]
        values = values[np.isfinite(values).all(axis=1)]
        if not len(values):
            return None
        east, north, up = np.sqrt((values**2).mean(axis=0)).tolist()
        return {
            "x": east, "y": north, "h": up, "plan": math.hypot(east, north), "n": len(values),
            "min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist(),
        }  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Return the section ``adjustment`` of the block's document (docs/engineering/formats.md)."""
        points = self.points
        values = dict(zip(self.parameters, zip(self.values, self.sigmas, strict=True), strict=True))
        return {
            "gauge": self.gauge,
            "sigma0": self.sigma0,
            "redundancy": self.redundancy,
            "degrees_of_freedom": self.degrees_of_freedom,
            "condition": json_value(self.condition),
            "iterations": self.iterations,
            "variances": self.variances.to_json(),
            **({} if self.common_error is None else {"common_error": self.common_error.to_json()}),
            **(
                {"shared_errors": {k: v.to_json() for k, v in self.shared_errors.items()}} if self.shared_errors else {}
            ),
            "images": {
                image: {
                    "parameters": {
                        name: {"value": float(value), "sigma": float(sigma)}
                        for (of, name), (value, sigma) in values.items()
                        if of == image
                    },
                    "rays": int((self.used_rays & (points.image == k)).sum()),
                    "rms": {
                        which: {role: self.image_rms(image, role, which) for role in ROLES}
                        for which in ("residuals", "back_projected", "raw_residuals")
                    },
                }
                for k, image in enumerate(points.images)
            },
            "object_rms": {role: self.object_rms(role) for role in ("control", "check")},
            "points": [self._point(k) for k in range(len(points))],
            "rays": [self._ray(k) for k in range(points.rays)],
            "rejected": [one.to_json() for one in self.rejected],
            "outlying": [one.to_json() for one in self.outlying],
            **to_document(self.warnings),
        }

    def _point(self, k: int) -> dict[str, Any]:
        points = self.points
        return {
            "id": points.ids[k],
            "role": str(points.roles[k]),
            "used_ground": bool(self.used_ground[k]),
            "ground": json_value(self.ground[k]),
            "sigma": json_value(np.sqrt(np.diag(self.ground_covariance[k]))),
            "residual": json_value(self.object_residuals[k]),
        }

    def _ray(self, k: int) -> dict[str, Any]:
        points = self.points
        return {
            "id": points.ids[points.point[k]],
            "image": points.images[points.image[k]],
            "used": bool(self.used_rays[k]),
            "measured": json_value(points.measured[k]),
            "residual": json_value(self.residuals[k]),
            "back_projected": json_value(self.back_projected[k]),
        }
