"""STAC items of the aligned orthos of a stack, each with its sigma, and their catalog."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.batch.stack.recorded import RecordedFolder
from ortho_pipeline.report.stac import write_catalog, write_ortho_item
from ortho_pipeline.report.stack.records import StackRecord

CATALOG = "catalog.json"


def items_of(folder: Path, dates: Sequence[Dated]) -> list[Path]:
    """Return the paths of the items of dates and of their catalog, if all are written."""
    return [*(folder / f"{one.name}_stac.json" for one in dates), folder / CATALOG]


def write_items(aligned: RecordedFolder, folder: Path, dates: Sequence[Dated], record: StackRecord) -> Path:
    """Write an item of each aligned ortho, and the catalog; return the path of the catalog.

    `ortho:stack_sigma` is the standard deviation (m, per axis) relative to `ortho:stack_datum`; `ortho:stack_shift` is
    how far (m, to east and north) the image showed the ground displaced.

    Parameters
    ----------
    aligned : RecordedFolder
        The folder of the orthos, for which the items are.
    folder : Path
        Where they are written.

    Raises
    ------
    InputError
        If an ortho has no valid pixel.
    """
    items = []
    for one, of_date in zip(dates, record.dates, strict=True):
        if of_date.output is None or of_date.east_north_m is None or of_date.sigma_m is None:
            continue
        properties = {
            **one.conditions.stated(),
            "ortho:stack_datum": record.datum,
            "ortho:stack_sigma": round(of_date.sigma_m, 4),
            "ortho:stack_shift": [round(value, 4) for value in of_date.east_north_m],
        }
        path = folder / f"{one.name}_stac.json"
        ortho, model = Path(of_date.output).name, f"{one.name}_model.json"
        with aligned.local(ortho, model, folder=folder):
            files = {"ortho": folder / ortho, "model": folder / model}
            write_ortho_item(path, files, one.time, one.name, properties)
        items.append(path)
    write_catalog(folder / CATALOG, items, "a stack")
    return folder / CATALOG
