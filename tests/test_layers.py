"""The architecture, held by reading the imports: docs/architecture.md says why."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "ortho_pipeline"

#: A module imports only from lines above its own.
LAYERS = """
errors options
locations
files
geoid_grid
crs geometry notebook compiled allowance voids
point_table datum
point_csv point_geojson point_lists point_ground
point_files
points
models least_squares statistics
problem block_points ground_frame
ridge block_steps block_system intersection
blunders block_solver report_text
block_variance
registration estimation hookspecs swaps model_file kernels lattice_kernel ray_kernel landscape rpc_files
block_blunders
model_choice block_checks selection ground_error drawing contract control_hull
comparison report_plots adjustment covariance map_scale delivered
gate
raster
raster_output
raster_writer
rpc dem preview edge outline crop stack
plugins rays gdal_engine resolution ellipse
footprint lattice simulate inputs testing dem_accuracy
gcp_export scene_fit warp mosaic
scene_layout
report experiments stac block_images results
pipeline block_report
studies bands batch_config batch_manifest executors
batch_plan
blocks batch
cli_command
cli_options cli_text
cli_studies cli_blocks cli_batch
cli
"""
LINE = {name: number for number, line in enumerate(LAYERS.split("\n")) for name in line.split()}
GDAL_MODULES = {"locations", "gate", "raster", "raster_output", "raster_writer", "dem", "mosaic", "plugins"}
GDAL_MODULES |= {"rpc", "stack", "gcp_export", "gdal_engine"}
NUMBA_MODULES = {"compiled"}
MAX_LINES, MAX_FUNCTION = 600, 50

FILES = sorted(PACKAGE.rglob("*.py"))
PLUGIN_FILES = sorted((ROOT / "plugins").rglob("*.py"))


def module_of(path: Path) -> str:
    """Return the name that stands in LAYERS: the module, or the folder that it lies in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(tree: ast.AST) -> Iterator[tuple[str, bool]]:
    """Yield each imported module (dotted) and whether it is imported at the top level of the file."""
    top = set(ast.iter_child_nodes(tree))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node in top
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the layer"
            if node.module == "ortho_pipeline":
                for alias in node.names:
                    yield f"ortho_pipeline.{alias.name}", node in top
            else:
                yield str(node.module), node in top


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_upwards(path: Path) -> None:
    name = module_of(path)
    if name in ("__init__", "__main__"):
        return
    assert name in LINE, f"{name} has no place in LAYERS: where does it belong?"
    for imported, _ in imports(parse(path)):
        parts = imported.split(".")
        if parts[0] != "ortho_pipeline" or parts[1] == name:
            continue
        assert LINE[parts[1]] < LINE[name], f"{name} imports {parts[1]}, which is not above it"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_heavy_libraries_stay_where_they_belong(path: Path) -> None:
    name = module_of(path)
    for imported, at_top in imports(parse(path)):
        library = imported.split(".")[0]
        if library == "osgeo":
            assert name in GDAL_MODULES, f"{name} imports GDAL"
        if library == "numba":
            assert name in NUMBA_MODULES, f"{name} imports numba"
        if library == "matplotlib":
            assert (name, at_top) == ("drawing", False), f"{name}: matplotlib only inside functions of drawing"


def test_the_package_itself_imports_nothing_of_its_own() -> None:
    heavy = {"numpy", "scipy", "numba", "osgeo", "pyproj", "matplotlib", "ortho_pipeline"}
    assert not [name for name, _ in imports(parse(PACKAGE / "__init__.py")) if name.split(".")[0] in heavy]


def test_the_command_line_defers_heavy_imports() -> None:
    names = ("errors", "options", "cli_command", "cli_options", "cli_text", "cli_studies", "cli_blocks", "cli_batch")
    light = {f"ortho_pipeline.{name}" for name in names}
    for path in PACKAGE.glob("cli*.py"):
        for imported, at_top in imports(parse(path)):
            if at_top and imported.startswith("ortho_pipeline"):
                assert imported in light


@pytest.mark.parametrize("path", FILES + PLUGIN_FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_grows_too_long(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count("\n") <= MAX_LINES
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert code_lines(node) <= MAX_FUNCTION, f"{node.name} has {code_lines(node)} lines"


def code_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function without its signature and docstring."""
    body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
    return 0 if not body else (node.end_lineno or 0) - body[0].lineno + 1


def test_no_drawer_for_everything() -> None:
    assert not [path for path in FILES if path.stem in ("utils", "util", "helpers", "misc", "common")]


def test_starting_a_command_loads_nothing_that_few_need() -> None:
    # Each of these takes as long as all the rest.
    heavy = (
        "scipy.interpolate",
        "scipy.optimize",
        "scipy.stats",
        "skimage",
        "matplotlib",
        "dask",
        "pystac",
        "pydantic",
    )
    code = f"import sys, ortho_pipeline.pipeline; print(*[name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
