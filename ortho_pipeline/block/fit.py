"""Result of a bundle adjustment, and the section of the block's document that is made of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.heights.record import HeightsRecord
from ortho_pipeline.block.intersection import sigmas_of
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.reliability.known_points import ContradictedPoint
from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.block.shared.common_error import BlockCommonError
from ortho_pipeline.block.shared.priors import SharedParameterRecord, SharedPriors
from ortho_pipeline.block.variances.components import Variances, VariancesRecord
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.estimation.records import CommonError as CommonErrorRecord
from ortho_pipeline.estimation.records import NoticeDocument, Parameter, Residual, Rmse, Role
from ortho_pipeline.estimation.spatial.shared_errors import SharedErrors
from ortho_pipeline.files.json.records import Count, Record, Words
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points.rows import ROLES

Triple = tuple[float, float, float]
#: Of a point of which it may be unknown.
OnGround = tuple[float | None, float | None, float | None]


class RmseByRole(Record):
    """Over the points of each role in one image."""

    control: Rmse | None
    check: Rmse | None
    tie: Rmse | None

    @property
    def all(self) -> Rmse | None:
        """Over the points of all roles."""
        return merged(self.control, self.check, self.tie)


class ImageRms(Record):
    """At the adjusted ground, at the known ground, and at the known ground with the models as they were."""

    residuals: RmseByRole
    back_projected: RmseByRole
    raw_residuals: RmseByRole


class AdjustedImage(Record):
    """The adjusted parameters of an image, and how well its rays fit."""

    parameters: dict[str, Parameter]
    rays: Count
    rms: ImageRms


class ObjectRms(Record):
    """Root mean squares on the ground, in plan and height, and the least and greatest residual."""

    x: float
    y: float
    h: float
    plan: float
    n: Count
    min: Triple
    max: Triple


class ObjectRmsByRole(Record):
    """Of control points, whose ground was used, and of check points, whose ground was not."""

    control: ObjectRms | None
    check: ObjectRms | None


class BlockPoint(Record):
    """A point: its adjusted longitude, latitude and height, its sigma in metres, and known minus adjusted ground."""

    id: str
    role: Role
    used_ground: bool
    ground: OnGround
    sigma: OnGround
    residual: OnGround


class Ray(Record):
    """A point in an image: its residual at the adjusted ground, and at the known ground."""

    id: str
    image: str
    used: bool
    measured: Residual
    residual: Residual
    back_projected: Residual


class BlockAdjustment(Record):
    """The adjustment of all images and points together; gauge names what defines the datum."""

    gauge: str
    sigma0: float | None
    redundancy: int
    degrees_of_freedom: float
    condition: float | None
    iterations: Count
    variances: VariancesRecord
    images: dict[str, AdjustedImage]
    object_rms: ObjectRmsByRole
    points: tuple[BlockPoint, ...]
    rays: tuple[Ray, ...]
    rejected: tuple[GrossError, ...]
    outlying: tuple[ContradictedPoint, ...]
    warnings: tuple[Words, ...]
    notices: tuple[NoticeDocument, ...]
    common_error: CommonErrorRecord | None = None
    shared_errors: dict[str, SharedErrors] | None = None
    heights: HeightsRecord | None = None
    shared_parameters: tuple[SharedParameterRecord, ...] = ()


def merged(*parts: Rmse | None) -> Rmse | None:
    """Return the root mean squares of several groups together; None where there is no point."""
    groups = [part for part in parts if part]
    number = sum(part.n for part in groups)
    if not number:
        return None
    col, row = (
        sum(part.n * square**2 for part, square in zip(groups, squares, strict=True)) / number
        for squares in ([part.col for part in groups], [part.row for part in groups])
    )
    return Rmse(col=math.sqrt(col), row=math.sqrt(row), total=math.sqrt(col + row), n=number)


def _refuse_other(what: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise InputError(f"there is no {what} {name!r}", field=what, remedy=f"use one of {', '.join(known)}")


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Result of a bundle adjustment of N points, M rays and P parameters.

    Reprojection residuals are measured minus predicted in pixels ``(M, 2)``: `residuals` those of the adjusted ground,
    `back_projected` those of the known ground (NaN for ties), `raw_residuals` the same with the models as they were.
    `object_residuals` ``(N, 3)`` are known minus adjusted ground in metres east, north, up. `ground` is lon, lat, h
    (EPSG:4979), NaN where the rays do not determine it; `ground_covariance` ``(N, 3, 3)`` m², east, north, up.
    `parameters` are (image, name) in the order of `covariance` ``(P, P)``, which `cofactors` has in parts. `sigma0` is
    the factor of the stated sigmas of measurements (None without redundancy), `variances` has it with the sigmas of
    ground that states none. Covariances contain that these are uncertain, so that 1.96 sigmas are right 95 times of
    100 with few points too.
    `outlying` are known points that the block contradicts and that were left as they are. Where points have an error in
    common, `common_error` is that, covariances have its part, and residuals of known ground are without its estimate.
    `heights` is what was taken from a DEM, `planes` where it was, `adjusted_dem` what errors it still has; `accuracies`
    (m) are those that metadata state of images. Of images whose neighbouring measurements share errors,
    `shared_errors` says what they do, and covariances have grown by it. `shared_priors` are parameters that images
    share, such as those of a camera.
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
    common_error: BlockCommonError | None = None
    heights: HeightsRecord | None = None
    adjusted_dem: AdjustedDem | None = None
    planes: Planes | None = None
    accuracies: Mapping[str, float] = field(default_factory=dict)
    shared_errors: Mapping[str, SharedErrors] = field(default_factory=dict)
    shared_priors: SharedPriors | None = None
    condition: float = 1.0
    iterations: int = 0

    def __repr__(self) -> str:
        found = self.object_rms()
        checks = ""
        if found:
            checks = f"; RMSE {found.plan:.2f} m, height {found.h:.2f} m at {counted(found.n, 'check point')}"
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

    def image_rms(self, image: str, role: str, which: str = "back_projected") -> Rmse | None:
        """Return root mean squares (px) of reprojection residuals of an image over a role; None where there is none.

        Parameters
        ----------
        which : {'back_projected', 'residuals', 'raw_residuals'}
        """
        if which not in ("back_projected", "residuals", "raw_residuals"):
            raise InputError(f"there are no residuals {which!r}", field="which")
        _refuse_other("role", role, ROLES)
        _refuse_other("image", image, self.points.images)
        rays = self.points.image == self.points.images.index(image)
        rays &= self.points.roles[self.points.point] == role
        if role == "control" or which == "residuals":
            rays &= self.used_rays
        if role == "control" and which != "residuals":
            rays &= self.used_ground[self.points.point]
        values = getattr(self, which)[rays]
        return Rmse.of(values[np.isfinite(values).all(axis=1)])

    def object_rms(self, role: str = "check") -> ObjectRms | None:
        """Return root mean squares, least and greatest of the object-space residuals (m) of a role; None for none."""
        _refuse_other("role", role, ROLES)
        values = self.object_residuals[self.points.roles == role]
        values = values[np.isfinite(values).all(axis=1)]
        if not len(values):
            return None
        east, north, up = np.sqrt((values**2).mean(axis=0)).tolist()
        return ObjectRms(
            x=east,
            y=north,
            h=up,
            plan=math.hypot(east, north),
            n=len(values),
            min=values.min(axis=0).tolist(),
            max=values.max(axis=0).tolist(),
        )

    @property
    def record(self) -> BlockAdjustment:
        """What is published of it (docs/engineering/formats.md)."""
        shared: dict[str, Any] = (
            {} if self.common_error is None else {"common_error": CommonErrorRecord.of(self.common_error)}
        )
        if self.shared_errors:
            shared["shared_errors"] = dict(self.shared_errors)
        if self.heights is not None:
            shared["heights"] = self.heights
        if self.shared_priors is not None:
            shared["shared_parameters"] = self.shared_priors.records
        return BlockAdjustment(
            gauge=self.gauge,
            sigma0=self.sigma0,
            redundancy=self.redundancy,
            degrees_of_freedom=self.degrees_of_freedom,
            condition=json_value(self.condition),
            iterations=self.iterations,
            variances=self.variances.record,
            images={image: self._image(image) for image in self.points.images},
            object_rms=ObjectRmsByRole(control=self.object_rms("control"), check=self.object_rms("check")),
            points=self._points(),
            rays=self._rays(),
            rejected=self.rejected,
            outlying=self.outlying,
            **to_document(self.warnings),
            **shared,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the section ``adjustment`` of the block's document (docs/engineering/formats.md)."""
        return self.record.given()

    def _image(self, image: str) -> AdjustedImage:
        values = zip(self.parameters, self.values, self.sigmas, strict=True)
        which = ("residuals", "back_projected", "raw_residuals")
        by_role = {kind: RmseByRole(**{role: self.image_rms(image, role, kind) for role in ROLES}) for kind in which}
        return AdjustedImage(
            parameters={name: Parameter(value=one, sigma=sigma) for (of, name), one, sigma in values if of == image},
            rays=int((self.used_rays & (self.points.image == self.points.images.index(image))).sum()),
            rms=ImageRms(**by_role),
        )

    def _points(self) -> tuple[BlockPoint, ...]:
        points = self.points
        columns = json_value([self.ground, self.ground_sigmas, self.object_residuals])
        rows = zip(points.ids, points.roles.tolist(), self.used_ground, *columns, strict=True)
        return tuple(
            BlockPoint(id=name, role=role, used_ground=bool(used), ground=ground, sigma=sigma, residual=residual)
            for name, role, used, ground, sigma, residual in rows
        )

    def _rays(self) -> tuple[Ray, ...]:
        points = self.points
        columns = json_value([points.measured, self.residuals, self.back_projected])
        rows = zip(points.point, points.image, self.used_rays, *columns, strict=True)
        return tuple(
            Ray(
                id=points.ids[point],
                image=points.images[image],
                used=bool(used),
                measured=measured,
                residual=residual,
                back_projected=projected,
            )
            for point, image, used, measured, residual, projected in rows
        )
