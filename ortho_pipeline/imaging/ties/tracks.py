"""Tracks: the same place in two scenes or more, each scene once.

The same chip of one scene, its home, is measured in all later scenes that show it. What a later scene shows of a track,
and the track's home did not see in scenes further on, is measured there in turn: so tracks go on through a block.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.imaging.matching.candidates import candidates, cells_of
from ortho_pipeline.imaging.matching.chip_search import FEWEST, SIDE
from ortho_pipeline.imaging.matching.targets import SAMPLES, OtherScene, SceneView, metres_per_pixel
from ortho_pipeline.imaging.ties.pairs import Pair, PairMatches, PairSummary, TieSettings, shared, shows
from ortho_pipeline.models.base import Array
from ortho_pipeline.options.texts import Setting, Text, counted
from ortho_pipeline.raster.caching.block_cache import limit_cache

#: Cells of a scene are at most so many times those wanted of its smallest overlap.
_MOST = 10
#: Heights that two pairs say of one place differ by at most so many sigmas.
_SIGMAS = 3.5


@dataclass(frozen=True, eq=False)
class Ties:
    """Tracks, one row for each place in each scene.

    Parameters
    ----------
    track : (m,) of int
        Numbered from 0.
    image : (m,) of int
        Index of the scene.
    measured : (m, 2)
        Column, row, px.
    covariance : (m, 2, 2)
        px².
    pairs : tuple of PairSummary
        All pairs of scenes that show the same ground.
    """

    track: NDArray[np.int_]
    image: NDArray[np.int_]
    measured: Array
    covariance: Array
    pairs: tuple[PairSummary, ...]

    def of_pair(self, first: int, second: int) -> NDArray[np.int_]:
        """Return the tracks that are in both scenes."""
        return np.intersect1d(self.track[self.image == first], self.track[self.image == second])


def tie(views: Sequence[SceneView], settings: TieSettings) -> Ties:
    """Tie scenes together.

    Raises
    ------
    InputError
        If no two of them show the same ground, or none that do could be matched; with the reason.
    """
    blocks = sorted(view.intensity.source.block for view in views)
    # A thread looks at two scenes.
    settings = replace(settings, threads=limit_cache(settings.memory, settings.threads, *blocks[-2:]))
    targets = [OtherScene(view.intensity, view.model) for view in views]
    overlaps = _overlaps(views, targets)
    if not overlaps:
        raise InputError(
            "no two scenes overlap",
            file=views[0].intensity.source.path,
            field="images",
            remedy="give scenes that overlap; if they do, check their models with `ortho info IMAGE`",
        )
    block = _Block(views, targets, settings)
    for home, view in enumerate(views):
        partners = {other: shown for (first, other), shown in overlaps.items() if first == home}
        block.tie_home(home, view, partners)
    if not block.tracks:
        reasons = "; ".join(
            f"{os.path.basename(views[pair.images[0]].intensity.source.path)} and "
            f"{os.path.basename(views[pair.images[1]].intensity.source.path)}: {pair.reason}"
            for pair in block.pairs
        )
        raise InputError(
            f"no tie points found: {reasons}",
            file=views[0].intensity.source.path,
            field="images",
            remedy=Text(
                "if the models may be farther off, search farther (",
                Setting("match.search"),
                "); if the DEM is coarse, state its accuracy (",
                Setting("surface.sigma"),
                "); or measure tie points by hand",
            ),
        )
    return block.ties()


def _overlaps(views: Sequence[SceneView], targets: Sequence[OtherScene]) -> dict[tuple[int, int], Array]:
    """Return the pairs of scenes that show the same ground, and points ``(n, 2)`` of the first that the second does."""
    found = {}
    for first, second in itertools.combinations(range(len(views)), 2):
        shown = shared(views[first], targets[second])
        if len(shown) >= FEWEST:
            found[first, second] = shown
    return found


@dataclass(eq=False)
class _Track:
    """Where a place is in each scene, its covariance there, and the scenes that were looked at."""

    places: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    asked: set[int] = field(default_factory=set)


class _Block:
    """Tracks as they grow, home by home."""

    def __init__(self, views: Sequence[SceneView], targets: Sequence[OtherScene], settings: TieSettings) -> None:
        self.views, self.targets, self.settings = views, targets, settings
        self.tracks: list[_Track] = []
        self.pairs: list[PairSummary] = []

    def tie_home(self, home: int, view: SceneView, partners: Mapping[int, Array]) -> None:
        """Measure chips of a scene in the scenes after it."""
        placed = self._placed(home, view, partners)
        if not placed:
            return
        grown = [track for track in self.tracks if home in track.places]
        begun, cells = self._begun(home, view, placed, partners, grown)
        asking = [*grown, *begun]

        def wanted(k: int, other: int) -> bool:
            return other not in asking[k].places and (k < len(grown) or other in cells[k - len(grown)])

        found = {}
        for other, pair in placed.items():
            asked = [k for k, track in enumerate(asking) if other not in track.asked and wanted(k, other)]
            places = np.array([asking[k].places[home][0] for k in asked]).reshape(-1, 2)
            seen = shows(view, self.targets[other], places) if len(places) else np.zeros(0, dtype=bool)
            index = np.array(asked, dtype=int)[seen]
            if len(index):
                found[other] = index, pair.match(places[seen])
        _drop_contradicting(found)
        self._take(home, asking, found, placed)
        self.tracks += [track for track in begun if len(track.places) > 1]

    def _placed(self, home: int, view: SceneView, partners: Mapping[int, Array]) -> dict[int, Pair]:
        """Return the pairs of a home whose relative position was found; the others are said."""
        placed = {}
        search = self.settings.search / metres_per_pixel(view)
        for other, shown in partners.items():
            try:
                placed[other] = Pair.place(view, self.targets[other], shown, search, self.settings)
            except InputError as error:
                self.pairs.append(PairSummary((home, other), 0, 0, reason=error.message))
        return placed

    def _begun(
        self,
        home: int,
        view: SceneView,
        placed: Mapping[int, Pair],
        partners: Mapping[int, Array],
        grown: Sequence[_Track],
    ) -> tuple[list[_Track], list[set[int]]]:
        """Return new tracks, one in each cell that lacks a tie with a scene after it, and these scenes of each."""
        share = min(len(partners[other]) for other in placed) / SAMPLES**2
        columns, rows = cells_of(*view.size, min(round(self.settings.points / share), _MOST * self.settings.points))
        x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        centres = np.column_stack([x.ravel(), y.ravel()]) * view.size
        lacking = {other: shows(view, self.targets[other], centres) for other in placed}
        for track in grown:
            place = track.places[home][0] / view.size * (columns, rows)
            cell = int(np.clip(place[1], 0, rows - 1)) * columns + int(np.clip(place[0], 0, columns - 1))
            for other in placed:
                if other in track.places:
                    lacking[other][cell] = False
        wanted = np.any(list(lacking.values()), axis=0).reshape(rows, columns)
        factor = min(pair.factor for pair in placed.values())
        origins, numbers = candidates(view, (0, 0, *view.size), (columns, rows), SIDE, factor, wanted)
        nothing = np.full((2, 2), np.nan)
        begun = [_Track({home: (origin + SIDE // 2 * float(factor), nothing)}) for origin in origins]
        return begun, [{other for other in placed if lacking[other][number]} for number in numbers.tolist()]

    def _take(
        self,
        home: int,
        asking: Sequence[_Track],
        found: Mapping[int, tuple[NDArray[np.int_], PairMatches]],
        placed: Mapping[int, Pair],
    ) -> None:
        """Add what was found to the tracks."""
        own: dict[int, list[Array]] = {}
        for other, (index, matched) in found.items():
            for row, k in enumerate(index.tolist()):
                asking[k].asked.add(other)
                if matched.good[row]:
                    asking[k].places[other] = matched.second[row], matched.second_covariance[row]
                    own.setdefault(k, []).append(matched.first_covariance[row])
            count = int(matched.good.sum())
            reason = "" if count else f"none of {counted(len(index), 'place')} matched"
            self.pairs.append(
                PairSummary((home, other), count, len(index), placed[other].shift, matched.components, reason)
            )
        for k, parts in own.items():
            place, covariance = asking[k].places[home]
            if np.isnan(covariance).any():
                asking[k].places[home] = place, np.mean(parts, axis=0)

    def ties(self) -> Ties:
        """Return all tracks."""
        rows = [
            (number, image, place, covariance)
            for number, track in enumerate(self.tracks)
            for image, (place, covariance) in sorted(track.places.items())
        ]
        return Ties(
            np.array([row[0] for row in rows]),
            np.array([row[1] for row in rows]),
            np.array([row[2] for row in rows]),
            np.array([row[3] for row in rows]),
            tuple(self.pairs),
        )


def _drop_contradicting(found: Mapping[int, tuple[NDArray[np.int_], PairMatches]]) -> None:
    """Take the worse of two matches of one chip away that put the ground at different heights."""
    for (first_index, first), (second_index, second) in itertools.combinations(found.values(), 2):
        _, rows, others = np.intersect1d(first_index, second_index, return_indices=True)
        both = first.good[rows] & second.good[others]
        rows, others = rows[both], others[both]
        apart = first.height[rows] - second.height[others]
        if len(apart) < FEWEST:
            continue
        apart = apart - np.median(apart)
        sigma = np.hypot(first.height_sigma[rows], second.height_sigma[others])
        # Corrections of both pairs take up a trend of the heights each in its own way.
        sigma = np.maximum(sigma, 1.4826 * float(np.median(np.abs(apart))))
        bad = np.abs(apart) > _SIGMAS * sigma
        worse = first.score[rows] < second.score[others]
        first.second[rows[bad & worse]] = np.nan
        second.second[others[bad & ~worse]] = np.nan
