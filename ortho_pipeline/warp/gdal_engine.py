"""GDAL's own warper as a second engine: slower, and an independent check.

One of GDAL's transformers stands for the sensor model: the one that expresses it, found by trying. How far it is off
the exact model on the surface is measured through that transformer, at points of the ortho.

=================  ===================================================================================================
transformer        stands for
=================  ===================================================================================================
RPC                a model that has an RPC (`rpc.export_rpc`), exact or fitted to 0.1 px; heights from the surface
GCP_POLYNOMIAL     a model of the plane that is a polynomial of order 1 to 3: GDAL's own fit to points of the model
GCP_HOMOGRAPHY     a model of the plane that is a ratio of the first order, where GDAL computes one (3.6 does not)
GEOLOC_ARRAY       every other model: the image point of every output pixel, as geolocation arrays of the ortho
=================  ===================================================================================================

Arrays of the *ortho*, not of the image: GDAL inverts arrays of an image by interpolating in their meshes, which is off
by tenths of a pixel where terrain bends within a mesh, and has no inverse where a slope is hidden behind another.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.exchange.rpc_fit import REFUSE_ERROR, RpcExport
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.raster.ortho import Profile, RasterWriter, refuse_empty
from ortho_pipeline.raster.pixel_types import alpha_of, gdal_type, mask_flags, numpy_type
from ortho_pipeline.raster.source import Grid, first_line
from ortho_pipeline.raster.verified_writing import gdal_errors, written
from ortho_pipeline.runtime.signals import called_by_gdal
from ortho_pipeline.surface.base import Excerpt, Surface
from ortho_pipeline.warp.job import WARPING, WarpJob, WarpRecord
from ortho_pipeline.warp.quality.hiding import Hiding

#: GDAL's fit to points of a model expresses it if it repeats it this closely (px); another fit only resembles it.
EXPRESSED = 1e-3
#: Points per side of the ortho at which a transformer is compared with the model.
_CHECKS = 150
#: Points per side that GDAL's polynomial or homography is fitted to.
_GCP_SIDE = 11
#: Image points farther outside than this (px) are moved there: the arrays keep to the range of the image.
_FAR = 1000.0
_NO_PLACE = -1e9
#: Output pixels whose image points are computed at once.
_PIECE = 1_000_000
#: GDAL's warper only makes files.
tile_maker = None


@dataclass(frozen=True)
class Transformer:
    """One of GDAL's transformers, set up for one model, surface and grid.

    Parameters
    ----------
    method : str
        As in GDAL's documentation: RPC, GCP_POLYNOMIAL, GCP_HOMOGRAPHY, GEOLOC_ARRAY.
    options : tuple of str
        Transformer options.
    rpc, gcps, gcp_crs
        What the image has to carry: fields of GDAL's RPC domain, or control points with their CRS (WKT).
    arrays : path, optional
        Raster with columns and rows of the image for every pixel of the ortho.
    max_error_px : float
        Largest difference (px) from the exact model.
    """

    method: str
    options: tuple[str, ...]
    rpc: Mapping[str, str] = field(default_factory=dict)
    gcps: tuple[gdal.GCP, ...] = ()
    gcp_crs: str = ""
    arrays: Path | None = None
    max_error_px: float = 0.0

    @property
    def limit(self) -> float:
        """Largest error (px) with which it may represent a model."""
        return EXPRESSED if self.method.startswith("GCP") else REFUSE_ERROR

    def source(self, dataset: gdal.Dataset, bands: tuple[int, ...] = (1,), *, mask: str | None = None) -> gdal.Dataset:
        """Return a view of some bands of an image that has the georeferencing of this transformer and no other.

        `mask` is the band whose mask it has, by GDAL's name, instead of its own.
        """
        # A geotransform cannot be taken away again; points keep Translate from copying it.
        view = gdal.Translate("", dataset, format="VRT", bandList=list(bands), GCPs=[gdal.GCP()], maskBand=mask)
        if mask:
            # The warper would take an alpha band at the end for the mask, and not warp it.
            view.GetRasterBand(view.RasterCount).SetColorInterpretation(gdal.GCI_Undefined)
        view.SetGCPs(list(self.gcps), self.gcp_crs)
        view.SetMetadata(dict(self.rpc), "RPC")
        view.SetMetadata({}, "GEOLOCATION")
        return view

    def georeference(self, ortho: gdal.Dataset, grid: Grid) -> None:
        """Give an empty ortho its place: by arrays instead of a geotransform where there are such."""
        if self.arrays is None:
            ortho.SetProjection(grid.crs.to_wkt())
            ortho.SetGeoTransform(grid.geotransform)
            return
        name = os.fspath(self.arrays)
        ortho.SetMetadata(
            {
                "X_DATASET": name,
                "X_BAND": "1",
                "Y_DATASET": name,
                "Y_BAND": "2",
                "PIXEL_OFFSET": "0",
                "LINE_OFFSET": "0",
                "PIXEL_STEP": "1",
                "LINE_STEP": "1",
                "GEOREFERENCING_CONVENTION": "PIXEL_CENTER",
            },
            "GEOLOCATION",
        )


@dataclass(frozen=True)
class Exact:
    """Positions of ortho pixels in the image: exact model, surface, grid, columns and rows of the image."""

    model: SensorModel
    surface: Surface
    grid: Grid
    size: tuple[int, int]

    def image(self, columns: Array, rows: Array) -> Array:
        """Return the image points ``(N, 2)`` of points ``(N,)`` of the ortho; NaN where there is none."""
        x, y = self.grid.xy(columns, rows)
        heights = self.surface.heights(np.column_stack([x, y]), self.grid.crs)
        return self.model.ground_to_image(
            ground_transform(self.grid.crs, self.model.crs)(np.column_stack([x, y, heights]))
        )

    def error(self, transformer: Transformer, image: gdal.Dataset) -> float:
        """Return how far (px) a transformer is off at points of the ortho; infinite if only one sees a point."""
        side = [
            np.unique(np.linspace(0, n - 1, _CHECKS).astype(int)) + 0.5 for n in (self.grid.width, self.grid.height)
        ]
        columns, rows = (axis.ravel() for axis in np.meshgrid(*side))
        ortho = gdal.GetDriverByName("VRT").Create("", self.grid.width, self.grid.height, 1)
        transformer.georeference(ortho, self.grid)
        transform = gdal.Transformer(transformer.source(image), ortho, list(transformer.options))
        points, success = transform.TransformPoints(1, np.column_stack([columns, rows, 0 * rows]).tolist())
        projected, exact = np.array(points)[:, :2], self.image(columns, rows)
        projected[~(np.array(success, dtype=bool) & np.isfinite(projected).all(axis=1))] = np.nan
        with np.errstate(invalid="ignore"):
            seen = [((place >= 0) & (place <= self.size)).all(axis=1) for place in (projected, exact)]
        use = seen[0] | seen[1]
        if transformer.method == "RPC":
            # GDAL interpolates next to voids and edges of a DEM, where our engine has no height.
            use &= np.isfinite(projected).all(axis=1) & np.isfinite(exact).all(axis=1)
        worst = np.abs(projected - exact)[use].max(initial=0.0)
        return float(worst) if np.isfinite(worst) else np.inf


def rectify(job: WarpJob, path: str | os.PathLike[str] | Hiding) -> WarpRecord:
    """Write the orthoimage by GDAL's own warper, without approximating its transformer: a cross-check of our engine.

    Raises
    ------
    InputError
        As our engine; for an image in several files; for pixels that terrain hides; for cubic heights, which GDAL's
        warper does not take from a DEM as our engine does; if no transformer of GDAL stands for the model within
        0.1 px.
    """
    begin = time.monotonic()
    if isinstance(path, Hiding):
        raise InputError(
            "GDAL's warper cannot detect occlusions",
            field="output.visibility",
            remedy=Text("leave out ", Setting("output.visibility"), " or ", Setting("output.engine", "gdal")),
        )
    _check(job)
    source, profile, grid, threads = job.source, job.look(), job.grid, job.threads()
    # GDAL's warper reads in one of its threads.
    limit_cache(job.resources.memory, 1, source.block, job.surface.block)
    exact = Exact(job.model, job.surface, grid, (source.width, source.height))
    writer = RasterWriter(
        path,
        grid,
        profile,
        driver=job.driver,
        creation_options=job.layout(),
        threads=threads,
        progress=job.resources.progress,
    )
    with writer, gdal_errors(path), contextlib.ExitStack() as scratch:
        arrays, target = writer.scratch("arrays"), writer.scratch("gdal")
        for temporary in (arrays, target):
            scratch.callback(temporary.unlink, missing_ok=True)
        transformer = _standing(exact, job.exported, source.dataset, arrays, scratch)
        # Alpha that is no alpha of the ortho.
        first = source.dataset.GetRasterBand(1)
        alpha = mask_flags(first) & gdal.GMF_ALPHA and profile.validity != "alpha"
        own = str(alpha_of(first) or "mask,1")
        view = transformer.source(source.dataset, tuple(source.band_numbers), mask=own if alpha else None)
        with written(_create(target, profile, grid)) as ortho:
            _describe(ortho, profile)
            transformer.georeference(ortho, grid)
            _warp_exactly(view, ortho, job, profile, transformer, threads)
        valid = writer.copy(target)
        refuse_empty(valid, path)
    return WarpRecord(
        max_error_px=transformer.max_error_px,
        tolerance_px=transformer.limit,
        finest_spacing=1,
        refined_blocks=0,
        blocks=0,
        pixels=grid.width * grid.height,
        valid_pixels=valid,
        seconds=time.monotonic() - begin,
        transformer=transformer.method,
    )


def _check(job: WarpJob) -> None:
    job.check()
    if job.dem_interpolation != "bilinear":
        raise InputError(
            "GDAL's warper interpolates the DEM bilinearly only",
            field="output.dem_interpolation",
            remedy=Text("leave out ", Setting("output.dem_interpolation"), " or ", Setting("output.engine", "gdal")),
        )
    if len(job.source.paths) > 1:
        raise InputError(
            "GDAL's warper reads only one file",
            file=job.source.paths[1],
            field="engine",
            remedy="use the default engine",
        )
    if any(band.GetMaskFlags() == 0 for band in job.source.bands):
        raise InputError(
            "GDAL's warper ignores masks of single bands",
            file=job.source.path,
            field="engine",
            remedy="use the default engine",
        )
    alpha = alpha_of(job.source.dataset.GetRasterBand(1))
    if alpha and numpy_type(job.source.dataset.GetRasterBand(alpha).DataType).kind == "f":
        raise InputError(
            "GDAL's warper rounds an alpha band of real numbers, so pixels below 0.5 would be empty",
            file=job.source.path,
            field="engine",
            remedy="use the default engine",
        )


# -- transformers that represent a model -------------------------------------------------------------------------------


def _standing(
    exact: Exact, exported: RpcExport | None, image: gdal.Dataset, arrays: Path, scratch: contextlib.ExitStack
) -> Transformer:
    """Return the first transformer that represents the model, with its error."""
    tried = []
    for candidate in _candidates(exact, exported, arrays, scratch):
        try:
            error = max(exact.error(candidate, image), candidate.max_error_px)
        except RuntimeError as refusal:  # this GDAL cannot make it
            tried.append(f"{candidate.method}: {first_line(refusal)}")
            continue
        if error <= candidate.limit:
            return replace(candidate, max_error_px=error)
        tried.append(f"{candidate.method}: {error:.3g} px error")
    raise InputError(
        f"none of GDAL's transformers represents this model ({'; '.join(tried)})",
        field="output.engine",
        remedy=Text("use the default engine (", Setting("output.engine", "ortho"), ")"),
    )


def _candidates(
    exact: Exact, exported: RpcExport | None, arrays: Path, scratch: contextlib.ExitStack
) -> Iterator[Transformer]:
    rpc = None if exported is None else _rpc(exact, exported, scratch)
    if rpc is not None and rpc.max_error_px == 0.0:
        yield rpc
    if not exact.model.uses_height:
        gcps, crs = _control(exact.model), parse_crs(exact.model.crs).to_wkt()
        for order in (1, 2, 3):
            options = ("METHOD=GCP_POLYNOMIAL", f"MAX_GCP_ORDER={order}")
            yield Transformer("GCP_POLYNOMIAL", options, gcps=gcps, gcp_crs=crs)
        yield Transformer("GCP_HOMOGRAPHY", ("METHOD=GCP_HOMOGRAPHY",), gcps=gcps, gcp_crs=crs)
    if rpc is not None and rpc.max_error_px > 0.0:
        yield rpc
    _write_arrays(exact, arrays)
    yield Transformer("GEOLOC_ARRAY", ("SRC_METHOD=NO_GEOTRANSFORM", "DST_METHOD=GEOLOC_ARRAY"), arrays=arrays)


def _rpc(exact: Exact, exported: RpcExport, scratch: contextlib.ExitStack) -> Transformer | None:
    """Return GDAL's RPC transformer with the heights under the grid; None where it would lose some of them."""
    options = ["METHOD=RPC"]  # GDAL would otherwise prefer GCPs
    ground = _heights_under(exact.surface, exact.grid)
    if ground is None:
        return None
    if ground.heights.size == 1:
        options += [f"RPC_HEIGHT={float(ground.heights[0, 0])!r}"]
    else:
        dem = f"/vsimem/ortho_dem_{os.getpid()}_{threading.get_ident()}.tif"
        scratch.callback(gdal.Unlink, dem)
        _write_dem(dem, ground)
        options += [f"RPC_DEM={dem}", "RPC_DEMINTERPOLATION=bilinear", "RPC_DEM_APPLY_VDATUM_SHIFT=NO"]
    return Transformer("RPC", tuple(options), rpc=rpc_metadata(exported.rpc), max_error_px=exported.max_error_px)


def _heights_under(surface: Surface, grid: Grid) -> Excerpt | None:
    """Return the ellipsoidal heights under a grid; None where GDAL would lose one side, at the antimeridian."""
    columns, rows = np.meshgrid(np.linspace(0, grid.width, 65), np.linspace(0, grid.height, 65))
    x, y = grid.xy(columns.ravel(), rows.ravel())
    return surface.excerpt(np.stack([x, y, np.zeros(x.size)], axis=1), grid.crs)


def _write_dem(path: str, ground: Excerpt) -> None:
    rows, columns = ground.heights.shape
    with written(gdal.GetDriverByName("GTiff").Create(path, columns, rows, 1, gdal.GDT_Float64)) as dataset:
        dataset.SetProjection(ground.crs.to_wkt())
        dataset.SetGeoTransform(ground.geotransform)
        dataset.GetRasterBand(1).SetNoDataValue(-1e6)
        dataset.GetRasterBand(1).WriteArray(np.where(np.isnan(ground.heights), -1e6, ground.heights))


def _control(model: SensorModel) -> tuple[gdal.GCP, ...]:
    """Return points of a model of the plane, over the box that it is meant for, in its own CRS."""
    centre, half = model.domain
    steps = np.linspace(-1.0, 1.0, _GCP_SIDE)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps))
    ground = centre + half * np.column_stack([x, y, 0 * x])
    rows = np.column_stack([ground, model.ground_to_image(ground)]).tolist()
    return tuple(gdal.GCP(*row) for row in rows if np.isfinite(row).all())


def _write_arrays(exact: Exact, path: Path) -> None:
    """Write the column and row in the image of the centre of every output pixel."""
    width, height = exact.grid.width, exact.grid.height
    options = ["BIGTIFF=IF_SAFER", "INTERLEAVE=BAND"]
    raster = gdal.GetDriverByName("GTiff").Create(os.fspath(path), width, height, 2, gdal.GDT_Float64, options)
    step = max(1, _PIECE // width)
    with written(raster) as dataset:
        for k in (1, 2):
            dataset.GetRasterBand(k).SetNoDataValue(_NO_PLACE)
        for top in range(0, height, step):
            columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(top, min(top + step, height)) + 0.5)
            image = exact.image(columns.ravel(), rows.ravel())
            image = np.clip(image, -_FAR, np.array(exact.size) + _FAR)  # NaN stays NaN
            image = np.where(np.isnan(image).any(axis=1, keepdims=True), _NO_PLACE, image).reshape(*columns.shape, 2)
            for k in (0, 1):
                dataset.GetRasterBand(k + 1).WriteArray(np.ascontiguousarray(image[:, :, k]), 0, top)


# -- the warp ----------------------------------------------------------------------------------------------------------


def _create(path: Path, profile: Profile, grid: Grid) -> gdal.Dataset:
    """Create the raster that GDAL warps into; its last band is the mask, if the profile has one."""
    mask = profile.validity == "mask"
    return gdal.GetDriverByName("GTiff").Create(
        os.fspath(path),
        grid.width,
        grid.height,
        profile.count + mask,
        gdal_type(profile.dtype),
        ["TILED=YES", "BIGTIFF=IF_SAFER"],
    )


def _describe(dataset: gdal.Dataset, profile: Profile) -> None:
    """Say which pixels of the raster that GDAL warps into have no value."""
    if profile.validity in ("mask", "alpha"):
        dataset.GetRasterBand(dataset.RasterCount).SetColorInterpretation(gdal.GCI_AlphaBand)
    if profile.nodata is not None:
        for k in range(profile.count):
            dataset.GetRasterBand(k + 1).SetNoDataValue(profile.nodata)


def _warp_exactly(
    view: gdal.Dataset, ortho: gdal.Dataset, job: WarpJob, profile: Profile, transformer: Transformer, threads: int
) -> None:
    progress = job.resources.progress
    # Without the first two the values depend on how the warper cuts the image into chunks; the next two let it find
    # the window of a chunk in the image from points all over it, because terrain moves them.
    settings = ["XSCALE=1", "YSCALE=1", "SAMPLE_GRID=YES", "SAMPLE_STEPS=101", "SOURCE_EXTRA=32"]
    with called_by_gdal(lambda share: progress and progress(WARPING, share)) as advance:
        gdal.Warp(
            ortho,
            view,
            transformerOptions=list(transformer.options),
            errorThreshold=0,
            resampleAlg=job.resampling,
            # By itself the warper clamps the source to the type of the output before it interpolates.
            workingType=gdal_type(job.source.dtype),
            dstNodata=profile.nodata,
            multithread=threads > 1,
            warpMemoryLimit=job.resources.memory // 2,
            warpOptions=[
                *settings,
                f"NUM_THREADS={threads}",
                "INIT_DEST=0" if profile.nodata is None else "INIT_DEST=NO_DATA",
            ],
            callback=advance,
        )
