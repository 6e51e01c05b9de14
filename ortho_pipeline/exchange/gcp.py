"""A sensor model sampled on a grid for GDAL: ground control points, geolocation arrays."""

from __future__ import annotations

import math
import os
from os import PathLike
from pathlib import Path

import numpy as np
from osgeo import gdal, osr

from ortho_pipeline.errors import InputError, ModelError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange.rpc import name_sources_relatively, without_georeference
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import longitudes_near
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.raster.verified_writing import close, raster_output, written
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.footprint import image_grid
from ortho_pipeline.surface.rays import meet_surface

#: Points per side of a grid of control points that represents a model.
GCP_SIDE = 11
#: Samples per side of geolocation arrays; GDAL interpolates between them.
_GEOLOCATION_SIDE = 257

#: Rows of column, row, longitude, latitude (degrees), ellipsoidal height (m).
Gcps = Array


# -- control points --------------------------------------------------------------------------------------------------


def gcps_of_points(points: Points) -> Gcps:
    """Return measured points ``(N, 5)``: column, row, longitude, latitude, ellipsoidal height."""
    control = points.to_crs("EPSG:4979")
    return np.column_stack([control.image, np.nan_to_num(_unwrapped(control.ground), nan=0.0)])


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
            "the rays of the image do not meet the ground, so no control points can be made",
            field="model",
            remedy=Text("give the metadata of this image, and a DEM of this place or ", Setting("surface.height")),
        )
    return gcps


def _lonlat(model: SensorModel, image: Array, surface: Surface | None) -> Array:
    if surface is None:
        ground = model.image_to_ground(image, model.reference_height)
    else:
        ground = meet_surface(model, image, surface)
    return _unwrapped(ground_transform(model.crs, "EPSG:4979")(ground))


def _unwrapped(ground: Array) -> Array:
    """Return ground without a jump of longitude at 180 degrees: all are within half a turn of the first finite one."""
    lon = ground[:, 0]
    first = lon[np.isfinite(lon)][:1].sum()
    return np.column_stack([longitudes_near(lon, first), ground[:, 1:]])


def write_gcps(dataset: gdal.Dataset, gcps: Gcps, path: str | PathLike[str]) -> None:
    """Write the image with control points in WGS 84: a ``.vrt`` that refers to it, or a GeoTIFF copy.

    The file has no RPC and no geotransform, so that no program uses them instead.

    Raises
    ------
    InputError
        If the folder cannot be written.
    ModelError
        If the points differ when they are read again.
    """
    path = Path(path)
    points = [gdal.GCP(x, y, h, column, row, "", str(k + 1)) for k, (column, row, x, y, h) in enumerate(gcps.tolist())]
    view = without_georeference(dataset)
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
            raise ModelError("the written control points differ when they are read again", file=path)


def _wgs84() -> osr.SpatialReference:
    wgs84 = osr.SpatialReference()
    wgs84.ImportFromEPSG(4326)
    wgs84.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    return wgs84


# -- geolocation arrays ----------------------------------------------------------------------------------------------


def write_geolocation(
    dataset: gdal.Dataset, model: SensorModel, size: tuple[int, int], surface: Surface | None, path: str | PathLike[str]
) -> float:
    """Write a VRT of the image with GDAL's geolocation arrays, and the arrays as GeoTIFF next to it.

    The arrays have longitude and latitude (WGS 84) of image points on the surface, or at the model's reference height.
    GDAL allows no relative names here, so the arrays must not be moved.

    Returns
    -------
    float
        Largest error (px) of the interpolation, in the middle between samples.

    Raises
    ------
    InputError
        If the folder cannot be written, or some rays of the image do not meet the surface.
    """
    path = Path(path)
    columns, rows = size
    step = max(1, math.ceil(max(size) / (_GEOLOCATION_SIDE - 1)))
    across, down = (np.arange(math.ceil(side / step) + 1) * float(step) for side in (columns, rows))
    image = np.stack(np.meshgrid(across, down), axis=-1)
    lonlat = _lonlat(model, image.reshape(-1, 2), surface)[:, :2].reshape(*image.shape[:2], 2)
    if not np.isfinite(lonlat).all():
        raise InputError(
            "some rays of the image do not meet the ground, so geolocation arrays would have gaps",
            field="model" if surface is None else "surface.dem",
            remedy=Text(
                "give the metadata of this image, and a DEM that covers the whole scene or ",
                Setting("surface.height"),
            ),
        )
    arrays = path.parent.resolve() / f"{path.stem}.tif"
    with raster_output(arrays) as temporary:
        created = gdal.GetDriverByName("GTiff").Create(
            os.fspath(temporary), len(across), len(down), 2, gdal.GDT_Float64, options=["COMPRESS=DEFLATE"]
        )
        with written(created) as raster:
            for k in (0, 1):
                raster.GetRasterBand(k + 1).WriteArray(np.ascontiguousarray(lonlat[:, :, k]))
    view = without_georeference(dataset)
    view.SetMetadata(
        {
            "X_DATASET": str(arrays),
            "X_BAND": "1",
            "Y_DATASET": str(arrays),
            "Y_BAND": "2",
            "PIXEL_OFFSET": "0",
            "LINE_OFFSET": "0",
            "PIXEL_STEP": str(step),
            "LINE_STEP": str(step),
            "SRS": _wgs84().ExportToWkt(),
            "GEOREFERENCING_CONVENTION": "TOP_LEFT_CORNER",
        },
        "GEOLOCATION",
    )
    with raster_output(path) as temporary:
        close(gdal.GetDriverByName("VRT").CreateCopy(os.fspath(temporary), view))
        name_sources_relatively(temporary, path)
    return _mesh_error(model, image, lonlat, surface)


def _mesh_error(model: SensorModel, image: Array, lonlat: Array, surface: Surface | None) -> float:
    """Return the largest error (px) in the middle of cells of the grid, of which some thousand are sampled."""
    rows, columns = (np.unique(np.linspace(0, side - 2, 65).astype(int)) for side in image.shape[:2])
    i, j = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))
    around = ((0, 0), (0, 1), (1, 0), (1, 1))
    middle = sum(image[i + a, j + b] for a, b in around) / 4
    interpolated = sum(lonlat[i + a, j + b] for a, b in around) / 4
    exact = _lonlat(model, middle, surface)
    # Both at the height of the exact point, to measure only the horizontal shift.
    both = [np.column_stack([place[:, :2], exact[:, 2]]) for place in (interpolated, exact)]
    inverse = ground_transform("EPSG:4979", model.crs)
    difference = model.ground_to_image(inverse(both[0])) - model.ground_to_image(inverse(both[1]))
    return float(np.nanmax(np.abs(difference)))
