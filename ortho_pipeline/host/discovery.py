"""Recognise a product and open it, with the plugins that are registered."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any

from ortho_pipeline.errors import InputError, OrthoError, PluginError, completed, described
from ortho_pipeline.exchange.crop import placed
from ortho_pipeline.exchange.export import FORMATS
from ortho_pipeline.hookspecs import Format, Scene, Sensor
from ortho_pipeline.host.contract import scene_faults
from ortho_pipeline.host.registry import Broken, Origin, Registry
from ortho_pipeline.host.unread import unread
from ortho_pipeline.models import KINDS
from ortho_pipeline.options.texts import Setting, Text
from ortho_pipeline.raster.source import open_dataset

_COPY_IT = "correct what the file says there, or copy it again from the delivery"
_COPY_AGAIN = Text(
    "copy the metadata again from the delivery, or give a sound model (",
    Setting("scene.rpc", "FILE"),
    ", ",
    Setting("scene.model", "FILE"),
    ")",
)
_TEST_IT = "its author: run ortho_pipeline.testing.check_sensor on this file"
log = logging.getLogger(__name__)


class Host:
    """The plugins that are there, and what they offer.

    Parameters
    ----------
    plugins : iterable of module
        Plugins to register besides the installed ones, for scripts and tests.
    installed : bool
        Whether to look for the entry points of installed distributions.
    lenient : bool
        Leave out a plugin that breaks the contract and list it in `broken`, instead of raising.

    Attributes
    ----------
    sensors : mapping of str to Sensor
    models : mapping of str to type
        Model families that plugins registered.
    broken : tuple of Broken
        Plugins that could not be imported.

    Raises
    ------
    PluginError
        If two sensors have one name, a bundled name is taken by another distribution, a hook is misspelt or has
        the wrong arguments, or a hook returns what it must not.
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
        """Return the host of the installed plugins; they are looked for once per process."""
        return _discovered()

    def provenance(self, sensor: str) -> Origin:
        """Return the plugin, distribution and version that a sensor or model family comes from.

        Raises
        ------
        InputError
            If there is no such name.
        """
        if sensor not in self._registry.owner:
            raise _unknown_sensor(sensor, self.sensors)
        return self._registry.origin[self._registry.owner[sensor]]

    def plugins(self) -> tuple[Origin, ...]:
        """Return the provenance of every plugin that is registered."""
        return tuple(self._registry.origin.values())

    @property
    def broken(self) -> tuple[Broken, ...]:
        """Plugins that were left out, and why."""
        return self._registry.broken

    @functools.cached_property
    def formats(self) -> Mapping[str, Format]:
        """The formats that models are written in, by name: those of the host, then those of plugins."""
        return {**FORMATS, **self._registry.formats()}

    def open_image(
        self,
        path: str | PathLike[str],
        sensor: str | None = None,
        *,
        allow_network: bool = False,
        roots: Sequence[str | PathLike[str]] = (),
    ) -> Any:
        """Return the dataset of an image; of a link, beside which nothing of its product lies, that of its target."""
        dataset = open_dataset(path, allow_network=allow_network, roots=roots)
        if not Path(path).is_symlink():
            return dataset
        target = open_dataset(os.path.realpath(path), allow_network=allow_network, roots=roots)
        # A sensor that knows the product goes before a fallback, at the link and at its target.
        for fallback in (False, True):
            asked = [
                item for item in self.sensors.values() if sensor in (None, item.name) and item.fallback == fallback
            ]
            for found in (dataset, target):
                if any(self._recognises(item, found) for item in asked):
                    return found
        return dataset

    def recognise(self, dataset: Any, sensor: str | None = None, options: Iterable[str] = ()) -> Sensor:
        """Return the sensor that `dataset` belongs to.

        Parameters
        ----------
        dataset : gdal.Dataset
        sensor : str, optional
            Take this one without asking.
        options : iterable of str
            Names of the options that the user gave: the fallback sensor that alone declares them is taken for a
            dataset that nobody recognises.

        Raises
        ------
        InputError
            If there is no such sensor, or none or several recognise the dataset.
        PluginError
            If a plugin failed while looking at it.
        """
        if sensor is not None:
            if sensor not in self.sensors:
                raise _unknown_sensor(sensor, self.sensors)
            return self.sensors[sensor]
        asked = set(options)
        special = [item for item in self.sensors.values() if not item.fallback]
        general = [item for item in self.sensors.values() if item.fallback]
        found = (
            [item for item in special if self._recognises(item, dataset)]
            or [item for item in general if self._recognises(item, dataset)]
            or [item for item in general if asked and asked <= set(item.options)]
        )
        if len(found) == 1:
            return found[0]
        raise _not_one(found, self.sensors.values(), dataset)

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
        for name in options:
            if name not in chosen.options:
                declared = ", ".join(chosen.options) or "none"
                raise InputError(
                    f"the sensor {chosen.name!r} has no option {name!r} (its options: {declared})",
                    file=path,
                    field=name,
                    remedy=Text("see `ortho sensors`, or choose another sensor with ", Setting("scene.sensor", "NAME")),
                )
        try:
            with completed(path, remedy=_COPY_IT):
                scene = chosen.open_scene(dataset, **options)
                size = dataset.RasterXSize, dataset.RasterYSize
                fault = next(scene_faults(chosen, scene, size, {*KINDS, *self.models}), None)
        except OrthoError:
            raise
        except (Exception, SystemExit) as error:
            text = described(error, chosen.open_scene)
            raise PluginError(f"{self._name(chosen)} failed to open it ({text})", file=path) from error
        if fault and self.provenance(chosen.name).bundled:
            # The plugins that come along keep the contract with sound files: it is the file that is damaged.
            raise InputError(
                f"this is not a possible {fault}", file=scene.model_source, field="model", remedy=_COPY_AGAIN
            )
        if fault:
            raise PluginError(f"{self._name(chosen)}: {fault}", file=path, field="scene", remedy=_TEST_IT)
        log.info("%s: sensor %s, models %s from %s", path, chosen.name, ", ".join(scene.models), scene.model_source)
        return placed(scene, dataset, crop_offset)

    def _recognises(self, sensor: Sensor, dataset: Any) -> bool:
        try:
            return bool(sensor.recognises(dataset))
        except (Exception, SystemExit) as error:
            raise PluginError(
                f"{self._name(sensor)} failed while looking at the dataset ({described(error, sensor.recognises)})",
                file=dataset.GetDescription(),
                remedy=Text(
                    "choose the sensor yourself with ", Setting("scene.sensor", "NAME"), ", or uninstall that plugin"
                ),
            ) from error

    def _name(self, sensor: Sensor) -> str:
        return f"sensor {sensor.name!r} of plugin {self._registry.owner[sensor.name]}"


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
    sensor : str, optional
        Name of the sensor, where it is not to be found out.
    options : mapping, optional
        Options of the sensor; only those that it declares are taken.
    allow_network : bool
        Whether URLs and GDAL's network file systems may be opened.
    roots : sequence of path
        Folders that an image may refer to, besides its own.
    crop_offset : (float, float), optional
        Column and row of the first pixel, where the image is a crop and its model is of the whole (`crop`).

    Raises
    ------
    InputError
        If the file cannot be opened, no sensor or several recognise it, or an option is not the sensor's.
    PluginError
        If a plugin broke the contract.
    """
    return Host.discover().open_scene(
        path, sensor, options, allow_network=allow_network, roots=roots, crop_offset=crop_offset
    )


@functools.cache
def _discovered() -> Host:
    host = Host(installed=True)
    # From now on model files that name one of these families can be read.
    KINDS.update(host.models)
    return host


def _unknown_sensor(name: str, sensors: Iterable[str]) -> InputError:
    names = ", ".join(sensors) or "none"
    return InputError(
        f"there is no sensor {name!r} (installed: {names})", field="scene.sensor", remedy="see `ortho sensors`"
    )


def _not_one(found: list[Sensor], sensors: Iterable[Sensor], dataset: Any) -> InputError:
    path = dataset.GetDescription()
    if found:
        names = ", ".join(item.name for item in found)
        return InputError(
            f"several sensors recognise it: {names}",
            file=path,
            remedy=Text("choose one with ", Setting("scene.sensor", "NAME")),
        )
    if beside := unread(dataset):
        return InputError(
            f"{beside.what}, which no sensor opens by itself", file=path, field="scene.sensor", remedy=beside.remedy
        )
    names = ", ".join(item.name for item in sensors) or "none"
    general = ", ".join(item.name for item in sensors if item.fallback)
    hint = f" (for images in general: {general})" if general else ""
    on_map = dataset.GetProjection() and dataset.GetGeoTransform(can_return_null=True) is not None
    finished = Text(", or if it is a finished ortho ", Setting("scene.ortho")) if on_map else Text("")
    return InputError(
        f"no sensor recognises it (installed: {names})",
        file=path,
        remedy=Text(
            "choose one with ",
            Setting("scene.sensor", "NAME"),
            f", which says what it needs{hint}, or give the RPC file with ",
            Setting("scene.rpc", "FILE"),
            finished,
        ),
    )
