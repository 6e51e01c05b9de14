"""Experiments with the matcher, as functions that return tables: tests run a few of each, `benchmarks/match.py` all.

A result is judged by the truth alone: whether the model that is fitted to the matches puts the corners, the rims and
the middle of the scene where the camera has them.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scenes import UTM, Case, Setting, View

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import open_dem

Array = NDArray[np.float64]
#: A model is wrong if it is off by more than this (px) and by more than so many of its own sigmas.
WRONG, SIGMAS = 0.5, 4.0


def matches(
    scene: Path, model: SensorModel, surface: Surface, references: Sequence[Path], *,
    search: float, dem_sigma: float = 0.0, reference_sigma: float = 0.0, points: int = 500, threads: int = 1,
    rotation_deg: float = 0.0,
) -> Points:  # fmt: skip
    """Call the matcher: the only place that knows how.

    Raises
    ------
    OrthoError
        If it refuses.
    """
    from ortho_pipeline.imaging.matching import MatchSettings, SceneView, match, open_references
    from ortho_pipeline.raster.intensity import Intensity
    from ortho_pipeline.raster.source import RasterSource

    view = SceneView(Intensity(RasterSource(scene)), model, surface)
    settings = MatchSettings(search, points, dem_sigma, reference_sigma, threads, rotation_deg=rotation_deg)
    return match(view, open_references(references), settings).points


def fitted(model: SensorModel, points: Points, correction: str, frame: tuple[int, int]) -> Fit:
    """Fit a correction over the model to the matches."""
    return fit(ImageCorrection.identity(model, correction, (frame[0] / 2, frame[1] / 2)), points)


@dataclass(frozen=True)
class Outcome:
    """What came of a trial.

    Parameters
    ----------
    refused : str
        The reason, empty if it was not.
    found, control : int
        Matches, and those that took part in the fit.
    off, sigma : float
        Largest distance (px) of the fitted model from the truth at nine places, and its own sigma there.
    wrong : bool
    rms : float
        Of the matches in the fit from the truth, each axis (px).
    z : tuple of float
        (estimate - truth) / sigma of each parameter.
    claimed : float
        Root mean square of the sigmas (px) that the matches claim.
    """

    refused: str = ""
    found: int = 0
    control: int = 0
    off: float = float("nan")
    sigma: float = float("nan")
    wrong: bool = False
    rms: float = float("nan")
    z: tuple[float, ...] = ()
    claimed: float = float("nan")

    @property
    def succeeded(self) -> bool:
        """Not refused, and not wrong."""
        return not self.refused and not self.wrong


def tried(case: Case, references: Sequence[Path] = (), search: float | None = None, **changes: Any) -> Outcome:
    """Match a written case, fit, and compare with the truth."""
    setting = case.setting
    # The errors of the reference differ from place to place: residuals tell of them. What is stated is that of all.
    sigmas = {"dem_sigma": float(np.hypot(setting.dem_sigma, setting.dem_noise))}
    surface = open_dem(case.dem_file, "ellipsoid")
    try:
        points = matches(
            case.scene_file, case.model, surface, references or [case.reference_file], search=search or case.search,
            **{**sigmas, **changes},
        )  # fmt: skip
        found = fitted(case.model, points, case.correction, case.frame)
    except OrthoError as error:
        return Outcome(refused=str(error))
    return judged(case, points, found)


def judged(case: Case, points: Points, found: Fit) -> Outcome:
    """Compare a fit with the truth."""
    off, ground = case.misfit(found.model)
    sigma = found.image_sigma(ground)
    far = np.abs(off) > np.maximum(WRONG, SIGMAS * sigma)
    missed = errors_of(case, points)[found.used]
    worst = int(np.hypot(*off.T).argmax())
    return Outcome(
        found=len(points), control=int(found.used.sum()), off=float(np.hypot(*off[worst])),
        sigma=float(np.hypot(*sigma[worst])), wrong=bool(far.any()), rms=float(np.sqrt((missed**2).mean())),
        z=tuple(((found.values - truth_of(case, found)) / found.sigmas).tolist()),
        claimed=float(np.sqrt((points.sigma_image**2).mean())),
    )  # fmt: skip


def errors_of(case: Case, points: Points) -> Array:
    """Return how far (px) each match is from where its place of the map, on the true ground, is in the scene."""
    return points.image - case.image_of(points.to_crs(UTM).ground[:, :2])


def truth_of(case: Case, found: Fit) -> Array:
    """Return the parameters that fit the truth best: those of a fit to a dense grid without any error."""
    steps = np.linspace(0.02, 0.98, 15)
    image = np.stack(np.meshgrid(steps * case.frame[0], steps * case.frame[1]), axis=-1).reshape(-1, 2)
    from scenes import lonlat

    ground = lonlat(case.ground_of(image))
    zero = found.model.with_params(np.zeros(len(found.values)))
    design = zero.param_partials(ground).reshape(len(image) * 2, -1)
    return np.linalg.lstsq(design, (image - zero.ground_to_image(ground)).ravel(), rcond=None)[0]


# -- settings ----------------------------------------------------------------------------------------------------------


def grounds() -> tuple[str, ...]:
    """Return the kinds of ground with good texture that there are here."""
    from landscape import has_pictures

    return ("country", "woods", "town", "real") if has_pictures() else ("country", "woods", "town")


def drawn(seed: int, kinds: Sequence[str]) -> Setting:
    """Return one of the 200 scenes: everything at random, a few difficulties at a time."""
    random = np.random.default_rng([seed, 99])
    # Grounds in a row, because to make one takes longer than a scene.
    ground = kinds[seed * len(kinds) // 200 % len(kinds)]
    ratio = float(random.choice([0.25, 0.5, 0.8, 1.0, 1.0, 1.3, 2.0, 4.0]))
    gsd = float(random.choice([0.5, 1.0, 2.5]))
    weather = {
        "clear": {}, "haze": {"haze": 0.5}, "shadows": {"shadows": 0.25}, "clouds": {"clouds": 0.25},
        "noise": {"noise": 0.05}, "holes": {"holes": 0.1}, "8 bit": {"dtype": "uint8"},
    }  # fmt: skip
    scene = View(**{"noise": 0.015, **weather[str(random.choice(list(weather)))]})
    reference = View(**{"noise": 0.01, **weather[str(random.choice(list(weather)))]})
    change = random.choice(["none", "none", "season", "band"])
    if change == "season":
        reference = replace(reference, season=int(random.integers(1, 3)))
    elif change == "band":
        reference = replace(reference, bands=str(random.choice(["b", "ba"])))
    fine = {0.25: 1.2, 4.0: 1.2, 0.5: 1.6, 2.0: 1.6}.get(ratio, 2.0)
    # A finer reference has many pixels that are to be rendered; it is given to models that are better.
    error = float(10 ** random.uniform(0, math.log10({0.25: 60, 0.5: 150}.get(ratio, 300))))
    return Setting(
        ground=ground, seed=seed, side={0.25: 500, 2.0: 800, 4.0: 900}.get(ratio, 700), gsd=gsd, ratio=ratio,
        scene=scene, reference=reference, pushbroom=bool(random.random() < 0.7),
        off_nadir_deg=float(random.uniform(-25, 25)),
        heading_deg=float(random.uniform(0, 360)), error=error,
        kind=str(random.choice(["shift", "drift", "affine", "attitude"])), slope=float(random.uniform(0, 4)),
        relief=float(random.choice([5, 20, 40])), dem_sigma=float(random.choice([0.0, 1.0, 3.0])) * gsd,
        dem_length=80.0 * gsd, reference_sigma=float(random.choice([0.0, 0.3])) * gsd, reference_length=150.0 * gsd,
        margin=error + float(random.uniform(20, 120)), fine=fine,
    )  # fmt: skip


# -- experiments -------------------------------------------------------------------------------------------------------


def run(settings: Iterable[Setting], told: Callable[[str], None] | None = None, **options: Any) -> list[dict[str, Any]]:
    """Write, match and judge one setting after the other; one row each."""
    rows = []
    for setting in settings:
        with tempfile.TemporaryDirectory(prefix="ortho_match_") as folder:
            outcome = tried(Case(setting, Path(folder)).write(), **options)
        rows.append({**asdict(outcome), "succeeded": outcome.succeeded, "setting": asdict(setting)})
        if told:
            told(line(rows[-1]))
    return rows


def line(row: dict[str, Any]) -> str:
    """Describe a row in one line."""
    setting = row["setting"]
    what = f"{setting['ground']:10s} {setting['seed']:4d} x{setting['ratio']:<4g} {setting['kind']:9s}"
    what += f" {setting['error']:6.1f} px"
    if row["refused"]:
        return f"{what}  refused: {row['refused'][:110]}"
    return (
        f"{what}  {'WRONG ' if row['wrong'] else ''}off {row['off']:.3f} (sigma {row['sigma']:.3f}) px, "
        f"{row['control']} of {row['found']} matches, RMS {row['rms']:.3f} (claimed {row['claimed']:.3f})"
    )


def good_texture(count: int, kinds: Sequence[str] | None = None) -> list[Setting]:
    """Return scenes with a little noise over good texture, a reference without errors and of the same resolution."""
    kinds = kinds or grounds()
    return [
        Setting(ground=kinds[k * len(kinds) // count], seed=1000 + k, error=15.0, kind=("shift", "affine")[k % 2])
        for k in range(count)
    ]


def scenes(count: int) -> list[Setting]:
    """Return so many of the 200 scenes, spread over them."""
    kinds = grounds()
    return [drawn(k * 200 // count, kinds) for k in range(count)]


def coverage(count: int) -> list[Setting]:
    """Return scenes of one kind, whose errors are as stated, to see whether sigmas are."""
    kinds, found = grounds(), []
    for k in range(count):
        random = np.random.default_rng([k, 55])
        gsd = 1.0
        found.append(Setting(
            ground=kinds[k * len(kinds) // count], seed=5000 + k, gsd=gsd, error=8.0, kind="shift",
            off_nadir_deg=float(random.uniform(-25, 25)), heading_deg=float(random.uniform(0, 360)),
            scene=View(noise=0.02), reference=View(noise=0.02),
            dem_sigma=(0.0, 2.0, 4.0)[k % 3], dem_length=(60.0, 120.0)[k % 2], dem_noise=0.5,
            reference_sigma=(0.0, 0.3, 0.0, 0.6)[k % 4], reference_length=100.0,
        ))  # fmt: skip
    return found


def rough(count: int) -> list[Setting]:
    """Return scenes with wrong heights and references, whose errors are as rough as each of the correlations in turn.

    Not of the 200: seeds from 200 on, of which those without such errors are passed over.
    """
    kinds, found, seed = grounds(), [], 200
    while len(found) < count:
        setting = drawn(seed, kinds)
        if setting.dem_sigma or setting.reference_sigma:
            kind = ("gaussian", "matern", "exponential")[len(found) % 3]
            found.append(replace(setting, ground=kinds[len(found) * len(kinds) // count], roughness=kind))
        seed += 1
    return found


def displaced(count: int, sigma: float = 2.0) -> list[Setting]:
    """Return small scenes whose reference lies as a whole where `sigma` (m, per axis) allows, drawn at random."""
    return [
        Setting(side=300, seed=7000 + k, error=5.0, margin=30.0, off_nadir_deg=12.0, heading_deg=40.0 * k,
                dem_noise=0.5, offset=tuple(np.random.default_rng([k, 77]).normal(0, sigma, 2)), reference_sigma=0.2,
                reference_length=60.0)
        for k in range(count)
    ]  # fmt: skip


def spread(rows: Sequence[dict[str, Any]]) -> float:
    """Return the root mean square of (estimate - truth) / sigma over all parameters of all rows that were fitted."""
    values = np.concatenate([row["z"] for row in rows if not row["refused"]])
    return float(np.sqrt((values**2).mean()))


def to_refuse(what: str, count: int) -> list[tuple[Setting, float]]:
    """Return scenes that have to be refused, with the search (m): 'place', 'chessboard', 'water', 'beyond', 'roofs'."""
    found = []
    kinds = grounds()
    for k in range(count):
        random = np.random.default_rng([k, 33])
        setting = Setting(
            ground=kinds[k * len(kinds) // count], seed=9000 + k, heading_deg=float(random.uniform(0, 360)), error=20.0,
            gsd=float((0.5, 1.0, 2.0)[k % 3]), ratio=float((1.0, 0.5, 2.0)[k // 3 % 3]), margin=100.0,
        )  # fmt: skip
        search = float((30, 60, 120)[k % 3]) * setting.gsd
        if what == "place":
            setting = replace(setting, elsewhere=True)
        elif what == "beyond":
            angle, far = random.uniform(0, 2 * np.pi), search + 200.0 + 20 * setting.gsd
            setting = replace(setting, offset=(far * np.cos(angle), far * np.sin(angle)))
        else:
            setting = replace(setting, ground=what, scene=View(noise=0.02), reference=View(noise=0.02))
        if what == "water":
            waves = replace(setting.scene, haze=0.2, noise=0.03)
            setting = replace(setting, scene=waves, reference=waves)
        found.append((setting, search))
    return found


def refusals(what: str, count: int, told: Callable[[str], None] | None = None) -> list[dict[str, Any]]:
    """Match scenes that have to be refused; one row each."""
    return [run([setting], told, search=search)[0] for setting, search in to_refuse(what, count)]
