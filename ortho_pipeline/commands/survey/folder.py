"""The contents of a folder: scenes with a model, DEMs, map images, points; and the next steps."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ortho_pipeline import host
from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.commands.results import ENDINGS, SCHEMA_VERSION
from ortho_pipeline.commands.sharpening.bundle import find_bundle
from ortho_pipeline.commands.survey.map_raster import is_upright, kind_of
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Text, counted
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.files.shell import typed
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.host.unread import unread
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.points import Points, read_points
from ortho_pipeline.points.formats import SUFFIXES
from ortho_pipeline.raster.source import open_dataset

_log = logging.getLogger(__name__)
Kind = Literal["scene", "dem", "map image", "image", "points", "block points"]

#: Endings of files that are tried as images and as points.
IMAGES = (
    ".tif",
    ".tiff",
    ".ntf",
    ".nitf",
    ".jp2",
    ".img",
    ".vrt",
    ".png",
    ".jpg",
    ".jpeg",
    ".hdf",
    ".h5",
    ".nc",
    ".xml",
    ".til",
)
#: Note on a DEM whose file does not declare its height datum.
NO_DATUM = "no height datum declared"
#: Those of them that hold pixels and nothing else: such a file that does not open is damaged.
_PIXELS = (".tif", ".tiff", ".ntf", ".nitf", ".jp2", ".img", ".png", ".jpg", ".jpeg")
#: Photos that cannot be read as they are.
_RAW = (".dng", ".heic", ".heif", ".arw", ".cr2", ".cr3", ".nef", ".raf", ".orf", ".rw2")
#: Files that are looked at, and folders below the given one.
_MOST, _DEPTH = 2000, 3
#: A file of points need not state these fields: options can.
_TO_STATE = "points.crs", "points.vertical"
#: How the text on a file that lacks one of these fields begins.
INCOMPLETE = "incomplete: "
#: Images that a notice names.
_NAMED = 10


@dataclass(frozen=True)
class SurveyedFile:
    """A file, by its path from the folder: its kind, its description, and the models of a scene.

    `reach` is how far pixels reach (columns, rows): the size of a scene, and the median place of points. `tiles` are
    the files of which the image of a scene consists.
    """

    path: str
    kind: Kind
    said: str
    models: tuple[str, ...] = ()
    reach: tuple[float, float] = (0.0, 0.0)
    tiles: tuple[str, ...] = ()


@dataclass(frozen=True)
class FolderSurvey:
    """The contents of a folder."""

    folder: Path
    found: tuple[SurveyedFile, ...]

    def of(self, kind: Kind) -> list[str]:
        """Return the paths of a kind, from the folder."""
        return [file.path for file in self.found if file.kind == kind]

    def beside(self, scene: str, kind: Kind) -> list[str]:
        """Return the files of a kind that belong to a scene: named after it, in its folder, or above it.

        What bears another scene's name is that one's; what lies in a folder above belongs to the scenes of that folder
        if it has some. The only DEM or block points of the delivery, in a folder without scenes, belong to all; what
        there is only one of belongs to the only scene. Points of which most are outside of an image were measured in
        another one, such as the pan image of a bundle.
        """
        reach = {file.path: file.reach for file in self.found}
        mine, others = Path(scene).stem, {Path(name).stem for name in self.of("scene")} - {Path(scene).stem}
        for folder in Path(scene).parents:
            if folder != Path(scene).parent and any(Path(name).parent == folder for name in self.of("scene")):
                break
            here = [name for name in self.of(kind) if Path(name).parent == folder and _fits(reach[name], reach[scene])]
            if named := [name for name in here if Path(name).stem.startswith(mine)]:
                return named
            if free := [name for name in here if not any(Path(name).stem.startswith(other) for other in others)]:
                return free
        only = [name for name in self.of(kind) if _fits(reach[name], reach[scene])]
        if kind not in ("dem", "block points") and len(self.of("scene")) > 1:
            return []
        alone = len(only) == 1 and not any(Path(name).parent == Path(only[0]).parent for name in self.of("scene"))
        return only if alone else []

    def to_json(self) -> dict[str, Any]:
        """Return the document of ``ortho info FOLDER --json``."""
        inner = ("reach", "tiles")
        files = [{name: value for name, value in vars(file).items() if name not in inner} for file in self.found]
        return {"schema_version": SCHEMA_VERSION, "folder": str(self.folder), "files": json_value(files)}


def _fits(inner: tuple[float, float], outer: tuple[float, float]) -> bool:
    return inner[0] <= outer[0] and inner[1] <= outer[1]


def survey(folder: str | os.PathLike[str], options: SceneOptions = SceneOptions()) -> FolderSurvey:
    """List the files of a folder and its subfolders, without outputs of this program.

    Raises
    ------
    InputError
        If there is no such folder, or it has too many files.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError("this is not a folder", file=folder, remedy="give a folder")
    names = list(islice(_files(place, _DEPTH), _MOST + 1))
    if len(names) > _MOST:
        raise InputError(
            f"the folder has more than {_MOST} files",
            file=folder,
            remedy="give the folder of one delivery, or write the pipeline file yourself (docs/run.md)",
        )
    files = [file for path in names if (file := _looked_at(path, place, options)) is not None]
    return FolderSurvey(place, tuple(_without_parts(files)))


def bundle_in(seen: FolderSurvey, options: SceneOptions) -> tuple[str, str] | None:
    """Return the panchromatic and the multispectral scene of a folder, if these two are all; else None."""
    if len(scenes := seen.of("scene")) != 2:
        return None
    found = find_bundle((seen.folder / scenes[0], seen.folder / scenes[1]), options)
    return None if found is None else (os.path.relpath(found[0], seen.folder), os.path.relpath(found[1], seen.folder))


def images_of(
    images: Sequence[str | os.PathLike[str]], scene: SceneOptions | Sequence[SceneOptions]
) -> tuple[Sequence[str | os.PathLike[str]], list[Notice]]:
    """Return the images of a command; one folder with several scenes stands for these.

    A notice names the other images of the folder.

    Raises
    ------
    InputError
        If the folder has no two scenes; the message says why its images are none.
    """
    if len(images) != 1 or not isinstance(scene, SceneOptions) or not Path(images[0]).is_dir():
        return images, []
    seen = survey(images[0], scene)
    scenes = seen.of("scene")
    others = [f"{file.path}: {file.said}" for file in seen.found if file.kind == "image"]
    if len(scenes) < 2:
        raise InputError(
            "; ".join([f"this folder has {counted(len(scenes), 'scene')}, and a block needs two", *others[:3]]),
            file=images[0],
            field="images",
            remedy=Text(f"see what is missing with `ortho info {typed(images[0])}`"),
        )
    return [seen.folder / name for name in scenes], _left_out(seen.of("image"), others)


def _left_out(names: list[str], reasons: list[str]) -> list[Notice]:
    if not names:
        return []
    text = f"{counted(len(names), 'image')} of the folder cannot be used: {'; '.join(reasons[:_NAMED])}"
    return [Notice("images-left-out", text, count=len(names), images=names[:_NAMED])]


def _files(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the files of a folder and of those in it, by name; hidden ones and linked folders are left out.

    So is what cannot be read, such as the folder ``lost+found`` of a disk, and links that lead nowhere.
    """
    try:
        with os.scandir(folder) as listed:
            entries = sorted((entry for entry in listed if not entry.name.startswith(".")), key=lambda one: one.name)
    except OSError as error:
        if depth == _DEPTH:
            raise
        _log.warning("%s: cannot read this folder (%s); it is left out", folder, error.strerror)
        return
    for entry in entries:
        if os.path.isfile(entry.path):
            yield Path(entry.path)
        elif depth and entry.is_dir(follow_symlinks=False):
            yield from _files(Path(entry.path), depth - 1)


def _looked_at(path: Path, folder: Path, options: SceneOptions) -> SurveyedFile | None:
    if any(path.name.endswith(ending) for ending in ENDINGS.values()) and _is_ours(path):
        return None
    suffix, name = path.suffix.lower(), str(path.relative_to(folder))
    if suffix in IMAGES:
        return _image(path, folder, options)
    if suffix in _RAW and not _has_copy(path):
        return SurveyedFile(
            name, "image", "photos in this format are not read. Convert them to JPEG, and keep the tags"
        )
    # JSON files are mostly reports and models.
    return _points(path, name) if suffix in SUFFIXES and suffix != ".json" else None


def _has_copy(path: Path) -> bool:
    """Return whether the camera wrote this photo in another format, too."""
    return any(path.with_suffix(case).exists() for ending in _PIXELS for case in (ending, ending.upper()))


def _is_ours(path: Path) -> bool:
    """Return whether a file has the report that this program would have written with it."""
    ending = next(ending for ending in ENDINGS.values() if path.name.endswith(ending))
    return path.with_name(path.name.removesuffix(ending) + ENDINGS["report"]).exists()


def _image(path: Path, folder: Path, options: SceneOptions) -> SurveyedFile | None:
    name = str(path.relative_to(folder))
    try:
        scene = host.open_scene(path, options.sensor, dict(options.sensor_options), **options.access)
    except OrthoError as error:
        return _raster(path, name, options, error)
    models = ", ".join(scene.models)
    return SurveyedFile(
        name,
        "scene",
        f"{scene.width} x {scene.height}, {scene.sensor}, {models} of {_short(scene.model_source)}",
        tuple(scene.models),
        (scene.width, scene.height),
        tuple(os.path.relpath(tile, folder) for tile in _tiles(scene, path)),
    )


def _tiles(scene: Scene, path: Path) -> list[str]:
    """Return the files of which the image of a scene consists, such as the tiles of a .TIL; none if it is one file.

    The other tiles of a tile are outside of it. A list of one product is opened as that product.
    """
    if Path(scene).resolve() != path.resolve():
        return [os.fspath(scene)]
    metadata = path.suffix.lower() == ".xml"
    tiles = []
    for piece in scene.pieces:
        (left, top), (width, height) = piece.offset, piece.size or (0, 0)
        inside = left >= 0 and top >= 0 and left + width <= scene.width and top + height <= scene.height
        if inside and piece.model is None and piece.scale == 1 and (piece.size or metadata):
            tiles.append(os.fspath(piece.path))
    return tiles


def _raster(path: Path, name: str, options: SceneOptions, refused: OrthoError) -> SurveyedFile | None:
    """Describe an image that no sensor opens; None if it is not an image."""
    try:
        dataset = open_dataset(path, **options.access)
    except OrthoError as error:
        return (
            SurveyedFile(name, "image", f"cannot be opened: {error.message}")
            if path.suffix.lower() in _PIXELS
            else None
        )
    size = f"{dataset.RasterXSize} x {dataset.RasterYSize}"
    kind = kind_of(dataset)
    if kind is None or not (is_upright(dataset) or unread(dataset) is None):
        return SurveyedFile(name, "image", f"{size}, no model: {refused.message}")
    crs = dataset.GetSpatialRef()
    text = f"{size}, {crs.GetName() if crs is not None else 'a CRS'}"
    datum = crs is None or crs.IsCompound() or crs.GetAxesCount() == 3
    return SurveyedFile(name, kind, text if kind != "dem" or datum else f"{text}, {NO_DATUM}")


def _points(path: Path, name: str) -> SurveyedFile | None:
    """Describe control and check points of one image, or the points of a block; None if it is another text."""
    try:
        points = read_points(path)
    except OrthoError as error:
        return _incomplete(name, "points", error) or _block_points(path, name)
    pixels = points.image[np.isfinite(points.image).all(axis=1)]
    column, row = np.median(pixels, axis=0).tolist() if len(pixels) else (0.0, 0.0)
    return SurveyedFile(name, "points", _roles(points), reach=(column, row))


def _block_points(path: Path, name: str) -> SurveyedFile | None:
    try:
        points = read_block_points(path)
    except OrthoError as error:
        return _incomplete(name, "block points", error)
    ties = counted(int(points.tie.sum()), "tie point")
    images = counted(len(points.images), "image")
    return SurveyedFile(name, "block points", f"{_roles(points)}, {ties} in {images}")


def _roles(points: Points | BlockPoints) -> str:
    roles = (("control", points.control), ("check", points.check))
    return ", ".join(counted(int(mask.sum()), f"{role} point") for role, mask in roles)


def _incomplete(name: str, kind: Kind, error: OrthoError) -> SurveyedFile | None:
    """Describe a table with a valid header that lacks its CRS or datum."""
    return SurveyedFile(name, kind, f"{INCOMPLETE}{error.message}") if error.field in _TO_STATE else None


def _without_parts(files: list[SurveyedFile]) -> list[SurveyedFile]:
    """Leave out tiles of an image that is listed as a whole, and metadata of an image that is listed."""
    scenes = {
        Path(file.path).with_suffix("")
        for file in files
        if file.kind == "scene" and not file.path.lower().endswith(".xml")
    }
    images = {file.path for file in files if file.kind in ("scene", "image")}
    several = {tile for file in files if len(file.tiles) > 1 for tile in file.tiles}
    # Of an image in one file, that file is listed.
    same = {file.path for file in files if len(file.tiles) == 1 and file.tiles[0] in images}
    return [
        file
        for file in files
        if file.path not in (several & images) | same
        and not (
            file.path.lower().endswith(".xml") and (file.kind != "scene" or Path(file.path).with_suffix("") in scenes)
        )
    ]


def _short(source: str) -> str:
    return Path(source).name if os.sep in source else source
