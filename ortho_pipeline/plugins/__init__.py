"""All that the host calls: find the plugins, recognise a product, open it.

See `ortho_pipeline.hookspecs` for the other side.
"""

from __future__ import annotations

from ortho_pipeline.plugins.host import Host, open_scene
from ortho_pipeline.plugins.registry import HOOKS, Broken, Provenance, Registry

__all__ = ["HOOKS", "Broken", "Host", "Provenance", "Registry", "open_scene"]
