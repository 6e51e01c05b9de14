"""The study ``ikonos``: IKONOS Geo over Tehran, and table 2 of Amini and Hashemi."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from os import PathLike
from typing import Any

from ortho_studies.hookspecs import Reproduced, Simulated, Study, StudyOption, hookimpl
from ortho_studies.ikonos import experiment, page
from ortho_studies.ikonos.simulation import write_product
from ortho_studies.simulation.page import text


def simulate(
    folder: str | PathLike[str], *, seed: int = 0, off_nadir: float | None = None, **options: Any
) -> Simulated:
    """Write an IKONOS Geo delivery over Tehran: images, metadata, RPC, DEM, 20 control and 20 check points, truth."""
    if off_nadir is not None:
        options["off_nadir_deg"] = off_nadir
    files = write_product(folder, seed=seed, **options)
    return Simulated(
        files,
        f"A simulated IKONOS Geo scene (seed {seed}); try\n  ortho rectify {files['image']} "
        f"--gcps {files['gcps']} --dem {files['dem']} -o out",
    )


def reproduce(realisations: int, *, progress: Callable[[float], None] | None = None) -> Reproduced:
    """Table 2 and figure 4 of Amini and Hashemi, on simulated IKONOS scenes, with further models."""
    document = experiment.reproduce(realisations, progress=progress)
    return Reproduced(document, text(document), lambda: page.page(document, experiment.error_vectors()))


@hookimpl
def ortho_studies() -> Iterable[Study]:
    """Offer the study."""
    yield STUDY


STUDY = Study(
    "ikonos",
    "IKONOS Geo over Tehran, 40 points (Amini and Hashemi)",
    simulate,
    reproduce,
    (
        StudyOption("off_nadir", "Off-nadir angle  [default: that of 'reproduce ikonos']", low=0, high=45, unit="DEG"),
        StudyOption("size", "Columns and rows.", int, 1000, unit="PX"),
        StudyOption("pixel", "Pixel size  [default: the image covers 11 km]", unit="M"),
        StudyOption("rpc", "Write _rpc.txt or not.", bool, True, flag="--rpc/--no-rpc"),
        StudyOption("multispectral", "Also write four colour bands in separate files.", bool, flag="--ms"),
        StudyOption("components", "Number of files into which each image is cut.", int, 1),
    ),
)
