"""Tables 3, 4 and 5 of Ok and Turker on simulated BILSAT-1 scenes, compared with the paper.

Every number is the median over realisations, with the 5th and 95th percentile. A realisation draws the 44 positions
(which the paper does not state), the noise of the points, and the error of the ephemeris. `KNOBS` lists all settings,
and the rows to which they were fitted: rows with all 44 points, which need no selection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.geodesy.ellipsoid import geodetic
from ortho_pipeline.models import family_of
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.resection import resect
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points
from ortho_pipeline.points.selection import select_control
from ortho_studies.bilsat.statements import Vectors, statements
from ortho_studies.bilsat.truth import (
    FOCAL_LENGTH,
    HIGH,
    LOW,
    MAP_CRS,
    OFF_NADIR_DEG,
    PITCH,
    PLACES,
    POINTS,
    ROUGHNESS,
    SIGMA_GROUND,
    SIGMA_IMAGE,
    SIGMA_POSITION,
    SIZE,
    BilsatScene,
)
from ortho_studies.simulation.tables import Knob, Number, make_document

PAPER = "Ok and Turker, Orthorectification of BILSAT imagery using rigorous and simple geometric models"
#: Weight of Tikhonov's regularisation where the paper has one: with 44 points 0.78 and 0.62 px come out (paper: 0.76,
#: 0.63); with 1e-5 0.79 and 0.66.
RIDGE = {"rfm2": 3e-6, "rfm3": 3e-6}
RIGOROUS = "rigorous"
QUANTITIES = ("GCP X", "GCP Y", "GCP XY", "ICP X", "ICP Y", "ICP XY")
TITLES = {
    3: "Rigorous model, evenly distributed points",
    4: "Rigorous model, points in a small part of the image",
    5: "Simple models, evenly distributed points",
}
KNOBS = (
    Knob(
        "SIGMA_IMAGE",
        SIGMA_IMAGE,
        "px per axis",
        "fitted",
        "Pointing noise of the paper's images and operators, which is not published elsewhere. The usual 0.5 px "
        "would explain only 0.71 of the 0.99 px.",
        ("3|rigorous even:44|*",),
    ),
    Knob(
        "OFF_NADIR_DEG",
        OFF_NADIR_DEG,
        "degrees",
        "fitted",
        "Tilt across the track. The satellite can tilt by up to 30 degrees; the paper does not state the angle.",
        ("5|poly1 even:44|*",),
    ),
    Knob(
        "ROUGHNESS",
        ROUGHNESS,
        "",
        "fitted",
        "Height variation of the plains, from the errors of the models without heights.",
        ("5|poly2 even:44|*", "5|poly3 even:44|*", "5|projective even:44|*"),
    ),
    Knob(
        "RIDGE",
        RIDGE,
        "",
        "fitted",
        "Weight of the Tikhonov regularisation of these two models, which the paper does not state; tried in "
        "steps of a factor of 3.",
        ("5|rfm2 even:44|*", "5|rfm3 even:44|*"),
    ),
    Knob(
        "relief",
        "plains, one range of mountains in the east, 700 to 1900 m",
        "",
        "chosen",
        "The heights and the mountains in the east are from the paper. Four shapes fit the rows with 44 points; "
        "this one was chosen with knowledge of all rows. With the others, 80 to 85 % of all rows were within "
        "1.5, with this one 85 %. So the choice may explain up to 5 %.",
    ),
    Knob(
        "PLACES",
        PLACES,
        "places in a cell",
        "chosen",
        f"In each cell {PLACES} places are drawn, and the lowest is measured, because road crossings are in plains and "
        "valleys. With one place, 3 % fewer predictions are within 1.5; with six, the same number.",
    ),
    Knob(
        "SIGMA_GROUND",
        SIGMA_GROUND,
        "m per axis",
        "paper",
        "Better than 1 m in planimetry and elevation. This is a fortieth of a pixel, so it has no influence.",
    ),
    Knob(
        "SIGMA_POSITION",
        SIGMA_POSITION,
        "m per axis",
        "chosen",
        "Error of the ephemeris, from which the rigorous model starts. It has no influence, because position "
        "and attitude are adjusted without weights, as in the paper.",
    ),
)
NAIVE = (
    "the paper’s own value with 44 points. With p unknowns and k points it is multiplied by √(1 − p/(2k)) for the "
    "control and by √(1 + p/(2k)) for the check points. It uses no geometry. It takes the noise of each model from "
    "the paper; the simulation must predict this noise."
)


@dataclass(frozen=True)
class PaperRow:
    """One row of a table: model, choice of control points, and what the paper found (None: not given)."""

    table: int
    model: str
    selection: str
    paper: tuple[float | None, ...]

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.model} {self.selection}"


def _row3(count: int, *paper: float) -> PaperRow:
    return PaperRow(3, RIGOROUS, f"even:{count}", (*paper, *[None] * (6 - len(paper))))


def _row4(count: int, group: int, control: float, check: float) -> PaperRow:
    return PaperRow(4, RIGOROUS, f"cluster:{count}:{group}", (None, None, control, None, None, check))


def _row5(model: str, count: int, *paper: float) -> PaperRow:
    return PaperRow(5, model, f"even:{count}", (*paper, *[None] * (6 - len(paper))))


ROWS = (
    _row3(4, 0.65, 0.37, 0.75, 0.80, 0.82, 1.14),
    _row3(8, 0.54, 0.36, 0.65, 0.83, 0.74, 1.11),
    _row3(12, 0.71, 0.44, 0.84, 0.81, 0.74, 1.10),
    _row3(16, 0.74, 0.41, 0.85, 0.79, 0.77, 1.10),
    _row3(20, 0.69, 0.48, 0.84, 0.83, 0.79, 1.15),
    _row3(24, 0.80, 0.55, 0.97, 0.76, 0.78, 1.09),
    _row3(28, 0.78, 0.64, 1.01, 0.75, 0.66, 1.00),
    _row3(32, 0.74, 0.65, 0.98, 0.84, 0.64, 1.06),
    _row3(44, 0.75, 0.64, 0.99),
    _row4(4, 1, 0.33, 4.05),
    _row4(4, 2, 0.04, 6.38),
    _row4(4, 3, 0.19, 2.48),
    _row4(12, 1, 0.62, 1.97),
    _row4(12, 2, 0.71, 2.78),
    _row4(12, 3, 0.78, 1.67),
    _row5("poly1", 4, 1.25, 3.52, 3.74, 6.18, 2.62, 6.71),
    _row5("poly1", 20, 2.49, 2.57, 3.58, 2.25, 1.52, 2.72),
    _row5("poly1", 44, 2.22, 2.01, 3.00),
    _row5("poly2", 7, 0.21, 0.21, 0.29, 1.10, 0.79, 1.35),
    _row5("poly2", 20, 0.74, 0.38, 0.83, 1.04, 0.88, 1.36),
    _row5("poly2", 44, 0.87, 0.66, 1.09),
    _row5("poly3", 11, 0.52, 0.23, 0.57, 1.14, 2.30, 2.57),
    _row5("poly3", 20, 0.61, 0.36, 0.71, 0.98, 0.91, 1.34),
    _row5("poly3", 44, 0.77, 0.65, 1.00),
    _row5("rfm1", 8, 0.17, 0.05, 0.18, 0.73, 2.67, 2.77),
    _row5("rfm1", 20, 0.39, 0.40, 0.56, 0.81, 0.90, 1.21),
    _row5("rfm1", 44, 0.60, 0.65, 0.88),
    _row5("rfm2", 20, 0.21, 0.20, 0.29, 1.31, 1.27, 1.82),
    _row5("rfm2", 32, 0.49, 0.44, 0.95, 0.54, 1.03, 1.16),
    _row5("rfm2", 44, 0.48, 0.58, 0.76),
    _row5("rfm3", 40, 0.30, 0.28, 0.41, 0.92, 1.51, 1.77),
    _row5("rfm3", 44, 0.44, 0.46, 0.63),
    _row5("projective", 9, 1.03, 2.13, 2.37, 1.42, 1.63),
    _row5("projective", 20, 0.81, 0.87, 1.18, 1.14, 0.87, 1.43),
    _row5("projective", 44, 0.94, 0.82, 1.25),
    _row5("dlt", 12, 0.36, 0.50, 0.61, 0.79, 0.75, 1.09),
    _row5("dlt", 20, 0.46, 0.47, 0.66, 0.74, 0.82, 1.11),
    _row5("dlt", 44, 0.60, 0.66, 0.89),
)


def reproduce(
    realisations: int = 100,
    *,
    off_nadir_deg: float = OFF_NADIR_DEG,
    sigma_image: float = SIGMA_IMAGE,
    sigma_ground: float = SIGMA_GROUND,
    rows: tuple[PaperRow, ...] = ROWS,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Run the experiment and return the document of ``ortho reproduce bilsat --json``.

    Returns
    -------
    dict
        As `tables.make_document` makes it.
    """
    values = np.full((len(rows), realisations, len(QUANTITIES)), np.nan)
    vectors = np.full((realisations, 2), np.nan)
    for seed in range(realisations):
        scene = BilsatScene.make(off_nadir_deg, seed=seed)
        points = scene.measure(seed, sigma_image=sigma_image, sigma_ground=sigma_ground).to_crs(MAP_CRS)
        position = geodetic(np.array([scene.survey(seed).position]))[0]
        for index, row in enumerate(rows):
            result = _fit(row, points, position)
            values[index, seed] = _numbers(result)
            if (row.model, row.selection) == (RIGOROUS, f"even:{len(points)}") and result is not None:
                vectors[seed] = _vector_statistics(points.image, result.residuals)
        if progress:
            progress((seed + 1) / realisations)
    numbers = [(row, k) for row in rows for k, number in enumerate(row.paper) if number is not None]
    medians = {
        (row.label, QUANTITIES[k]): float(np.median(kept))
        for row, k in numbers
        for kept in [values[rows.index(row), :, k][np.isfinite(values[rows.index(row), :, k])]]
        if len(kept)
    }
    seen = np.isfinite(vectors).any()
    return make_document(
        PAPER,
        sensor="bilsat",
        settings_text=(
            f"{realisations} realisations, {off_nadir_deg:g} degrees off nadir, noise {sigma_image:g} px in the image "
            f"and {sigma_ground:g} m on the ground, regularisation of rfm2 and rfm3 "
            f"{' and '.join(f'{value:g}' for value in sorted(set(RIDGE.values())))}"
        ),
        knobs=KNOBS,
        naive_text=NAIVE,
        numbers=[Number(row.table, row.label, QUANTITIES[k], "px", row.paper[k], naive(row, k)) for row, k in numbers],
        found=np.stack([values[rows.index(row), :, k] for row, k in numbers], axis=1),
        titles=TITLES,
        statements=statements(medians, Vectors(*np.nanmedian(vectors, axis=0).tolist()) if seen else None),
    )


def naive(row: PaperRow, k: int) -> float | None:
    """Guess a number of a row from the paper's row of the same model with all points (`NAIVE`)."""
    count = int(row.selection.split(":")[1])
    if count == POINTS:
        return None
    level = next(one for one in ROWS if (one.model, one.selection) == (row.model, f"even:{POINTS}")).paper[k % 3]
    unknowns = 6 if row.model == RIGOROUS else family_of(row.model).parameters
    share = unknowns / (2 * count)
    return None if level is None else float(level * np.sqrt(max(0.0, 1 + share if k >= 3 else 1 - share)))


def _vector_statistics(image: Array, residuals: Array) -> tuple[float, float]:
    """Return the correlation of neighbours' residuals, and that of the ranks of isolation and length."""
    apart = np.linalg.norm(image[:, None] - image[None], axis=2) + np.diag(np.full(len(image), np.inf))
    nearest = apart.argmin(axis=1)
    neighbours = float((residuals * residuals[nearest]).sum() / (residuals**2).sum())
    ranks = [values.argsort().argsort() for values in (apart.min(axis=1), np.hypot(*residuals.T))]
    return neighbours, float(np.corrcoef(ranks)[0, 1])


def error_vectors(seed: int = 0) -> tuple[Array, Array]:
    """Return image points and residuals ``(44, 2)`` of the rigorous model with all points, as in figure 2."""
    scene = BilsatScene.make(OFF_NADIR_DEG, seed=seed)
    points = scene.measure(seed)
    position = geodetic(np.array([scene.survey(seed).position]))[0]
    return points.image, _rigorous(points, position).residuals


def _interior() -> Interior:
    return Interior(SIZE, SIZE, FOCAL_LENGTH, PITCH, PITCH)


def _rigorous(points: Points, position: np.ndarray) -> Fit:
    # From the ephemeris, as equation 5, but with the rotation that the points give: from zero angles the fit to a
    # cluster of points now and then ends on the far side of the normal of its small triangle.
    start = resect(points, _interior(), position=position, heights=(LOW - 100, HIGH + 100))
    return fit(start, points, robust=False, name=RIGOROUS)


def _fit(row: PaperRow, points: Points, position: np.ndarray) -> Fit | None:
    # All points stand for all: there is nothing to select.
    chosen = points if row.selection == f"even:{len(points)}" else select_control(points, row.selection)
    try:
        if row.model == RIGOROUS:
            return _rigorous(chosen, position)
        return fit_family(row.model, chosen, robust=False, ridge=RIDGE.get(row.model))
    except OrthoError:
        return None


def _numbers(result: Fit | None) -> list[float]:
    if result is None:
        return [np.nan] * len(QUANTITIES)
    control, check = result.rmse("control"), result.rmse("check")
    return [getattr(part, key) if part else np.nan for part in (control, check) for key in ("col", "row", "total")]
