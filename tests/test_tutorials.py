"""The tutorials are done as they stand, and every picture in them is one that the code draws."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from make_tutorial_images import FIGURES, IMAGES, main, played

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


def test_every_tutorial_is_on_the_site_and_has_its_pictures():
    site = (ROOT / "mkdocs.yml").read_text()
    assert sorted(FIGURES) == [page.name for page in PAGES]
    for page in PAGES:
        assert f"tutorials/{page.name}" in site
        shown = re.findall(r"!\[[^\]]+\]\(\.\./images/tutorials/([^)]+)\)", page.read_text(encoding="utf-8"))
        assert sorted(shown) == sorted(FIGURES[page.name])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tutorial(page, tmp_path):
    for _ in played(page, tmp_path, slow=False):
        pass


@pytest.mark.slow
def test_the_pictures_are_those_of_the_code(tmp_path):
    """All of every tutorial; a picture is compared with that of the repository as it looks from a distance."""
    from PIL import Image

    main(tmp_path)
    for path in sorted(IMAGES.iterdir()):
        made = tmp_path / path.name
        if made.suffix == ".jpg" and not made.exists():
            assert path.name == "run.jpg"  # no browser here
            continue
        one, other = (Image.open(file).convert("L").resize((64, 64)) for file in (path, made))
        worst = max(abs(a - b) for a, b in zip(one.tobytes(), other.tobytes(), strict=True))
        assert worst < 60, path.name
    assert "matplotlib" in sys.modules
