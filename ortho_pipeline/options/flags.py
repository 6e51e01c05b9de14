"""Flags of options: what people type for the name by which messages know an option."""

from __future__ import annotations

from collections.abc import Mapping

from ortho_pipeline.errors.texts import Setting
from ortho_pipeline.options.block import BlockOptions
from ortho_pipeline.options.groups import GROUPS
from ortho_pipeline.options.mosaic import MosaicOptions
from ortho_pipeline.options.option import options_of
from ortho_pipeline.options.stack import StackOptions

#: Options of a scene, of a mosaic and of a stack.
FLAGGED = {**GROUPS, "mosaic": MosaicOptions, "stack": StackOptions}
#: Name of an option in messages -> its flag, if a command has it.
FLAGS = {
    f"{group}.{name}": option.flags.split()[0]
    for group, options in (("points", BlockOptions), *FLAGGED.items())
    for name, option in options_of(options).items()
}


def flag_of(setting: Setting, flags: Mapping[str, str] = FLAGS) -> str:
    """Return an option with its value as it is typed; one without a flag as messages name it.

    Examples
    --------
    >>> flag_of(Setting("surface.dem", "FILE"))
    '--dem FILE'
    """
    return f"{flags[setting.name]} {value_of(setting)}".strip() if setting.name in flags else str(setting)


def value_of(setting: Setting) -> str:
    """Return the value of an option in a text, with its key if it has several."""
    return "=".join(part for part in (setting.key, setting.value) if part is not None)
