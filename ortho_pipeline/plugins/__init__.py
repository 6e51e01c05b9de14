"""All that the host calls: find the plugins, recognise a product, open it.

See `ortho_pipeline.hookspecs` for the other side. Host and GDAL are loaded when they are first asked for: the commands
that packages add are found without them.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ortho_pipeline.plugins.host import Host as Host
    from ortho_pipeline.plugins.host import open_scene as open_scene

__all__ = ["Host", "open_scene"]

if not TYPE_CHECKING:  # a checker knows the names from above, and no others

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.host"), name)
        globals()[name] = value
        return value
