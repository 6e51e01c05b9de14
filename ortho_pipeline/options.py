"""What a user can ask for, grouped as the pipeline takes it; every field has the default of the command line."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

#: What a file of points calls the first pixel -> what is added to reach (0, 0) at its outer corner.
PIXEL_ORIGINS = {
    "corner": 0.0,  # (0, 0) is the outer corner of the first pixel: GDAL, QGIS, this package
    "center": 0.5,  # (0, 0) is its centre: RPC files, OpenCV
    "corner-1": -1.0,  # (1, 1) is its outer corner: ENVI
    "center-1": -0.5,  # (1, 1) is its centre: MATLAB, Fortran, DIMAP, much older software
}
#: Types of pixels that an ortho may have, by GDAL's names.
PIXEL_TYPES = ("Byte", "UInt16", "Int16", "UInt32", "Int32", "Float32", "Float64")


@dataclass(frozen=True)
class SceneOptions:
    """How the image is opened.

    Parameters
    ----------
    sensor : str, optional
        Name of the sensor, where several or none recognise the image.
    rpc : str, optional
        ``tag``, ``sidecar`` or an RPC file.
    model : path, optional
        A model file that takes the place of the image's own model.
    allow_network : bool
        Whether URLs and GDAL's network file systems may be opened.
    roots : sequence of path
        Folders that an image may refer to, besides its own: sources of a VRT have to lie there.
    sensor_options : mapping of str to str
        Options that the sensor declares (`ortho sensors`).
    crop_offset : (float, float), optional
        Column and row of the first pixel in the image that the model belongs to, where this one is a crop of it.
    """

    sensor: str | None = None
    rpc: str | None = None
    model: str | os.PathLike[str] | None = None
    allow_network: bool = False
    roots: Sequence[str | os.PathLike[str]] = ()
    sensor_options: Mapping[str, str] = field(default_factory=dict)
    crop_offset: Sequence[float] | None = None

    @property
    def access(self) -> dict[str, Any]:
        """What may be opened, as `raster.open_dataset` takes it."""
        return {"allow_network": self.allow_network, "roots": tuple(self.roots)}

    @property
    def files(self) -> dict[str, str | os.PathLike[str]]:
        """Files besides the image that the scene is read from, by what they are."""
        given = {name: value for name, value in self.sensor_options.items() if _is_file(value)}
        own = {"RPC": self.rpc, "model": self.model}
        return {**{role: path for role, path in own.items() if path is not None}, **given}


def _is_file(value: object) -> bool:
    """Tell whether a text names a file, on disk or as GDAL names those in an archive."""
    return isinstance(value, str | os.PathLike) and (os.fspath(value).startswith("/vsi") or os.path.isfile(value))


class PointTable(Protocol):
    """Points that are read already: `ortho_pipeline.Points`."""

    @property
    def ids(self) -> tuple[str, ...]: ...
    @property
    def source(self) -> str: ...


@dataclass(frozen=True)
class PointOptions:
    """Which points there are, and what is adjusted to them.

    Parameters
    ----------
    gcps : path or Points, optional
        A file of points, ``own`` for those in the image, or points that are read already, in pixels of this image.
    crs, vertical : str, optional
        For files that do not say.
    pixel_origin : one of `PIXEL_ORIGINS`
        What files that do not say it (CSV, ODM and link files) call the first pixel.
    check : str, optional
        ``every:N`` or ``ids:a,b``: which points only check.
    select : str, optional
        ``even:N``, ``cluster:N``, ``ids:a,b`` or ``random:N:seed``: which points control; the others check.
    correction : {'none', 'shift', 'shift-drift', 'affine', 'model'}, optional
        A correction in image space, or 'model': the model's own parameters, weighted by what the sensor says of them.
        Default: shift if there are control points.
    fit_model : str, optional
        A model family (`ortho models`) that is fitted to the points alone, in place of the image's own model.
    model_crs : str, optional
        Ground CRS of that family: geocentric, geographic, utm or EPSG:n; that of the points by default.
    prune : bool
        Remove parameters that the points do not justify.
    params : str, optional
        ``a,b,c``: the only parameters that are adjusted.
    significance : float
        Chance of calling a parameter justified that is zero.
    ridge : str
        Regularisation of a fitted family: ``auto``, ``none``, ``gcv``, ``lcurve`` or its weight.
    near : float, optional
        Distance (m) below which points are neighbours in the analysis of the residuals.
    """

    gcps: str | os.PathLike[str] | PointTable | None = None
    crs: str | None = None
    vertical: str | None = None
    pixel_origin: str = "corner"
    check: str | None = None
    select: str | None = None
    correction: str | None = None
    fit_model: str | None = None
    model_crs: str | None = None
    prune: bool = False
    params: str | None = None
    significance: float = 0.05
    ridge: str = "auto"
    near: float | None = None


@dataclass(frozen=True)
class BlockOptions:
    """Which points of a block there are, and what is adjusted to them.

    Parameters
    ----------
    points : path
        Rays: which point was measured where in which image.
    gcps : path, optional
        Ground of the points, where that file does not have it.
    crs, vertical : str, optional
        For files that do not say.
    pixel_origin : one of `PIXEL_ORIGINS`
        What files that do not say it (CSV, ODM and link files) call the first pixel.
    check : str, optional
        ``every:N`` or ``ids:a,b``: which control points only check.
    model : str, optional
        A name among the models of each scene, or a family (`ortho models`) that is fitted to the control points of
        each image; the scene's best model by default.
    model_crs : str, optional
        Ground CRS of that family: geocentric, geographic, utm or EPSG:n.
    correction : {'none', 'shift', 'shift-drift', 'affine', 'model'}, optional
        What is adjusted: a correction in image space, or the model's own parameters. Default: the model's own where it
        has any, else a shift.
    hold : float, optional
        Sigma (px) with which the orientation is held at its start values.
    ground_sigma : str, optional
        ``XY`` or ``XY,H``: sigmas (m) in plan and height of ground that states none; estimated by default.
    """

    points: str | os.PathLike[str]
    gcps: str | os.PathLike[str] | None = None
    crs: str | None = None
    vertical: str | None = None
    pixel_origin: str = "corner"
    check: str | None = None
    model: str | None = None
    model_crs: str | None = None
    correction: str | None = None
    hold: float | None = None
    ground_sigma: str | None = None


@dataclass(frozen=True)
class SurfaceOptions:
    """Where heights come from: a DEM, or one ellipsoidal height in metres.

    Parameters
    ----------
    fill : str
        ``error``, ``mask``, ``nearest`` or a height: what is done where the DEM has no height.
    override_vertical : bool
        Believe `vertical` even where the DEM declares another height datum.
    """

    dem: str | os.PathLike[str] | None = None
    vertical: str | None = None
    override_vertical: bool = False
    fill: str = "error"
    height: float | None = None


@dataclass(frozen=True)
class OutputOptions:
    """What the ortho looks like and how it is computed; `memory` in bytes, `tolerance` in source pixels.

    Parameters
    ----------
    resolution : float or (float, float), optional
        Size of a pixel in x and y, in units of the CRS.
    align : bool
        Widen `extent` to whole multiples of the resolution (without an extent that is always so).
    bands : sequence of int
        Which bands of the image, from 1, in this order; all without.
    dtype : str, optional
        GDAL's name of the type of the pixels (`PIXEL_TYPES`); that of the image without.
    nodata : float or 'nan', optional
        Value of pixels without an image; without, that of the image, or a mask.
    stac : bool
        Ask for a STAC item; `acquired` is the time of acquisition for it where the metadata have none.
    """

    crs: str | None = None
    resolution: float | Sequence[float] | None = None
    extent: Sequence[float] | None = None
    align: bool = False
    resampling: str = "bilinear"
    bands: Sequence[int] | None = None
    dtype: str | None = None
    nodata: float | str | None = None
    dem_interpolation: str = "bilinear"
    format: str = "COG"
    creation_options: Mapping[str, str] = field(default_factory=dict)
    engine: str = "ortho"
    memory: int = 512_000_000
    threads: int | None = None
    tolerance: float = 0.01
    stac: bool = False
    acquired: str | None = None
