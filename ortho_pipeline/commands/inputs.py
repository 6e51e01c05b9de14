"""Inputs of a command: the scene, the surface, the points; the paths it may write; and the record of all that."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyproj

from ortho_pipeline import plugins
from ortho_pipeline.commands.heights.surfaces import dem_files, sigma_file
from ortho_pipeline.commands.stac.given import is_collected
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.exchange import crop
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.exchange.rpc import files_of
from ortho_pipeline.files import allowed, sha256, states
from ortho_pipeline.files.documents import software_version
from ortho_pipeline.files.locations import archive_of, is_far, located
from ortho_pipeline.files.process_limits import startable_threads
from ortho_pipeline.files.traffic import bytes_read
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.raster import source as raster
from ortho_pipeline.surface.base import Surface

#: Side-cars that GDAL would attach to an image of this stem, whatever the image itself says.
SIDE_CARS = ("_RPC.TXT", "_rpc.txt", ".RPB", ".rpb", "_metadata.txt", ".IMD")
#: The same, after the whole name of the image.
ATTACHED = (".aux.xml", ".ovr", ".msk")
#: In place of a file of points: the ground control points that the image itself holds.
OWN_POINTS = "own"
#: Options that stand in a record only where they were given: without them, files of the same job keep their bytes.
_IF_GIVEN = ("like", "reference_bands", "search_rotation")
#: Name of the "sensor" of an image that has no model of its own.
POINTS_ONLY = "points only"


# -- opening ---------------------------------------------------------------------------------------------------------


def open_scene(image: str | os.PathLike[str], options: SceneOptions = SceneOptions()) -> Scene:
    """Open an image with its sensor, or with the model of a model file; a scene that is open already stays as it is.

    Raises
    ------
    InputError
        If no sensor recognises the image, the model file belongs to an image of another size, or options say how to
        open what is open.
    """
    if isinstance(image, Scene):
        if dataclasses.replace(options, allow_network=False, roots=()) != SceneOptions():
            raise InputError(
                "this scene is open already", file=image, field="scene", remedy="give its path, or open it so"
            )  # fmt: skip
        return image
    if options.model is None:
        given: dict[str, Any] = dict(options.sensor_options)
        if options.rpc is not None:
            if "rpc" in given:
                raise InputError(
                    "the RPC is chosen twice", field="scene.rpc", remedy="leave out `scene.sensor_options.rpc=...`"
                )
            given["rpc"] = options.rpc
        given = {name: _perhaps_elsewhere(value, options.allow_network) for name, value in given.items()}
        return plugins.open_scene(image, options.sensor, given, crop_offset=options.crop_offset, **options.access)
    if options.rpc is not None or options.sensor is not None or options.sensor_options:
        raise InputError(
            "a model file takes the place of the image's model", field="scene.model",
            remedy="leave out `scene.rpc`, `scene.sensor` and `scene.sensor_options`",
        )  # fmt: skip
    dataset = raster.open_dataset(image, **options.access)
    plugins.Host.discover()  # model families of plugins, which the file may name
    saved = read_model_file(located(options.model, allow_network=options.allow_network))
    size = dataset.RasterXSize, dataset.RasterYSize
    offset = options.crop_offset
    if offset is None and saved.size != size:
        offset = crop.noted_offset(dataset)
    if saved.size is not None and not crop.fits(size, saved.size, offset):
        raise InputError(
            f"this model is of an image of {saved.size[0]} x {saved.size[1]} pixels, {Path(image).name} has "
            f"{size[0]} x {size[1]}",
            file=options.model,
            field="size",
            remedy="give the model file of this image, or `scene.crop_offset=COL,ROW` if it is a crop of that one",
        )
    scene = Scene(
        sensor=saved.sensor or "model file", path=image, width=size[0], height=size[1],
        models={saved.model.kind: saved.model}, model_source=str(options.model),
        facts={"delivered_model_source": saved.model_source} if saved.model_source else {},
        adjusted=saved.adjusted,
    )  # fmt: skip
    return scene if offset is None else crop.placed(scene, dataset, offset)


def open_image(image: str | os.PathLike[str], options: SceneOptions, *, needs_model: bool) -> Scene:
    """Open an image whose own model is only wanted if there is one.

    Parameters
    ----------
    needs_model : bool
        Whether an image without a model of its own is an error.

    Returns
    -------
    Scene
        Without models and of the sensor "points only" where no sensor recognises the image.
    """
    asked = isinstance(image, Scene) or bool(options.model or options.rpc or options.sensor or options.sensor_options)
    if needs_model or asked:
        return open_scene(image, options)
    host = plugins.Host.discover()
    dataset = host.open_image(image, **options.access)
    try:
        host.recognise(dataset)
    except InputError:
        if any(sensor.recognises(dataset) for sensor in host.sensors.values()):
            raise
        return Scene(POINTS_ONLY, Path(image), dataset.RasterXSize, dataset.RasterYSize, {}, "control points")
    return open_scene(image, options)


def _perhaps_elsewhere(value: Any, allow_network: bool) -> Any:
    """Return a file of an archive or of the network as one that can be read; any other value as it is."""
    text = str(value)
    return located(text, allow_network=allow_network) if text.startswith("/vsi") or "://" in text else value


# -- points ----------------------------------------------------------------------------------------------------------


def point_options(points: PointOptions | Points) -> PointOptions:
    """Return options; points that are read already are used as they are."""
    return PointOptions(gcps=points) if isinstance(points, Points) else points


def point_file(options: PointOptions) -> str | os.PathLike[str] | None:
    """Return the file of points, None where there is none or they are read already."""
    return options.gcps if isinstance(options.gcps, str | os.PathLike) else None


# -- paths -----------------------------------------------------------------------------------------------------------


def check_paths(
    files: Mapping[str, Path],
    image: str | os.PathLike[str],
    scene: SceneOptions,
    points: PointOptions,
    surface: SurfaceOptions,
    match: MatchOptions = MatchOptions(),
    overwrite: bool = False,
    *,
    output: OutputOptions = OutputOptions(),
) -> None:
    """Refuse to write what is read or through a link, and what changes the model of the source or of the ortho.

    Parameters
    ----------
    overwrite : bool
        Accept old side-cars of the ortho, which the caller removes (`old_side_cars`).

    Raises
    ------
    InputError
        With the path that is in the way.
    """
    inputs = {Path(path).resolve() for path in given_files(image, scene, points, surface, match, output)}
    removed = old_side_cars(files["ortho"]) if overwrite and "ortho" in files else []
    for path in (*map(allowed, files.values()), *removed):
        if path.resolve() in inputs:
            raise InputError(
                "this path would be read and written", file=path, field="folder", remedy="choose another output folder"
            )
    folder = next(iter(files.values())).parent
    attaching = any(str(path).endswith(SIDE_CARS) for path in files.values())
    if attaching and folder.resolve() == Path(image).resolve().parent:
        raise InputError(
            "the RPC files written here would attach to the source image and change its model", file=folder,
            field="folder", remedy="choose an output folder of its own",
        )  # fmt: skip
    if "ortho" in files and not overwrite:
        # Statistics, overviews and masks go with an ortho that is replaced; a model is nothing that an ortho has.
        for stale in old_side_cars(files["ortho"]):
            if stale.name.endswith(SIDE_CARS) or not files["ortho"].exists():
                raise InputError(
                    "an old side-car lies here that GDAL would attach to the ortho", file=stale,
                    remedy="remove it (`overwrite` does), or choose another output folder",
                )  # fmt: skip


def given_files(
    image: str | os.PathLike[str],
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    output: OutputOptions = OutputOptions(),
) -> list[str | os.PathLike[str]]:
    """Return the files that the user gave."""
    given = (image, *scene.files.values(), point_file(points), *dem_files(surface), sigma_file(surface),
             *match.reference, *output.files.values())  # fmt: skip
    return [path for path in given if path is not None]


def refuse_changed(before: Mapping[str, tuple[int, int, int]]) -> None:
    """Refuse a result whose inputs changed meanwhile: its pixels, its model and its checksums may be of two files.

    Parameters
    ----------
    before : mapping
        From `files.states`, when the work began.

    Raises
    ------
    InputError
        With the file.
    """
    now = states(before)
    for path, state in before.items():
        if now.get(path) != state:
            raise InputError("this file changed while it was being used", file=path, remedy="run again")


def old_side_cars(ortho: Path) -> list[Path]:
    """Return the files beside an ortho that GDAL would attach to it: models, statistics, overviews, masks."""
    names = [ortho.stem + ending for ending in SIDE_CARS] + [ortho.name + ending for ending in ATTACHED]
    return [path for path in (ortho.with_name(name) for name in names) if path.is_file() or path.is_symlink()]


# -- record ----------------------------------------------------------------------------------------------------------


def files_read(
    image: str | os.PathLike[str],
    scene: SceneOptions = SceneOptions(),
    points: PointOptions = PointOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
    match: MatchOptions = MatchOptions(),
    opened: Scene | None = None,
    output: OutputOptions = OutputOptions(),
    heights: Surface | None = None,
) -> dict[Path, str]:
    """Return every file that is read and its role, side-cars and sources of a VRT included.

    Of what lies in an archive that is the archive. `opened` knows what its sensor read, `heights` what was found.
    """
    read: dict[Path, str] = {}

    def add(role: str, paths: Iterable[str | os.PathLike[str] | None]) -> None:
        for name in paths:
            path = None if name is None else archive_of(os.fspath(name)) or Path(name)
            if path is not None and path.is_file():
                read.setdefault(path, role)

    add("image", [image])
    add("image", _files_of(image, scene))
    for role, path in scene.files.items():
        add(role, [path])
    if opened is not None:
        add("image", [opened.path, *opened.rasters])
        add("image", _files_of(opened.path, scene) if opened.path != Path(image) else ())
        add("metadata", [*opened.sources, opened.model_source])
    add("points", [point_file(points)])
    for dem in dem_files(surface):
        add("DEM", [dem, *(() if is_collected(dem) else _files_of(dem, scene))])
    if heights is not None:
        # Of heights that were found: what led to them, and the files.
        add("DEM", heights.provenance.get("documents", ()))
        for dem in (name for name in heights.files if Path(name) not in read and not is_far(name)):
            add("DEM", [dem, *_files_of(dem, scene)])
    if surface.vertical is not None:
        add("geoid", [surface.vertical])
    add("DEM accuracy", [sigma_file(surface)])
    for reference in match.reference:
        add("reference", [reference, *_files_of(reference, scene)])
    for role, path in output.files.items():
        add(role, [path, *_files_of(path, scene)])
    return read


def hashed(
    read: Mapping[Path, str], digest: Callable[..., str] = sha256, stop: threading.Event | None = None
) -> list[dict[str, Any]]:
    """Return path, role, bytes and SHA-256 of the files of `files_read`.

    Parameters
    ----------
    digest : callable (path, stop) -> str
        May know checksums that were taken before.
    """
    return [
        {"role": role, "path": str(path), "bytes": path.stat().st_size, "sha256": digest(path, stop)}
        for path, role in read.items()
    ]


@contextlib.contextmanager
def hashed_beside(
    read: Mapping[Path, str], digest: Callable[..., str] = sha256
) -> Iterator[Future[list[dict[str, Any]]]]:
    """Take the checksums of files in a thread while the block runs; an error in the block does not wait for them.

    The thread ends with the block, whatever happens, and never calls GDAL: the interpreter cannot exit while a thread
    is inside of a GDAL function (its binding's destructor takes the lock of the interpreter, and the process aborts).
    """
    startable_threads(1)
    stop = threading.Event()
    with ThreadPoolExecutor(1, thread_name_prefix="checksums") as pool:
        future = pool.submit(hashed, read, digest, stop)
        try:
            yield future
        finally:
            stop.set()


def _files_of(path: str | os.PathLike[str], scene: SceneOptions) -> list[str]:
    try:
        return files_of(raster.open_dataset(path, **scene.access))
    except OrthoError:
        return []


def provenance(
    scene: Scene,
    points: PointOptions,
    surface: Surface | None,
    inputs: list[dict[str, Any]],
    command: str | None,
    asked: Mapping[str, Any],
) -> dict[str, Any]:
    """Return what is needed to make the same result again: files with checksums, options, versions, the command.

    Parameters
    ----------
    inputs : list
        From `hashed`.
    asked : mapping of str to dataclass
        What else the user asked for, by name.
    """
    control = None
    if points.gcps is not None:
        control = _as_asked(points)
    return {
        "command": command,
        "inputs": inputs,
        "image": {"path": str(scene.path), "size": [scene.width, scene.height]},
        "sensor": scene.sensor,
        "model_source": scene.model_source,
        "points": control,
        "surface": None if surface is None else dict(surface.provenance),
        "options": {name: _as_asked(value) for name, value in asked.items()},
        "software": {
            "ortho-pipeline": software_version(),
            "gdal": raster.gdal.VersionInfo("RELEASE_NAME"),
            "proj": pyproj.proj_version_str,
        },
    }


def read_since(before: int) -> dict[str, Any]:
    """Return how much was read over the network since `before` (`bytes_read`), for the provenance; nothing if none."""
    read = bytes_read() - before
    return {"network_bytes": read} if read else {}


def _as_asked(options: Any) -> dict[str, Any]:
    """Return options as JSON values, without the budget of the machine, on which no result depends."""
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    left_out = {"memory", "threads", *(key for key in _IF_GIVEN if given.get(key) is None)}
    return {key: _text_of(value) for key, value in given.items() if key not in left_out}


def _text_of(value: Any) -> Any:
    """Return points and paths as text, anything else as it is."""
    if isinstance(value, tuple):
        return tuple(map(_text_of, value))
    return str(value) if isinstance(value, Points) else os.fspath(value) if isinstance(value, os.PathLike) else value
