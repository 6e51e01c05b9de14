"""The hooks, and what plugins return from them; authors import all of it from `ortho_pipeline.plugin`.

A plugin is a module that is named in the entry-point group ``ortho_pipeline`` of an installed distribution
(``tinysat = "tinysat_plugin"`` under ``[project.entry-points.ortho_pipeline]``). It translates what a vendor wrote
into a sensor model; the mathematics stays in `ortho_pipeline.models`. The whole of a plugin::

    from ortho_pipeline.plugin import Scene, Sensor, hookimpl, rpc_of_dataset

    @hookimpl
    def ortho_sensors():
        yield Sensor("tinysat", "TinySat level 1A scenes", recognises, open_scene, {"band": "band to use, 1 to 4"})

    def recognises(dataset):                        # an open gdal.Dataset; cheap, and False for what is not yours
        return dataset.GetMetadataItem("TIFFTAG_SOFTWARE") == "TINYSAT"

    def open_scene(dataset, *, band="1"):           # the declared options arrive as keyword arguments
        rpc, source = rpc_of_dataset(dataset)
        return Scene("tinysat", dataset.GetDescription(), dataset.RasterXSize, dataset.RasterYSize, {"rpc": rpc},
                     source, facts={"band": int(band)})

Files beside an image are found from ``ortho_pipeline.plugin.place(dataset.GetDescription())``, which has the methods of
`pathlib.Path` for an image on disk and for one in an archive (docs/plugin-reference.md).

The host tries every scene at a few points before it works with it (`ortho_pipeline.host.contract`). Test more with
`ortho_pipeline.testing.check_sensor`.

The hooks stand here and not in `ortho_pipeline.plugin`: that module names readers and commands, and rooms below those
use `Scene` too.

A package that adds commands to ``ortho`` names a module in the group ``ortho_pipeline_commands``, which implements
`ortho_commands`. That module is imported by ``ortho --help``: it declares the commands and imports nothing heavy. So
this module imports nothing heavy either.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pluggy

if TYPE_CHECKING:
    from ortho_pipeline.display.notices import Notice
    from ortho_pipeline.estimation.fit import Fit
    from ortho_pipeline.estimation.observations.prior import Prior
    from ortho_pipeline.models.base import SensorModel
    from ortho_pipeline.points import Points

PROJECT_NAME = "ortho_pipeline"
#: The entry-point groups, and the hooks that are called in the modules which each names.
GROUPS = {
    PROJECT_NAME: ("ortho_sensors", "ortho_models", "ortho_formats"),
    "ortho_pipeline_commands": ("ortho_commands",),
}
hookspec = pluggy.HookspecMarker(PROJECT_NAME)
#: Marks a function of a plugin as a hook.
hookimpl = pluggy.HookimplMarker(PROJECT_NAME)


@dataclass(frozen=True)
class Piece:
    """Another file cut from the same acquisition: what is measured in it counts for the scene as well.

    Parameters
    ----------
    path : path
        The file; points name it as the image that they were measured in.
    offset : (float, float)
        Column and row of its first corner in the pixels of the scene; (0, 0) for another band.
    size : (int, int), optional
        Its columns and rows, where it has a model of its own.
    model : SensorModel, optional
        In its own pixels, where the first model of the scene does not reach as far; with another scale than 1, where
        its pixels lie beside those of the scene by the ground alone (`sees_apart`).
    scale : float
        Width of one of its pixels in those of the scene; another than 1 where colours are coarser than panchromatic.
    """

    path: str | PathLike[str]
    offset: tuple[float, float] = (0.0, 0.0)
    size: tuple[int, int] | None = None
    model: SensorModel | None = None
    scale: float = 1.0

    @property
    def sees_apart(self) -> bool:
        """Whether it is an image of its own, as colours beside panchromatic: both models say what is where in both."""
        return self.model is not None and self.scale != 1.0


@dataclass(frozen=True)
class Scene:
    """One opened product: its image and the models that suit it.

    Parameters
    ----------
    sensor : str
        Name of the sensor that opened it.
    path : path
        The image file.
    width, height : int
        Size of the image in pixels, which is that of the dataset.
    models : mapping of str to SensorModel
        Best first; image coordinates are (column, row) from the outer corner of the first pixel.
    model_source : str
        The file or tag that the first model was read from.
    facts : mapping
        What is worth showing to people (acquisition time, sun elevation, cloud cover ...): JSON values.
    warnings : tuple of str
        What the user ought to know before trusting the result; a `Notice` among them brings a code of its own.
    priors : mapping of str to Prior
        How well the vendor knows parameters of the model that ``--correction model`` adjusts (`adjustable`).
    rasters : tuple of path
        Files of one size whose bands the ortho stacks, in this order; without them the image alone.
    pieces : tuple of Piece
        Other bands and components of the same acquisition, which share one adjustment with this image.
    sources : tuple of path
        Files that were read besides the image and `model_source`, for the record.
    unsuited : mapping of str to str
        Model families (`ortho models`) that do not suit this product, each with what to say where it is fitted.
    adjusted : mapping, optional
        What the model was adjusted by before: the section ``adjustment`` of the model file that it comes from.
    accuracy : float, optional
        Standard deviation (m, each axis in plan) of the first model without control, as the vendor states it. An RPC
        may state its own.
    """

    sensor: str
    path: str | PathLike[str]
    width: int
    height: int
    models: Mapping[str, SensorModel]
    model_source: str
    facts: Mapping[str, object] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    priors: Mapping[str, Prior] = field(default_factory=dict)
    rasters: tuple[str | PathLike[str], ...] = ()
    pieces: tuple[Piece, ...] = ()
    sources: tuple[str | PathLike[str], ...] = ()
    unsuited: Mapping[str, str] = field(default_factory=dict)
    adjusted: Mapping[str, Any] | None = None
    accuracy: float | None = None

    def __post_init__(self) -> None:
        from ortho_pipeline.files.locations import place

        object.__setattr__(self, "path", place(self.path))
        if isinstance(self.model_source, PathLike):
            object.__setattr__(self, "model_source", str(self.model_source))
        object.__setattr__(self, "rasters", tuple(map(place, self.rasters)))

    def __fspath__(self) -> str:
        """Stand for the image file where a path is wanted."""
        return str(self.path)

    @property
    def model(self) -> SensorModel:
        """The first, best model."""
        return next(iter(self.models.values()))

    @property
    def shared_model(self) -> SensorModel:
        """The first model, with those of the other pieces of the acquisition where they have their own."""
        parts = {(0.0, 0.0): (self.model, (self.width, self.height))}
        for piece in self.pieces:
            if piece.model is not None and piece.size is not None and not piece.sees_apart:
                # The bands of a component have the same geometry.
                parts.setdefault(piece.offset, (piece.model, piece.size))
        if len(parts) == 1:
            return self.model
        from ortho_pipeline.models.mosaicked import Pieces

        models, sizes = zip(*parts.values(), strict=True)
        return Pieces(models, tuple(parts), sizes)

    def fit(self, points: Points, correction: str = "shift") -> Fit:
        """Adjust the model to control points, as `ortho fit` does.

        Parameters
        ----------
        points : Points
            In pixels of this image, with heights.
        correction : {'none', 'shift', 'shift-drift', 'affine', 'model'}
            What is adjusted: the image points, or the parameters of the model itself ('model').

        Raises
        ------
        InputError
            For an unknown correction, or if the points do not determine it.
        """
        from ortho_pipeline.errors import InputError
        from ortho_pipeline.estimation.coordinate_swaps import refuse_swapped
        from ortho_pipeline.estimation.family_fit import OWN, fit_own
        from ortho_pipeline.estimation.fit import fit
        from ortho_pipeline.models.correction import ImageCorrection
        from ortho_pipeline.options import CORRECTIONS

        if correction not in CORRECTIONS:
            raise InputError(
                f"there is no correction {correction!r}", field="correction", remedy=f"one of {', '.join(CORRECTIONS)}"
            )
        if not self.models:
            raise InputError("this image has no model", file=self.path, field="model", remedy="open it with a sensor")
        if correction == OWN:
            own = self.model if self.adjustable is None else self.models[self.adjustable]
            return fit_own(own, points, self.priors)
        refuse_swapped(self.shared_model, points, self.height)
        start = ImageCorrection.identity(self.shared_model, correction, (self.width / 2, self.height / 2))
        name = self.model.kind if correction == "none" else f"{self.model.kind}+{correction}"
        return fit(start, points, robust=correction != "none", name=name)

    def __repr__(self) -> str:
        models = ", ".join(self.models) or "none"
        return f"<scene {Path(self.path).name}: {self.width} x {self.height}, sensor {self.sensor}, models {models}>"

    @property
    def notices(self) -> tuple[Notice, ...]:
        """The warnings, each with a code: one that came as text alone is ``from-sensor``."""
        from ortho_pipeline.display.notices import FROM_SENSOR, with_code

        return with_code(self.warnings, FROM_SENSOR)

    @property
    def adjustable(self) -> str | None:
        """Name of the first model that has parameters of its own, such as a pushbroom beside an RPC; None if none."""
        return next((name for name, model in self.models.items() if model.param_names), None)


@dataclass(frozen=True)
class Sensor:
    """The offer of a plugin: how to recognise and to open one kind of product.

    Parameters
    ----------
    name : str
        Short name in lower case, unique among all plugins (``--sensor NAME``).
    description : str
        One line for `ortho sensors`.
    recognises : callable(dataset) -> bool
        True if the open `gdal.Dataset` is such a product. No exception for what is not, datasets without a file
        included.
    open_scene : callable(dataset, **options) -> Scene
        Translates the vendor's metadata. Raises `ortho_pipeline.errors.InputError` for a damaged product.
    options : mapping of str to str
        The keyword options of `open_scene`, each with a default there and a line of help here. Values arrive as
        text; any other option is refused before `open_scene` is called.
    fallback : bool
        A fallback sensor serves any product of a general kind: it is asked only when no other sensor
        recognises the dataset, and it is taken when it alone declares the options that the user gave.
    metadata_beside : callable(image) -> Path, optional
        Where the metadata of an image are looked for, if a product is an image and one file beside it
        (`Scene.model_source`): a copy there makes another image of the same pixels such a product, as `ortho register`
        does.
    """

    name: str
    description: str
    recognises: Callable[[Any], bool]
    open_scene: Callable[..., Scene]
    options: Mapping[str, str] = field(default_factory=dict)
    fallback: bool = False
    metadata_beside: Callable[[str], Path] | None = None


@dataclass(frozen=True)
class Format:
    """A format that sensor models are written in, by ``ortho export --format NAME``.

    ::

        @hookimpl
        def ortho_formats():
            yield Format("corners", "ground of the four corners", "_corners.json", write_corners)

    Parameters
    ----------
    name : str
        As it is typed: lower case, digits and dashes; unique among all plugins.
    title : str
        One line for ``ortho export --help``, such as "RPC as text".
    ending : str
        What the name of the file ends with, after the stem of the image: ``_corners.json``. No two formats share one.
    write : callable(export, path) -> float
        Writes the model of an `ortho_pipeline.plugin.Export` to the new file `path`. Returns the largest distance in
        pixels between the file and the model. Raises `InputError` for a model that the format cannot express. If it
        fails, the host removes the file.
    """

    name: str
    title: str
    ending: str
    write: Callable[[Any, Path], float | None]


@dataclass(frozen=True)
class Subcommand:
    """A command of ``ortho`` that a package adds; its code is imported when somebody calls it.

    ::

        @hookimpl
        def ortho_commands():
            yield Subcommand("coverage", "Show which part of IMAGE the DEM covers.", "ortho_coverage.command:coverage")

    Parameters
    ----------
    name : str
        As it is typed: lower case, digits and dashes; unique among all packages.
    summary : str
        The first sentence of its help, for the list of ``ortho --help``.
    target : str
        ``package.module:name`` of the command or group of click.
    examples : tuple of (str, str)
        What each is for, and its command line (``ortho coverage ...``): they end the command's help.
    group : str
        The heading of ``ortho --help`` under which it is listed.
    """

    name: str
    summary: str
    target: str
    examples: tuple[tuple[str, str], ...] = ()
    group: str = "More commands"


@hookspec
def ortho_sensors() -> Iterable[Sensor]:
    """Return the sensors that this plugin offers."""
    raise NotImplementedError


@hookspec
def ortho_models() -> Mapping[str, type[SensorModel]]:
    """Return further model families by name: classes whose ``from_dict`` undoes their ``to_dict``.

    The name is the ``kind`` of the class, as `ortho_pipeline.models.model_from_dict` looks it up.
    """
    raise NotImplementedError


@hookspec
def ortho_formats() -> Iterable[Format]:
    """Return the formats that this plugin writes sensor models in."""
    raise NotImplementedError


@hookspec
def ortho_commands() -> Iterable[Subcommand]:
    """Return commands of ``ortho``; called in modules of the entry-point group ``ortho_pipeline_commands`` alone.

    It is called for ``ortho --help`` and for a command that the host does not have.
    """
    raise NotImplementedError
