"""The commands that installed packages add to `ortho`, by the hook `ortho_commands`."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import click

from ortho_pipeline.errors import PluginError, described
from ortho_pipeline.host.registry import Registry

if TYPE_CHECKING:
    from ortho_pipeline.hookspecs import Subcommand
    from ortho_pipeline.host.registry import Broken, Origin

GROUP = "ortho_pipeline_commands"


class AddedCommands:
    """The commands that installed packages add; a package that breaks the contract is skipped with a warning.

    Parameters
    ----------
    reserved : iterable of str
        The commands of the host.

    Attributes
    ----------
    offers : mapping of str to Subcommand
    """

    def __init__(self, reserved: Iterable[str]) -> None:
        self._registry = Registry(True, GROUP, reserved)
        self._registry.register_installed()
        self.offers: Mapping[str, Subcommand] = self._registry.commands()

    def packages(self) -> tuple[Origin, ...]:
        """Return where each package came from."""
        return tuple(self._registry.origin.values())

    def broken(self) -> tuple[Broken, ...]:
        """Return the packages that were left out, and why."""
        return self._registry.broken

    def load(self, name: str) -> click.Command:
        """Import a command.

        Raises
        ------
        PluginError
            If its package fails, or its target is no command of click.
        """
        module, _, attribute = self.offers[name].target.partition(":")
        problem = f"the command {name!r} of plugin {self._registry.owner[name]} cannot be loaded"
        try:
            command = getattr(importlib.import_module(module), attribute)
        except (Exception, SystemExit) as error:
            # A package may fail in any way, and its requirements may be missing.
            raise PluginError(
                f"{problem} ({described(error, module)})",
                remedy="install the missing requirement, or report the error to the author of the plugin",
            ) from error
        if not isinstance(command, click.Command):
            raise PluginError(f"{problem}: {module}:{attribute} is a {type(command).__name__}, not a click command")
        return command
