r"""Two scenes: positions of chips of one scene in the other, independent of the heights of the DEM.

A chip of the first scene is compared with the second scene, rendered into its geometry through the DEM. A match d of
the chip at p means that the second scene shows at :math:`B(G(p + d))` what the first one shows at p. G is where the ray
of the (corrected) first model meets the DEM. This is true for any height of the DEM, because the same G rendered the
chip: a height error :math:`\delta` moves d by :math:`\delta\,u` along the epipolar direction
:math:`u = A_h - A_{xy} B_{xy}^{-1} B_h` (px per metre), but does not move the tie point. So matches are searched along
it as far as heights may be wrong, and tested against each other across it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.imaging.matching.chip_search import FEWEST, SIGMAS
from ortho_pipeline.imaging.matching.search import place
from ortho_pipeline.imaging.matching.sight import HEIGHTS, Chips, along_sight, displacements, solved
from ortho_pipeline.imaging.matching.targets import OtherScene, SceneView, chip_factor, shown_by, spread_over
from ortho_pipeline.imaging.matching.weights import Components, components
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.rays import meet_surface

#: Rounds of the test of matches against each other.
_JUDGED = 8
#: Largest displacement by heights (chip px, standard deviation) in the first search; else its pixels are too fine.
_BLURRED = 1.5
#: Least standard deviation (px) of a match.
_FLOOR = 0.02


@dataclass(frozen=True)
class TieSettings:
    """Options of the search for tie points.

    Parameters
    ----------
    search : float
        Largest relative error (m on the ground) of the models.
    points : int
        Approximate number of tie points of a pair.
    apart : bool
        Whether there are fewer in small scenes, so that neighbouring chips share no pixels: those err alike, and an
        adjustment takes ties for independent. In very small scenes some share them all the same.
    dem_sigma : float
        Standard deviation (m) of the DEM's heights.
    threads : int
    memory : int
        Bytes for all of the work, including GDAL's cache.
    rotation_deg : float
        Largest rotation of a model relative to another.
    """

    search: float
    points: int = 500
    apart: bool = False
    dem_sigma: float = 10.0
    threads: int = 1
    memory: int = 512_000_000
    rotation_deg: float = 0.0


@dataclass(frozen=True)
class PairSummary:
    """Result of a pair of scenes.

    Parameters
    ----------
    images : (int, int)
    ties, tried : int
    shift : (float, float)
        Mean error of the first model relative to the second: column and row (px of the first scene).
    components : Components or None
        The parts of the residuals.
    reason : str
        Why there are no tie points; empty if there are.
    crowding : float
        Chips over each pixel of the first scene. Above 1, neighbours share pixels and so errors.
    """

    images: tuple[int, int]
    ties: int
    tried: int
    shift: tuple[float, float] = (math.nan, math.nan)
    components: Components | None = None
    reason: str = ""
    crowding: float = 0.0


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Positions of points of one scene in the other one; NaN if not found.

    Parameters
    ----------
    first, second : (n, 2)
        Pixel positions in both scenes.
    first_covariance, second_covariance : (n, 2, 2)
        px²; each chip has half the error of a match.
    height, height_sigma : (n,)
        Height (m) of the match above the DEM, without the part that a correction of the model absorbs.
    score : (n,)
        Correlation of the chips.
    """

    first: Array
    second: Array
    first_covariance: Array
    second_covariance: Array
    height: Array
    height_sigma: Array
    score: Array
    components: Components

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which positions were found."""
        return np.isfinite(self.second[:, 0])


@dataclass(frozen=True, eq=False)
class Pair:
    """A scene, another one, and the correction of the first model for which they agree.

    Parameters
    ----------
    view : SceneView
    target : OtherScene
    correction : ImageCorrection
    factor : int
        Pixels of the first scene in a chip pixel.
    reach : float
        Largest displacement (px) of a match by heights.
    settings : TieSettings
    """

    view: SceneView
    target: OtherScene
    correction: ImageCorrection
    factor: int
    reach: float
    settings: TieSettings

    @classmethod
    def place(cls, view: SceneView, target: OtherScene, shown: Array, search: float, settings: TieSettings) -> Pair:
        """Find the correction from the common area of both scenes.

        Parameters
        ----------
        shown : (n, 2)
            Points of the first scene that the second one shows.
        search : float
            Largest error of the model (px).

        Raises
        ------
        InputError
            If resolutions are too different, the common area is a strip, or there is no clear best position.
        """
        base = chip_factor(view, [target], shown)
        ground = meet_surface(view.model, shown, view.surface)
        ground = ground[np.isfinite(ground).all(axis=1)]
        parallax = np.hypot(*displacements(view, target, view.model.ground_partials(ground), ground)[0].T)
        sigma = settings.dem_sigma * float(np.nanmedian(parallax)) if len(ground) else 0.0
        low, high = shown.min(axis=0), shown.max(axis=0)
        window = int(low[0]), int(low[1]), math.ceil(high[0]), math.ceil(high[1])
        if min(high - low) < base:
            raise InputError(
                f"{target.called} shares only a strip of less than {base} px with {view.intensity.source.path}",
                file=target.path,
                field="images",
                remedy="give images that overlap more",
            )
        finest = base
        while sigma / finest > _BLURRED and min(high - low) / (2 * finest) >= 3 * 24:
            finest *= 2
        while True:
            try:
                turn = settings.rotation_deg if finest == base else 0.0
                correction, _ = place(view, [target], max(search, 2.0 * finest), finest, window, turn)
            except InputError:
                # Heights may be better than stated, and some ground has no structure in large pixels.
                if finest > base:
                    finest = max(base, finest // 2)
                    continue
                fit = along_sight(view, [target], base, search, window, sigma, settings.threads)
                if fit is None:
                    raise
                return cls(view, target, fit[0], base, 2 * HEIGHTS * sigma + 2 * base, settings)
            else:
                return cls(view, target, correction, base, HEIGHTS * sigma + 2 * finest, settings)

    @property
    def shift(self) -> tuple[float, float]:
        """Mean error of the model: column and row (px)."""
        shift = self.correction.coefficients[[0, 3]]
        return float(shift[0]), float(shift[1])

    def match(self, places: Array) -> PairMatches:
        """Find positions ``(n, 2)`` of the first scene in the second one.

        Chips have whole pixels: the result for the nearest pixel corner is used for the position itself.
        """
        chips = self._chips(np.round(places).astype(int))
        chips.search()
        chips.measure()
        return self._judged(places, chips)

    def _chips(self, centres: NDArray[np.int_]) -> Chips:
        seen = SceneView(self.view.intensity, self.correction, self.view.surface)
        return Chips(seen, [self.target], centres, self.factor, self.reach, self.settings.threads)

    def _judged(self, places: Array, chips: Chips) -> PairMatches:
        """Reject matches that contradict the others across the epipolar direction, or the heights by too much."""
        count = len(places)
        ground = np.full((count, 3), np.nan)
        good = np.isfinite(chips.offset).all(axis=1)
        ground[good] = meet_surface(self.correction, places[good] + chips.offset[good], self.view.surface)
        good &= np.isfinite(ground).all(axis=1)
        partials = np.full((count, 2, 3), np.nan)
        partials[good] = self.correction.ground_partials(ground[good])
        along, turned = displacements(self.view, self.target, partials, ground)
        good &= np.isfinite(along).all(axis=1)
        parts, residuals = Components(1.0, 0.0, _FLOOR), np.full((count, 2), np.nan)
        for _ in range(_JUDGED):
            index = np.flatnonzero(good)
            if len(index) < FEWEST:
                good[:] = False
                break
            origin, extent = places[index].mean(axis=0), max(float(np.ptp(places[index], axis=0).max()), 1.0)
            design = np.column_stack([np.ones(len(index)), (places[index] - origin) / extent])
            residuals[index], parts = _fitted(design, chips.offset[index], chips.covariance[index], along[index])
            parts = replace(parts, other=max(parts.other, _FLOOR))
            total = replace(parts, height=max(parts.height, self.settings.dem_sigma)).covariance(
                chips.covariance[index], along[index]
            )
            apart = residuals[index]
            distance = squared_distances(apart, total)
            bad = distance > SIGMAS**2
            if not bad.any():
                break
            good[index[bad]] = False
        second = np.full((count, 2), np.nan)
        second[good] = self.target.project(ground[good], self.view.model.crs)
        covariance = replace(parts, height=0.0).covariance(chips.covariance, along)
        height, sigma = _heights(residuals, covariance, along)
        return PairMatches(
            places,
            second,
            covariance / 2,
            turned @ covariance @ turned.swapaxes(1, 2) / 2,
            height,
            sigma,
            chips.score,
            parts,
        )


def shared(view: SceneView, target: OtherScene) -> Array:
    """Return the points ``(n, 2)``, of many spread over a scene, that another scene shows by the models."""
    image = spread_over(view)
    return image[shows(view, target, image)]


def shows(view: SceneView, target: OtherScene, image: Array) -> NDArray[np.bool_]:
    """Return which image points ``(n,)`` of a scene another scene shows, by the models."""
    return shown_by([target], meet_surface(view.model, image, view.surface), view.model.crs)


def _fitted(design: Array, offset: Array, matched: Array, along: Array) -> tuple[Array, Components]:
    """Return the residuals of offsets ``(n, 2)`` after a weighted affine correction, and the parts of their errors."""
    residuals = offset - np.median(offset, axis=0)
    parts = components(residuals, matched, along)
    for _ in range(3):
        total = replace(parts, other=max(parts.other, _FLOOR)).covariance(matched, along)
        distance = squared_distances(residuals, total)
        weight = np.linalg.inv(total) / np.maximum(1.0, np.sqrt(distance) / 2.0)[:, None, None]
        rows = np.einsum("nk,ij->nijk", design, np.eye(2)).reshape(len(design), 2, 2 * design.shape[1])
        normal = np.einsum("nip,nij,njq->pq", rows, weight, rows)
        right = np.einsum("nip,nij,nj->p", rows, weight, offset)
        residuals = offset - rows @ np.linalg.lstsq(normal, right, rcond=None)[0]
        parts = components(residuals, matched, along)
    return residuals, parts


def _heights(residuals: Array, covariance: Array, along: Array) -> tuple[Array, Array]:
    """Return the heights ``(n,)`` (m) that correspond to residuals, and their sigmas."""
    weighted = solved(covariance, along[:, :, None])[:, :, 0]
    square = np.einsum("ni,ni->n", weighted, along)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.einsum("ni,ni->n", weighted, residuals) / square, 1.0 / np.sqrt(square)
