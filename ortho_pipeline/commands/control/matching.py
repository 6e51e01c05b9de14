"""Matching in a command: opens the scene and its references, and records the result."""

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

from ortho_pipeline.commands.control.search import Search, default_search, rotation_of, search_of
from ortho_pipeline.commands.heights.opening import GIVE_HEIGHTS
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres, px
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import MatchOptions, OutputOptions, SceneOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.report.document import report_of_ortho
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

#: A reference that covers a smaller share of a scene gives a notice.
_COVERS = 0.5
#: A reference was probably made from the scene itself if the median correlation of chips is this high and the matches
#: agree to so many pixels: two images of one place have noise, heights and light of their own, and do not.
_SAME, _EXACT = 0.97, 0.01
#: Fields of the image in which matches are counted hold about so many that were tried; at most so many per side.
_PER_FIELD, _FIELDS = 5, 10


@dataclass(frozen=True, eq=False)
class Matched:
    """The matches of a scene with its references.

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
        Stated accuracy (m) of the heights.
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
        """Error (px) of the delivered model: measured minus predicted, median over the matches ``(2,)``."""
        shift: Array = -np.median(self.matches.offset[self.kept], axis=0)
        return shift

    @functools.cached_property
    def record(self) -> MatchingRecord:
        """The published record; `tested_by` adds the test of a fit by its points."""
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
                    factor=level.factor,
                    radius=level.radius,
                    chips=level.chips,
                    agreeing=level.agreeing,
                    shift_px=(-level.shift[0], -level.shift[1]),
                )
                for level in matches.levels
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
        """Return the record with the errors of a fit at matches and measured points that it did not use."""
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
        return MatchCoverage.model_validate(
            {"share": share, **{name: count.tolist() for name, count in counts.items()}}
        )

    def summary(self) -> list[tuple[str, str]]:
        """Return the summary for people, as rows of a name and a text."""
        from ortho_pipeline.imaging.matching import REASONS

        record = self.record
        column, row = record.shift_px
        reasons = "; ".join(f"{count}: {REASONS[name]}" for name, count in record.reasons.items())
        levels = "; ".join(
            f"{level.agreeing} of {counted(level.chips, 'chip')} agree at 1/{level.factor} resolution"
            for level in record.levels
        )
        sigma = self.options.reference_sigma
        return [
            (
                "matching",
                f"sigma of one match {px(record.sigma_px)} (median), relative to the reference: "
                f"{record.components.text()}",
            ),
            (
                "reference",
                ", ".join(Path(level).name for level in self.references)
                + (f", accuracy {metres(sigma)} per axis" if sigma else ", accuracy not stated"),
            ),
            ("matches", f"{record.kept} of {record.tried} tried{': ' + reasons if reasons else ''}"),
            (
                "",
                f"{record.control} control, {record.check} check (those in every fifth cell of a grid over the "
                f"image); all cover "
                f"{record.coverage.share:.0%} of the image",
            ),
            ("search", f"{metres(self.search.distance)} ({self.search.source}); {levels}"),
            (
                "shift",
                f"column {column:+.2f} px, row {row:+.2f} px (measured minus delivered model), "
                f"{metres(record.shift_m)}",
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

    >>> references = op.MatchOptions(reference=("sample_data/reference.tif",))
    >>> scene, dem = op.open_scene("sample_data/scene.tif"), op.open_dem("sample_data/dem.tif")
    >>> len(op.match_scene(scene, references, dem).matches.points) > 20
    True

    Parameters
    ----------
    scene : Scene
        With models that are meant for the surface.
    opened : SceneOptions
        What may be opened.
    threads, memory : int
        Default: as many threads as processors; memory in bytes. No result depends on them.
    intensity : Intensity, optional
        Replaces the intensity of the scene, to leave out pixels or bands.

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
        points=options.wanted,
        dem_sigma=typical_sigma(view.surface) or 0.0,
        reference_sigma=options.reference_sigma or 0.0,
        threads=threads or os.cpu_count() or 1,
        memory=memory,
        rotation_deg=rotation_of(scene, options),
    )
    with _of_references(scene):
        matches = match(view, references, settings)
    paths = tuple(reference.path for reference in references)
    notices = [
        *default_search(search),
        *_made_of_scene(scene, references, matches),
        *_partial(matches),
        *_bands_apart(matches),
    ]
    return Matched(
        matches, paths, options, search, (scene.width, scene.height), pixel, tuple(notices), typical_sigma(view.surface)
    )


def open_reference_views(
    scene: Scene, options: MatchOptions, surface: Surface | None, opened: SceneOptions
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
            remedy=GIVE_HEIGHTS,
        )
    if not scene.models:
        raise InputError(
            "this image has no sensor model, which matching needs",
            file=scene.path,
            field="match.reference",
            remedy=Text("give measured control points with ", Setting("points.gcps")),
        )
    with _of_references(scene):
        references = open_references(options.reference, options.reference_bands or (), **opened.access)
    for reference in references:
        _refuse_scene(scene, reference)
    rasters = scene.rasters or (scene.path,)
    return SceneView(Intensity(RasterSource(*rasters, **opened.access)), scene.model, surface), references


@contextmanager
def _of_references(scene: Scene) -> Iterator[None]:
    """Name the option of what is refused, if that is not the scene."""
    try:
        yield
    except InputError as error:
        of_scene = error.file is not None and Path(error.file) in map(Path, scene.rasters or (scene.path,))
        if error.field in (None, "reference") and not of_scene:
            error.field = "match.reference"
        raise


# -- how far to search -----------------------------------------------------------------------------------------------


def _partial(matches: Matches) -> list[Notice]:
    """Return a notice if the references cover little of the scene."""
    if matches.coverage >= _COVERS:
        return []
    text = f"the reference covers {matches.coverage:.0%} of the scene; accuracy outside it is not tested"
    return [Notice("reference-covers-part", text, coverage=matches.coverage)]


def _bands_apart(matches: Matches) -> list[Notice]:
    """Return a notice if single bands of the references give different positions of the scene."""
    from ortho_pipeline.imaging.band_shifts import agreeing, disagreeing, spread

    bands = matches.bands
    if not disagreeing(bands):
        return []
    agree = agreeing(bands)
    shifts = ", ".join(
        f"band {band.band} by {band.shift[0]:+.2f} ± {band.sigma[0]:.2f}, {band.shift[1]:+.2f} ± {band.sigma[1]:.2f}"
        for band in bands
    )
    largest = (
        ("The largest group that agrees: ", Setting("match.reference_bands", ",".join(map(str, agree))))
        if len(agree) > 1
        else ("No two bands agree",)
    )
    text = Text(
        "bands of the reference give different positions of the scene, so the result is uncertain by ",
        f"{spread(bands):.1f} px. Shifts of single bands from the result (column, row, px): {shifts}. ",
        *largest,
    )
    fields = [{"band": band.band, "shift_px": list(band.shift), "sigma_px": list(band.sigma)} for band in bands]
    return [Notice("bands-disagree", text, bands=fields, agreeing=list(agree), spread_px=spread(bands))]


# -- the scene as its own reference --------------------------------------------------------------------------------


def _refuse_scene(scene: Scene, reference: Reference) -> None:
    """Refuse a reference that is the scene itself, or a view of it."""
    own = {os.path.realpath(path) for path in (scene.path, *scene.rasters)}
    shown = {os.path.realpath(name) for name in reference.intensity.source.dataset.GetFileList() or ()}
    if own & {os.path.realpath(reference.path), *shown}:
        raise InputError(
            "the reference is the scene itself, so matching cannot find its position",
            file=reference.path,
            field="match.reference",
            remedy="give an ortho that was made from other images",
        )


def _made_of_scene(scene: Scene, references: tuple[Reference, ...], matches: Matches) -> list[Notice]:
    """Return a notice if the reference was probably made from the scene."""
    name, alike, agreement = Path(scene.path).name, median_correlation(matches), _agreement(matches)
    why = next(
        (
            f"{Path(reference.path).name} names {name} as its source"
            for reference in references
            if _names(reference, name)
        ),
        None,
    )
    if why is None and alike >= _SAME and agreement < _EXACT:
        why = f"scene and reference agree to {px(agreement)} (correlation {alike:.3f}), which two images hardly do"
    if why is None:
        return []
    text = f"{why}. If the reference was made from this scene, the matches prove nothing about its position"
    return [Notice("reference-made-of-scene", text, correlation=alike)]


def _names(reference: Reference, image: str) -> bool:
    """Return whether a reference was made from an image, by its metadata or its report."""
    described = reference.intensity.source.dataset.GetMetadata() or {}
    if any(image in str(text) for text in described.values()):
        return True
    report = report_of_ortho(reference.path)
    return report is not None and report.scene.name == image


def _agreement(matches: Matches) -> float:
    """Return how far (px per axis) the matches are from an affine transformation of the model, robustly."""
    kept = matches.reason == ""
    design = np.column_stack([np.ones(int(kept.sum())), matches.image[kept]])
    residuals = matches.offset[kept] - design @ np.linalg.lstsq(design, matches.offset[kept], rcond=None)[0]
    return float(1.4826 * np.median(np.abs(residuals)))


def median_correlation(matches: Matches) -> float:
    """Return the median correlation of the intensities of scene and target in the chips that were kept."""
    kept = matches.reason == ""
    scene, target = (
        chips[kept].reshape(int(kept.sum()), -1).astype(float) for chips in (matches.scene, matches.target)
    )
    seen = np.isfinite(scene) & np.isfinite(target)
    count = np.maximum(seen.sum(axis=1), 1)[:, None]
    scene, target = (
        np.where(seen, values - np.where(seen, values, 0.0).sum(axis=1, keepdims=True) / count, 0.0)
        for values in (scene, target)
    )
    length = np.linalg.norm(scene, axis=1) * np.linalg.norm(target, axis=1)
    return float(np.median((scene * target).sum(axis=1) / np.where(length > 0, length, 1.0)))
