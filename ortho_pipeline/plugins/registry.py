"""The plugins that are there: where each came from, what its hooks return, and which names are whose.

Plugins are found through the entry-point group ``ortho_pipeline``, the bundled ones included: they have no privileged
path, only reserved names.
"""

from __future__ import annotations

import contextlib
import difflib
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from types import MappingProxyType
from typing import Any

import pluggy

from ortho_pipeline import hookspecs
from ortho_pipeline.errors import PluginError
from ortho_pipeline.hookspecs import PROJECT_NAME, Sensor, Study
from ortho_pipeline.models import KINDS, SensorModel
from ortho_pipeline.plugins.contract import described, sensor_faults

BUNDLED = "ortho-pipeline"
HOOKS = ("ortho_sensors", "ortho_models", "ortho_studies")
#: What each hook returns, what it is collected in, and what authors are told who return something else.
_RETURNS: dict[str, tuple[type, type, str]] = {
    "ortho_sensors": (Iterable, list, "yield the Sensor, or return [Sensor(...)]"),
    "ortho_models": (Mapping, dict, "return {kind: class}"),
    "ortho_studies": (Iterable, list, "yield the Study, or return [Study(...)]"),
}
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

    @property
    def bundled(self) -> bool:
        """Whether it comes along with the package."""
        return self.distribution.lower().replace("_", "-").replace(".", "-") == BUNDLED

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


class Registry:
    """The plugins that are registered, where they came from, which names are whose, and what their hooks return.

    Parameters
    ----------
    lenient : bool
        Leave out a plugin that breaks the contract and list it in `broken`, instead of raising.

    Attributes
    ----------
    origin : dict of str to Provenance
        Of every plugin, by its name.
    owner : dict of str to str
        The plugin that a sensor, a model family or a study belongs to.
    broken : tuple of Broken
    """

    def __init__(self, lenient: bool) -> None:
        self._manager = pluggy.PluginManager(PROJECT_NAME)
        self._manager.add_hookspecs(hookspecs)
        self._reserved: set[str] = set()
        self._lenient = lenient
        self.origin: dict[str, Provenance] = {}
        self.owner: dict[str, str] = {}
        self.broken: tuple[Broken, ...] = ()

    def register_installed(self) -> None:
        """Register the plugins that installed distributions name as entry points."""
        known: dict[int, tuple[str, str]] = {}  # each look at a name or a version parses all metadata
        for entry in sorted(metadata.entry_points(group=PROJECT_NAME), key=lambda entry: entry.name):
            if id(entry.dist) not in known:
                told = entry.dist.metadata if entry.dist else {"Name": "(unknown)", "Version": ""}
                known[id(entry.dist)] = told["Name"], told["Version"]
            distribution, version = known[id(entry.dist)]
            origin = Provenance(entry.name, entry.value, distribution, version)
            if origin.bundled:
                self._reserved.add(entry.name)
            try:
                plugin = entry.load()
            except (Exception, SystemExit) as error:
                # A plugin is somebody else's code: whatever its import does wrong, the others go on.
                self._leave_out(Broken(entry.name, distribution, version, described(error, entry.module)))
                continue
            self.register(plugin, origin)

    def register(self, plugin: Any, origin: Provenance) -> None:
        """Register one plugin, which came from `origin`."""
        name = f"{origin.plugin} ({origin})" if origin.version else origin.plugin
        with self._judged(origin):
            self._refuse_misspelt(plugin, name)
            try:
                registered = self._manager.register(plugin, name)
            except (pluggy.PluginValidationError, ValueError) as error:
                raise PluginError(f"plugin {name}: {error}", file=origin.module) from error
            if registered is not None:
                self.origin[registered] = origin

    def sensors(self) -> Mapping[str, Sensor]:
        """Collect the sensors that plugins offer, by name."""
        sensors: dict[str, Sensor] = {}
        for plugin, offered in self._returned("ortho_sensors"):
            with self._judged(self.origin[plugin]):
                for sensor in offered:
                    fault = next(sensor_faults(sensor), None)
                    if fault:
                        raise PluginError(f"plugin {plugin}: {fault}")
                    if sensor.name in sensors and self.owner[sensor.name] == plugin:
                        raise PluginError(f"plugin {plugin} offers two sensors {sensor.name!r}")
                    self._claim(plugin, sensor.name, "sensor")
                    sensors[sensor.name] = sensor
        return MappingProxyType(dict(sorted(sensors.items())))

    def models(self) -> Mapping[str, type[SensorModel]]:
        """Collect the model families that plugins offer, by kind."""
        families: dict[str, type[SensorModel]] = {}
        for plugin, offered in self._returned("ortho_models"):
            with self._judged(self.origin[plugin]):
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
        return MappingProxyType(families)

    def studies(self) -> Mapping[str, Study]:
        """Collect the studies that plugins offer, by name."""
        studies: dict[str, Study] = {}
        for plugin, offered in self._returned("ortho_studies"):
            with self._judged(self.origin[plugin]):
                for study in offered:
                    if not isinstance(study, Study):
                        raise PluginError(f"plugin {plugin}: ortho_studies yields {type(study).__name__}, not Study")
                    if study.name in studies and self.owner[study.name] == plugin:
                        raise PluginError(f"plugin {plugin} offers two studies {study.name!r}")
                    self._claim(plugin, study.name, "study")
                    studies[study.name] = study
        return MappingProxyType(dict(sorted(studies.items())))

    @contextlib.contextmanager
    def _judged(self, origin: Provenance) -> Iterator[None]:
        """Let an error of a plugin pass, or note it and go on."""
        try:
            yield
        except PluginError as error:
            if not self._lenient:
                raise
            self._leave_out(Broken(origin.plugin, origin.distribution, origin.version, error.message))

    def _leave_out(self, broken: Broken) -> None:
        self.broken += (broken,)
        log.warning("%s", broken)

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
            with self._judged(self.origin[plugin]):
                try:
                    offered = implementation.function()
                    returned = collect(offered) if isinstance(offered, wanted) else None
                except (Exception, SystemExit) as error:
                    text = described(error, implementation.function)
                    raise PluginError(f"plugin {plugin}: {hook} failed ({text})") from error
                if returned is None:
                    what = type(offered).__name__
                    raise PluginError(f"plugin {plugin}: {hook} returned {what}", remedy=f"its author: {advice}")
                yield plugin, returned

    def _claim(self, plugin: str, name: str, what: str) -> None:
        bundled = {key for key, origin in self.origin.items() if origin.bundled}
        if plugin not in bundled and (name in self._reserved or self.owner.get(name) in bundled):
            raise PluginError(
                f"plugin {plugin} offers the {what} {name!r}, but that name belongs to {BUNDLED}",
                remedy=f"its author: rename the {what}; its users: uninstall that plugin",
            )
        # A sensor and a model family of one plugin may share a name.
        if self.owner.get(name, plugin) != plugin:
            raise PluginError(
                f"two plugins offer the {what} {name!r}: {self.owner[name]} and {plugin}",
                remedy=f"an author: rename the {what}; a user: uninstall one of the two",
            )
        self.owner[name] = plugin
