"""The hooks, and what plugins return from them; authors import all of it from `ortho_pipeline.plugin`.

A plugin is a module in the entry-point group ``ortho_pipeline`` of an installed distribution
(``tinysat = "tinysat_plugin"`` under ``[project.entry-points.ortho_pipeline]``). It translates vendor metadata into a
sensor model; the mathematics stays in `ortho_pipeline.models`. A complete plugin::

    from ortho_pipeline.plugin import Scene, Sensor, hookimpl, rpc_of_dataset

    @hookimpl
    def ortho_sensors():
        yield Sensor("tinysat", "TinySat level 1A scenes", recognises, open_scene, {"band": "band to use, 1 to 4"})

    def recognises(dataset):                        # an open gdal.Dataset; fast, and False for other products
        return dataset.GetMetadataItem("TIFFTAG_SOFTWARE") == "TINYSAT"

    def open_scene(dataset, *, band="1"):           # the declared options are keyword arguments
        rpc, source = rpc_of_dataset(dataset)
        return Scene("tinysat", dataset.GetDescription(), dataset.RasterXSize, dataset.RasterYSize, {"rpc": rpc},
                     source, facts={"band": int(band)})

To find files next to an image, use ``ortho_pipeline.plugin.place(dataset.GetDescription())``. It has the methods of
`pathlib.Path`, for images on disk and in archives (docs/plugin-reference.md).

The host tries every scene at a few points before it uses it (`ortho_pipeline.host.contract`).
`ortho_pipeline.testing.check_sensor` tests more.

The hooks are in this module and not in `ortho_pipeline.plugin`, because rooms below the readers and commands of that
module also use `Scene`.

A package that adds commands to ``ortho`` declares a module in the group ``ortho_pipeline_commands``, which implements
`ortho_commands`. ``ortho --help`` imports that module, so it must import nothing heavy; neither does this module.
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
#: The entry-point groups, with the hooks of the modules of each.
GROUPS = {
    PROJECT_NAME: ("ortho_sensors", "ortho_models", "ortho_formats"),
    "ortho_pipeline_commands": ("ortho_commands",),
}
hookspec = pluggy.HookspecMarker(PROJECT_NAME)
#: Marks a function of a plugin as a hook.
hookimpl = pluggy.HookimplMarker(PROJECT_NAME)


@dataclass(frozen=True)
class Piece:
    """Another file of the same acquisition: points that are measured in it also count for the scene.

    Parameters
    ----------
    path : path
        The file. Points refer to it as the image in which they were measured.
    offset : (float, float)
        Column and row of its first corner in pixels of the scene; (0, 0) for another band.
    size : (int, int), optional
        Its columns and rows, if it has its own model.
    model : SensorModel, optional
        Its own model, in its own pixels. Needed where the first model of the scene does not cover it, and if `scale` is
        not 1.
    scale : float
        Width of its pixels in pixels of the scene; not 1 if, for example, colours are coarser than panchromatic. Then a
        point goes to the ground by the model of the piece, and to the image by that of the scene.

    Examples
    --------
    >>> Piece("po_1_red.tif", scale=4.0).sees_apart  # without a model of its own
    False
    """

    path: str | PathLike[str]
    offset: tuple[float, float] = (0.0, 0.0)
    size: tuple[int, int] | None = None
    model: SensorModel | None = None
    scale: float = 1.0

    @property
    def sees_apart(self) -> bool:
        """Whether only the two models relate it to the scene, as for colours with panchromatic."""
        return self.model is not None and self.scale != 1.0


@dataclass(frozen=True)
class Scene:
    """An opened product: its image and its sensor models.

    Parameters
    ----------
    sensor : str
        Name of the sensor that opened the product.
    path : path
        The image file.
    width, height : int
        Size of the image in pixels, equal to that of the dataset.
    models : mapping of str to SensorModel
        The best model first. Image coordinates are (column, row) from the outer corner of the first pixel.
    model_source : str
        The file or tag of the first model, as every report shows it.
    facts : mapping
        Facts for people (acquisition time, sun elevation, cloud cover ...) as JSON values, for `ortho info`.
    warnings : tuple of str
        What users must know before they trust the result. A `Notice` has its own code.
    priors : mapping of str to Prior
        How well parameters of the first model with parameters (`adjustable`) are known, in their units. With
        ``--correction model`` they are observations like the control points. Images of a block whose priors have
        the same text in ``shared``, such as a camera, have one value.
    rasters : tuple of path
        Files of the same size whose bands the ortho stacks, in this order; default: the image alone.
    pieces : tuple of Piece
        Other bands and components of the same acquisition. Points measured in them count for this image, too.
    sources : tuple of path
        Other files that were read, for the record of a run.
    unsuited : mapping of str to str
        Model families (`ortho models`) that do not suit this product, each with its warning.
    adjusted : mapping, optional
        How an adjustment changed a saved model: the section ``adjustment`` of its file. Plugins leave it out, because
        they deliver models of vendors.
    accuracy : float, optional
        Standard deviation (m, per axis in plan) of the first model without control, as the vendor states it. An RPC
        may state its own.

    Examples
    --------
    >>> scene = op.open_scene("sample_data/scene.tif")
    >>> scene
    <scene scene.tif: 1000 x 1000, sensor rpc, models rpc>
    >>> scene.fit(op.read_points("sample_data/gcps.geojson"), "shift").param_names
    ('col_shift', 'row_shift')
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
        """Return the path of the image, so that a scene can be used as a path."""
        return str(self.path)

    @property
    def model(self) -> SensorModel:
        """The first, best model."""
        return next(iter(self.models.values()))

    @property
    def shared_model(self) -> SensorModel:
        """The first model, combined with the models of other pieces of the acquisition that have their own."""
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
        """Adjust the model to control points, like `ortho fit`.

        Parameters
        ----------
        points : Points
            In pixels of this image, with heights.
        correction : {'none', 'shift', 'shift-drift', 'affine', 'model'}
            A correction in the image, or 'model' for the model's own parameters.

        Raises
        ------
        InputError
            For an unknown correction, or if the points do not determine it.

        Examples
        --------
        >>> import ortho_pipeline as op
        >>> op.open_scene("sample_data/scene.tif").fit(op.read_points("sample_data/gcps.geojson"), "shift")
        <fit of rpc+shift to 12 control points: RMSE control 0.221 px, check 0.190 px, loo 0.241 px>
        """
        from ortho_pipeline.errors import InputError
        from ortho_pipeline.estimation.coordinate_swaps import refuse_swapped
        from ortho_pipeline.estimation.family_fit import OWN, fit_own
        from ortho_pipeline.estimation.fit import fit
        from ortho_pipeline.estimation.observations.arguments import refuse_other_points
        from ortho_pipeline.models.correction import ImageCorrection
        from ortho_pipeline.options import CORRECTIONS

        refuse_other_points(points)
        if correction not in CORRECTIONS:
            raise InputError(
                f"unknown correction {correction!r}", field="correction", remedy=f"use one of {', '.join(CORRECTIONS)}"
            )
        if not self.models:
            raise InputError(
                "this image has no sensor model", file=self.path, field="model", remedy="open it with a sensor"
            )
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
        """The warnings, each with a code; plain texts get ``from-sensor``."""
        from ortho_pipeline.display.notices import FROM_SENSOR, with_code

        return with_code(self.warnings, FROM_SENSOR)

    @property
    def adjustable(self) -> str | None:
        """Name of the first model that has its own parameters, such as a pushbroom model; None without one."""
        return next((name for name, model in self.models.items() if model.param_names), None)


@dataclass(frozen=True)
class Sensor:
    """What a plugin offers: how to recognise and open one kind of product.

    Parameters
    ----------
    name : str
        Short name in lower case, unique among all plugins (``--sensor NAME``).
    description : str
        One line for `ortho sensors`.
    recognises : callable(dataset) -> bool
        True if the open `gdal.Dataset` is such a product. It is cheap. For all else it returns False and raises
        nothing, also for datasets without a file.
    open_scene : callable(dataset, **options) -> Scene
        Translates the vendor's metadata. Raises `InputError` with file, field and remedy for a damaged product.
    options : mapping of str to str
        The keyword options of `open_scene` (``--sensor-option mounting=0.1``), each with a line of help; each needs a
        default in `open_scene`. Values are strings. The host refuses other options.
    fallback : bool
        A fallback sensor opens a general kind of product. It is asked only if no other sensor recognises the dataset.
        It is also used if it alone declares the options that the user gave.
    metadata_beside : callable(image) -> Path, optional
        Where an image has its metadata, if a product is one image and one file (`Scene.model_source`) next to it. With
        a copy there, another image of the same pixels is such a product too (`ortho register` does this).

    Examples
    --------
    >>> Sensor("tinysat", "TinySat level 1A scenes", lambda dataset: False, op.open_scene).fallback
    False
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
    """A file format for sensor models, for ``ortho export --format NAME``.

    ::

        @hookimpl
        def ortho_formats():
            yield Format("corners", "ground of the four corners", "_corners.json", write_corners)

    Parameters
    ----------
    name : str
        Lower case, digits and dashes; unique among all plugins.
    title : str
        One line for ``ortho export --help``, such as "RPC as text".
    ending : str
        End of the file name, after the stem of the image: ``_corners.json``. Unique among all formats.
    write : callable(export, path) -> float
        Writes the model of an `ortho_pipeline.plugin.Export` to the new file `path`. Returns the largest distance
        between file and model in pixels. Raises `InputError` if the format cannot express the model. If it fails, the
        host removes the file.

    Examples
    --------
    >>> Format("corners", "ground of the four corners", "_corners.json", lambda export, path: 0.0).ending
    '_corners.json'
    """

    name: str
    title: str
    ending: str
    write: Callable[[Any, Path], float | None]


@dataclass(frozen=True)
class BlockFormat:
    """How another program takes all images of a block, for ``ortho adjust --export NAME``.

    The host writes the models and the images without a georeference; the format adds a text that names them.

    Parameters
    ----------
    name : str
        Lower case, digits and dashes; unique among all formats.
    title : str
        One line for ``ortho adjust --help``.
    file : str
        Name of the text file, such as ``cars.json``; unique among all formats.
    models : tuple of str
        Names of the formats of the models, best first. The first one that represents all models is written.
    text : callable(export) -> str
        The content of the file, for a `ortho_pipeline.plugin.BlockExport`. Raises `InputError` if the program
        cannot take the block.
    command : str
        The program to which people give the file, such as ``cars``.

    Examples
    --------
    >>> BlockFormat("cars", "CARS 1", "cars.json", ("geom",), lambda export: "{}", "cars").file
    'cars.json'
    """

    name: str
    title: str
    file: str
    models: tuple[str, ...]
    text: Callable[[Any], str]
    command: str


@dataclass(frozen=True)
class Subcommand:
    """A command that a package adds to ``ortho``; its code is imported when it is called.

    ::

        @hookimpl
        def ortho_commands():
            yield Subcommand("coverage", "Show which part of IMAGE the DEM covers.", "ortho_coverage.command:coverage")

    Parameters
    ----------
    name : str
        Lower case, digits and dashes; unique among all packages.
    summary : str
        First sentence of its help, also in the list of ``ortho --help``.
    target : str
        ``package.module:name`` of the click command or group.
    examples : tuple of (str, str)
        Purpose and command line (``ortho coverage ...``) of each example at the end of the help.
    group : str
        Heading of ``ortho --help`` for this command.

    Examples
    --------
    >>> Subcommand("coverage", "Show which part of IMAGE the DEM covers.", "ortho_coverage.command:coverage").group
    'More commands'
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
    """Return model families by name: classes whose ``from_dict`` reads what ``to_dict`` writes.

    The name is the ``kind`` of the class, which `ortho_pipeline.models.model_from_dict` looks up.
    """
    raise NotImplementedError


@hookspec
def ortho_formats() -> Iterable[Format | BlockFormat]:
    """Return the file formats for sensor models that this plugin offers: of one image, or of all images of a block."""
    raise NotImplementedError


@hookspec
def ortho_commands() -> Iterable[Subcommand]:
    """Return commands of ``ortho``; only for modules of the entry-point group ``ortho_pipeline_commands``.

    The host calls it for ``ortho --help``, and for a command that it does not have.
    """
    raise NotImplementedError
