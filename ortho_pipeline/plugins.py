"""All that the host calls: find the plugins, recognise a product, open it.

Plugins are found through the entry-point group ``ortho_pipeline``, the bundled ones included: they have no privileged
path, only reserved names. See `ortho_pipeline.hookspecs` for the other side.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from os import PathLike
from types import MappingProxyType, ModuleType
from typing import Any

import pluggy

from ortho_pipeline import hookspecs
from ortho_pipeline.errors import InputError, OrthoError, PluginError
from ortho_pipeline.hookspecs import PROJECT_NAME, Scene, Sensor
from ortho_pipeline.models import KINDS, SensorModel
from ortho_pipeline.raster import open_dataset

BUNDLED = "ortho-pipeline"
HOOKS = ("ortho_sensors", "ortho_models")
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
    """A plugin that could not be imported, and why."""

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

    Attributes
    ----------
    sensors : mapping of str to Sensor
    models : mapping of str to type
        Model families that plugins registered.
    broken : tuple of Broken
        Installed plugins that could not be imported.

    Raises
    ------
    PluginError
        If two sensors have one name, a bundled name is taken by another distribution, a hook is misspelt or has
        the wrong arguments, or a hook returns what it must not.
    """

    def __init__(self, plugins: Iterable[ModuleType] = (), *, installed: bool = False) -> None:
        self._manager = pluggy.PluginManager(PROJECT_NAME)
        self._manager.add_hookspecs(hookspecs)
        self._origin: dict[str, Provenance] = {}
        self._owner: dict[str, str] = {}
        self._reserved: set[str] = set()
        self.broken: tuple[Broken, ...] = ()
        if installed:
            self._register_installed()
        for plugin in plugins:
            name = plugin.__name__
            self._register(plugin, Provenance(name, name, "(registered by a script)", ""))
        self._refuse_unknown_hooks()
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
        raise _not_one(found, self.sensors, dataset.GetDescription())

    def open_scene(
        self,
        path: str | PathLike[str],
        sensor: str | None = None,
        options: Mapping[str, Any] | None = None,
        *,
        allow_network: bool = False,
    ) -> Scene:
        """Open a product with the sensor that recognises it; see `open_scene`."""
        options = dict(options or {})
        dataset = open_dataset(path, allow_network=allow_network)
        chosen = self.recognise(dataset, sensor, options)
        for name in options:
            if name not in chosen.options:
                declared = ", ".join(chosen.options) or "none"
                raise InputError(
                    f"the sensor {chosen.name!r} has no option {name!r} (its options: {declared})",
                    file=path,
                    field=name,
                    remedy="see `ortho sensors`, or choose another sensor with --sensor NAME",
                )
        try:
            scene = chosen.open_scene(dataset, **options)
        except OrthoError:
            raise
        except Exception as error:
            raise PluginError(f"{self._name(chosen)} failed to open it ({_text(error)})", file=path) from error
        self._check_scene(chosen, scene)
        return scene

    def _register_installed(self) -> None:
        broken = []
        for entry in sorted(metadata.entry_points(group=PROJECT_NAME), key=lambda entry: entry.name):
            distribution, version = (entry.dist.name, entry.dist.version) if entry.dist else ("(unknown)", "")
            if _normalised(distribution) == BUNDLED:
                self._reserved.add(entry.name)
            try:
                plugin = entry.load()
            except Exception as error:
                # A plugin is somebody else's code: whatever its import does wrong, the others go on.
                broken.append(Broken(entry.name, distribution, version, _text(error)))
                log.warning("%s", broken[-1])
                continue
            self._register(plugin, Provenance(entry.name, entry.value, distribution, version))
        self.broken = tuple(broken)

    def _register(self, plugin: Any, origin: Provenance) -> None:
        name = f"{origin.plugin} ({origin})" if origin.version else origin.plugin
        for hook in HOOKS:
            if callable(getattr(plugin, hook, None)) and self._manager.parse_hookimpl_opts(plugin, hook) is None:
                raise PluginError(f"plugin {name}: {hook} is not marked with @hookimpl", file=origin.module)
        try:
            registered = self._manager.register(plugin, name)
        except (pluggy.PluginValidationError, ValueError) as error:
            raise PluginError(f"plugin {name}: {error}", file=origin.module) from error
        if registered is not None:
            self._origin[registered] = origin

    def _refuse_unknown_hooks(self) -> None:
        try:
            self._manager.check_pending()
        except pluggy.PluginValidationError as error:
            raise PluginError(f"misspelt hook: {error}", remedy=f"the hooks are {', '.join(HOOKS)}") from error

    def _returned(self, hook: str) -> Iterable[tuple[str, Any]]:
        # Each implementation is called by itself, so that an error can name its plugin.
        for implementation in getattr(self._manager.hook, hook).get_hookimpls():
            plugin = implementation.plugin_name
            try:
                result = implementation.function()
                yield plugin, dict(result) if hook == "ortho_models" else list(result)
            except Exception as error:
                raise PluginError(f"plugin {plugin}: {hook} failed ({_text(error)})") from error

    def _collect_sensors(self) -> dict[str, Sensor]:
        sensors: dict[str, Sensor] = {}
        for plugin, offered in self._returned("ortho_sensors"):
            for sensor in offered:
                _check_sensor_type(plugin, sensor)
                if sensor.name in sensors and self._owner[sensor.name] == plugin:
                    raise PluginError(f"plugin {plugin} offers two sensors {sensor.name!r}")
                self._claim(plugin, sensor.name)
                sensors[sensor.name] = sensor
        return dict(sorted(sensors.items()))

    def _collect_models(self) -> dict[str, type[SensorModel]]:
        families: dict[str, type[SensorModel]] = {}
        for plugin, offered in self._returned("ortho_models"):
            for name, family in offered.items():
                if not (isinstance(name, str) and isinstance(family, type) and issubclass(family, SensorModel)):
                    raise PluginError(f"plugin {plugin}: ortho_models must map names to SensorModel classes")
                if KINDS.get(name, family) is not family:
                    raise PluginError(f"plugin {plugin} offers the model family {name!r}, but that name is taken")
                self._claim(plugin, name)
                families[name] = family
        return families

    def _claim(self, plugin: str, name: str) -> None:
        bundled = {key for key, origin in self._origin.items() if _normalised(origin.distribution) == BUNDLED}
        if plugin not in bundled and (name in self._reserved or self._owner.get(name) in bundled):
            raise PluginError(
                f"plugin {plugin} offers {name!r}, but that name belongs to {BUNDLED}",
                remedy="uninstall that plugin, or ask its author for another name",
            )
        # A sensor and a model family of one plugin may share a name.
        if self._owner.get(name, plugin) != plugin:
            raise PluginError(
                f"two plugins offer {name!r}: {self._owner[name]} and {plugin}", remedy="uninstall one of the two"
            )
        self._owner[name] = plugin

    def _recognises(self, sensor: Sensor, dataset: Any) -> bool:
        try:
            return bool(sensor.recognises(dataset))
        except Exception as error:
            raise PluginError(
                f"{self._name(sensor)} failed while looking at the dataset ({_text(error)})",
                file=dataset.GetDescription(),
                remedy="choose the sensor yourself with --sensor NAME, or uninstall that plugin",
            ) from error

    def _name(self, sensor: Sensor) -> str:
        return f"sensor {sensor.name!r} of plugin {self._owner[sensor.name]}"

    def _check_scene(self, sensor: Sensor, scene: object) -> None:
        wrong = None
        if not isinstance(scene, Scene):
            wrong = f"open_scene returned {type(scene).__name__} instead of a Scene"
        elif scene.sensor != sensor.name:
            wrong = f"the scene says that it is of sensor {scene.sensor!r}"
        elif not scene.models or not all(isinstance(model, SensorModel) for model in scene.models.values()):
            wrong = "the scene has no models, or one that is no SensorModel"
        elif not (scene.width > 0 and scene.height > 0):
            wrong = f"the size of the scene is {scene.width} x {scene.height}"
        if wrong:
            raise PluginError(f"{self._name(sensor)}: {wrong}")


def open_scene(
    path: str | PathLike[str],
    sensor: str | None = None,
    options: Mapping[str, Any] | None = None,
    *,
    allow_network: bool = False,
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
        Whether URLs and GDAL's virtual file systems may be opened.

    Raises
    ------
    InputError
        If the file cannot be opened, no sensor or several recognise it, or an option is not the sensor's.
    PluginError
        If a plugin broke the contract.
    """
    return Host.discover().open_scene(path, sensor, options, allow_network=allow_network)


@functools.cache
def _discovered() -> Host:
    host = Host(installed=True)
    # From now on model files that name one of these families can be read.
    KINDS.update(host.models)
    return host


def _normalised(distribution: str) -> str:
    return distribution.lower().replace("_", "-").replace(".", "-")


def _text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _check_sensor_type(plugin: str, sensor: object) -> None:
    wrong = None
    if not isinstance(sensor, Sensor):
        wrong = f"ortho_sensors returned {type(sensor).__name__} instead of Sensor"
    elif not isinstance(sensor.name, str) or not sensor.name or sensor.name != sensor.name.strip():
        wrong = f"{sensor.name!r} is no name of a sensor"
    elif not callable(sensor.recognises) or not callable(sensor.open_scene):
        wrong = f"sensor {sensor.name!r}: recognises and open_scene must be callable"
    elif not isinstance(sensor.options, Mapping) or not all(
        isinstance(text, str) for pair in sensor.options.items() for text in pair
    ):
        wrong = f"sensor {sensor.name!r}: options must map names to help texts"
    if wrong:
        raise PluginError(f"plugin {plugin}: {wrong}")


def _unknown_sensor(name: str, sensors: Iterable[str]) -> InputError:
    names = ", ".join(sensors) or "none"
    return InputError(
        f"there is no sensor {name!r} (installed: {names})", field="--sensor", remedy="see `ortho sensors`"
    )


def _not_one(found: list[Sensor], sensors: Iterable[str], path: str) -> InputError:
    if found:
        names = ", ".join(item.name for item in found)
        return InputError(f"several sensors recognise it: {names}", file=path, remedy="choose one with --sensor NAME")
    names = ", ".join(sensors) or "none"
    return InputError(
        f"no sensor recognises it (installed: {names})",
        file=path,
        remedy="choose one with --sensor NAME, or give the RPC file with --rpc FILE",
    )
