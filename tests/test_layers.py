"""The architecture, held by reading the imports: docs/architecture.md says why.

`python tests/test_layers.py` writes the table of rooms into that page.
"""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from house import House

from ortho_pipeline.estimation.choice import comparison
from ortho_pipeline.models.correction import FREE
from ortho_pipeline.options import CORRECTIONS, RESAMPLING, BlockOptions, options_of
from ortho_pipeline.options.flags import FLAGGED
from ortho_pipeline.warp import job

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "ortho_pipeline"

#: Rooms, and modules that stand between them, bottom to top: each imports only itself and what is on lines above.
ROOMS = """
errors
options
files
runtime
stores
display
geodesy
points
models
estimation
hookspecs
raster
surface
exchange
host
testing
imaging
block
warp
report
commands
batch
cli
plugin
"""
#: Packages that add commands, with their rooms in the same order. They import the host; studies import sensors, too.
ADDED = {
    "ortho_measure": """
marks journal solution
places
planning proposals
project
session block
serving
cli
""",
    "ortho_studies": """
hookspecs simulation
bilsat cartosat ikonos orbview3
studies
cli
""",
}
#: A sensor that imports another package, and why: cameras of Ames Stereo Pipeline are CSM states, too.
NEIGHBOURS = {("ortho_asp", "ortho_csm")}


def lines_of(rooms: str) -> dict[str, int]:
    """Return the line on which each name stands."""
    return {name: number for number, line in enumerate(rooms.split("\n")) for name in line.split()}


LINE = lines_of(ROOMS)
#: Where GDAL, numba and matplotlib are imported.
GDAL_MODULES = {
    "files.locations",
    "files.traffic",
    "raster.opening.drivers",
    "raster.opening.gate",
    "raster.opening.references",
    "raster.caching.block_cache",
    "raster.source",
    "raster.stored_crs",
    "raster.intensity",
    "raster.verified_writing",
    "raster.pixel_types",
    "raster.ortho",
    "raster.regridded",
    "raster.pansharpened",
    "surface.dem_file",
    "testing",
}
GDAL_MODULES |= {
    "surface.writing",
    "exchange.rpc",
    "exchange.gcp",
    "exchange.moved_grid",
    "exchange.export",
    "imaging.band_stack",
    "warp.mosaic.writing",
    "warp.gdal_engine",
}
NUMBA_MODULES = {"runtime.compilation.compiler"}
MATPLOTLIB_MODULES = {"report.notebook.charts", "display.drawing"}
MAX_ENTRIES, MAX_MODULES, MAX_LINES, MAX_CLASS, MAX_FUNCTION, MAX_PARAMETERS = 27, 12, 500, 250, 50, 12

FILES = sorted(PACKAGE.rglob("*.py"))
PLUGIN_FILES = sorted((ROOT / "plugins").rglob("*.py"))
PLUGINS = {path.name for path in (ROOT / "plugins").iterdir() if path.is_dir()}


def module_of(path: Path) -> str:
    """Return the dotted name of a module below the host, or the whole name of one in `/plugins`."""
    start = PACKAGE if path.is_relative_to(PACKAGE) else ROOT / "plugins"
    return ".".join(path.relative_to(start).with_suffix("").parts)


def room_of(module: str) -> str:
    """Return the name that stands in ROOMS: the room, or a module that stands between rooms."""
    return module.partition(".")[0]


@functools.cache
def imports(path: Path) -> tuple[tuple[str, bool], ...]:
    """Return each imported module (dotted) and whether it is imported at the top level of the file."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[str, bool]]:
    top = set(ast.iter_child_nodes(parse(path)))
    for node in nodes(path):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node in top
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide the room"
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                yield inside if is_module(inside) else str(node.module), node in top


def is_module(dotted: str) -> bool:
    """Whether a dotted name is a module or a room of the host or of a package in `/plugins`."""
    start, *inside = dotted.split(".")
    path = (PACKAGE if start == PACKAGE.name else ROOT / "plugins" / start).joinpath(*inside)
    return path.is_dir() or path.with_suffix(".py").is_file()


@functools.cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(parse(path)))


def test_what_a_user_may_choose_is_what_there_is() -> None:
    """`options` is read before NumPy is there, so it repeats these names."""
    assert CORRECTIONS == (*FREE, "model") == (*comparison.CORRECTIONS, "model")
    assert tuple(job.KERNELS) == RESAMPLING


def test_imports_point_upwards() -> None:
    for path in FILES:
        room = room_of(module_of(path))
        if room in ("__init__", "__main__"):
            continue
        assert room in LINE, f"{room} has no place in ROOMS: where does it belong?"
        for imported, _ in imports(path):
            parts = imported.split(".")
            assert parts[0] not in PLUGINS, f"{path.name} imports {imported}: the host knows no plugin by name"
            if parts[0] == "ortho_pipeline" and parts[1:2] not in ([], [room]):
                assert LINE[parts[1]] < LINE[room], f"{module_of(path)} imports {imported}, which is not below {room}"


def test_packages_stand_above_the_host_and_know_no_other() -> None:
    for path in PLUGIN_FILES:
        package, *inside = path.relative_to(ROOT / "plugins").with_suffix("").parts
        lines = lines_of(ADDED.get(package, ""))
        for imported, _ in imports(path):
            other, *rooms = imported.split(".")
            if other in PLUGINS and other != package and (package, other) not in NEIGHBOURS:
                assert package == "ortho_studies", f"{path.name} imports {imported}: packages know the host alone"
                assert other not in ADDED, f"{path.name} imports {imported}: studies know the host and sensors"
            elif other == package and lines and rooms and rooms[0] != inside[0]:
                assert lines[rooms[0]] < lines[inside[0]], f"{path} imports {imported}, which is not below"


def test_packages_that_add_commands_only_declare_them() -> None:
    for package in ADDED:
        found = {name for name, _ in imports(ROOT / "plugins" / package / "__init__.py")}
        assert found == {"collections.abc", "ortho_pipeline.plugin"}, f"{package}: ortho --help imports this"


def test_no_circle_of_imports() -> None:
    assert House(ROOT).circles(deferred=False) == []


def test_heavy_libraries_stay_where_they_belong() -> None:
    every = FILES + PLUGIN_FILES
    for name, imported, at_top in ((module_of(path), *one) for path in every for one in imports(path)):
        library = imported.split(".")[0]
        if library == "osgeo" and not name.startswith("ortho_"):
            assert name in GDAL_MODULES, f"{name} imports GDAL"
        assert library != "osgeo" or not name.startswith("ortho_measure"), f"{name} imports GDAL"
        if library == "numba":
            assert name in NUMBA_MODULES, f"{name} imports numba"
        if library in ("starlette", "uvicorn"):
            assert name == "ortho_measure.serving.server", f"{name} imports {library}: only the server does"
            assert not at_top, f"{name}: {library} is an extra, and only loaded inside functions"
        if imported == "fcntl":
            assert name == "files.locks", f"{name} imports fcntl: locks of files are files.Lock"
        if library == "jinja2":
            assert name == "display.pages", f"{name} imports jinja2: pages are rendered by display/pages.py"
        if library == "matplotlib":
            assert name in MATPLOTLIB_MODULES, f"{name} imports matplotlib"
            assert not at_top, f"{name}: matplotlib only inside functions"


def test_pools_of_threads_are_made_in_one_place() -> None:
    made = {
        module_of(path)
        for path in FILES + PLUGIN_FILES
        for node in nodes(path)
        if isinstance(node, ast.Call) and "ThreadPoolExecutor" in ast.unparse(node.func)
    }
    assert made == {"runtime.process_limits"}, "process_limits.thread_pool asks how many threads there can be"


def test_the_package_itself_imports_only_what_loads_its_names() -> None:
    heavy = {"numpy", "scipy", "numba", "osgeo", "pyproj", "matplotlib", "ortho_pipeline"}
    top = [name for name, at_top in imports(PACKAGE / "__init__.py") if at_top]
    assert [name for name in top if name.split(".")[0] in heavy] == ["ortho_pipeline.runtime.lazy_names"]


def test_sensors_and_formats_import_the_host_from_one_module() -> None:
    for path in PLUGIN_FILES:
        where = path.relative_to(ROOT / "plugins")
        if where.parts[0] not in ADDED:
            hosts = {name for name, _ in imports(path) if name.partition(".")[0] == "ortho_pipeline"}
            assert hosts <= {"ortho_pipeline.plugin"}, f"{where} imports {hosts}: name what it needs in plugin.py"


def test_the_host_imports_nothing_from_the_door_of_plugins() -> None:
    for path in FILES:
        assert "ortho_pipeline.plugin" not in {name for name, _ in imports(path)}, f"{path}: name the room"


def test_the_command_line_defers_heavy_imports() -> None:
    for path in (*(PACKAGE / "cli").glob("*.py"), *(ROOT / "plugins" / package / "cli.py" for package in ADDED)):
        for imported, at_top in imports(path):
            if at_top and imported.startswith("ortho_"):
                assert imported.split(".")[1] in ("cli", "errors", "options"), f"{path.name} imports {imported}"


def test_nothing_grows_too_long() -> None:
    for path in FILES + PLUGIN_FILES:
        where = path.relative_to(ROOT)
        assert path.read_text(encoding="utf-8").count("\n") <= MAX_LINES, f"{where}: split it"
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert code_lines(node) <= MAX_FUNCTION, f"{where}: {node.name} has {code_lines(node)} lines"
                assert parameters(node) <= MAX_PARAMETERS, f"{where}: {node.name} has {parameters(node)} parameters"
            elif isinstance(node, ast.ClassDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                assert lines <= MAX_CLASS, f"{where}: {node.name} has {lines} lines"


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the parameters of a function without `self` and `cls`."""
    given = node.args
    names = [one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg) if one]
    return len([name for name in names if name not in ("self", "cls")])


def code_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function without its signature and docstring."""
    body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
    return 0 if not body else (node.end_lineno or 0) - body[0].lineno + 1


def test_rooms_are_few_and_small() -> None:
    assert len([path for path in PACKAGE.iterdir() if path.name != "__pycache__"]) <= MAX_ENTRIES
    for folder in {path.parent for path in FILES + PLUGIN_FILES}:
        assert len(list(folder.glob("*.py"))) <= MAX_MODULES, f"{folder.name} is full"


#: Private names of other packages that are used, and why.
PRIVATE = {
    # A documented function: the watch over a worker whose parent is gone ends it without unwinding.
    "os._exit",
    # numba has no other way to give a function a cache whose folder was checked.
    "made._cache",
}


def test_nothing_private_of_other_packages_is_used() -> None:
    assert {name for _, _, name in House(ROOT).private_names()} == PRIVATE


def test_no_drawer_for_everything() -> None:
    assert not [path for path in FILES + PLUGIN_FILES if path.stem in ("utils", "util", "helpers", "misc", "common")]


def table() -> str:
    """Return the table of rooms as it stands in docs/architecture.md."""
    rows = ["| room | what lives there |", "|---|---|"]
    for line in ROOMS.split("\n"):
        for name in line.split():
            path = PACKAGE / name
            file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
            doc = (ast.get_docstring(parse(file)) or "").split("\n\n")[0].replace("\n", " ")
            rows.append(f"| `{name}{'/' if path.is_dir() else '.py'}` | {doc} |")
    return "\n".join(rows)


MARKS = re.compile(r"(<!-- rooms -->\n).*?(\n<!-- end of rooms -->)", re.DOTALL)


def test_the_map_of_the_house_is_true() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    found = MARKS.search(page)
    assert found
    assert found[0] == f"{found[1]}{table()}{found[2]}", "write it again: python tests/test_layers.py"


#: Whole command lines, of this program and of others, which are typed as they are.
COMMAND_LINE = re.compile(
    r"\b(ortho (adjust|align|doctor|fit|measure|rectify|run|sensors|sharpen)|pyproj sync|projsync|gdal_calc\.py|"
    r"mapproject|parallel_stereo|point2dem|dem_mosaic) "
)


def texts(path: Path) -> Iterator[str]:
    """Yield the strings of a module but docstrings; of a formatted one what is between its values, joined by blanks."""
    skipped: set[ast.AST] = set()
    for node in nodes(path):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            skipped.add(node.value)
        if isinstance(node, ast.JoinedStr):
            skipped |= set(node.values)
            yield " ".join(str(one.value) for one in node.values if isinstance(one, ast.Constant))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in skipped:
            yield node.value


def test_messages_name_options_by_their_fields() -> None:
    words = {"cli", "options"}
    paths = [path for path in FILES + PLUGIN_FILES if not words & {*path.relative_to(ROOT).parts, path.stem}]
    for where, text in ((path.relative_to(ROOT), text) for path in paths for text in texts(path)):
        typed = re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)
        if where.name != "study.py":  # the switches of a study are its own to name
            assert not typed or COMMAND_LINE.search(text), f"{where}, {typed}: a flag is the command line's"
        assert not re.search(r"`(scene|points|surface|match|output|stack)\.", text), f"{where}: {text!r}, not a Setting"
    for where, call in ((path, node) for path in paths for node in nodes(path)):
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Setting"):
            continue
        group, _, name = str(getattr(call.args[0], "value", "")).partition(".")
        if name:
            known = {**options_of(FLAGGED[group]), **(options_of(BlockOptions) if group == "points" else {})}
            assert name in known, f"{where}: there is no option {group}.{name}"


def test_the_page_on_where_to_change_what_names_files_that_exist() -> None:
    page = (ROOT / "docs" / "engineering" / "where-to-change.md").read_text(encoding="utf-8")
    paths = {path for path in re.findall(r"`([\w./]+/[\w.]*|[\w/]+/\w+\.\w+)`", page) if not path.startswith("/")}
    assert len(paths) > 60
    missing = [path for path in paths if not any((at / path).exists() for at in (ROOT, PACKAGE))]
    assert missing == []


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
    code = f"import sys, ortho_pipeline.commands; print(*[name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


if __name__ == "__main__":
    page = ROOT / "docs" / "architecture.md"
    page.write_text(MARKS.sub(lambda found: found[1] + table() + found[2], page.read_text(encoding="utf-8")))
