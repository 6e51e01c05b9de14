"""The images of a stack and their dates: from a list, a pattern of file names, STAC items, reports or metadata."""

from __future__ import annotations

import csv
import functools
import glob
import io
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.freshness import DIGESTS, far_states, state_of
from ortho_pipeline.batch.paths import PipelinePaths, Place, key_of_name
from ortho_pipeline.batch.records import FileState
from ortho_pipeline.batch.stack.acquisition.conditions import Conditions, conditions_of
from ortho_pipeline.batch.stack.acquisition.times import by_pattern, time_of
from ortho_pipeline.commands.heights.opening import GIVE_HEIGHTS, dem_files, has_surface
from ortho_pipeline.commands.orthos.opening import ORTHO, open_ortho
from ortho_pipeline.commands.orthos.verifying import RASTERS
from ortho_pipeline.commands.placement import Placement, place_scene
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import decoded, read_bounded, read_json
from ortho_pipeline.files.folders import listed_paths
from ortho_pipeline.files.locations import Location, VsiPath, located, place
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SceneOptions, SurfaceOptions
from ortho_pipeline.raster.source import open_dataset
from ortho_pipeline.stores.sidecars import ask_beside
from ortho_pipeline.stores.stac.item import is_item_file, read_item

#: A list and a JSON document next to an ortho are no larger.
_BYTES = 50_000_000
#: Columns of a list: of the file, and of its date.
_FILE, _DATE = ("file", "path", "image", "ortho", "name"), ("date", "datetime", "acquired", "time")
#: Metadata with the time of acquisition: domain and item, the best first.
_ITEMS = ("IMAGERY", "ACQUISITIONDATETIME"), ("", "ACQUISITIONDATETIME"), ("", "acquired")
#: This may be the time of acquisition, or of the last change by any program.
_WRITTEN = "TIFFTAG_DATETIME"
#: Where dates can be from if those next to an image or in it are missing or wrong.
_OTHERWISE = Text(
    "instead of the folder, give a CSV file with the columns file and date (2024-01-31); or the place of the date in "
    "the file names: ",
    Setting("stack.date_pattern", "%Y%m%d"),
)


@dataclass(frozen=True, eq=False)
class RawScene:
    """A raw scene with its delivered model, on its heights.

    Parameters
    ----------
    resolved : Resolved
        Its request, with CRS and pixel size of its ortho, scene and heights.
    inputs : tuple of FileState
        The files that it was read from.
    """

    resolved: Resolved
    inputs: tuple[FileState, ...]

    @functools.cached_property
    def placed(self) -> Placement:
        """The scene with its delivered model on its heights, and the grid of its ortho."""
        return place_scene(self.resolved)


@dataclass(frozen=True, eq=False)
class Dated:
    """An ortho with its date, and where the date is from.

    Parameters
    ----------
    raw : RawScene, optional
        The raw scene of which the ortho was made for matching.
    made : FileState, optional
        The state of that ortho.
    """

    name: str
    path: Place
    time: datetime
    source: str
    scene: Scene
    raw: RawScene | None = None
    made: FileState | None = None
    conditions: Conditions = field(default_factory=Conditions)

    @property
    def image(self) -> Place:
        """The file that was given."""
        return self.path if self.raw is None else place(self.raw.resolved.scene.path)

    def states(self, options: SceneOptions) -> tuple[FileState, ...]:
        """Return the states of the ortho, of its side-cars and of the sources of a VRT, if they are on this machine."""
        if self.made is not None:
            return (self.made,)
        request = Request(self.path, options)
        if Location(self.path).is_far:
            ortho = state_of("ortho", self.path, allow_network=options.allow_network)
            return (ortho, *(state for state in far_states(request) if state.path != ortho.path))
        files = Ledger.of(request, self.scene).roles
        return tuple(FileState.of("ortho", file.absolute(), DIGESTS) for file in sorted(files))

    @property
    def days(self) -> float:
        """Days since 1970."""
        return self.time.timestamp() / 86400.0


def dated_orthos(
    given: Sequence[str | os.PathLike[str]],
    pattern: str | None = None,
    options: SceneOptions = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
) -> list[Dated]:
    """Return the images of folders, lists and patterns of names, in order of time and name.

    Parameters
    ----------
    surface : SurfaceOptions
        Heights, with which raw scenes are allowed. A DEM in a folder of images is none of them.

    Raises
    ------
    InputError
        If an image has no date or two, two have one name, or one is raw and there are no heights.
    """
    heights, skipped = has_surface(surface), {_real(path) for path in dem_files(surface)}
    found = _each_once(one for one in _files(given, options) if _real(one.path) not in skipped)
    dated = []
    for one in found:
        path = one.path
        scene = open_ortho(path, options, only=False)
        if scene.sensor != ORTHO and not heights:
            raise InputError(
                f"{path.name} is not a finished ortho: the sensor {scene.sensor!r} opens it as a raw scene",
                file=path,
                field="surface.dem",
                remedy=Text(GIVE_HEIGHTS, "; if it is an ortho, delete the old RPC or metadata files"),
            )
        documents, dataset = _documents(one), open_dataset(path, **options.access)
        time, source = _date(one, pattern, documents, dataset, scene)
        facts = [*(_facts_of(document) for document, _ in documents), scene.facts]
        conditions = conditions_of(facts, dataset)
        dated.append(Dated(one.name, path, time, source, scene, conditions=conditions))
    if len(dated) < 2:
        raise InputError(
            f"a stack needs at least two images, not {len(dated)}",
            field="orthos",
            remedy=f"give a folder with orthos ({', '.join(RASTERS)}) or STAC items",
        )
    return sorted(dated, key=lambda one: (one.time, one.name))


def placed_at(name: str | os.PathLike[str], options: SceneOptions) -> Place:
    """Return the place of a file that a user names: a path, which other workers understand, or an address.

    Raises
    ------
    InputError
        If it is on another machine, and the network is not allowed.
    """
    found = located(name, allow_network=options.allow_network)
    return found if isinstance(found, VsiPath) else Path(os.path.abspath(found))


@dataclass(frozen=True)
class _Given:
    """An image that was given, with the date that a list states, and the STAC item that names it, with its id."""

    path: Place
    stated: str | None = None
    item: Place | None = None
    id: str = ""

    @property
    def name(self) -> str:
        """The name of its date; with the id of its item, because assets of all items may have one name, such as B04."""
        stem = self.path.stem
        return stem if stem.startswith(self.id) else f"{self.id}_{stem}"

    def completed(self, other: _Given) -> _Given:
        """Return an image that was given twice, with the date and the STAC item of either.

        Raises
        ------
        InputError
            If the other one states another date, or is from another STAC item.
        """
        if self.item is not None and other.item is not None and self.item != other.item:
            raise InputError(
                f"another STAC item names this image, too: {Path(self.item).name}",
                file=other.item,
                field="orthos",
                remedy="give one of the two items",
            )
        if self.stated and other.stated and time_of(self.stated, self.path) != time_of(other.stated, self.path):
            raise InputError(
                f"lists give this image two dates: {self.stated} and {other.stated}",
                file=self.path,
                field="date",
                remedy="delete the wrong row",
            )
        return replace(self if other.item is None else other, stated=self.stated or other.stated)


def _each_once(given: Iterable[_Given]) -> list[_Given]:
    """Return images, each once.

    Raises
    ------
    InputError
        If two have one name, or one has two dates.
    """
    found: dict[tuple[str, str], _Given] = {}
    for one in given:
        key = key_of_name(one.path.stem), _real(one.path)
        found[key] = found[key].completed(one) if key in found else one
    names: set[str] = set()
    for one in found.values():
        if key_of_name(one.name) in names:
            raise InputError(
                f"two images are called {one.name}",
                file=one.path,
                field="orthos",
                remedy="rename one of them, or give a STAC item of each, with an id of its own",
            )
        names.add(key_of_name(one.name))
    return list(found.values())


def _files(given: Sequence[str | os.PathLike[str]], options: SceneOptions) -> list[_Given]:
    """Return the images of folders, lists, patterns and STAC items; of a folder without images those of its items."""
    found: list[_Given] = []
    for one in listed_paths(given, "orthos"):
        name = Location(one)
        if name.is_address:
            found += _far_files(name, options)
            continue
        path = placed_at(name.document if name.is_item else name, options)
        if path.is_dir():
            found += _among(sorted(path.iterdir(), key=str), options)
        elif path.suffix.lower() in (".csv", ".txt") and path.is_file():
            found += _listed(path, options)
        elif not path.exists() and any(mark in name for mark in "*?["):
            matches = sorted(glob.glob(os.fspath(path)))
            if not matches:
                raise InputError("no file has such a name", file=path, field="orthos", remedy="check the pattern")
            # A pattern such as scenes/* has side-cars, too.
            rasters, asset = [file for file in matches if Path(file).suffix.lower() in RASTERS], name.asset
            found += [_one(Location(f"{file}#{asset}" if asset else file), options) for file in rasters or matches]
        else:
            found.append(_one(name, options))
    ask_beside(*(one.path for one in found), allow_network=options.allow_network)
    return found


def _far_files(address: Location, options: SceneOptions) -> list[_Given]:
    """Return the images of an address: of an image, a STAC item, a list, a folder or pattern in object storage."""
    if (ending := Path(address).suffix.lower()) in (".csv", ".txt"):
        return _listed(placed_at(address, options), options)
    # A web server has no patterns, and a query follows a question mark.
    is_pattern = not address.is_on_web and any(mark in address.document for mark in "*?[")
    if not is_pattern and (address.is_item or address.is_on_web or (ending and not address.endswith("/"))):
        return [_one(address, options)]
    pattern = address.document if is_pattern else f"{address.rstrip('/')}/*"
    matches = PipelinePaths(address, None, options.allow_network).matching(pattern, "orthos")
    if found := _among(matches, options, address.asset):
        return found
    raise InputError("no image has such an address", file=address, field="orthos", remedy="check the address")


def _among(files: Sequence[Place], options: SceneOptions, asset: str = "") -> list[_Given]:
    """Return the images among some files; without any, those of the STAC items, or an asset of each."""
    if images := [_Given(file) for file in files if file.suffix.lower() in RASTERS]:
        return images
    items = [Location(file).url for file in files if is_item_file(file, allow_network=options.allow_network)]
    return [_one(Location(f"{item}#{asset}" if asset else item), options) for item in items]


def _one(name: Location, options: SceneOptions) -> _Given:
    """Return an image, or that of a STAC item."""
    if not name.is_item:
        return _Given(placed_at(name, options))
    item = read_item(name.document, allow_network=options.allow_network, roots=tuple(options.roots))
    image = item.image(name.asset)
    if item.rpc_of(image) is not None:
        raise InputError(
            "the RPC of this image is an asset of its own, and a stack takes the RPC next to the image",
            file=name,
            field="orthos",
            remedy="download the image and the RPC to one folder, with the same stem",
        )
    named = re.sub(r"[^\w.-]+", "_", item.id).strip(".")
    return _Given(placed_at(image.href, options), item=placed_at(name.document, options), id=named)


def _listed(path: Place, options: SceneOptions) -> list[_Given]:
    return [replace(_one(Location(file), options), stated=stated) for file, stated in read_list(path)]


@reads("give a CSV file with the columns file and date")
def read_list(path: str | os.PathLike[str]) -> list[tuple[str, str | None]]:
    """Return the files of a list, relative to its folder, and their dates if it has a column of them.

    The delimiter (comma, semicolon or tab) is that of the header.

    Raises
    ------
    InputError
        If it has no column of files, or a row has no file or a wrong date.
    """
    text = decoded(read_bounded(path, _BYTES, remedy="give a list of files"))
    header = next((line for line in text.splitlines() if line.strip()), "")
    # Where a comma is the decimal mark, spreadsheets write semicolons.
    lines = csv.reader(io.StringIO(text), delimiter=max(",;\t", key=header.count))
    try:
        rows = [row for row in lines if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"this is not CSV ({error})", file=path, field=f"line {lines.line_num}") from error
    if not rows:
        raise InputError("this list is empty", file=path, field="line 1")
    names = [cell.strip().lower() for cell in rows[0]]
    file = next((names.index(name) for name in _FILE if name in names), None)
    date = next((names.index(name) for name in _DATE if name in names), None)
    if file is None:
        raise InputError(
            "this list has no column of files",
            file=path,
            field="line 1",
            remedy="name the columns file and date; if this is a file next to an image, give the folder of the images",
        )
    found: list[tuple[str, str | None]] = []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) <= file or not row[file].strip() or "\0" in row[file]:
            raise InputError("a row of this list has no file", file=path, field=f"line {number}")
        stated = row[date].strip() if date is not None and len(row) > date else ""
        if stated:
            time_of(stated, path, f"write the date of line {number} as 2024-05-03")
        name = Location(row[file].strip())
        found.append((name if name.is_address else os.path.join(os.path.dirname(path), name), stated or None))
    return found


def _date(
    one: _Given, pattern: str | None, documents: Sequence[tuple[Any, Place]], dataset: Any, scene: Scene
) -> tuple[datetime, str]:
    """Return the date of an ortho, and where it is from."""
    path = one.path
    if one.stated is not None:
        return time_of(one.stated, path), "list"
    if pattern is not None:
        return by_pattern(path.name, pattern), "file name"
    for document, name in documents:
        text = _stated_in(document)
        if text is not None:
            return time_of(text, name, _OTHERWISE), name.name
    acquired = scene.facts.get("acquired")
    if scene.sensor != ORTHO and isinstance(acquired, str):
        return time_of(acquired, path, _OTHERWISE), "metadata"
    for domain, item in _ITEMS:
        text = (dataset.GetMetadata(domain) or {}).get(item)
        if text:
            return time_of(text, path, _OTHERWISE), item
    raise InputError(
        "this image has no date: no STAC item and no report are next to it, and its metadata state none"
        + (" (TIFFTAG_DATETIME may be when the file was written)" if dataset.GetMetadataItem(_WRITTEN) else ""),
        file=path,
        field="date",
        remedy=_OTHERWISE,
    )


def _real(path: str | os.PathLike[str]) -> str:
    """Return a path on this machine without links, another one as it is."""
    return os.fspath(path) if Location(path).is_far else os.path.realpath(path)


def _documents(one: _Given) -> list[tuple[Any, Place]]:
    """Return the STAC item of an image and JSON documents next to it, which may state its date, clouds and sun."""
    path = one.path
    stem = path.stem.removesuffix("_ortho")
    names = [path.with_suffix(".json"), path.with_name(f"{stem}_stac.json"), path.with_name(f"{stem}_report.json")]
    if one.item is not None:
        names = [one.item, *(name for name in names if name != one.item)]
    return [(read_json(name, _BYTES, "repair or delete this file"), name) for name in names if name.is_file()]


def _stated_in(document: Any) -> str | None:
    """Return the date that a STAC item or a report states."""
    facts = _facts_of(document)
    names = ("datetime", "start_datetime", "acquired")
    return next((str(facts[name]) for name in names if isinstance(facts.get(name), str)), None)


def _facts_of(document: Any) -> dict[str, Any]:
    """Return the properties of a STAC item, or the facts of the scene of a report; empty if it is neither."""
    found: dict[str, Any] = {}
    for name in ("scene", "properties"):
        member = document.get(name) if isinstance(document, dict) else None
        facts = member.get("facts", member) if isinstance(member, dict) else None
        found |= facts if isinstance(facts, dict) else {}
    return found
