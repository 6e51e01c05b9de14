"""The study ``cartosat``: a CARTOSAT-1 stereo pair over Hobart, and the tables of Willneff et al."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from os import PathLike

from ortho_studies.cartosat import experiment, page
from ortho_studies.cartosat.simulation import write_product
from ortho_studies.hookspecs import Reproduced, Simulated, Study, StudyOption, hookimpl
from ortho_studies.simulation.page import text


def simulate(folder: str | PathLike[str], *, seed: int = 0, size: int = 1200, jitter: float = 0.0) -> Simulated:
    """Write a CARTOSAT-1 stereo pair over Hobart: BANDF and BANDA with _MET.TXT and _RPC.TXT, DEM, 69 points, truth."""
    files = write_product(folder, seed=seed, size=size, jitter=jitter)
    return Simulated(
        files,
        f"A simulated CARTOSAT-1 stereo pair (seed {seed}); try\n  ortho adjust {files['fore']} "
        f"{files['aft']} --points {files['points']} --model rpc --correction affine -o out",
    )


def reproduce(realisations: int, *, progress: Callable[[float], None] | None = None) -> Reproduced:
    """Tables 2 to 6 of Willneff et al., on simulated CARTOSAT-1 stereo pairs, and errors against the number of GCPs."""
    document = experiment.reproduce(realisations, progress=progress)
    return Reproduced(
        document, text(document), lambda: page.page(document, {m: experiment.error_vectors(m) for m in page.DRAWN})
    )


@hookimpl
def ortho_studies() -> Iterable[Study]:
    """Offer the study."""
    yield STUDY


STUDY = Study(
    "cartosat",
    "A CARTOSAT-1 stereo pair over Hobart, 69 points (Willneff et al.)",
    simulate,
    reproduce,
    (
        StudyOption(
            "size",
            "Columns and rows; 12000 is the real size (25 min), fewer means larger pixels.",
            int,
            1200,
            unit="PX",
        ),
        StudyOption("jitter", "Pitch jitter, in pixels of the real size.", float, 0.0, 0, 10, unit="PX"),
    ),
    realisations=50,
)
