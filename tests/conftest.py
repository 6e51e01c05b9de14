"""What the tests share: where the real scenes are, and a tiny scene whose every number is known."""

from __future__ import annotations

import gc
import importlib.util
import os
import signal
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
from osgeo import gdal, osr
from real_data import data_folder

from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.models import RPC
from ortho_pipeline.runtime.compiled import Kernel

# A shell that starts the tests in the background has its children ignore Ctrl-C; what the tests start must not.
for _number, _action in (
    (signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL), (signal.SIGHUP, signal.SIG_DFL),
):  # fmt: skip
    if signal.getsignal(_number) == signal.SIG_IGN:
        signal.signal(_number, _action)

# Tests start hundreds of processes: each would compile all modules again where the environment forbids to keep them.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Files of tests need not survive a power failure, and each wait for the disk takes milliseconds.
os.fsync = lambda _: None

ROOT = Path(__file__).resolve().parent.parent
REAL = data_folder()
SAMPLE = ROOT / "sample_data"
#: The longest tests begin first: otherwise one process runs them at the end, and the others wait.
LONG = "test_tutorials.py", "test_notebooks.py", "test_browser.py", "test_workers.py"

# The same few examples in every run. To search for more: `pytest --hypothesis-profile=search -k round_trip`.
_QUIET = {
    "deadline": None,
    "database": None,
    "suppress_health_check": [
        # The files of one example are written over by the next.
        hypothesis.HealthCheck.function_scoped_fixture,
        hypothesis.HealthCheck.too_slow,
    ],
}
hypothesis.settings.register_profile("tests", derandomize=True, max_examples=10, **_QUIET)
hypothesis.settings.register_profile("search", max_examples=2000, **_QUIET)
hypothesis.settings.load_profile("tests")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in LONG)
    for item in items:
        for mark in item.iter_markers("driver"):
            if gdal.GetDriverByName(mark.args[0]) is None:
                item.add_marker(pytest.mark.skip(reason=f"this GDAL was built without {mark.args[0]}"))
    if REAL.is_dir():
        return
    skip = pytest.mark.skip(reason=f"the real scenes are not here: there is no {REAL} (`make real-data` fetches them)")
    for item in items:
        if "realdata" in item.keywords:
            item.add_marker(skip)


def pytest_collection_finish() -> None:
    """Exempt modules and tests, which stay anyway, from every later search for garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def real() -> Path:
    """Folder of the real scenes; tests that use it carry the marker `realdata`."""
    return REAL


@pytest.fixture(scope="session")
def benchmark_module() -> Callable[[str], Any]:
    """Return a function that loads a module of benchmarks/ by its name."""

    def load(name: str) -> Any:
        path = Path(__file__).parents[1] / "benchmarks" / f"{name}.py"
        spec = importlib.util.spec_from_file_location(f"benchmarks_{name}", path)
        assert spec is not None
        assert spec.loader is not None
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def sample() -> Path:
    """Folder of the simulated sample scene."""
    return SAMPLE


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Have the kernels of modules run as plain Python, where an index outside of an array is an error."""

    def interpret(*modules: Any) -> None:
        for module in modules:
            for name, value in list(vars(module).items()):
                if isinstance(value, Kernel):
                    monkeypatch.setattr(module, name, value.py_func)

    return interpret


class Calls:
    """Counts the calls of functions, Python's and C's, within a `with`: work that is the same on every machine.

    What one call does inside of a compiled library is not seen; that is for `benchmarks/`.
    """

    count = 0

    def __enter__(self) -> Calls:
        sys.setprofile(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def _called(self, frame: object, event: str, argument: object) -> None:
        self.count += event in ("call", "c_call")


@pytest.fixture
def calls() -> Calls:
    """Count calls: ``with calls: job()``, then `calls.count`."""
    return Calls()


@dataclass(frozen=True)
class Tiny:
    """A 400 x 300 scene of 4.8 m pixels with an RPC, flat-ish DEM and points, in a folder of its own."""

    folder: Path
    model: RPC
    bias: tuple[float, float] = (3.0, -2.0)
    width: int = 400
    height: int = 300

    @property
    def image(self) -> Path:
        return self.folder / "tiny.tif"

    @property
    def dem(self) -> Path:
        return self.folder / "dem.tif"

    @property
    def gcps(self) -> Path:
        return self.folder / "gcps.csv"

    def points(self, count: int, noise: float = 0.1) -> list[tuple[str, float, float, float, float, float]]:
        """Return rows (id, col, row, lon, lat, h) of control points that carry the bias and `noise` pixels."""
        random = np.random.default_rng(3)
        ground = np.column_stack(
            [
                self.model.lon_off + 0.8 * self.model.lon_scale * random.uniform(-1, 1, count),
                self.model.lat_off + 0.8 * self.model.lat_scale * random.uniform(-1, 1, count),
                random.uniform(460, 540, count),
            ]
        )
        image = self.model.ground_to_image(ground) + self.bias + random.normal(0, noise, (count, 2))
        return [(f"p{i}", *image[i].tolist(), *ground[i].tolist()) for i in range(count)]

    def write(self, path: Path, rows: Iterable[tuple[object, ...]], header: str = "id,col,row,x,y,h") -> Path:
        """Write rows as CSV."""
        path.write_text("\n".join([header, *(",".join(str(value) for value in row) for row in rows)]) + "\n")
        return path

    def write_dem(self, path: Path | None = None, share: float = 1.0) -> Path:
        """Write a DEM of heights around 500 m in UTM 34S that covers the western `share` of scene and margin."""
        step, columns, rows = 30.0, int(130 * share), 130
        wgs84 = osr.SpatialReference()
        wgs84.ImportFromEPSG(4326)
        wgs84.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
        utm = osr.SpatialReference()
        utm.ImportFromEPSG(32734)
        x, y, _ = osr.CoordinateTransformation(wgs84, utm).TransformPoint(self.model.lon_off, self.model.lat_off)
        west, north = round(x) - 65 * step, round(y) + 65 * step
        grid_x, grid_y = np.meshgrid(west + step * (np.arange(columns) + 0.5), north - step * (np.arange(rows) + 0.5))
        dataset = gdal.GetDriverByName("GTiff").Create(str(path or self.dem), columns, rows, 1, gdal.GDT_Float32)
        dataset.SetGeoTransform((west, step, 0, north, 0, -step))
        dataset.SetSpatialRef(utm)
        dataset.WriteArray((500 + 20 * np.sin(grid_x / 300) + 0 * grid_y).astype(np.float32))
        dataset = None
        return path or self.dem


@pytest.fixture
def tiny(tmp_path: Path) -> Tiny:
    """Make the tiny scene in a folder of its own; the test may add to it."""
    made = Tiny(tmp_path / "tiny", _tiny_model())
    made.folder.mkdir()
    _write_tiny_image(made)
    made.write_dem()
    made.write(made.gcps, made.points(12))
    return made


def _tiny_model() -> RPC:
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 3]], row[[2, 3]] = (1.0, 0.05), (-1.0, 0.02)
    return RPC(200.0, 150.0, 20.0, -30.0, 500.0, 200.0, 150.0, 0.01, 0.0065, 500.0, col, one, row, one)


def _write_tiny_image(made: Tiny) -> None:
    row, col = np.mgrid[0 : made.height, 0 : made.width]
    pixels = (1000 + 300 * np.sin(col / 7) * np.cos(row / 9)).astype(np.uint16)
    dataset = gdal.GetDriverByName("GTiff").Create(str(made.image), made.width, made.height, 1, gdal.GDT_UInt16)
    dataset.SetMetadata(rpc_metadata(made.model), "RPC")
    dataset.WriteArray(pixels)
    dataset = None


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a distribution with one plugin module."""
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    modules = []

    def installed(distribution, module, source, entry=None, group="ortho_pipeline"):
        info = tmp_path / "site" / f"{distribution.replace('-', '_')}-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{entry or module} = {module}\n")
        (tmp_path / "site" / f"{module}.py").write_text(source)
        modules.append(module)

    yield installed
    for module in modules:
        sys.modules.pop(module, None)
