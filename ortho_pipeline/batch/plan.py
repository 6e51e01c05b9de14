"""From a pipeline file to jobs: patterns, placeholders, paths inside of their root, names that do not collide."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ortho_pipeline.batch.config import Config, Entry, Settings, merged, read_config, read_content
from ortho_pipeline.batch.paths import PipelinePaths, Place, key_of_name
from ortho_pipeline.commands.heights.automatic import AUTO
from ortho_pipeline.commands.resolved.ledger import versions
from ortho_pipeline.commands.resolved.request import OWN_POINTS, Request
from ortho_pipeline.commands.stac.given import heights_given, resolved
from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.files.locations import Location, VsiPath, located, place
from ortho_pipeline.files.shell import typed
from ortho_pipeline.options import (
    MatchOptions,
    MosaicOptions,
    OutputOptions,
    PointOptions,
    SceneOptions,
    SurfaceOptions,
)
from ortho_pipeline.surface.cells.sources import address_of
from ortho_pipeline.surface.dem_mosaic import matching_files

#: Folder of records and locks within the output folder.
STATE = ".run"
#: Files of a run next to the folders of the scenes, by role.
RUN_FILES = {
    "log": "run.jsonl",
    "summary": "run.json",
    "catalog": "catalog.json",
    "seams": "mosaic.json",
    "page": "mosaic.html",
    "index": "index.html",
}
_PLACEHOLDER = re.compile(r"\{(\w+)\}")
_NAME_BYTES = 150
#: Suffixes by which file names differ from other words in a remote pipeline file.
_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,8}$")


@dataclass(frozen=True)
class Job:
    """One scene: all that a worker has to know, in absolute paths.

    Parameters
    ----------
    name : str
        Name of the scene and of its folder within `output`.
    versions : mapping
        Software of the process that made the plan; a worker has to have the same.
    run : str
        The run that asks for it.
    """

    name: str
    request: Request
    output: Path
    versions: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    run: str = ""

    @property
    def image(self) -> Place:
        """The image of the scene."""
        image: Place = self.request.image
        return image

    @property
    def folder(self) -> Path:
        """Where the outputs go."""
        return self.output / self.name

    @property
    def record(self) -> Path:
        """File of the scene's record."""
        return self.output / STATE / f"{self.name}.json"

    @property
    def lock(self) -> Path:
        """File of the scene's lock."""
        return self.output / STATE / f"{self.name}.lock"

    @property
    def dem_source(self) -> str | None:
        """Address or absolute path of the source of `dem: auto`, also if the environment names it; None without."""
        if self.request.surface.dem != AUTO:
            return None
        source = address_of(self.request.surface.source)
        return source if Location(source).is_address else os.path.abspath(source)

    @property
    def configuration(self) -> dict[str, Any]:
        """The request as JSON values, without the budget of the machine."""
        groups = {"scene": "scene", "points": "points", "surface": "surface", "ortho": "output"}
        options = {name: dataclasses.asdict(getattr(self.request, group)) for name, group in groups.items()}
        for budget in ("memory", "threads"):
            del options["ortho"][budget]
        options["surface"]["source"] = self.dem_source or options["surface"]["source"]
        options["scene"]["allow_network"] = False  # leave to reach a file is no part of what is made of it
        # Without a reference these options are refused, also by a second run.
        if self.request.match != MatchOptions():
            options["match"] = dataclasses.asdict(self.request.match)
        # Files on this machine are known by their content; of others there is the size.
        far = {"image_bytes": self.image.size()} if isinstance(self.image, VsiPath) else {}
        return {"name": self.name, "image": str(self.image), **far, **options}


@dataclass(frozen=True)
class Plan:
    """A pipeline file, worked out.

    Parameters
    ----------
    source : mapping
        The pipeline file in a provenance: role, name, size and SHA-256 of the bytes that were parsed.
    """

    path: Place
    output: Path
    jobs: tuple[Job, ...]
    source: Mapping[str, Any]
    mosaic: MosaicOptions | None = None

    def chosen(self, only: Sequence[str] = (), shard: tuple[int, int] | None = None) -> tuple[Job, ...]:
        """Return the jobs of these names, or the k-th (from 1) of n parts.

        Raises
        ------
        InputError
            If there is no scene of a name, or no such part.
        """
        known = {job.name: job for job in self.jobs}
        for name in only:
            if name not in known:
                raise InputError(
                    f"there is no scene {name!r}",
                    file=self.path,
                    field="only",
                    remedy=f"see the names with `ortho run {typed(self.path)} --list`",
                )
        jobs = tuple(known[name] for name in dict.fromkeys(only)) if only else self.jobs
        if shard is None:
            return jobs
        part, parts = shard
        if not 1 <= part <= parts:
            raise InputError(f"there is no part {part} of {parts}", field="shard", remedy="use a part such as 1/4")
        return jobs[part - 1 :: parts]


@reads("see docs/run.md for the form of the file")
def plan(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, *, allow_network: bool = False
) -> Plan:
    """Read a pipeline file and work out its scenes.

    Parameters
    ----------
    path : path or address
    root : path, optional
        Folder that contains all paths; by default that of the file. A ``root`` in the file can only narrow it, because
        the author of the file does not decide what it may read.
    allow_network : bool
        Allow a remote file, and addresses in it.

    Raises
    ------
    InputError
        For a wrong file, a path outside of the root, a pattern without a match, or two scenes of one name.
    """
    file = place(located(path, allow_network=allow_network))
    content = read_content(file)
    source = {
        "role": "pipeline file",
        "path": file.name,
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    return _Planner(file, read_config(file, content), PipelinePaths(path, root, allow_network)).plan(source)


class _Planner:
    def __init__(self, path: Place, config: Config, places: PipelinePaths) -> None:
        self.path, self.config, self.places = path, config, places
        if config.root is not None:
            places.root = places.inside(config.root, "root of the file")
        self._rasters: dict[str, str] = {}
        # What another machine asks for is not written here: its outputs go to a store.
        self.output = Path("nowhere") if places.far else places.inside(config.output, "output")

    def plan(self, source: Mapping[str, Any]) -> Plan:
        if self.output == self.places.base:
            raise InputError(
                "the output folder cannot be the folder of the pipeline file",
                file=self.path,
                field="output",
                remedy="choose another output folder, for example out",
            )
        entries_of: dict[Place, list[tuple[int, Entry]]] = {}
        for number, entry in enumerate(self.config.scenes):
            for image in self._images(entry, number):
                entries_of.setdefault(image, []).append((number, entry))
        jobs = [self._job(image, entries) for image, entries in entries_of.items()]
        self._check_names(jobs)
        self._check_mosaic(jobs)
        settings = None if self.config.mosaic is None else MosaicOptions(**dict(self.config.mosaic))
        return Plan(self.path, self.output, tuple(jobs), source, settings)

    # -- images ------------------------------------------------------------------------------------------------------

    def _images(self, entry: Entry, number: int) -> list[Place]:
        if entry.image is not None:
            return [self.places.of(entry.image, f"scenes[{number}].image")]
        images: dict[Place, None] = {}
        excluded = {
            image for pattern in _listed(entry.exclude) for image in self._matches(pattern, f"scenes[{number}].exclude")
        }
        for pattern in _listed(entry.images):
            matches = [image for image in self._matches(pattern, f"scenes[{number}].images") if image not in excluded]
            if not matches:
                field, base = f"scenes[{number}].images", self.places.address or self.places.base
                if set(self.places.matching(pattern, field)) - excluded:
                    what, remedy = f"only files in the output folder match {pattern!r}", "choose another output folder"
                else:
                    what, remedy = f"no file matches {pattern!r}", f"check the pattern, which is relative to {base}"
                raise InputError(what, file=self.path, field=field, remedy=remedy)
            for image in matches:
                place = self.places.inside(str(image), f"scenes[{number}].images") if isinstance(image, Path) else image
                images[place] = None
        return list(images)

    def _matches(self, pattern: str, field: str) -> list[Place]:
        # A pattern with ** would take the orthos of the last run for scenes.
        paths = self.places.matching(pattern, field)
        return [path for path in paths if not (isinstance(path, Path) and path.is_relative_to(self.output))]

    # -- one scene ---------------------------------------------------------------------------------------------------

    def _job(self, image: Place, entries: Sequence[tuple[int, Entry]]) -> Job:
        where = f"scenes[{entries[-1][0]}]"
        settings = merged(self.config.defaults, *(entry for _, entry in entries))
        names = [entry.name for _, entry in entries if entry.name is not None]
        name = self._filled(names[-1] if names else "{stem}", image, f"{where}.name")
        scene, shown = self._scene(settings, image, where), image
        if isinstance(image, Path) and Location(image).is_item:
            asset, scene = resolved(image, scene)
            shown = self.places.of(str(asset), f"{where}.image")
        request = Request(
            shown,
            scene,
            points=self._points(settings, image, where),
            surface=self._surface(settings, image, where, scene),
            match=self._match(settings, image, where),
            output=self._ortho(settings, image, where),
        )
        return Job(self._checked_name(name, image, where), request, self.output, versions())

    def _scene(self, settings: Settings, image: Place, where: str) -> SceneOptions:
        scene: Any = settings.scene
        options = {}
        for key, value in scene.sensor_options.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            options[key] = self._perhaps_file(text, image, f"{where}.scene.sensor_options.{key}")
        rpc = scene.rpc if scene.rpc in ("tag", "sidecar") else self._file(scene.rpc, image, f"{where}.scene.rpc")
        model = self._file(scene.model, image, f"{where}.scene.model")
        files = {"rpc": rpc, "model": model, "sensor_options": options}
        roots = () if self.places.far else (str(self.places.root),)
        return SceneOptions(**{**dict(scene), **files}, roots=roots, allow_network=self.places.allow_network)

    def _points(self, settings: Settings, image: Place, where: str) -> PointOptions:
        values, match = dict[str, Any](settings.points), dict[str, Any](settings.match)
        if values["gcps"] != OWN_POINTS:
            values["gcps"] = self._file(values["gcps"], image, f"{where}.points.gcps")
        if values["vertical"] is not None:
            values["vertical"] = self._perhaps_file(values["vertical"], image, f"{where}.points.vertical")
        if values["gcps"] is None and not match["reference"]:
            # Defaults of all scenes say how points are used; this scene has none.
            return PointOptions(correction=values["correction"])
        return PointOptions(**values)

    def _surface(self, settings: Settings, image: Place, where: str, scene: SceneOptions) -> SurfaceOptions:
        values: dict[str, Any] = dict(settings.surface)
        if values["dem"] != AUTO:
            values["dem"] = self._file(values["dem"], image, f"{where}.surface.dem")
            values["dem"] = self._raster_of(values["dem"], scene, f"{where}.surface.dem")
        for cell in () if values["dem"] is None else matching_files(values["dem"]) or ():
            self.places.inside(cell, f"{where}.surface.dem")
        if values["source"] is not None and not Location(values["source"]).is_address:
            values["source"] = self._file(values["source"], image, f"{where}.surface.source")
        values["fill"] = str(values["fill"])
        if isinstance(values["sigma"], str):
            values["sigma"] = self._perhaps_file(values["sigma"], image, f"{where}.surface.sigma")
        if values["vertical"] is not None:
            values["vertical"] = self._perhaps_file(values["vertical"], image, f"{where}.surface.vertical")
        return SurfaceOptions(**values)

    def _raster_of(self, dem: str | None, scene: SceneOptions, field: str) -> str | None:
        """Return the raster of a STAC item, which is read once for all scenes; anything else as it is."""
        if dem is None:
            return None
        if dem not in self._rasters:
            raster = heights_given(dem, scene)
            self._rasters[dem] = dem if raster == dem else self.places.name(str(raster), field)
        return self._rasters[dem]

    def _match(self, settings: Settings, image: Place, where: str) -> MatchOptions:
        values: dict[str, Any] = dict(settings.match)
        field = f"{where}.match.reference"
        values["reference"] = tuple(self._file(name, image, field) for name in _listed(values["reference"]))
        return MatchOptions(**values)

    def _ortho(self, settings: Settings, image: Place, where: str) -> OutputOptions:
        values: dict[str, Any] = dict(settings.output)
        for name in ("fill_from", "like"):
            values[name] = self._file(values[name], image, f"{where}.output.{name}")
        values["creation_options"] = {key: str(value) for key, value in values["creation_options"].items()}
        return OutputOptions(**values)

    # -- paths -------------------------------------------------------------------------------------------------------

    def _file(self, text: str | None, image: Place, field: str) -> str | None:
        return None if text is None else self.places.name(self._filled(text, image, field), field)

    def _perhaps_file(self, text: str, image: Place, field: str) -> str:
        """Return the path of a value that names a file, any other value as it is."""
        text = self._filled(text, image, field)
        looks = os.sep in text and not text.startswith("+")
        if self.places.far:
            return self.places.name(text, field) if looks or _SUFFIX.search(text) else text
        if looks or _exists(self.places.base / text):
            return self.places.name(text, field)
        if _exists(Path(text)):
            raise InputError(
                f"{text!r} is in the current folder, but paths are relative to the pipeline file",
                file=self.path,
                field=field,
                remedy=f"give its path relative to {self.places.base}",
            )
        return text

    def _filled(self, text: str, image: Place, field: str) -> str:
        values = {"stem": image.stem, "folder": image.parent.name}

        def value(match: re.Match[str]) -> str:
            if match[1] not in values:
                raise InputError(
                    f"unknown placeholder {match[0]}", file=self.path, field=field, remedy="use {stem} or {folder}"
                )
            return values[match[1]]

        return _PLACEHOLDER.sub(value, text)

    # -- checks ------------------------------------------------------------------------------------------------------

    def _checked_name(self, name: str, image: Place, where: str) -> str:
        bad = not name or name.startswith(".") or name != name.strip() or len(os.fsencode(name)) > _NAME_BYTES
        if bad or any(letter in "/\\:\0" or not letter.isprintable() for letter in name):
            raise InputError(
                f"{name!r} cannot be a folder name (for {image.name})",
                file=self.path,
                field=f"{where}.name",
                remedy="use letters, digits, blanks and dashes, without a leading dot",
            )
        return name

    def _check_names(self, jobs: Sequence[Job]) -> None:
        taken: dict[str, Job] = {}
        for job in jobs:
            key = key_of_name(job.name)
            if key in (*RUN_FILES.values(), "mosaic.vrt", "mosaic.tif"):
                raise InputError(
                    f"the run writes a file of the name {job.name!r}",
                    file=self.path,
                    field="name",
                    remedy="give the scene another name",
                )
            other = taken.setdefault(key, job)
            if other is not job:
                raise InputError(
                    f"{other.image} and {job.image} have the same scene name {job.name!r}",
                    file=self.path,
                    field="scenes.name",
                    remedy="give them different names, for example name: '{folder}_{stem}'",
                )

    def _check_mosaic(self, jobs: Sequence[Job]) -> None:
        if self.config.mosaic is None:
            return
        for job in jobs:
            for field in ("crs", "resolution"):
                if getattr(job.request.output, field) is None:
                    raise InputError(
                        "the scenes of a mosaic need a common grid",
                        file=self.path,
                        field=f"defaults.output.{field}",
                        remedy="set it under defaults: output: (such as crs: EPSG:32635 and resolution: 2.5)",
                    )


def for_run(jobs: Sequence[Job], run: str, memory: int, threads: int | None, *, allow_network: bool) -> list[Job]:
    """Return the jobs of a run, with the bytes and threads that each may use, and leave to use the network."""
    return [replace(job, run=run, request=_within(job.request, memory, threads, allow_network)) for job in jobs]


def _within(request: Request, memory: int, threads: int | None, allow_network: bool) -> Request:
    return replace(
        request,
        output=replace(request.output, memory=memory, threads=threads),
        scene=replace(request.scene, allow_network=allow_network),
    )


def _exists(path: Path) -> bool:
    """Return whether anything, even a pipe, has this name; False for impossible names."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _listed(patterns: str | Sequence[str] | None) -> list[str]:
    return [patterns] if isinstance(patterns, str) else list(patterns or [])
