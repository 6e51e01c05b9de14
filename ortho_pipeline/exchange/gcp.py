"""A sensor model in every form that GDAL reads: RPC, ground control points, geolocation arrays.

RPC files themselves are written by `ortho_pipeline.exchange.rpc`; here are the forms that sample a model on a grid,
and the table of formats of `ortho export`.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from osgeo import gdal, osr

from ortho_pipeline.display.notices import to_document
from ortho_pipeline.errors import InputError, ModelError
from ortho_pipeline.exchange.rpc import (
    RpcExport,
    export_rpc,
    name_sources_relatively,
    write_rpb,
    write_rpc_txt,
    write_tagged_copy,
    write_vrt,
)
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.raster.output import close, raster_output, written
from ortho_pipeline.surface.dem import Surface
from ortho_pipeline.surface.footprint import image_grid
from ortho_pipeline.surface.rays import intersect

#: What ``ortho export --format`` takes, and what the file's name ends with.
ENDINGS = {
    "rpc-txt": "_RPC.TXT",
    "rpb": ".RPB",
    "vrt": ".vrt",
    "tag": "_rpc.tif",
    "gcp": "_gcp.vrt",
    "gcp-tag": "_gcp.tif",
    "geolocation": "_geolocation.vrt",
}
FORMATS = tuple(ENDINGS)
#: Points per side of a grid of control points that stands for a model.
GCP_SIDE = 11
#: Samples per side of geolocation arrays; GDAL interpolates between them.
_GEOLOCATION_SIDE = 257

#: Rows of column, row, longitude, latitude (degrees), ellipsoidal height (m).
Gcps = Array


def check_formats(formats: Sequence[str]) -> tuple[str, ...]:
    """Return the formats, each once.

    Raises
    ------
    InputError
        If one is unknown.
    """
    unknown = [name for name in formats if name not in ENDINGS]
    if unknown or not formats:
        raise InputError(
            f"no format is called {', '.join(unknown) or 'nothing'}", field="--format",
            remedy=f"one or more of {', '.join(FORMATS)}",
        )  # fmt: skip
    return tuple(dict.fromkeys(formats))


class Export:
    """Writes one model in any of the formats and notes how well each stands for it.

    Parameters
    ----------
    dataset : gdal.Dataset
        The image.
    size : (int, int)
        Its columns and rows.
    surface : Surface, optional
        Where grids of points get their heights from.
    control : Points
        The measured points that the model was adjusted to, gross errors not among them; where there are any, they are
        the control points of the formats ``gcp``.
    left_out : sequence of (str, str)
        Measured control points that are not, with the reason.
    force : bool
        Accept an RPC that is off by more than 0.1 px.
    """

    def __init__(
        self,
        dataset: gdal.Dataset,
        model: SensorModel,
        size: tuple[int, int],
        surface: Surface | None,
        control: Points,
        left_out: Sequence[tuple[str, str]] = (),
        *,
        force: bool = False,
    ) -> None:
        self.dataset, self.model, self.size = dataset, model, size
        self.surface, self.control, self.left_out, self.force = surface, control, tuple(left_out), force
        self.document: dict[str, Any] = {"exact": None, "max_error_px": None, **to_document(())}

    @functools.cached_property
    def rpc(self) -> RpcExport:
        """The model as RPC."""
        exported = export_rpc(self.model, force=self.force)
        self.document |= {"exact": exported.exact, "max_error_px": exported.max_error_px}
        self.document |= to_document(exported.warnings)
        return exported

    def write(self, name: str, path: Path) -> None:
        """Write one format."""
        writers: dict[str, Callable[[], object]] = {
            "rpc-txt": lambda: write_rpc_txt(self.rpc.rpc, path),
            "rpb": lambda: write_rpb(self.rpc.rpc, path),
            "vrt": lambda: write_vrt(self.dataset, self.rpc.rpc, path),
            "tag": lambda: write_tagged_copy(self.dataset, self.rpc.rpc, path),
            "gcp": lambda: write_gcps(self.dataset, self._gcps(), path),
            "gcp-tag": lambda: write_gcps(self.dataset, self._gcps(), path),
            "geolocation": lambda: self._geolocation(path),
        }
        writers[name]()

    def _gcps(self) -> Gcps:
        left_out: list[dict[str, str]] = []
        if len(self.control):
            gcps, source = gcps_of_points(self.control), "the measured control points"
            left_out = [{"id": name, "reason": reason} for name, reason in self.left_out]
        else:
            gcps, source = gcps_of_model(self.model, self.size, self.surface), f"a grid{self._where()}"
        self.document["gcps"] = {"n": len(gcps), "source": source, "left_out": left_out}
        return gcps

    def _geolocation(self, path: Path) -> None:
        worst = write_geolocation(self.dataset, self.model, self.size, self.surface, path)
        self.document["geolocation"] = {"max_error_px": worst, "heights": f"the model{self._where()}"}

    def _where(self) -> str:
        if self.surface is not None and self.surface.constant_height is None:
            return " on the DEM"
        height = self.model.reference_height if self.surface is None else self.surface.constant_height
        return f" at {height:.0f} m above the ellipsoid"

    def summary(self, model: str, source: str) -> str:
        """Say in a line each what was written and how well it stands for the model."""
        lines = [f"Model {model} of {source}"]
        if self.document["exact"] is not None:
            worst = self.document["max_error_px"]
            lines.append("RPC: exact" if self.document["exact"] else f"RPC: refitted, at most {worst:.2g} px off")
        if "gcps" in self.document:
            lines.append("Control points: {n}, {source}".format(**self.document["gcps"]))
            lines += ["Left out: {id} ({reason})".format(**one) for one in self.document["gcps"]["left_out"]]
        if "geolocation" in self.document:
            found = self.document["geolocation"]
            lines.append(f"Geolocation: {found['heights']}, {found['max_error_px']:.2g} px off between its samples")
        return "\n".join([*lines, *(f"Warning: {text}" for text in self.document["warnings"])])


# -- control points --------------------------------------------------------------------------------------------------


def gcps_of_points(points: Points) -> Gcps:
    """Return measured points ``(N, 5)``: column, row, longitude, latitude, ellipsoidal height."""
    control = points.to_crs("EPSG:4979")
    return np.column_stack([control.image, np.nan_to_num(control.ground, nan=0.0)])


def gcps_of_model(
    model: SensorModel, size: tuple[int, int], surface: Surface | None = None, side: int = GCP_SIDE
) -> Gcps:
    """Return a grid of points ``(N, 5)`` over the image, on the surface or at the model's reference height.

    Raises
    ------
    InputError
        If fewer than four of them meet the ground.
    """
    image = image_grid(*size, side)
    gcps = np.column_stack([image, _lonlat(model, image, surface)])
    gcps = gcps[np.isfinite(gcps).all(axis=1)]
    if len(gcps) < 4:
        raise InputError(
            "the rays of the image do not meet the ground: there is no grid of control points", field="model",
            remedy="give the metadata of this very image, and a DEM or --height that lies under it",
        )  # fmt: skip
    return gcps


def _lonlat(model: SensorModel, image: Array, surface: Surface | None) -> Array:
    if surface is None:
        ground = model.image_to_ground(image, model.reference_height)
    else:
        ground = intersect(model, image, surface)
    return ground_transform(model.crs, "EPSG:4979")(ground)


def write_gcps(dataset: gdal.Dataset, gcps: Gcps, path: str | PathLike[str]) -> None:
    """Write the image with control points in WGS 84: a ``.vrt`` that refers to it, or a GeoTIFF copy.

    An RPC and a geotransform of the image are left out, so that no program can take them instead.

    Raises
    ------
    InputError
        If the folder cannot be written.
    ModelError
        If the file does not give the same points again.
    """
    path = Path(path)
    points = [gdal.GCP(x, y, h, column, row, "", str(k + 1)) for k, (column, row, x, y, h) in enumerate(gcps.tolist())]
    view = _without_georeferencing(dataset)
    view.SetGCPs(points, _wgs84().ExportToWkt())
    with raster_output(path) as temporary:
        if path.suffix.lower() == ".vrt":
            close(gdal.GetDriverByName("VRT").CreateCopy(os.fspath(temporary), view))
            name_sources_relatively(temporary, path)
        else:
            options = ["COMPRESS=DEFLATE", "TILED=YES", "BIGTIFF=IF_SAFER"]
            close(gdal.GetDriverByName("GTiff").CreateCopy(os.fspath(temporary), view, options=options))
        copy = gdal.OpenEx(os.fspath(temporary), gdal.OF_RASTER, allowed_drivers=["VRT", "GTiff"])
        again = np.array([[p.GCPPixel, p.GCPLine, p.GCPX, p.GCPY, p.GCPZ] for p in copy.GetGCPs()])
        # A VRT keeps four decimals of pixels and twelve of degrees.
        other = copy.GetMetadata("RPC") or copy.GetGeoTransform(can_return_null=True)
        if again.shape != gcps.shape or np.abs(again - gcps).max() > 1e-4 or other:
            raise ModelError("the control points that were written are others when they are read again", file=path)


def _without_georeferencing(dataset: gdal.Dataset) -> gdal.Dataset:
    """Return a view of an image without RPC, points and geotransform, which programs would prefer to ours."""
    # A geotransform cannot be taken away again; points keep Translate from copying it.
    view = gdal.Translate("", dataset, format="VRT", GCPs=[gdal.GCP()])
    view.SetGCPs([], "")
    view.SetMetadata({}, "RPC")
    return view


def _wgs84() -> osr.SpatialReference:
    wgs84 = osr.SpatialReference()
    wgs84.ImportFromEPSG(4326)
    wgs84.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    return wgs84


# -- geolocation arrays ----------------------------------------------------------------------------------------------


def write_geolocation(
    dataset: gdal.Dataset, model: SensorModel, size: tuple[int, int], surface: Surface | None, path: str | PathLike[str]
) -> float:
    """Write a VRT of the image with GDAL's geolocation arrays, and the arrays as GeoTIFF beside it.

    Longitude and latitude (WGS 84) of image points on the surface, or at the model's reference height. GDAL has no
    relative names here: the arrays stay where they are written.

    Returns
    -------
    float
        Largest error (px) of interpolating between the samples, in the middle of their meshes.

    Raises
    ------
    InputError
        If the folder cannot be written.
    InputError
        If some rays of the image do not meet the surface.
    """
    path = Path(path)
    columns, rows = size
    step = max(1, math.ceil(max(size) / (_GEOLOCATION_SIDE - 1)))
    across, down = (np.arange(math.ceil(side / step) + 1) * float(step) for side in (columns, rows))
    image = np.stack(np.meshgrid(across, down), axis=-1)
    lonlat = _lonlat(model, image.reshape(-1, 2), surface)[:, :2].reshape(*image.shape[:2], 2)
    if not np.isfinite(lonlat).all():
        raise InputError(
            "some rays of the image do not meet the ground: geolocation arrays would have holes",
            field="model" if surface is None else "--dem",
            remedy="give the metadata of this very image, and a DEM that covers the whole scene, or --height",
        )  # fmt: skip
    arrays = path.resolve().with_suffix(".tif")
    with raster_output(arrays) as temporary:
        made = gdal.GetDriverByName("GTiff").Create(
            os.fspath(temporary), len(across), len(down), 2, gdal.GDT_Float64, options=["COMPRESS=DEFLATE"]
        )
        with written(made) as raster:
            for k in (0, 1):
                raster.GetRasterBand(k + 1).WriteArray(np.ascontiguousarray(lonlat[:, :, k]))
    view = _without_georeferencing(dataset)
    view.SetMetadata(
        {"X_DATASET": str(arrays), "X_BAND": "1", "Y_DATASET": str(arrays), "Y_BAND": "2", "PIXEL_OFFSET": "0",
         "LINE_OFFSET": "0", "PIXEL_STEP": str(step), "LINE_STEP": str(step), "SRS": _wgs84().ExportToWkt(),
         "GEOREFERENCING_CONVENTION": "TOP_LEFT_CORNER"},
        "GEOLOCATION",
    )  # fmt: skip
    with raster_output(path) as temporary:
        close(gdal.GetDriverByName("VRT").CreateCopy(os.fspath(temporary), view))
        name_sources_relatively(temporary, path)
    return _mesh_error(model, image, lonlat, surface)


def _mesh_error(model: SensorModel, image: Array, lonlat: Array, surface: Surface | None) -> float:
    """Return the largest error (px) in the middle of the meshes, on a spread of at most some thousand of them."""
    rows, columns = (np.unique(np.linspace(0, side - 2, 65).astype(int)) for side in image.shape[:2])
    i, j = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))
    around = ((0, 0), (0, 1), (1, 0), (1, 1))
    middle = sum(image[i + a, j + b] for a, b in around) / 4
    meant = sum(lonlat[i + a, j + b] for a, b in around) / 4
    exact = _lonlat(model, middle, surface)
    # Both at the height of the exact point, so that only the shift in plan is measured.
    both = [np.column_stack([place[:, :2], exact[:, 2]]) for place in (meant, exact)]
    inverse = ground_transform("EPSG:4979", model.crs)
    difference = model.ground_to_image(inverse(both[0])) - model.ground_to_image(inverse(both[1]))
    return float(np.nanmax(np.abs(difference)))
