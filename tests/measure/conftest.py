"""An orthoimage of the sample scene's place, of its known landscape and with no other error, and the scene's truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from ortho_measure import planning
from ortho_measure.block.session import open_block_session
from ortho_measure.project import Project
from ortho_measure.session import open_session
from ortho_studies.simulation.scanner import LineScanner
from ortho_studies.simulation.terrain import Landscape, Terrain
from osgeo import gdal, osr

from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.options import MatchOptions, SurfaceOptions

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
_PIXEL, _SIDE = 2.5, 1360


@dataclass(frozen=True)
class Truth:
    """The camera of the sample, its terrain and landscape."""

    camera: LineScanner
    terrain: Terrain

    def image_of(self, ground: np.ndarray) -> np.ndarray:
        """Return where the camera has ground ``(N, 3)`` in longitude, latitude and ellipsoidal height."""
        return self.camera.ground_to_image(ground_transform("EPSG:4979", self.camera.crs)(np.asarray(ground)))

    def ground_at(self, image: np.ndarray, rounds: int = 40) -> np.ndarray:
        """Return the true ground ``(N, 3)`` of image points, lon, lat, h; each round is some ten times as near."""
        height = np.full(len(image), 850.0)
        for _ in range(rounds):
            ground = ground_transform(self.camera.crs, "EPSG:4979")(self.camera.image_to_ground(image, height))
            height = self.terrain(ground[:, 0], ground[:, 1])
        return np.column_stack([ground[:, :2], height])


@pytest.fixture(scope="session", autouse=True)
def structure_is_found_once() -> Iterator[None]:
    """Look for the structure of an image once, and not for every session that is opened on it."""
    found, first = planning.candidates, {}

    def candidates(view, region, cells, size, factor, inside):
        path = Path(view.intensity.source.path)
        key = (path, path.stat().st_mtime_ns, view.intensity.bands, region, cells, size, factor, inside.tobytes())
        if key not in first:
            first[key] = found(view, region, cells, size, factor, inside)
        return first[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "candidates", candidates)
        yield


@pytest.fixture(scope="session")
def truth() -> Truth:
    return truth_of_sample()


def truth_of_sample() -> Truth:
    """Return the truth that the sample data came from."""
    document = json.loads((SAMPLE / "truth.json").read_text())
    camera = {key: tuple(value) if isinstance(value, list) else value for key, value in document["camera"].items()}
    camera.pop("kind")
    return Truth(LineScanner(**camera), Terrain(**document["terrain"]))


#: Places of the scene (px) with structure; about them the quick reference has pixels.
FEATURES = np.array([(200, 200), (800, 220), (500, 500), (240, 800), (780, 790), (150, 500)], dtype=float)
_PATCH = 120


@pytest.fixture(scope="session")
def features() -> np.ndarray:
    return FEATURES


@pytest.fixture(scope="session")
def reference(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ortho of the landscape itself about `FEATURES`: no camera and no DEM had a part in it."""
    path = tmp_path_factory.mktemp("reference") / "reference.tif"
    write_reference(truth, path, FEATURES)
    return path


@pytest.fixture(scope="session")
def whole_reference(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of the whole scene, which takes a while."""
    path = tmp_path_factory.mktemp("reference") / "whole.tif"
    write_reference(truth, path)
    return path


def write_reference(truth: Truth, path: Path, about: np.ndarray | None = None) -> None:
    """Write the landscape as an ortho, about some image points only if they are given."""
    terrain = truth.terrain
    left, top = terrain.x0 - _SIDE * _PIXEL / 2, terrain.y0 + _SIDE * _PIXEL / 2
    landscape = Landscape(terrain, _PIXEL, seed=7)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), _SIDE, _SIDE, 1, gdal.GDT_Byte, ["TILED=YES"])
    system = osr.SpatialReference()
    system.ImportFromEPSG(32636)
    dataset.SetProjection(system.ExportToWkt())
    dataset.SetGeoTransform((left, _PIXEL, 0, top, 0, -_PIXEL))
    band = dataset.GetRasterBand(1)
    band.SetNoDataValue(0)
    windows = [(0, first, _SIDE, 80) for first in range(0, _SIDE, 80)]
    if about is not None:
        xy = terrain.xy(*truth.ground_at(about)[:, :2].T)
        middle = np.round((xy - (left, top)) / (_PIXEL, -_PIXEL)).astype(int)
        windows = [(column - _PATCH, row - _PATCH, 2 * _PATCH, 2 * _PATCH) for column, row in middle.tolist()]
    for column, row, width, height in windows:
        x = left + (column + np.arange(width) + 0.5) * _PIXEL
        y = top - (row + np.arange(height) + 0.5) * _PIXEL
        x, y = np.meshgrid(x, y)
        values = landscape(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
        band.WriteArray(np.round(1 + values * 250).astype(np.uint8), column, row)
    dataset = None


#: What the RPC of the second scene is off by (px), and half the side of what is there about each feature.
SECOND_BIAS, _SEEN = np.array([-3.0, 5.0]), 60


@dataclass(frozen=True)
class Stereo:
    """A second scene of the same ground, from the other side: its file and its truth."""

    path: Path
    truth: Truth


@pytest.fixture(scope="session")
def third(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Stereo:
    """One more from nearly above."""
    path = tmp_path_factory.mktemp("third") / "third.tif"
    return write_second(truth, path, FEATURES, off_nadir_deg=3.0, bias=np.array([4.0, 2.0]))


@pytest.fixture(scope="session")
def stereo(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Stereo:
    path = tmp_path_factory.mktemp("stereo") / "second.tif"
    return write_second(truth, path, FEATURES)


@pytest.fixture(scope="session")
def whole_stereo(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Stereo:
    """The same with all its pixels, which takes a while."""
    return write_second(truth, tmp_path_factory.mktemp("stereo") / "second.tif")


def write_second(
    truth: Truth, path: Path, about: np.ndarray | None = None, *, off_nadir_deg: float = -14.0,
    bias: np.ndarray = SECOND_BIAS,
) -> Stereo:  # fmt: skip
    """Write a scene from 14 degrees on the other side, with a biased RPC; only about features if they are given."""
    camera = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=off_nadir_deg, heights=(600.0, 1200.0))
    second = Truth(camera, truth.terrain)
    landscape = Landscape(truth.terrain, _PIXEL, seed=7)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), camera.width, camera.height, 1, gdal.GDT_Byte)
    step = 2 * _SEEN
    if about is None:
        corners = [(column, row) for column in range(0, 980, step) for row in range(0, 980, step)]
    else:
        corners = (np.round(second.image_of(truth.ground_at(about))).astype(int) - _SEEN).tolist()
    for column, row in corners:
        left, top = max(column, 0), max(row, 0)
        width, height = min(column + step, camera.width) - left, min(row + step, camera.height) - top
        columns, rows = np.meshgrid(left + np.arange(width) + 0.5, top + np.arange(height) + 0.5)
        ground = second.ground_at(np.column_stack([columns.ravel(), rows.ravel()]), rounds=4)
        values = landscape(truth.terrain.xy(*ground[:, :2].T)).reshape(height, width)
        dataset.GetRasterBand(1).WriteArray(np.round(1 + values * 250).astype(np.uint8), left, top)
    dataset = None
    centre, half = camera.domain
    box = *(centre - 1.02 * half)[:2].tolist(), *(centre + 1.02 * half)[:2].tolist()
    rpc = fit_rpc(camera, box, (600.0, 1200.0)).rpc
    column, row = bias
    write_rpc_txt(
        replace(rpc, col_off=rpc.col_off - column, row_off=rpc.row_off - row), path.with_name(f"{path.stem}_RPC.TXT")
    )
    return Stereo(path, second)


def opened_projects(
    folder: Path, reference: Path | None = None, second: Path | None = None
) -> list[Callable[[], Project]]:
    """Return what opens, and opens again, a project of one image and one of two."""
    truth = truth_of_sample()
    if reference is None or second is None:
        reference, second = folder / "reference.tif", folder / "second.tif"
        write_reference(truth, reference, FEATURES)
        write_second(truth, second, FEATURES)
    given = {"surface": SurfaceOptions(dem=SAMPLE / "dem.tif"), "match": MatchOptions(reference=(str(reference),))}
    scene = SAMPLE / "scene.tif"
    return [
        partial(open_session, scene, folder / "one.geojson", **given),
        partial(open_block_session, [scene, second], folder / "two.geojson", **given),
    ]


@pytest.fixture
def projects(reference: Path, stereo: Stereo, tmp_path: Path) -> list[Callable[[], Project]]:
    return opened_projects(tmp_path, reference, stereo.path)
