"""Check that the repository is ready for a tag, and print the notes of its release: the version's part of CHANGELOG.md.

    python tools/release.py v0.8.0

It stops if the package has another version, if CHANGELOG.md has no section of it, or if README.md has relative links,
which PyPI cannot follow. Needs Python alone.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def notes(tag: str, root: Path = ROOT) -> str:
    """Return what CHANGELOG.md says of the version of a tag; exit with an error if the repository is not ready."""
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    if tag != f"v{version}":
        raise SystemExit(f"Error: the tag is {tag}, but pyproject.toml has version {version}. Use v{version}.")
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    section = changes.partition(f"\n## {version} (")[2].partition("\n## ")[0]
    found = section.partition("\n")[2].strip()
    if not found:
        raise SystemExit(f"Error: CHANGELOG.md has no section '## {version} (DATE)' with changes.")
    relative = relative_links((root / "README.md").read_text(encoding="utf-8"))
    if relative:
        raise SystemExit(
            f"Error: {len(relative)} links of README.md are relative ({relative[0]}, ...). They break on PyPI. "
            "RELEASING.md has the command that makes them absolute."
        )
    return found + "\n"


def relative_links(page: str) -> list[str]:
    """Return the targets of links and pictures of a page that depend on where the page is."""
    return [target for target in re.findall(r"\]\(([^)\s]+)\)", page) if not re.match(r"[a-z]+:|#", target)]


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    print(notes(sys.argv[1]), end="")
