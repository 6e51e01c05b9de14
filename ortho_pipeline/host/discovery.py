"""Recognise a product and open it, with the plugins that are registered."""

from __future__ import annotations

import dataclasses
import functools
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any

from ortho_pipeline.errors import InputError, OrthoError, PluginError, completed, described
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.exchange.crop import placed
from ortho_pipeline.exchange.export import FORMATS
from ortho_pipeline.files.shell import typed
from ortho_pipeline.hookspecs import BlockFormat, Format, Scene, Sensor
from ortho_pipeline.host.contract import scene_faults
from ortho_pipeline.host.registry import Broken, Origin, Registry
from ortho_pipeline.host.unread import unread
from ortho_pipeline.models import KINDS
from ortho_pipeline.raster.source import open_dataset

_COPY_IT = "correct this field, or copy the file again from the delivery"
_COPY_AGAIN = Text(
    "copy the metadata again from the delivery, or give another model (",
    Setting("scene.rpc", "FILE"),
    ", ",
    Setting("scene.model", "FILE"),
    ")",
)
_TEST_IT = "report it to the author of the plugin; authors: run ortho_pipeline.testing.check_sensor on this file"
log = logging.getLogger(__name__)


class Host:
    """The registered plugins, and what they offer.

    Parameters
    ----------
    plugins : iterable of module
        Further plugins, for scripts and tests.
    installed : bool
        Also register the entry points of installed distributions.
    lenient : bool
        Skip a plugin that breaks the contract and list it in `broken`, instead of raising.

    Attributes
    ----------
    sensors : mapping of str to Sensor
    models : mapping of str to type
        Model families that plugins registered.
    broken : tuple of Broken
        Skipped plugins.

    Raises
    ------
    PluginError
        If two sensors have the same name, another distribution uses a bundled name, or a hook is misspelt, has wrong
        arguments or returns a wrong type.
    """

    def __init__(self, plugins: Iterable[ModuleType] = (), *, installed: bool = False, lenient: bool = False) -> None:
        self._registry = Registry(lenient)
        if installed:
            self._registry.register_installed()
        for plugin in plugins:
            name = plugin.__name__
            self._registry.register(plugin, Origin(name, name, "(registered by a script)", ""))
        self.sensors = self._registry.sensors()
        self.models = self._registry.models()

    @classmethod
    def discover(cls) -> Host:
        """Return the host of the installed plugins, which are searched once per process."""
        return _discovered()

    def provenance(self, sensor: str) -> Origin:
        """Return plugin, distribution and version of a sensor or model family.

        Raises
        ------
        InputError
            If there is no such name.
        """
        if sensor not in self._registry.owner:
            raise _unknown_sensor(sensor, self.sensors)
        return self._registry.origin[self._registry.owner[sensor]]

    def plugins(self) -> tuple[Origin, ...]:
        """Return the origins of all registered plugins."""
        return tuple(self._registry.origin.values())

    @property
    def broken(self) -> tuple[Broken, ...]:
        """Skipped plugins, with reasons."""
        return self._registry.broken

    @functools.cached_property
    def _added_formats(self) -> Mapping[str, Format | BlockFormat]:
        return self._registry.formats()

    @functools.cached_property
    def formats(self) -> Mapping[str, Format]:
        """File formats for models by name: those of the host, then those of plugins."""
        added = {name: offer for name, offer in self._added_formats.items() if isinstance(offer, Format)}
        return {**FORMATS, **added}

    @functools.cached_property
    def block_formats(self) -> Mapping[str, BlockFormat]:
        """Formats for all images of a block, by name."""
        return {name: offer for name, offer in self._added_formats.items() if isinstance(offer, BlockFormat)}

    def open_image(
        self,
        path: str | PathLike[str],
        sensor: str | None = None,
        *,
        allow_network: bool = False,
        roots: Sequence[str | PathLike[str]] = (),
    ) -> Any:
        """Return the dataset of an image; for a symbolic link without its product's files, that of the target."""
        dataset = open_dataset(path, allow_network=allow_network, roots=roots)
        if not Path(path).is_symlink():
            return dataset
        target = open_dataset(os.path.realpath(path), allow_network=allow_network, roots=roots)
        # A sensor that knows the product has priority over a fallback, both at the link and at its target.
        for fallback in (False, True):
            candidates = [
                item for item in self.sensors.values() if sensor in (None, item.name) and item.fallback == fallback
            ]
            for candidate in (dataset, target):
                if any(self._recognises(item, candidate) for item in candidates):
                    return candidate
        return dataset

    def recognise(self, dataset: Any, sensor: str | None = None, options: Iterable[str] = ()) -> Sensor:
        """Return the sensor of `dataset`.

        Parameters
        ----------
        dataset : gdal.Dataset
        sensor : str, optional
            Use this sensor, whether it recognises the dataset or not.
        options : iterable of str
            Names of the options of the user. If no sensor recognises the dataset, the only fallback sensor that
            declares them is used.

        Raises
        ------
        InputError
            If there is no such sensor, or none or several recognise the dataset.
        PluginError
            If a plugin failed to check the dataset.
        """
        if sensor is not None:
            if sensor not in self.sensors:
                raise _unknown_sensor(sensor, self.sensors)
            return self.sensors[sensor]
        names = set(options)
        special = [item for item in self.sensors.values() if not item.fallback]
        general = [item for item in self.sensors.values() if item.fallback]
        candidates = (
            [item for item in special if self._recognises(item, dataset)]
            or [item for item in general if self._recognises(item, dataset)]
            or [item for item in general if names and names <= set(item.options)]
        )
        if len(candidates) == 1:
            return candidates[0]
        raise _not_one(candidates, self.sensors.values(), dataset)

    def open_scene(
        self,
        path: str | PathLike[str],
        sensor: str | None = None,
        options: Mapping[str, Any] | None = None,
        *,
        allow_network: bool = False,
        roots: Sequence[str | PathLike[str]] = (),
        crop_offset: Sequence[float] | None = None,
    ) -> Scene:
        """Open a product with the sensor that recognises it; see `open_scene`."""
        options = dict(options or {})
        dataset = self.open_image(path, sensor, allow_network=allow_network, roots=roots)
        chosen = self.recognise(dataset, sensor, options)
        require_declared(chosen, options, path)
        try:
            with completed(path, remedy=_COPY_IT):
                scene = chosen.open_scene(dataset, **options)
                size = dataset.RasterXSize, dataset.RasterYSize
                fault = next(scene_faults(chosen, scene, size, {*KINDS, *self.models}), None)
        except OrthoError:
            raise
        except (Exception, SystemExit) as error:
            text = described(error, chosen.open_scene)
            raise PluginError(f"{self._name(chosen)} could not open it ({text})", file=path, remedy=_TEST_IT) from error
        if fault and self.provenance(chosen.name).bundled:
            # Bundled plugins keep the contract for valid files, so the file is damaged.
            raise InputError(
                f"the metadata give an impossible geometry: {fault}",
                file=scene.model_source,
                field="model",
                remedy=_COPY_AGAIN,
            )
        if fault:
            raise PluginError(f"{self._name(chosen)}: {fault}", file=path, field="scene", remedy=_TEST_IT)
        log.info("%s: sensor %s, models %s from %s", path, chosen.name, ", ".join(scene.models), scene.model_source)
        scene = placed(scene, dataset, crop_offset)
        others = _other_images(dataset)
        return dataclasses.replace(scene, warnings=(*scene.warnings, *others)) if others else scene

    def _recognises(self, sensor: Sensor, dataset: Any) -> bool:
        try:
            return bool(sensor.recognises(dataset))
        except (Exception, SystemExit) as error:
            raise PluginError(
                f"{self._name(sensor)} failed to check this dataset ({described(error, sensor.recognises)})",
                file=dataset.GetDescription(),
                remedy=Text("choose a sensor with ", Setting("scene.sensor", "NAME"), ", or uninstall this plugin"),
            ) from error

    def _name(self, sensor: Sensor) -> str:
        return f"sensor {sensor.name!r} of plugin {self._registry.owner[sensor.name]}"


def _other_images(dataset: Any) -> tuple[str, ...]:
    """Return a warning if GDAL opened the first of several images of a file: segments of NITF, pages of TIFF."""
    names = [name for name, _ in dataset.GetSubDatasets()]
    if len(names) < 2 or dataset.GetDriver().ShortName not in ("NITF", "GTiff"):
        return ()
    second = typed(f"{Path(dataset.GetDescription()).stem}_second.tif")
    return (
        f"the file has {counted(len(names), 'image')}; only the first is used. For the second: "
        f"`gdal_translate {typed(names[1])} {second}`",
    )


def open_scene(
    path: str | PathLike[str],
    sensor: str | None = None,
    options: Mapping[str, Any] | None = None,
    *,
    allow_network: bool = False,
    roots: Sequence[str | PathLike[str]] = (),
    crop_offset: Sequence[float] | None = None,
) -> Scene:
    """Open a product with the installed sensor that recognises it.

    Parameters
    ----------
    path : path
        The image file.
    sensor, options : str, mapping, optional
        Name of the sensor, instead of automatic recognition, and its options.
    allow_network : bool
        Allow URLs and GDAL's network file systems.
    roots : sequence of path
        Folders that an image may refer to, besides its own.
    crop_offset : (float, float), optional
        Column and row of the first pixel, if the image is a crop and its model is for the whole image.

    Raises
    ------
    InputError
        If the file cannot be opened, not exactly one sensor recognises it, or an option is unknown.

    Examples
    --------
    >>> open_scene("sample_data/scene.tif").sensor
    'rpc'
    """
    return Host.discover().open_scene(
        path, sensor, options, allow_network=allow_network, roots=roots, crop_offset=crop_offset
    )


def require_declared(sensor: Sensor, options: Iterable[str], path: str | PathLike[str]) -> None:
    """Refuse options of a user that a sensor does not declare."""
    for name in options:
        if name not in sensor.options:
            declared = ", ".join(sensor.options) or "none"
            raise InputError(
                f"the sensor {sensor.name!r} has no option {name!r}; its options: {declared}",
                file=path,
                field=name,
                remedy=Text("see `ortho sensors`, or choose another sensor with ", Setting("scene.sensor", "NAME")),
            )


@functools.cache
def _discovered() -> Host:
    host = Host(installed=True)
    # Model files of these families can be read from now on.
    KINDS.update(host.models)
    return host


def _unknown_sensor(name: str, sensors: Iterable[str]) -> InputError:
    names = ", ".join(sensors) or "none"
    return InputError(
        f"unknown sensor {name!r} (installed: {names})",
        field="scene.sensor",
        remedy="list sensors with `ortho sensors`",
    )


def _not_one(candidates: list[Sensor], sensors: Iterable[Sensor], dataset: Any) -> InputError:
    path = dataset.GetDescription()
    if candidates:
        names = ", ".join(item.name for item in candidates)
        return InputError(
            f"several sensors recognise this image: {names}",
            file=path,
            remedy=Text("choose one with ", Setting("scene.sensor", "NAME")),
        )
    if beside := unread(dataset):
        return InputError(
            f"{beside.what}; no sensor opens it automatically", file=path, field="scene.sensor", remedy=beside.remedy
        )
    general = ", ".join(item.name for item in sensors if item.fallback)
    hint = f" (general ones: {general})" if general else ""
    on_map = dataset.GetProjection() and dataset.GetGeoTransform(can_return_null=True) is not None
    found, finished = "", Text("")
    if on_map:
        found = ". It is on a map grid, as a finished ortho is"
        use = "for a finished ortho use the commands verify or align, or add "
        finished = Text(use, Setting("scene.ortho"), ". For a raw scene, ")
    return InputError(
        f"no sensor recognises this image: it has no RPC, and no metadata of a known product are next to it{found}",
        file=path,
        remedy=Text(
            finished,
            "copy the other files of the delivery next to it, give an RPC file with ",
            Setting("scene.rpc", "FILE"),
            ", or fit a model to control points ('ortho compare' recommends one). To see which files a "
            "sensor needs and does not find, repeat with ",
            Setting("scene.sensor", "NAME"),
            hint,
        ),
    )
