"""Matching as a command does it: the scene and its references opened, how far to search, and what is said of it all."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres, px
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.options.texts import Setting, Text, counted
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.report.document import read_report
from ortho_pipeline.report.matching import (
    Candidate,
    MatchComponents,
    MatchCoverage,
    MatchingRecord,
    MatchLevel,
    Tested,
)
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.surface.accuracy import typical_sigma
from ortho_pipeline.surface.base import Surface

if TYPE_CHECKING:
    # What matches takes a while to load, and few commands match.
    from ortho_pipeline.imaging.matching import Matches, Reference, SceneView

#: How far a model may be off (m) of which nothing is known, and at most this part of the scene's shorter side.
DEFAULT_SEARCH, _PART = 100.0, 0.25
#: Many times the sigma that a scene states are searched, and never less than so many pixels.
_SIGMAS, _LEAST = 3.0, 8.0
#: Degrees by which a pose that only metadata give may be turned.
POSE_DEG = 5.0
#: A reference that covers less than this of a scene is a notice.
_COVERS = 0.5
#: A reference is probably made of the scene itself where the chips are as alike as that in the median, and the matches
#: agree to so many pixels: two images of one place have noise, heights and light of their own, and do not.
_SAME, _EXACT = 0.97, 0.01
#: Fields of the image in which matches are counted hold about so many that were tried; at most so many per side.
_PER_FIELD, _FIELDS = 5, 10


@dataclass(frozen=True)
class Search:
    """How far the model of a scene may be off, and who says so.

    Parameters
    ----------
    distance : float
        Metres on the ground.
    source : str
    known : bool
        Whether the user or the scene says so.
    """

    distance: float
    source: str
    known: bool = True


@dataclass(frozen=True, eq=False)
class Matched:
    """What a scene and its references have in common.

    Parameters
    ----------
    matches : Matches
        With the chips; `matches.points` are the points.
    references : tuple of path
    options : MatchOptions
    search : Search
    size : (int, int)
        Columns and rows of the scene.
    pixel : float
        Size (m) of a pixel on the ground.
    notices : tuple of Notice
    dem_sigma : float, optional
        What the heights were said to be good for (m).
    """

    matches: Matches
    references: tuple[str, ...]
    options: MatchOptions
    search: Search
    size: tuple[int, int]
    pixel: float
    notices: tuple[Notice, ...] = ()
    dem_sigma: float | None = None

    @property
    def kept(self) -> np.ndarray:
        """Which matches are points ``(n,)``."""
        return np.asarray(self.matches.reason == "")

    @property
    def shift(self) -> Array:
        """How far (px) the delivered model is off: measured minus predicted, the median over the matches ``(2,)``."""
        shift: Array = -np.median(self.matches.offset[self.kept], axis=0)
        return shift

    @functools.cached_property
    def record(self) -> MatchingRecord:
        """What is published of it; what its points say of a fit is told by `tested_by`."""
        from ortho_pipeline.imaging.matching import REASONS

        matches, kept, points = self.matches, self.kept, self.matches.points
        reasons = {name: int((matches.reason == name).sum()) for name in REASONS}
        shift, parts = self.shift, matches.components
        return MatchingRecord(
            references=self.references,
            reference_sigma_m=self.options.reference_sigma,
            dem_sigma_m=self.dem_sigma,
            search_m=self.search.distance,
            search_from=self.search.source,
            pixel_m=self.pixel,
            tried=len(kept),
            kept=int(kept.sum()),
            control=int(points.control.sum()),
            check=int(points.check.sum()),
            reasons={name: count for name, count in reasons.items() if count},
            levels=tuple(
                MatchLevel(
                    factor=one.factor,
                    radius=one.radius,
                    chips=one.chips,
                    agreeing=one.agreeing,
                    shift_px=(-one.shift[0], -one.shift[1]),
                )
                for one in matches.levels
            ),
            shift_px=(shift[0], shift[1]),
            shift_m=float(np.hypot(*shift)) * self.pixel,
            components=MatchComponents(matching=parts.matching, height_m=parts.height, other_px=parts.other),
            sigma_px=float(np.median(points.sigma_image)),
            correlation=median_correlation(matches),
            coverage=self._coverage(),
            candidates=tuple(
                Candidate(id=f"m{cell}", image=place, score=score, reason=reason or None)
                for cell, place, score, reason in zip(
                    matches.cell, *map(json_value, (matches.image, matches.score, matches.reason)), strict=True
                )
            ),
            relative=None,
            absolute=None,
        )

    def tested_by(self, fit: Fit) -> MatchingRecord:
        """Return the record with what matches and measured points say of a fit that they took no part in."""
        checks, matched = fit.points.check, fit.points.groups >= 0
        return self.record.replaced(
            relative=Tested.of(fit, checks & matched), absolute=Tested.of(fit, checks & ~matched)
        )

    def to_json(self) -> dict[str, Any]:
        """Return the section ``matching`` of documents without a fit (docs/engineering/formats.md)."""
        return self.record.model_dump(mode="json", exclude={"relative", "absolute"})

    def _coverage(self) -> MatchCoverage:
        """Return how many matches were tried and kept in each field of the image, rows of columns."""
        counts = {}
        side = int(np.clip(round(math.sqrt(len(self.kept) / _PER_FIELD)), 1, _FIELDS))
        for name, mask in (("tried", np.ones(len(self.kept), dtype=bool)), ("kept", self.kept)):
            part = np.clip(self.matches.image[mask] / self.size * side, 0, side - 1).astype(int)
            counts[name] = np.bincount(part[:, 1] * side + part[:, 0], minlength=side**2).reshape(side, side)
        share = float((counts["kept"] > 0).mean())
        return MatchCoverage.model_validate({"share": share, **{name: one.tolist() for name, one in counts.items()}})

    def summary(self) -> list[tuple[str, str]]:
        """Return what people read of it, as rows of a name and a text."""
        from ortho_pipeline.imaging.matching import REASONS

        said = self.record
        column, row = said.shift_px
        reasons = ", ".join(f"{count} {REASONS[name]}" for name, count in said.reasons.items())
        levels = "; ".join(
            f"{one.agreeing} of {counted(one.chips, 'chip')} of 1/{one.factor} resolution agree" for one in said.levels
        )
        sigma = self.options.reference_sigma
        return [
            (
                "reference",
                ", ".join(Path(one).name for one in self.references)
                + (f", +-{metres(sigma)} per axis" if sigma else ", its own accuracy is not stated"),
            ),
            ("matches", f"{said.kept} of {said.tried} tried{': ' + reasons if reasons else ''}"),
            (
                "",
                f"{said.control} control, {said.check} check (every fifth cell), in "
                f"{said.coverage.share:.0%} of the fields of the image",
            ),
            ("search", f"{metres(self.search.distance)} ({self.search.source}); {levels}"),
            (
                "model off",
                f"column {column:+.2f} px, row {row:+.2f} px (measured minus delivered model), {metres(said.shift_m)}",
            ),
            (
                "accuracy",
                f"{px(said.sigma_px)} in the middle of the matches, relative to the reference: "
                f"{said.components.text()}",
            ),
        ]


@one_blas_thread()
@cache_restored()
def match_scene(
    scene: Scene,
    options: MatchOptions,
    surface: Surface | None,
    opened: SceneOptions = SceneOptions(),
    threads: int | None = None,
    memory: int = OutputOptions.memory,
    intensity: Intensity | None = None,
) -> Matched:
    """Match a scene with the references of the options.

    Parameters
    ----------
    scene : Scene
        With models that are meant for the surface.
    opened : SceneOptions
        What may be opened.
    threads : int, optional
        As many as there are processors without; no result depends on it.
    memory : int
        Bytes.
    intensity : Intensity, optional
        Of the scene, where some of its pixels or bands take no part.

    Raises
    ------
    InputError
        For references that are none, a scene without model or heights, and what matching refuses.
    """
    from ortho_pipeline.imaging.matching import MatchSettings, match
    from ortho_pipeline.imaging.matching.targets import metres_per_pixel

    view, references = open_reference_views(scene, options, surface, opened)
    view = view if intensity is None else replace(view, intensity=intensity)
    pixel = metres_per_pixel(view)
    search = search_of(scene, options, pixel)
    settings = MatchSettings(
        search=search.distance,
        points=options.points,
        dem_sigma=typical_sigma(view.surface) or 0.0,
        reference_sigma=options.reference_sigma or 0.0,
        threads=threads or os.cpu_count() or 1,
        memory=memory,
        rotation_deg=rotation_of(scene, options),
    )
    with _of_references():
        matches = match(view, references, settings)
    paths = tuple(one.path for one in references)
    notices = [
        *_default_search(search),
        *_made_of_scene(scene, references, matches),
        *_partial(matches),
        *_bands_apart(matches),
    ]
    return Matched(
        matches, paths, options, search, (scene.width, scene.height), pixel, tuple(notices), typical_sigma(view.surface)
    )


def open_reference_views(
    scene: Scene, options: MatchOptions, surface: Surface | None, opened: SceneOptions = SceneOptions()
) -> tuple[SceneView, tuple[Reference, ...]]:
    """Open a scene and its references as a matcher sees them.

    Raises
    ------
    InputError
        For references that are none, and a scene without model or heights.
    """
    from ortho_pipeline.imaging.matching import SceneView, open_references

    if surface is None:
        raise InputError(
            "matching needs heights",
            field="surface.dem",
            remedy=Text(
                "give ",
                Setting("surface.dem", "FILE"),
                ", or ",
                Setting("surface.height", "METRES"),
                " above the ellipsoid for flat ground",
            ),
        )
    if not scene.models:
        raise InputError(
            "this image has no model of its own to begin matching with",
            file=scene.path,
            field="match.reference",
            remedy=Text("give control points by hand with ", Setting("points.gcps")),
        )
    with _of_references():
        references = open_references(options.reference, options.reference_bands or (), **opened.access)
    for one in references:
        _refuse_scene(scene, one)
    rasters = scene.rasters or (scene.path,)
    return SceneView(Intensity(RasterSource(*rasters, **opened.access)), scene.model, surface), references


@contextmanager
def _of_references() -> Iterator[None]:
    """Name the option that is refused, where that is known of the reference alone."""
    try:
        yield
    except InputError as error:
        if error.field in (None, "reference"):
            error.field = "match.reference"
        raise


# -- how far to search -----------------------------------------------------------------------------------------------


def search_of(scene: Scene, options: MatchOptions, pixel: float) -> Search:
    """Return how far (m) the model may be off: as the user says, as the scene says, or a default.

    Parameters
    ----------
    pixel : float
        Size (m) of a pixel on the ground.
    """
    if options.search is not None:
        least = 2.0 * pixel  # as far as chips are moved in any case
        return Search(options.search, "as asked for") if options.search >= least else Search(least, "two pixels")
    stated = _stated(scene, pixel)
    if stated is not None:
        sigma, source = stated
        return Search(max(_SIGMAS * sigma, _LEAST * pixel), f"{_SIGMAS:.0f} times {metres(sigma)}, {source}")
    part = _PART * min(scene.width, scene.height) * pixel
    if part < DEFAULT_SEARCH:
        return Search(part, f"a default: the scene states no accuracy; {_PART:.0%} of its side", known=False)
    return Search(DEFAULT_SEARCH, "a default: the scene states no accuracy", known=False)


def rotation_of(scene: Scene, options: MatchOptions) -> float:
    """Return how far (degrees) the model may be turned: as the user says, or `POSE_DEG` where it is a pose.

    An RPC is made of a pose that was adjusted: it is taken not to be turned.
    """
    if options.search_rotation is not None:
        return options.search_rotation
    return POSE_DEG if set(scene.model.param_names) & set(scene.priors) else 0.0


def _stated(scene: Scene, pixel: float) -> tuple[float, str] | None:
    """Return the standard deviation (m) of a scene's model and who states it; None where nobody does."""
    model = scene.model
    if isinstance(model, RPC):
        errors = [value for value in (model.err_bias, model.err_rand) if value is not None and value > 0]
        if errors:
            return math.hypot(*errors), "the errors that the RPC states (ERR_BIAS, ERR_RAND)"
    names = model.param_names
    sigma = scene.facts.get("position_sigma_m")
    # Of what has an orientation it is the position of the sensor, and the attitude errs too.
    if not names and isinstance(sigma, int | float) and sigma > 0:
        return float(sigma) * math.sqrt(2), "the accuracy of position in the metadata"
    known = {name: prior.sigma for name, prior in scene.priors.items() if math.isfinite(prior.sigma)}
    if names and set(names) <= set(known):
        centre = model.image_to_ground(np.array([[scene.width / 2, scene.height / 2]]), model.reference_height)
        spread = model.param_partials(centre)[0] * np.array([known[name] for name in names])
        if np.isfinite(spread).all():
            return float(np.linalg.norm(spread)) * pixel, "what the sensor knows of its parameters"
    return None


def _default_search(search: Search) -> list[Notice]:
    if search.known:
        return []
    text = Text(
        f"no stated accuracy for this scene's model; searched within {metres(search.distance)}. Change it with ",
        Setting("match.search"),
    )
    return [Notice("search-by-default", text, search_m=search.distance)]


def _partial(matches: Matches) -> list[Notice]:
    """Return a notice if the references cover little of the scene."""
    if matches.coverage >= _COVERS:
        return []
    text = f"the reference covers {matches.coverage:.0%} of the scene; accuracy outside it is not tested"
    return [Notice("reference-covers-part", text, coverage=matches.coverage)]


def _bands_apart(matches: Matches) -> list[Notice]:
    """Return a notice if single bands of the references put the scene in different places."""
    from ortho_pipeline.imaging.band_shifts import agreeing, disagreeing, spread

    bands = matches.bands
    if not disagreeing(bands):
        return []
    agree = agreeing(bands)
    said = ", ".join(
        f"band {one.band} by {one.shift[0]:+.2f} ± {one.sigma[0]:.2f}, {one.shift[1]:+.2f} ± {one.sigma[1]:.2f}"
        for one in bands
    )
    text = Text(
        "bands of the reference disagree about the place of the scene. Compared with the result, single ",
        f"bands move it (column, row, px): {said}. The result is not known better than {spread(bands):.1f} px. ",
        "Choose bands that agree and look like the scene: ",
        Setting("match.reference_bands", ",".join(map(str, agree))),
    )
    found = [{"band": one.band, "shift_px": list(one.shift), "sigma_px": list(one.sigma)} for one in bands]
    return [Notice("bands-disagree", text, bands=found, agreeing=list(agree), spread_px=spread(bands))]


# -- what a reference is not -----------------------------------------------------------------------------------------


def _refuse_scene(scene: Scene, reference: Reference) -> None:
    """Refuse a reference that is the scene itself, or a view of it."""
    own = {os.path.realpath(path) for path in (scene.path, *scene.rasters)}
    shown = {os.path.realpath(name) for name in reference.intensity.source.dataset.GetFileList() or ()}
    if own & {os.path.realpath(reference.path), *shown}:
        raise InputError(
            "the reference is the scene itself: that says nothing of where it lies",
            file=reference.path,
            field="match.reference",
            remedy="give an orthoimage that was made of other images",
        )


def _made_of_scene(scene: Scene, references: tuple[Reference, ...], matches: Matches) -> list[Notice]:
    """Return a notice if the reference looks as if it were made of the scene."""
    name, alike, agreement = Path(scene.path).name, median_correlation(matches), _agreement(matches)
    why = next((f"{Path(one.path).name} names {name} as its source" for one in references if _names(one, name)), None)
    if why is None and alike >= _SAME and agreement < _EXACT:
        why = f"scene and reference are the same to {px(agreement)} (correlation {alike:.3f}), as two images hardly are"
    if why is None:
        return []
    text = f"{why}: if the reference was made of this scene, the matches say nothing of where it lies"
    return [Notice("reference-made-of-scene", text, correlation=alike)]


def _names(reference: Reference, image: str) -> bool:
    """Tell whether a reference says that it was made of an image: in its metadata, or in the report beside it."""
    described = reference.intensity.source.dataset.GetMetadata() or {}
    if any(image in str(text) for text in described.values()):
        return True
    report = Path(reference.path.replace("_ortho.tif", "_report.json"))
    if report.suffix != ".json" or not report.is_file():
        return False
    try:
        return bool(read_report(report).scene.name == image)
    except InputError:
        return False


def _agreement(matches: Matches) -> float:
    """Return how far (px per axis) the matches are from an affine transformation of the model, robustly."""
    kept = matches.reason == ""
    design = np.column_stack([np.ones(int(kept.sum())), matches.image[kept]])
    residuals = matches.offset[kept] - design @ np.linalg.lstsq(design, matches.offset[kept], rcond=None)[0]
    return float(1.4826 * np.median(np.abs(residuals)))


def median_correlation(matches: Matches) -> float:
    """Return the median correlation of the intensities of scene and target in the chips that were kept."""
    kept = matches.reason == ""
    one, other = (chips[kept].reshape(int(kept.sum()), -1).astype(float) for chips in (matches.scene, matches.target))
    seen = np.isfinite(one) & np.isfinite(other)
    count = np.maximum(seen.sum(axis=1), 1)[:, None]
    one, other = (
        np.where(seen, values - np.where(seen, values, 0.0).sum(axis=1, keepdims=True) / count, 0.0)
        for values in (one, other)
    )
    length = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    return float(np.median((one * other).sum(axis=1) / np.where(length > 0, length, 1.0)))
