"""The registered plugins: their origin, what their hooks return, and who owns each name.

All plugins, also the bundled ones, are found through entry-point groups; bundled ones only have reserved names.
Packages with commands have their own group, because ``ortho --help`` loads them, and sensors import NumPy and GDAL.
"""

from __future__ import annotations

import contextlib
import difflib
import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from traceback import walk_tb
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any

import pluggy

from ortho_pipeline import hookspecs
from ortho_pipeline.errors import OrthoError, PluginError, described
from ortho_pipeline.hookspecs import BlockFormat, Format, Sensor, Subcommand

if TYPE_CHECKING:
    from ortho_pipeline.models import SensorModel

BUNDLED = "ortho-pipeline"
_TYPED, _TARGET = re.compile(r"[a-z][a-z0-9-]*"), re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_ENDING, _FILE = re.compile(r"[._-][A-Za-z0-9._-]*\.?[A-Za-z0-9]+"), re.compile(r"[a-z0-9-]+\.[a-z0-9]+")
_ENTRY = re.compile(r"\w[\w.]*(\s*:\s*\w[\w.]*)?\s*(\[.*\])?")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Origin:
    """Origin of a plugin: its module, distribution and version."""

    plugin: str
    module: str
    distribution: str
    version: str

    def __str__(self) -> str:
        return f"{self.distribution} {self.version}".strip()

    @property
    def code(self) -> str:
        """The name of the module without that of an object in it."""
        return self.module.partition(":")[0].partition("[")[0].strip()

    @property
    def bundled(self) -> bool:
        """Whether the plugin belongs to ortho-pipeline."""
        return self.distribution.lower().replace("_", "-").replace(".", "-") == BUNDLED


@dataclass(frozen=True)
class Broken:
    """A plugin that could not be imported or breaks the contract, with the reason."""

    plugin: str
    distribution: str
    version: str
    error: str

    def __str__(self) -> str:
        return f"plugin {self.plugin!r} of {self.distribution} {self.version} is skipped: {self.error}"


def _installed(group: str) -> Iterator[tuple[Origin, metadata.EntryPoint]]:
    """Yield the plugins that installed distributions declare, with their origins; some may have no metadata."""
    known: dict[int, tuple[str, str]] = {}  # each access to a name or version parses all metadata
    for entry in metadata.entry_points(group=group):
        if id(entry.dist) not in known:
            known[id(entry.dist)] = "(unknown)", ""
            # Some versions of importlib raise where the metadata are missing, others return none.
            with contextlib.suppress(FileNotFoundError):
                fields = entry.dist.metadata if entry.dist else {"Name": "", "Version": ""}
                known[id(entry.dist)] = fields["Name"] or "(unknown)", fields["Version"] or ""
        yield Origin(entry.name, entry.value, *known[id(entry.dist)]), entry


def fault_of_plugin(error: BaseException) -> PluginError | None:
    """Return an exception as the fault of the installed sensor or model whose code it passed; None without one."""
    if isinstance(error, OrthoError | MemoryError):
        return None
    packages = {frame.f_globals.get("__name__", "").partition(".")[0] for frame, _ in walk_tb(error.__traceback__)}
    for origin, _ in _installed(hookspecs.PROJECT_NAME):
        if origin.code.partition(".")[0] in packages and not origin.bundled:
            fault = PluginError(
                f"plugin {origin.plugin} ({origin}) failed ({described(error, origin.code)})",
                remedy="report it to the author of the plugin",
            )
            fault.__cause__ = error
            return fault
    return None


class Registry:
    """The registered plugins, their origins, the owners of names, and what their hooks return.

    Parameters
    ----------
    lenient : bool
        Skip a plugin that breaks the contract and list it in `broken`, instead of raising.
    group : str, optional
        Entry-point group, one of ``GROUPS`` of `specs`; default: its ``PROJECT_NAME``.
    reserved : iterable of str
        Names that belong to the host.
    specs : module
        The hooks: `ortho_pipeline.hookspecs`, or the module of a package that has its own hooks.

    Attributes
    ----------
    origin : dict of str to Origin
        Origin of each plugin.
    owner : dict of str to str
        Plugin of each sensor, model family, format, command or other offer.
    broken : tuple of Broken
    """

    def __init__(
        self, lenient: bool, group: str = "", reserved: Iterable[str] = (), specs: ModuleType = hookspecs
    ) -> None:
        self._manager = pluggy.PluginManager(specs.PROJECT_NAME)
        self._manager.add_hookspecs(specs)
        self._specs = specs
        self._group = group or specs.PROJECT_NAME
        self._reserved = set(reserved)
        self._lenient = lenient
        self.origin: dict[str, Origin] = {}
        self.owner: dict[str, str] = {}
        self.broken: tuple[Broken, ...] = ()

    def register_installed(self) -> None:
        """Register the plugins that installed distributions declare as entry points."""
        # Bundled plugins first: their names are reserved.
        for origin, entry in sorted(_installed(self._group), key=lambda pair: (not pair[0].bundled, pair[1].name)):
            if origin.bundled:
                self._reserved.add(entry.name)
            try:
                if not _ENTRY.fullmatch(entry.value):
                    raise ImportError(f"its entry point {entry.value!r} does not name a module")
                plugin = entry.load()
            except (Exception, SystemExit) as error:
                # A plugin is foreign code: whatever fails in its import, continue with the others.
                self._leave_out(Broken(entry.name, origin.distribution, origin.version, described(error, origin.code)))
                continue
            self.register(plugin, origin)

    def register(self, plugin: Any, origin: Origin) -> None:
        """Register one plugin."""
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
        """Collect the sensors of all plugins, by name."""
        from ortho_pipeline.host.contract import sensor_faults

        return self.named("ortho_sensors", "sensor", Sensor, sensor_faults)

    def models(self) -> Mapping[str, type[SensorModel]]:
        """Collect the model families of all plugins, by kind."""
        from ortho_pipeline.models import KINDS, SensorModel

        families: dict[str, type[SensorModel]] = {}
        for plugin, offered in self._returned("ortho_models", Mapping, dict, "return {kind: class}"):
            with self._judged(self.origin[plugin]):
                for name, family in offered.items():
                    if not (isinstance(name, str) and isinstance(family, type) and issubclass(family, SensorModel)):
                        raise PluginError(f"plugin {plugin}: ortho_models must map names to SensorModel classes")
                    taken = KINDS.get(name, family)
                    if taken is not family:
                        raise PluginError(
                            f"plugin {plugin} offers the model family {name!r}, but this name belongs to "
                            f"{taken.__module__}.{taken.__qualname__}",
                            remedy=f"give {family.__qualname__} another kind, or uninstall the plugin",
                        )
                    self._claim(plugin, name, "model family")
                    families[name] = family
        return MappingProxyType(families)

    def formats(self) -> Mapping[str, Format | BlockFormat]:
        """Collect the formats of all plugins, by name; their output is checked."""
        from ortho_pipeline.exchange.export import FORMATS, RESERVED

        self._reserved |= RESERVED
        endings = {offer.ending.casefold(): offer.name for offer in FORMATS.values()}
        kinds = (Format, BlockFormat)
        added = self.named("ortho_formats", "format", kinds, lambda offer: _format_faults(offer, endings))
        return {name: _checked(offer, self.owner[name]) for name, offer in added.items()}

    def commands(self) -> Mapping[str, Subcommand]:
        """Collect the commands of all packages, by name."""
        return self.named("ortho_commands", "command", Subcommand, _command_faults)

    def named(
        self,
        hook: str,
        what: str,
        kind: type[Any] | tuple[type[Any], ...],
        faults: Callable[[Any], Iterator[str]] = lambda _: iter(()),
    ) -> Mapping[str, Any]:
        """Collect the offers of a hook, by name.

        Parameters
        ----------
        hook : str
            Returns an iterable of values of `kind`, or of one of several kinds.
        what : str
            Word for such a value in messages.
        faults : callable(offer) -> iterator of str
            Faults of an offer; the first one is an error of its plugin.
        """
        offers: dict[str, Any] = {}
        wanted = (kind if isinstance(kind, tuple) else (kind,))[0].__name__
        advice = f"yield the {wanted}, or return [{wanted}(...)]"
        for plugin, offered in self._returned(hook, Iterable, list, advice):
            with self._judged(self.origin[plugin]):
                for offer in offered:
                    if not isinstance(offer, kind):
                        raise PluginError(f"plugin {plugin}: {hook} yields {type(offer).__name__}, not {wanted}")
                    if fault := next(faults(offer), None):
                        raise PluginError(f"plugin {plugin}: {fault}")
                    if offer.name in offers and self.owner[offer.name] == plugin:
                        raise PluginError(f"plugin {plugin} offers the {what} {offer.name!r} twice")
                    self._claim(plugin, offer.name, what)
                    offers[offer.name] = offer
        return MappingProxyType(dict(sorted(offers.items())))

    @contextlib.contextmanager
    def _judged(self, origin: Origin) -> Iterator[None]:
        """Raise an error of a plugin, or skip the plugin and continue."""
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
        hooks = self._specs.GROUPS[self._group]
        for hook in hooks:
            if callable(getattr(plugin, hook, None)) and self._manager.parse_hookimpl_opts(plugin, hook) is None:
                marker = "ortho_pipeline.plugin" if self._specs is hookspecs else self._specs.__name__
                raise PluginError(
                    f"plugin {name}: {hook} has no decorator @hookimpl",
                    remedy=f"write @hookimpl (from {marker}) above it",
                )
        for hook in dir(plugin):
            if hook in hooks or self._manager.parse_hookimpl_opts(plugin, hook) is None:
                continue
            for group, others in self._specs.GROUPS.items():
                if hook in others:
                    raise PluginError(
                        f"plugin {name}: {hook} has no effect in the entry-point group {self._group}",
                        remedy=f"authors: declare its module in the group {group}",
                    )
            meant = difflib.get_close_matches(hook, hooks, 1) or hooks
            raise PluginError(f"plugin {name}: unknown hook {hook!r}", remedy=f"did you mean {' or '.join(meant)}?")

    def _returned(self, hook: str, wanted: type, collect: type, advice: str) -> Iterator[tuple[str, Any]]:
        # Call the hook for each plugin separately, with its wrappers, so that an error can name its plugin.
        implementations = getattr(self._manager.hook, hook).get_hookimpls()
        offering = [item for item in implementations if not (item.wrapper or item.hookwrapper)]
        for implementation in offering:
            plugin = implementation.plugin_name
            others = [item.plugin for item in offering if item is not implementation]
            with self._judged(self.origin[plugin]):
                try:
                    # pluggy drops None.
                    offered = next(iter(self._manager.subset_hook_caller(hook, others)()), None)
                    returned = collect(offered) if isinstance(offered, wanted) else None
                except (Exception, SystemExit) as error:
                    text = described(error, implementation.function)
                    raise PluginError(f"plugin {plugin}: {hook} failed ({text})") from error
                if returned is None:
                    what = type(offered).__name__
                    raise PluginError(f"plugin {plugin}: {hook} returned {what}", remedy=f"authors: {advice}")
                yield plugin, returned

    def _claim(self, plugin: str, name: str, what: str) -> None:
        bundled = {key for key, origin in self.origin.items() if origin.bundled}
        if plugin not in bundled and (name in self._reserved or self.owner.get(name) in bundled):
            raise PluginError(
                f"plugin {plugin} offers the {what} {name!r}, but this name belongs to {BUNDLED}",
                remedy=f"authors: rename the {what}; users: uninstall the plugin",
            )
        # A sensor and a model family of one plugin may share a name.
        if self.owner.get(name, plugin) != plugin:
            raise PluginError(
                f"two plugins offer the {what} {name!r}: {self.owner[name]} and {plugin}",
                remedy=f"authors: rename the {what}; users: uninstall one of the two",
            )
        self.owner[name] = plugin


def _format_faults(offer: Format | BlockFormat, endings: dict[str, str]) -> Iterator[str]:
    """Yield the faults of an offered format; `endings` are those in use, with the names of their formats."""
    if isinstance(offer, BlockFormat):
        ending, pattern, what, action = offer.file, _FILE, "file must be like 'name.json'", "text"
        named = bool(offer.models) and all(isinstance(one, str) for one in offer.models)
    else:
        ending, pattern, what, action = offer.ending, _ENDING, "ending must be like '_name.json'", "write"
        named = True
    if not isinstance(offer.name, str) or not _TYPED.fullmatch(offer.name):
        yield f"{offer.name!r} is not a valid format name; use lower case, digits and dashes"
    elif not isinstance(offer.title, str) or not offer.title.strip():
        yield f"format {offer.name!r}: the title is empty"
    elif not isinstance(ending, str) or not pattern.fullmatch(ending):
        yield f"format {offer.name!r}: the {what}, not {ending!r}"
    elif not named:
        yield f"format {offer.name!r}: models must name formats"
    elif not callable(getattr(offer, action)):
        yield f"format {offer.name!r}: {action} must be callable"
    elif (other := endings.setdefault(ending.casefold(), offer.name)) != offer.name:
        yield f"format {offer.name!r}: the format {other!r} has the same ending {ending!r}"


def _checked(offer: Format | BlockFormat, plugin: str) -> Format | BlockFormat:
    """Return a format that writes completely or not at all; errors name its plugin."""
    label = f"format {offer.name!r} of plugin {plugin}"
    if isinstance(offer, BlockFormat):
        return replace(offer, text=_checked_text(offer, label))
    return replace(offer, write=_checked_write(offer, label))


def _checked_text(offer: BlockFormat, label: str) -> Callable[[Any], str]:
    """Return the function for the text of a plugin's format."""

    def text(export: Any) -> str:
        with _of_plugin(label, offer.text, offer.file):
            content = offer.text(export)
        if not isinstance(content, str) or not content.strip():
            raise PluginError(f"{label}: text returned {content!r}", remedy="authors: return the text of the file")
        return content

    return text


def _checked_write(offer: Format, label: str) -> Callable[[Any, Path], float]:
    """Return the function that writes a plugin's format."""

    def write(export: Any, path: Path) -> float:
        from ortho_pipeline.files import whole_or_nothing

        with whole_or_nothing(path) as temporary:
            with _of_plugin(label, offer.write, path):
                worst = offer.write(export, temporary)
            if not temporary.stat().st_size:
                raise PluginError(f"{label} wrote nothing", file=path, remedy="authors: write to the given path")
            if isinstance(worst, bool) or not isinstance(worst, int | float) or not worst >= 0:
                raise PluginError(
                    f"{label}: write returned {worst!r}",
                    file=path,
                    remedy="authors: return the largest distance between file and model, in pixels",
                )
        return float(worst)

    return write


@contextlib.contextmanager
def _of_plugin(label: str, function: Callable[..., Any], file: str | Path) -> Iterator[None]:
    """Let an error of a plugin's function name the plugin."""
    try:
        yield
    except OrthoError:
        raise
    except (Exception, SystemExit) as error:
        raise PluginError(f"{label} failed ({described(error, function)})", file=file) from error


def _command_faults(command: Subcommand) -> Iterator[str]:
    texts = (command.name, command.summary, command.target)
    if not all(isinstance(text, str) for text in texts) or not _TYPED.fullmatch(command.name):
        yield f"{command.name!r} is not a valid command name; use lower case, digits and dashes"
    elif not _TARGET.fullmatch(command.target):
        yield f"command {command.name!r}: the target must be 'package.module:name', not {command.target!r}"
    elif not command.summary.strip():
        yield f"command {command.name!r}: the summary is empty"
