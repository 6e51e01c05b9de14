"""The study ``bilsat``: BILSAT-1 frames over Ankara, and the tables of Ok and Turker."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from os import PathLike

from ortho_studies.bilsat import experiment, page
from ortho_studies.bilsat.simulation import write_product
from ortho_studies.bilsat.truth import OFF_NADIR_DEG, SIZE, XS_CAMERAS
from ortho_studies.hookspecs import Reproduced, Simulated, Study, StudyOption, hookimpl
from ortho_studies.simulation.page import text


def simulate(
    folder: str | PathLike[str],
    *,
    seed: int = 0,
    off_nadir: float = OFF_NADIR_DEG,
    size: int = SIZE,
    all_cameras: bool = False,
) -> Simulated:
    """Write a BILSAT-1 frame over Ankara: image, imaging survey, DEM, 44 points, truth."""
    cameras = tuple(XS_CAMERAS) if all_cameras else ("red",)
    files = write_product(folder, seed=seed, off_nadir_deg=off_nadir, size=size, cameras=cameras)
    return Simulated(
        files,
        f"A simulated BILSAT-1 scene (seed {seed}); try\n  ortho rectify {files['image']} "
        f"--gcps {files['gcps']} --dem {files['dem']} --correction model -o out",
    )


def reproduce(realisations: int, *, progress: Callable[[float], None] | None = None) -> Reproduced:
    """Tables 3, 4 and 5 and figure 2 of Ok and Turker, on simulated BILSAT-1 scenes."""
    document = experiment.reproduce(realisations, progress=progress)
    return Reproduced(document, text(document), lambda: page.page(document, *experiment.error_vectors()))


@hookimpl
def ortho_studies() -> Iterable[Study]:
    """Offer the study."""
    yield STUDY


STUDY = Study(
    "bilsat",
    "A BILSAT-1 frame over Ankara, 44 points (Ok and Turker)",
    simulate,
    reproduce,
    (
        StudyOption("off_nadir", "Off-nadir angle  [default: that of 'reproduce bilsat']", low=0, high=30, unit="DEG"),
        StudyOption("size", "Columns and rows; fewer means larger pixels  [default: 2048]", int, unit="PX"),
        StudyOption(
            "all_cameras", "Write an image of each of the four XS cameras, not only of the red one.", bool, flag="--xs"
        ),
    ),
)
