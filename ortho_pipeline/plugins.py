"""All that the host calls: find the plugins, recognise a product, open it.

Plugins are found through the entry-point group ``ortho_pipeline``, the bundled ones included: they have no privileged
path, only reserved names. See `ortho_pipeline.hookspecs` for the other side.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from os import PathLike
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import pluggy

from ortho_pipeline import hookspecs
from ortho_pipeline.contract import described, scene_faults, sensor_faults
from ortho_pipeline.errors import InputError, OrthoError, PluginError, Terminated, completed
from ortho_pipeline.exchange.crop import placed
from ortho_pipeline.hookspecs import PROJECT_NAME, Scene, Sensor, Study
from ortho_pipeline.models import KINDS, SensorModel
from ortho_pipeline.raster.source import open_dataset

BUNDLED = "ortho-pipeline"
HOOKS = ("ortho_sensors", "ortho_models", "ortho_studies")
#: What each hook returns, what it is collected in, and what authors are told who return something else.
_RETURNS: dict[str, tuple[type, type, str]] = {
    "ortho_sensors": (Iterable, list, "yield the Sensor, or return [Sensor(...)]"),
    "ortho_models": (Mapping, dict, "return {kind: class}"),
    "ortho_studies": (Iterable, list, "yield the Study, or return [Study(...)]"),
}
_COPY_IT = "correct what the file says there, or copy it again from the delivery"
_COPY_AGAIN = "copy the metadata again from the delivery, or give a sound model (`scene.rpc=FILE`, `scene.model=FILE`)"
_TEST_IT = "its author: run ortho_pipeline.testing.check_sensor on this file"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Provenance:
    """Where a plugin came from: its module, distribution and version."""

    plugin: str
    module: str
    distribution: str
    version: str

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}".strip()

    def to_json(self) -> dict[str, str]:
        """Return the fields as JSON values."""
        return dict(vars(self))


@dataclass(frozen=True)
class Broken:
    """A plugin that could not be imported, or that breaks the contract, and why."""

    plugin: str
    distribution: str
    version: str
    error: str

    def __str__(self) -> str:
        return f"plugin {self.plugin!r} of {self.distribution} {self.version} is left out: {self.error}"

    def to_json(self) -> dict[str, str]:
        """Return the fields as JSON values."""
        return dict(vars(self))


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
        self._manager = pluggy.PluginManager(PROJECT_NAME)
        self._manager.add_hookspecs(hookspecs)
        self._origin: dict[str, Provenance] = {}
        self._owner: dict[str, str] = {}
        self._reserved: set[str] = set()
        self._lenient = lenient
        self.broken: tuple[Broken, ...] = ()
        if installed:
            self._register_installed()
        for plugin in plugins:
            name = plugin.__name__
            self._register(plugin, Provenance(name, name, "(registered by a script)", ""))
        self.sensors: Mapping[str, Sensor] = MappingProxyType(self._collect_sensors())
        self.models: Mapping[str, type[SensorModel]] = MappingProxyType(self._collect_models())

    @classmethod
    def discover(cls) -> Host:
        """Return the host of the installed plugins; they are looked for once per process."""
        return _discovered()

    def provenance(self, sensor: str) -> Provenance:
        """Return the plugin, distribution and version that a sensor or model family comes from.

        Raises
        ------
        InputError
            If there is no such name.
        """
        if sensor not in self._owner:
            raise _unknown_sensor(sensor, self.sensors)
        return self._origin[self._owner[sensor]]

    def plugins(self) -> tuple[Provenance, ...]:
        """Return the provenance of every plugin that is registered."""
        return tuple(self._origin.values())

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
        raise _not_one(found, self.sensors.values(), dataset.GetDescription())

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
                    remedy="see `ortho sensors`, or choose another sensor with `scene.sensor=NAME`",
                )
        try:
            with completed(path, remedy=_COPY_IT):
                scene = chosen.open_scene(dataset, **options)
                size = dataset.RasterXSize, dataset.RasterYSize
                fault = next(scene_faults(chosen, scene, size, {*KINDS, *self.models}), None)
        except OrthoError:
            raise
        except Terminated:
            raise
        except (Exception, SystemExit) as error:
            text = described(error, chosen.open_scene)
            raise PluginError(f"{self._name(chosen)} failed to open it ({text})", file=path) from error
        if fault and _normalised(self.provenance(chosen.name).distribution) == BUNDLED:
            # The plugins that come along keep the contract with sound files: it is the file that is damaged.
            raise InputError(
                f"this is not a possible {fault}", file=scene.model_source, field="model", remedy=_COPY_AGAIN
            )
        if fault:
            raise PluginError(f"{self._name(chosen)}: {fault}", file=path, field="scene", remedy=_TEST_IT)
        log.info("%s: sensor %s, models %s from %s", path, chosen.name, ", ".join(scene.models), scene.model_source)
        return placed(scene, dataset, crop_offset)

    def _register_installed(self) -> None:
        for entry in sorted(metadata.entry_points(group=PROJECT_NAME), key=lambda entry: entry.name):
            distribution, version = (entry.dist.name, entry.dist.version) if entry.dist else ("(unknown)", "")
            if _normalised(distribution) == BUNDLED:
                self._reserved.add(entry.name)
            try:
                plugin = entry.load()
            except Terminated:
                raise
            except (Exception, SystemExit) as error:
                # A plugin is somebody else's code: whatever its import does wrong, the others go on.
                self._leave_out(Broken(entry.name, distribution, version, described(error, entry.module)))
                continue
            self._register(plugin, Provenance(entry.name, entry.value, distribution, version))

    def _leave_out(self, broken: Broken) -> None:
        self.broken += (broken,)
        log.warning("%s", broken)

    @contextlib.contextmanager
    def _judged(self, origin: Provenance) -> Iterator[None]:
        """Let an error of a plugin pass, or note it and go on."""
        try:
            yield
        except PluginError as error:
            if not self._lenient:
                raise
            self._leave_out(Broken(origin.plugin, origin.distribution, origin.version, error.message))

    def _register(self, plugin: Any, origin: Provenance) -> None:
        name = f"{origin.plugin} ({origin})" if origin.version else origin.plugin
        with self._judged(origin):
            self._refuse_misspelt(plugin, name)
            try:
                registered = self._manager.register(plugin, name)
            except (pluggy.PluginValidationError, ValueError) as error:
                raise PluginError(f"plugin {name}: {error}", file=origin.module) from error
            if registered is not None:
                self._origin[registered] = origin

    def _refuse_misspelt(self, plugin: Any, name: str) -> None:
        for hook in HOOKS:
            if callable(getattr(plugin, hook, None)) and self._manager.parse_hookimpl_opts(plugin, hook) is None:
                raise PluginError(
                    f"plugin {name}: {hook} is not marked with @hookimpl", remedy="write @hookimpl above it"
                )
        for hook in dir(plugin):
            if hook not in HOOKS and self._manager.parse_hookimpl_opts(plugin, hook) is not None:
                meant = difflib.get_close_matches(hook, HOOKS, 1) or HOOKS
                raise PluginError(
                    f"plugin {name}: there is no hook {hook!r}", remedy=f"did you mean {' or '.join(meant)}?"
                )

    def _returned(self, hook: str) -> Iterator[tuple[str, Any]]:
        # Each implementation is called by itself, so that an error can name its plugin.
        wanted, collect, advice = _RETURNS[hook]
        for implementation in getattr(self._manager.hook, hook).get_hookimpls():
            plugin = implementation.plugin_name
            with self._judged(self._origin[plugin]):
                try:
                    offered = implementation.function()
                    returned = collect(offered) if isinstance(offered, wanted) else None
                except Terminated:
                    raise
                except (Exception, SystemExit) as error:
                    text = described(error, implementation.function)
                    raise PluginError(f"plugin {plugin}: {hook} failed ({text})") from error
                if returned is None:
                    what = type(offered).__name__
                    raise PluginError(f"plugin {plugin}: {hook} returned {what}", remedy=f"its author: {advice}")
                yield plugin, returned

    def _collect_sensors(self) -> dict[str, Sensor]:
        sensors: dict[str, Sensor] = {}
        for plugin, offered in self._returned("ortho_sensors"):
            with self._judged(self._origin[plugin]):
                for sensor in offered:
                    fault = next(sensor_faults(sensor), None)
                    if fault:
                        raise PluginError(f"plugin {plugin}: {fault}")
                    if sensor.name in sensors and self._owner[sensor.name] == plugin:
                        raise PluginError(f"plugin {plugin} offers two sensors {sensor.name!r}")
                    self._claim(plugin, sensor.name, "sensor")
                    sensors[sensor.name] = sensor
        return dict(sorted(sensors.items()))

    def _collect_models(self) -> dict[str, type[SensorModel]]:
        families: dict[str, type[SensorModel]] = {}
        for plugin, offered in self._returned("ortho_models"):
            with self._judged(self._origin[plugin]):
                for name, family in offered.items():
                    if not (isinstance(name, str) and isinstance(family, type) and issubclass(family, SensorModel)):
                        raise PluginError(f"plugin {plugin}: ortho_models must map names to SensorModel classes")
                    taken = KINDS.get(name, family)
                    if taken is not family:
                        raise PluginError(
                            f"plugin {plugin} offers the model family {name!r}, but that name is taken by "
                            f"{taken.__module__}.{taken.__qualname__}",
                            remedy=f"give {family.__qualname__} another kind; or uninstall that plugin",
                        )
                    self._claim(plugin, name, "model family")
                    families[name] = family
        return families

    @functools.cached_property
    def studies(self) -> Mapping[str, Study]:
        """The simulations and experiments by name; collected when they are first asked for."""
        studies: dict[str, Study] = {}
        for plugin, offered in self._returned("ortho_studies"):
            with self._judged(self._origin[plugin]):
                for study in offered:
                    if not isinstance(study, Study):
                        raise PluginError(f"plugin {plugin}: ortho_studies yields {type(study).__name__}, not Study")
                    if study.name in studies and self._owner[study.name] == plugin:
                        raise PluginError(f"plugin {plugin} offers two studies {study.name!r}")
                    self._claim(plugin, study.name, "study")
                    studies[study.name] = study
        return MappingProxyType(dict(sorted(studies.items())))

    def _claim(self, plugin: str, name: str, what: str) -> None:
        bundled = {key for key, origin in self._origin.items() if _normalised(origin.distribution) == BUNDLED}
        if plugin not in bundled and (name in self._reserved or self._owner.get(name) in bundled):
            raise PluginError(
                f"plugin {plugin} offers the {what} {name!r}, but that name belongs to {BUNDLED}",
                remedy=f"its author: rename the {what}; its users: uninstall that plugin",
            )
        # A sensor and a model family of one plugin may share a name.
        if self._owner.get(name, plugin) != plugin:
            raise PluginError(
                f"two plugins offer the {what} {name!r}: {self._owner[name]} and {plugin}",
                remedy=f"an author: rename the {what}; a user: uninstall one of the two",
            )
        self._owner[name] = plugin

    def _recognises(self, sensor: Sensor, dataset: Any) -> bool:
        try:
            return bool(sensor.recognises(dataset))
        except Terminated:
            raise
        except (Exception, SystemExit) as error:
            raise PluginError(
                f"{self._name(sensor)} failed while looking at the dataset ({described(error, sensor.recognises)})",
                file=dataset.GetDescription(),
                remedy="choose the sensor yourself with `scene.sensor=NAME`, or uninstall that plugin",
            ) from error

    def _name(self, sensor: Sensor) -> str:
        return f"sensor {sensor.name!r} of plugin {self._owner[sensor.name]}"


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


def _normalised(distribution: str) -> str:
    return distribution.lower().replace("_", "-").replace(".", "-")


def _unknown_sensor(name: str, sensors: Iterable[str]) -> InputError:
    names = ", ".join(sensors) or "none"
    return InputError(
        f"there is no sensor {name!r} (installed: {names})", field="scene.sensor", remedy="see `ortho sensors`"
    )


def _not_one(found: list[Sensor], sensors: Iterable[Sensor], path: str) -> InputError:
    if found:
        names = ", ".join(item.name for item in found)
        return InputError(
            f"several sensors recognise it: {names}", file=path, remedy="choose one with `scene.sensor=NAME`"
        )
    names = ", ".join(item.name for item in sensors) or "none"
    general = ", ".join(item.name for item in sensors if item.fallback)
    hint = f" (for images in general: {general})" if general else ""
    return InputError(
        f"no sensor recognises it (installed: {names})",
        file=path,
        remedy=f"choose one with `scene.sensor=NAME`, which says what it needs{hint}, or give the RPC file with "
        "`scene.rpc=FILE`",
    )
