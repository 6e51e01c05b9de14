"""A scene, its reference orthoimage and its DEM over a ground of known truth, as files, and that truth.

The scene is what a camera of `cameras` sees: each pixel's ray is met with the relief, and the texture read there. What
is delivered with it is an RPC that is wrong by a known amount.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from cameras import Camera
from landscape import CELL, SIZE, Land, Texture, bilinear, field_of, land, sample
from numpy.typing import ArrayLike, NDArray
from osgeo import gdal, osr
from scipy.ndimage import gaussian_filter, map_coordinates

from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.models import RPC
from ortho_pipeline.models.base import SensorModel, as_ground

Array = NDArray[np.float64]
UTM = "EPSG:32735"
#: Map coordinates of the middle of every scene, and the mean height there.
MIDDLE, LEVEL = (512_345.0, 7_123_456.0), 300.0
TYPES = {"uint8": (gdal.GDT_Byte, 20, 200), "uint16": (gdal.GDT_UInt16, 300, 3000), "float32": (gdal.GDT_Float32, 0, 1)}


@dataclass(frozen=True)
class View:
    """What one image of the ground is like; lengths in pixels of the scene, brightness in units of the ground's tone.

    Parameters
    ----------
    season : int
        0 is the ground as it is; see `Land.seen`.
    bands : str
        Letters of the ground's bands, one for each band of the file.
    noise : float
        Sigma of white noise; the ground's own deviation is about 0.2.
    haze, shadows, clouds : float
        Greatest share of the signal that haze takes away; share of the image that lies in the shadow of clouds, and
        under clouds.
    stripes : float
        Sigma of an offset of each column.
    holes : float
        Share of the image without data (0).
    """

    season: int = 0
    bands: str = "a"
    noise: float = 0.01
    haze: float = 0.0
    shadows: float = 0.0
    clouds: float = 0.0
    stripes: float = 0.0
    holes: float = 0.0
    dtype: str = "uint16"


@dataclass(frozen=True)
class Setting:
    """All that a simulated scene and its reference are made from; the same setting gives the same files.

    Parameters
    ----------
    side : int
        Columns of the scene; rows are 6/7 of them.
    ratio : float
        Pixel of the reference over pixel of the scene.
    error, kind : float, str
        Length (px) of the shift of the delivered model, and what it has besides: 'shift' nothing, 'drift' slopes along
        the rows, 'affine' along both axes, 'attitude' a wrong heading; `slope` px at the rim of the image.
    relief : float
        Sigma of the heights, in pixels.
    dem_sigma, dem_length, dem_noise : float
        Correlated error of the DEM (m) and its length (m), and white error (m) of its samples.
    reference_sigma, reference_length : float
        The same of the reference, each axis, in metres.
    roughness : str
        How these errors are correlated, as in `landscape.correlation`.
    margin : float
        How far (px of the scene) the reference reaches beyond the scene.
    offset : (float, float)
        How far (m) the reference's georeference is wrong as a whole.
    elsewhere : bool
        The reference shows another place.
    fine : float
        Texels of one pixel of the finer of both images.
    """

    ground: str = "country"
    seed: int = 0
    side: int = 700
    gsd: float = 1.0
    ratio: float = 1.0
    scene: View = View()
    reference: View = View()
    pushbroom: bool = True
    off_nadir_deg: float = 12.0
    heading_deg: float = 190.0
    error: float = 10.0
    kind: str = "shift"
    slope: float = 2.0
    relief: float = 20.0
    dem_sigma: float = 0.0
    dem_length: float = 100.0
    dem_noise: float = 0.0
    reference_sigma: float = 0.0
    reference_length: float = 150.0
    roughness: str = "gaussian"
    reference_crs: str = UTM
    margin: float = 60.0
    offset: tuple[float, float] = (0.0, 0.0)
    elsewhere: bool = False
    fine: float = 2.0


class Delivered(SensorModel):
    """The truth with its error on top; an RPC is fitted to it."""

    kind = "test_delivered"

    def __init__(self, case: Case) -> None:
        object.__setattr__(self, "case", case)

    @property
    def crs(self) -> str:
        return UTM

    @property
    def domain(self) -> tuple[Array, Array]:
        case = self.case
        half = 0.75 * case.setting.side * case.setting.gsd
        return np.array([*MIDDLE, LEVEL]), np.array([half, half, 6 * case.relief + 50.0])

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self.case.with_error(as_ground(ground))


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated scene with its truth; `write` makes the files.

    Map coordinates are those of `UTM`, heights are above the ellipsoid.
    """

    setting: Setting
    folder: Path

    # -- the truth -----------------------------------------------------------------------------------------------------

    @cached_property
    def land(self) -> Land:
        return land(self.setting.ground, 0)

    def random(self, what: int) -> np.random.Generator:
        """Return the random numbers of one part of the scene, whatever the others draw."""
        return np.random.default_rng([self.setting.seed, what])

    @property
    def spacing(self) -> float:
        """Metres of a texel."""
        return self.setting.gsd * min(1.0, self.setting.ratio) / self.setting.fine

    @property
    def relief(self) -> float:
        """Sigma of the heights in metres."""
        return self.setting.relief * self.setting.gsd

    @cached_property
    def _corner(self) -> Array:
        """Texel coordinates of the middle of the scene; anywhere on the ground."""
        return self.random(1).uniform(0, SIZE, 2)

    def texel(self, xy: Array) -> tuple[Array, Array]:
        """Return the texel coordinates of map coordinates ``(..., 2)``."""
        return self._texel(xy[..., 0], xy[..., 1])

    def _texel(self, x: Array, y: Array) -> tuple[Array, Array]:
        return self._corner[0] + (x - MIDDLE[0]) / self.spacing, self._corner[1] + (MIDDLE[1] - y) / self.spacing

    def height(self, x: Array, y: Array) -> Array:
        """Return the true heights at map coordinates of any shape."""
        return LEVEL + self.relief * self.land.heights(*self._texel(x, y))

    @cached_property
    def camera(self) -> Camera:
        setting = self.setting
        wobble = self.random(2).normal(0, 1e-6, 3) * setting.side * setting.gsd / 600
        return Camera(
            place=(*MIDDLE, LEVEL), gsd=setting.gsd, width=setting.side, height=setting.side * 6 // 7,
            heading_deg=setting.heading_deg, off_nadir_deg=setting.off_nadir_deg, pitch_deg=3.0,
            wobble=(wobble[0], wobble[1], 10 * wobble[2]), pushbroom=setting.pushbroom,
            altitude=600_000.0 if setting.pushbroom else 4000.0 * setting.gsd,
        )  # fmt: skip

    def ground_of(self, image: ArrayLike) -> Array:
        """Return where image points ``(N, 2)`` are on the ground: map x, y, height ``(N, 3)``."""
        image = np.asarray(image, dtype=float)
        height = np.full(len(image), LEVEL)
        for _ in range(100):
            xy = self.camera.ground_at(image, height)
            before, height = height, self.height(xy[:, 0], xy[:, 1])
            if np.abs(height - before).max(initial=0.0) < 1e-9:
                break
        return np.column_stack([self.camera.ground_at(image, height), height])

    def image_of(self, xy: ArrayLike) -> Array:
        """Return where places of the map ``(N, 2)``, on the true ground, are in the scene ``(N, 2)``."""
        xy = np.asarray(xy, dtype=float)[:, :2]
        return self.camera.image_of(np.column_stack([xy, self.height(xy[:, 0], xy[:, 1])]))

    # -- what is delivered ---------------------------------------------------------------------------------------------

    @cached_property
    def error(self) -> tuple[Array, Array]:
        """Shift ``(2,)`` and slopes ``(2, 2)`` (px per px about the middle) of the delivered model's error."""
        setting, random = self.setting, self.random(3)
        angle = random.uniform(0, 2 * np.pi)
        shift = setting.error * np.array([np.cos(angle), np.sin(angle)])
        slopes = random.uniform(-1, 1, (2, 2)) * setting.slope / (setting.side / 2)
        keep = {"shift": [0, 0], "drift": [0, 1], "affine": [1, 1], "attitude": [0, 0]}[setting.kind]
        return shift, slopes * keep

    @property
    def correction(self) -> str:
        """What takes the error of the model away."""
        return {"shift": "shift", "drift": "shift-drift"}.get(self.setting.kind, "affine")

    def with_error(self, ground: Array) -> Array:
        """Return the image points ``(N, 2)`` of map points ``(N, 3)`` as the delivered model has them."""
        camera, (shift, slopes) = self.camera, self.error
        if self.setting.kind == "attitude":
            turn = math.degrees(self.setting.slope / (self.setting.side / 2))
            camera = replace(camera, heading_deg=camera.heading_deg + turn)
        image = camera.image_of(ground)
        return image + shift + (image - [camera.width / 2, camera.height / 2]) @ slopes.T

    @cached_property
    def model(self) -> RPC:
        """The delivered model: an RPC that is within 0.01 px of the truth with its error."""
        reach = 0.75 * self.setting.side * self.setting.gsd * np.array([-1, 1])
        x, y = np.meshgrid(MIDDLE[0] + reach, MIDDLE[1] + reach)
        lon, lat = to_lonlat().transform(x.ravel(), y.ravel())
        height = 6 * self.relief + 50.0
        found = fit_rpc(
            Delivered(self),
            (min(lon), min(lat), max(lon), max(lat)),
            (LEVEL - height, LEVEL + height),
            grid=(7, 7, 4),
        )
        return found.rpc

    def misfit(self, model: SensorModel) -> tuple[Array, Array]:
        """Return how far (px) a model is from the truth at the corners, the rims and the middle, and those places.

        Returns
        -------
        off : ndarray (9, 2)
        ground : ndarray (9, 3)
            Longitude, latitude, height.
        """
        steps = np.array([0.0, 0.5, 1.0])
        image = np.stack(np.meshgrid(steps * self.camera.width, steps * self.camera.height), axis=-1).reshape(-1, 2)
        ground = lonlat(self.ground_of(image))
        return model.ground_to_image(ground) - image, ground

    @property
    def search(self) -> float:
        """How far (m) the model may be off: a bit more than it is."""
        return (1.15 * self.setting.error + self.setting.slope + 8.0) * self.setting.gsd

    # -- the files -----------------------------------------------------------------------------------------------------

    @property
    def scene_file(self) -> Path:
        return self.folder / "scene.tif"

    @property
    def reference_file(self) -> Path:
        return self.folder / "reference.tif"

    @property
    def dem_file(self) -> Path:
        return self.folder / "dem.tif"

    def write(self) -> Case:
        """Write scene, reference and DEM."""
        self.folder.mkdir(parents=True, exist_ok=True)
        pixels = self.rendered()
        write_raster(self.scene_file, pixels, self.setting.scene.dtype, rpc=self.model)
        self.write_reference()
        self.write_dem()
        return self

    def mesh(self, columns: Array, rows: Array) -> tuple[Array, Array]:
        """Return the map x and y ``(R, C)`` of the ground at a mesh of image positions."""
        height: Any = LEVEL
        for _ in range(60):
            x, y = self.camera.meshed(columns, rows, height)
            before, height = height, self.height(x, y)
            if np.abs(height - before).max() < 1e-3 * self.setting.gsd:
                break
        return self.camera.meshed(columns, rows, height)

    def rendered(self) -> list[Texture]:
        """Return the bands of the scene, in the ground's tone; NaN in its holes."""
        setting, camera = self.setting, self.camera
        x, y = self.mesh(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        pixel = setting.gsd / self.spacing
        return self._view(setting.scene, *self._texel(x, y), pixel, 0.4, 10)

    def _view(self, view: View, u: Array, v: Array, pixel: float, blur: float, salt: int) -> list[Texture]:
        bands = [sample(self.land.seen(band, view.season, pixel, blur * pixel), u, v) for band in view.bands]
        random = self.random(salt)
        sky = Sky(bands[0].shape, random)
        return [sky.over(band, view) for band in bands]

    def reference_grid(self) -> tuple[tuple[float, ...], int, int]:
        """Return geotransform, columns and rows of the reference in its CRS."""
        setting = self.setting
        rim = np.linspace(0, 1, 9)
        frame = np.stack(np.meshgrid(rim * self.camera.width, rim * self.camera.height), axis=-1).reshape(-1, 2)
        ground = self.ground_of(frame)[:, :2]
        margin = setting.margin * setting.gsd
        low, high = ground.min(axis=0) - margin, ground.max(axis=0) + margin
        step = setting.gsd * setting.ratio
        if setting.reference_crs != UTM:
            x, y = np.meshgrid([low[0], high[0]], [low[1], high[1]])
            there = np.stack(transformer(UTM, setting.reference_crs).transform(x.ravel(), y.ravel()), axis=1)
            per_metre = np.ptp(there, axis=0)[0] / (high - low)[0]
            low, high, step = there.min(axis=0), there.max(axis=0), step * per_metre
        left, top = low[0] + 0.37 * step, high[1] - 0.21 * step
        columns, rows = (int(length / step) for length in high - low)
        return (left, step, 0.0, top, 0.0, -step), columns, rows

    def reference_place(self, place: tuple[float, ...], columns: int, rows: int) -> tuple[Array, Array]:
        """Return the true map x and y ``(R, C)`` of what the pixels of the reference show."""
        setting = self.setting
        x = place[0] + place[1] * (np.arange(columns) + 0.5)
        y = place[3] + place[5] * (np.arange(rows) + 0.5)
        x, y = np.meshgrid(x, y)
        if setting.reference_crs != UTM:
            x, y = transformer(setting.reference_crs, UTM).transform(x, y)
        moved = [setting.offset[0], setting.offset[1]]
        if setting.reference_sigma:
            moved = [
                moved[k] + setting.reference_sigma * self.smooth(20 + k, setting.reference_length, x, y) for k in (0, 1)
            ]
        return x - moved[0], y - moved[1]

    def smooth(self, salt: int, length: float, x: Array, y: Array) -> Array:
        """Return a field, sigma 1, correlated over `length` metres, at map coordinates."""
        # Its samples are finer than its length, and it repeats like the ground.
        size = min(SIZE // CELL, max(16, int(8 * SIZE * self.spacing / length)))
        u, v = self._texel(x, y)
        scale = length * size / (SIZE * self.spacing)
        samples = _field(self.setting.seed, salt, size, scale, self.setting.roughness)
        return bilinear(samples, u * (size / SIZE), v * (size / SIZE))

    def write_reference(self) -> None:
        """Write the reference orthoimage."""
        setting = self.setting
        place, columns, rows = self.reference_grid()
        u, v = self._texel(*self.reference_place(place, columns, rows))
        if setting.elsewhere:
            away = self.random(4).uniform(0.3, 0.7, 2) * SIZE
            u, v = u + away[0], v + away[1]
        pixel = setting.gsd * setting.ratio / self.spacing
        bands = self._view(setting.reference, u, v, pixel, 0.3, 11)
        write_raster(self.reference_file, bands, setting.reference.dtype, place=place, crs=setting.reference_crs)

    def write_dem(self) -> None:
        """Write the DEM: the true samples with its errors, as far as the reference reaches and a bit more."""
        setting, step = self.setting, CELL * self.spacing
        corners = self.ground_of([[0, 0], [self.camera.width, 0], [0, self.camera.height], self.frame])[:, :2]
        margin = (setting.margin + setting.error + 60) * setting.gsd
        u, v = self.texel(np.array([corners.min(axis=0) - margin, corners.max(axis=0) + margin]))
        column = np.arange(math.floor(u[0] / CELL), math.ceil(u[1] / CELL) + 1)
        row = np.arange(math.floor(v[1] / CELL), math.ceil(v[0] / CELL) + 1)
        size = SIZE // CELL
        heights = LEVEL + self.relief * self.land.relief[np.ix_(row % size, column % size)]
        x = MIDDLE[0] + ((column + 0.5) * CELL - self._corner[0]) * self.spacing
        y = MIDDLE[1] - ((row + 0.5) * CELL - self._corner[1]) * self.spacing
        if setting.dem_sigma:
            heights = heights + setting.dem_sigma * self.smooth(30, setting.dem_length, *np.meshgrid(x, y))
        heights = heights + self.random(31).normal(0, setting.dem_noise, heights.shape)
        place = (x[0] - step / 2, step, 0.0, y[0] + step / 2, 0.0, -step)
        write_raster(self.dem_file, [heights], "float32", place=place, crs=UTM, nodata=None)

    @property
    def frame(self) -> tuple[int, int]:
        """Columns and rows of the scene."""
        return self.camera.width, self.camera.height


@lru_cache(maxsize=8)
def _field(seed: int, salt: int, size: int, length: float, roughness: str) -> Array:
    return field_of(np.random.default_rng([seed, salt]), size, length, roughness)


class Sky:
    """What lies between the ground and a detector; fields of its own for each image."""

    def __init__(self, shape: tuple[int, int], random: np.random.Generator) -> None:
        self.shape, self.random = shape, random

    def over(self, tone: Texture, view: View) -> Texture:
        """Return the tone as the detector gives it; NaN in holes."""
        if view.shadows:
            tone = tone * (1 - 0.6 * self.patches(view.shadows, 12, 0.05))
        if view.haze:
            haze = view.haze * (0.5 + 0.5 * np.clip(self.field(6) / 2, -1, 1))
            tone = tone * (1 - haze) + 0.9 * haze
        if view.clouds:
            cloud = self.patches(view.clouds, 8, 0.04)
            tone = tone * (1 - cloud) + cloud * (1.0 + 0.1 * self.field(24))
        tone = tone + self.random.normal(0, 1, self.shape).astype(np.float32) * view.noise
        if view.stripes:
            tone = tone + self.random.normal(0, view.stripes, self.shape[1]).astype(np.float32)
        if view.holes:
            tone = np.where(self.patches(view.holes, 10, 0.0) > 0.5, np.nan, tone)
        return tone.astype(np.float32)

    def field(self, waves: int) -> Texture:
        """Return smooth noise, sigma 1, with about so many waves along the image."""
        small = gaussian_filter(self.random.normal(0, 1, (4 * waves, 4 * waves)), 1.5, mode="wrap")
        rows, columns = (np.linspace(0, 4 * waves - 1, count) for count in self.shape)
        wide = map_coordinates(small, np.meshgrid(np.arange(4 * waves), columns, indexing="ij"), order=3)
        full = map_coordinates(wide, np.meshgrid(rows, np.arange(len(columns)), indexing="ij"), order=1)
        return ((full - full.mean()) / full.std()).astype(np.float32)

    def patches(self, share: float, waves: int, soft: float) -> Texture:
        """Return patches that cover a share of the image: 1 within, 0 outside, with an edge of some softness."""
        field = self.field(waves)
        limit = np.quantile(field, 1 - share)
        return np.clip(0.5 + (field - limit) / max(4 * soft, 1e-3), 0, 1)


def lonlat(ground: ArrayLike) -> Array:
    """Return map points ``(N, 3)`` as longitude, latitude, height."""
    x, y, height = np.asarray(ground, dtype=float).T
    return np.column_stack([*to_lonlat().transform(x, y), height])


@lru_cache(maxsize=8)
def transformer(source: str, target: str) -> pyproj.Transformer:
    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def to_lonlat() -> pyproj.Transformer:
    return transformer(UTM, "EPSG:4326")


def write_raster(
    path: Path, bands: list[Any], dtype: str, *, place: tuple[float, ...] | None = None, crs: str | None = None,
    rpc: RPC | None = None, nodata: float | None = 0.0,
) -> None:  # fmt: skip
    """Write bands of tone as a GeoTIFF; NaN is nodata."""
    kind, low, gain = TYPES[dtype]
    rows, columns = bands[0].shape
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, len(bands), kind)
    if place is not None:
        dataset.SetGeoTransform(place)
    if crs is not None:
        reference = osr.SpatialReference()
        reference.SetFromUserInput(crs)
        dataset.SetSpatialRef(reference)
    if rpc is not None:
        dataset.SetMetadata(rpc_metadata(rpc), "RPC")
    for number, band in enumerate(bands, start=1):
        values = band
        if dtype != "float32":
            top = 255 if dtype == "uint8" else 65535
            values = np.where(np.isfinite(band), np.clip(np.rint(low + gain * band), 1, top), 0)
        if nodata is not None:
            dataset.GetRasterBand(number).SetNoDataValue(nodata)
        dataset.GetRasterBand(number).WriteArray(values.astype(dtype))
    dataset = None
