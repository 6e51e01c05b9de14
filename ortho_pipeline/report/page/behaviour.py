"""The script of a page, and the policy that lets a browser run this one and load nothing."""

from __future__ import annotations

import base64
import functools
import hashlib
from importlib import resources


@functools.cache
def script() -> str:
    """Return the script that sorts and filters tables, and shows which vector, chip and row are of one point."""
    folder = resources.files("ortho_pipeline.report") / "templates"
    return (folder / "page.js").read_text(encoding="utf-8")


def policy(code: str) -> str:
    """Return the Content-Security-Policy of a page that runs `code`: nothing else runs, and nothing is loaded."""
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    return (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
        f"script-src 'sha256-{digest}'"
    )
