"""Run the notebooks of the documentation and store what they show; make pages of them for the site.

python docs/make_notebooks.py            run docs/notebooks/*.ipynb and store their outputs (make images)
python docs/make_notebooks.py --pages    write a page and its pictures for each, from the stored outputs (make docs)
"""

from __future__ import annotations

import base64
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
_FORMS = ("image/png", "text/html", "text/plain")


def run(path: Path, folder: Path) -> Any:
    """Return a notebook with the outputs of a run in `folder`, where it finds the sample data as in a checkout."""
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    place = folder / "docs" / "notebooks"
    place.mkdir(parents=True)
    (folder / "sample_data").symlink_to(ROOT / "sample_data")
    NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(place)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # the times of this run
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            shown = next((form for form in _FORMS if form in data), None)
            if shown:
                output.data = {shown: data[shown]}
    return notebook


def page(notebook: Any, folder: Path, name: str) -> str:
    """Return a notebook as Markdown; its pictures are written into `folder`."""
    parts = []
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "image/png" in data:
                picture = f"{name}-{number}.png"
                (folder / picture).write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![What the cell draws]({picture})")
            elif "text/html" in data:
                parts.append(re.sub(r"\n\s*\n", "\n", data["text/html"].strip()))
            else:
                parts.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def main(arguments: list[str]) -> None:
    """Run the notebooks, or write their pages."""
    for path in NOTEBOOKS:
        if arguments == ["--pages"]:
            text = page(nbformat.read(path, as_version=4), path.parent, path.stem)
            path.with_suffix(".md").write_text(text, encoding="utf-8")
            continue
        with tempfile.TemporaryDirectory() as folder:
            notebook = run(path, Path(folder))
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main(sys.argv[1:])
