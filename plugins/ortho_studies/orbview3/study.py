"""The study ``orbview3``: two OrbView-3 scenes over Zonguldak, and table 1 of Bueyueksalih et al."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from os import PathLike

from ortho_studies.hookspecs import Reproduced, Simulated, Study, StudyOption, hookimpl
from ortho_studies.orbview3 import experiment, page
from ortho_studies.orbview3.simulation import write_product
from ortho_studies.simulation.page import text


def simulate(folder: str | PathLike[str], *, seed: int = 0, pixel: int = 8) -> Simulated:
    """Write two OrbView-3 scenes over Zonguldak: images with .pvl and _rpc.txt, DEM, 34 points, truth."""
    files = write_product(folder, seed=seed, pixel=pixel)
    return Simulated(
        files,
        f"Two simulated OrbView-3 scenes (seed {seed}); try\n  ortho fit {files['image_471890']} "
        f"--gcps {files['gcps_471890']} --correction affine --prune",
    )


def reproduce(realisations: int, *, progress: Callable[[float], None] | None = None) -> Reproduced:
    """Table 1 and figures 4 to 7 of Bueyueksalih et al., on simulated OrbView-3 scenes, and their QuickBird table."""
    document = experiment.reproduce(realisations, progress=progress)
    return Reproduced(document, text(document), lambda: page.page(document, experiment.error_vectors()))


@hookimpl
def ortho_studies() -> Iterable[Study]:
    """Offer the study."""
    yield STUDY


STUDY = Study(
    "orbview3",
    "Two OrbView-3 scenes over Zonguldak (Bueyueksalih et al.)",
    simulate,
    reproduce,
    (StudyOption("pixel", "Pixel size in metres; 1 is the real size, larger means fewer pixels.", int, 8, unit="M"),),
)
