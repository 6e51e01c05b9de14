"""The guts of ``ortho simulate`` and ``ortho reproduce``: scenes of known truth, and the papers' tables."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.experiments.page import text
from ortho_pipeline.files import write_text
from ortho_pipeline.pipeline import Result


def simulate_bilsat(
    folder: str | os.PathLike[str],
    *,
    seed: int = 0,
    off_nadir_deg: float | None = None,
    size: int | None = None,
    all_cameras: bool = False,
) -> Result:
    """Write a simulated BILSAT-1 scene: image, imaging survey, DEM, 44 points, truth.

    Parameters
    ----------
    off_nadir_deg, size : optional
        Tilt, and columns and rows; those of the paper's reproduction and of the real camera without them.
    all_cameras : bool
        Take the image with each of the four XS cameras.

    Raises
    ------
    InputError
        If such a scene is not possible, or the folder cannot be written.
    """
    from ortho_bilsat.simulation import write_product

    from ortho_pipeline.experiments.bilsat_scene import OFF_NADIR_DEG, SIZE, XS_CAMERAS

    files = write_product(
        folder, seed=seed, off_nadir_deg=OFF_NADIR_DEG if off_nadir_deg is None else off_nadir_deg,
        size=size or SIZE, cameras=tuple(XS_CAMERAS) if all_cameras else ("red",),
    )  # fmt: skip
    return Result(files, {}, f"A simulated BILSAT-1 scene (seed {seed}); try\n  ortho rectify {files['image']} "
                  f"--gcps {files['gcps']} --dem {files['dem']} --correction model -o out")  # fmt: skip


def reproduce_bilsat(
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int = 100,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute the tables of the BILSAT-1 paper on a simulated scene, beside the paper's numbers.

    Parameters
    ----------
    folder : path, optional
        Where ``bilsat.json`` and the page ``bilsat.html`` go.

    Returns
    -------
    Result
        `document` has paper, settings, summary and tables (docs/formats.md).
    """
    from ortho_pipeline.experiments import bilsat, bilsat_page

    document = bilsat.reproduce(realisations, progress=progress)
    return _written("bilsat", document, folder, lambda: bilsat_page.page(document, *bilsat.error_vectors()))


def _written(
    name: str, document: Mapping[str, Any], folder: str | os.PathLike[str] | None, page: Callable[[], str]
) -> Result:
    """Write document and page of a reproduction where there is a folder for them."""
    files = {} if folder is None else {ending: Path(folder) / f"{name}.{ending}" for ending in ("json", "html")}
    if files:
        write_text(files["json"], json.dumps(document, indent=1, allow_nan=False) + "\n")
        write_text(files["html"], page())
    return Result(files, document, text(document))
