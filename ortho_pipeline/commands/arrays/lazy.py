"""An ortho as an xarray DataArray whose blocks dask makes on demand, with the pixels that the file would have."""

from __future__ import annotations

import dataclasses
import functools
import os
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.commands.heights.opening import require_heights
from ortho_pipeline.commands.placement import Placement, open_rasters, place_scene
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.scene_fit import adjustable
from ortho_pipeline.commands.stac.given import with_items
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, installing
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources, one_blas_thread
from ortho_pipeline.surface.base import Surface

if TYPE_CHECKING:
    import xarray

    from ortho_pipeline.warp.job import WarpJob
    from ortho_pipeline.warp.lattice_engine import TileMaker

#: Options of files, and of other rasters than the ortho.
_IDLE = ("accuracy_raster", "visibility", "angles", "stac", "fill_from")


@with_items
@one_blas_thread()
def ortho_array(
    image: str | os.PathLike[str] | Scene,
    dem: str | os.PathLike[str] | SurfaceOptions,
    *,
    chunks: int | None = None,
    scene: SceneOptions = SceneOptions(),
    points: PointOptions | Points = PointOptions(),
    match: MatchOptions = MatchOptions(),
    output: OutputOptions = OutputOptions(),
) -> xarray.DataArray:
    """Return the orthoimage of a scene as a lazy array: dask computes only the blocks that are used.

    The model is adjusted and the scene laid on its surface now; pixels are read and warped by dask, in threads, in
    processes or on a cluster. They are those of the file that `rectify` writes with the same options, bit by bit.

    Parameters
    ----------
    dem : path or SurfaceOptions
        A DEM that declares its height datum, or all options of heights.
    chunks : int, optional
        Side of a block in pixels, a multiple of `warp.lattice.BLOCK`.

    Returns
    -------
    xarray.DataArray
        ``(band, y, x)``, with the coordinates of pixel centres, `spatial_ref` as CF has it (read by rioxarray and
        odc-geo), and, where there is no nodata value, `valid` ``(y, x)``.

    Raises
    ------
    InputError
        As `rectify`; for chunks that are no multiple, options that mean further files, and without xarray and dask.

    Examples
    --------
    >>> coarse = op.OutputOptions(resolution=50.0)
    >>> op.ortho_array("sample_data/scene.tif", "sample_data/dem.tif", output=coarse).dims
    ('band', 'y', 'x')
    """
    assert isinstance(points, PointOptions), "with_items makes options of points"
    side = _side(chunks)
    for field in _IDLE:
        if getattr(output, field) != getattr(OutputOptions(), field):
            raise InputError("an array is the ortho alone", field=f"output.{field}", remedy="leave it out")
    _tile_maker_of(output)
    surface = dem if isinstance(dem, SurfaceOptions) else SurfaceOptions(dem=dem)
    require_heights(surface)
    request = Request(image, scene, points, surface, match, output)
    placed = place_scene(adjustable(request))
    path = placed.scene.path if isinstance(image, Scene) else image
    # What is sent to other processes holds no options but these.
    opening = functools.partial(open_rasters, placed.scene, Request(path, scene, output=output))
    tiles = Tiles(placed.model, opening, placed.surface, placed.grid, dataclasses.replace(output, extent=None))
    return _array(placed, tiles, side)


def _side(chunks: int | None) -> int:
    from ortho_pipeline.warp.lattice import BLOCK
    from ortho_pipeline.warp.lattice_engine import TILE

    side = TILE if chunks is None else chunks
    if not isinstance(side, int) or side < BLOCK or side % BLOCK:
        raise InputError(
            f"blocks of {chunks} pixels are not made", field="chunks", remedy=f"a multiple of {BLOCK}, such as {TILE}"
        )
    return side


def _tile_maker_of(output: OutputOptions) -> Callable[[WarpJob], TileMaker]:
    from ortho_pipeline.warp.engines import engine_of

    make = engine_of(output.engine).tile_maker
    if make is None:
        raise InputError(
            "GDAL's warper only makes files", field="output.engine", remedy=Text("leave out ", Setting("output.engine"))
        )
    return make


class LazyTiles(Protocol):
    """What makes blocks of an ortho: pixels ``(bands, h, w)``, and which of them ``(h, w)`` are valid."""

    profile: Profile

    def __call__(self, top: int, left: int, height: int, width: int) -> tuple[NDArray[Any], NDArray[np.bool_]]: ...


class Tiles:
    """What makes tiles of an ortho; it may be sent to other processes, where it opens its files again."""

    def __init__(
        self,
        model: SensorModel,
        opening: Callable[[], RasterSource],
        surface: Surface,
        grid: Grid,
        output: OutputOptions,
    ) -> None:
        self._parts = model, opening, surface, grid, output
        self._source = opening()
        self.profile = Profile.of(self._source, output.dtype, output.nodata)
        self._lock = threading.Lock()
        self._maker: TileMaker | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Tiles, self._parts

    def __call__(self, top: int, left: int, height: int, width: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels ``(bands, height, width)`` of a tile, and which of them ``(height, width)`` are valid."""
        tile = self._ready().make((top, left, height, width))
        return tile.pixels, tile.valid

    def _ready(self) -> TileMaker:
        from ortho_pipeline.warp.job import WarpJob

        with self._lock:
            if self._maker is None:
                model, _, surface, grid, output = self._parts
                self._maker = _tile_maker_of(output)(
                    WarpJob(
                        model,
                        self._source,
                        surface,
                        grid,
                        output.resampling,
                        output.dem_interpolation,
                        output.tolerance,
                        Resources(output.memory),
                        profile=self.profile,
                    )
                )
            return self._maker


def _array(placed: Placement, tiles: Tiles, side: int) -> xarray.DataArray:
    _, xarray = libraries("ortho_array")
    pixels, valid = blocks_of(tiles, placed.grid, side)
    coordinates = coordinates_of(placed.grid, tiles.profile)
    if tiles.profile.validity == "mask":
        coordinates["valid"] = (("y", "x"), valid)
    return xarray.DataArray(pixels, coordinates, ("band", "y", "x"), "ortho", attributes_of(tiles.profile))


def libraries(field: str) -> tuple[Any, Any]:
    """Return dask and xarray, which are optional.

    Raises
    ------
    InputError
        If one of them is not installed; it names `field`.
    """
    try:
        import dask
        import dask.array
        import xarray
    except ImportError as error:
        raise InputError(
            f"lazy arrays need {error.name}, which is not installed",
            field=field,
            remedy=installing("xarray"),
        ) from error
    return dask, xarray


def blocks_of(tiles: LazyTiles, grid: Grid, side: int) -> tuple[Any, Any]:
    """Return dask arrays of pixels ``(bands, h, w)`` and of which are valid ``(h, w)``, in blocks of a side (px)."""
    dask, _ = libraries("chunks")
    maker, profile = dask.delayed(tiles, traverse=False), tiles.profile
    pixels: list[list[Any]] = []
    valid: list[list[Any]] = []
    for top in range(0, grid.height, side):
        pixels.append([])
        valid.append([])
        for left in range(0, grid.width, side):
            shape = min(side, grid.height - top), min(side, grid.width - left)
            tile = maker(top, left, *shape)
            pixels[-1].append(dask.array.from_delayed(tile[0], (profile.count, *shape), dtype=profile.dtype))
            valid[-1].append(dask.array.from_delayed(tile[1], shape, dtype=bool))
    return dask.array.block(pixels), dask.array.block(valid)


def coordinates_of(grid: Grid, profile: Profile) -> dict[str, Any]:
    """Return bands, pixel centres and the CF grid mapping of an ortho."""
    return {
        "band": np.arange(1, profile.count + 1),
        "y": grid.top - grid.dy * (np.arange(grid.height) + 0.5),
        "x": grid.left + grid.dx * (np.arange(grid.width) + 0.5),
        "spatial_ref": ((), 0, _reference(grid)),
    }


def attributes_of(profile: Profile) -> dict[str, Any]:
    """Return the attributes of the array of an ortho."""
    nodata = {} if profile.nodata is None else {"_FillValue": profile.dtype.type(profile.nodata)}
    return {**nodata, "grid_mapping": "spatial_ref", "long_name": _names(profile.descriptions)}


def _reference(grid: Grid) -> dict[str, Any]:
    """Return the attributes of a CF grid mapping, with the geotransform as GDAL writes it there."""
    transform = " ".join(repr(float(value)) for value in grid.geotransform)
    return {**grid.crs.to_cf(), "spatial_ref": grid.crs.to_wkt(), "GeoTransform": transform}


def _names(descriptions: Sequence[str]) -> tuple[str, ...]:
    return tuple(description or f"band {number}" for number, description in enumerate(descriptions, start=1))
