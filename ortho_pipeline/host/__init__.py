"""Plugins: find them, recognise a product, open it.

`ortho_pipeline.hookspecs` is the other side. Host and GDAL are loaded on first use, because the commands of packages
are found without them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ortho_pipeline.runtime.lazy_names import lazily

if TYPE_CHECKING:
    from ortho_pipeline.host.discovery import Host as Host
    from ortho_pipeline.host.discovery import open_scene as open_scene

__all__ = ["Host", "open_scene"]

if not TYPE_CHECKING:  # a checker knows the names from above, and no others
    __getattr__ = lazily(__name__, dict.fromkeys(__all__, "host.discovery"))
