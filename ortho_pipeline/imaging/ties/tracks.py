"""Tracks: the same point in two or more scenes, once in each scene.

A chip of one scene, its home, is measured in all later scenes that show it. Each later scene of a track then searches
the scenes that the home did not overlap, so tracks continue through a block.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.imaging.matching.candidates import RIM, candidates, cells_of
from ortho_pipeline.imaging.matching.chip_search import FEWEST, SIDE
from ortho_pipeline.imaging.matching.targets import SAMPLES, OtherScene, SceneView, metres_per_pixel
from ortho_pipeline.imaging.ties.pairs import Pair, PairMatches, PairSummary, TieSettings, shared, shows
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.caching.block_cache import limit_cache
from ortho_pipeline.surface.rays import refuse_camera_below

#: Largest ratio of the number of cells of a scene to the number of points wanted in its smallest overlap.
_MOST = 10
#: If fewer places fit side by side in the largest overlap of a scene, so many share pixels: a pair needs `FEWEST`.
_FIT, _SHARING = 2 * FEWEST, 3 * FEWEST
#: Largest difference (in sigmas) between the heights of one point from two pairs.
_SIGMAS = 3.5
#: Scenes that a message names.
_NAMED = 4


@dataclass(frozen=True, eq=False)
class Ties:
    """Tracks, with one row for each point in each scene.

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
        If no two scenes overlap, or none could be matched. The message has the reason.
    """
    blocks = sorted(view.intensity.source.block for view in views)
    # A thread reads two scenes.
    settings = replace(settings, threads=limit_cache(settings.memory, settings.threads, *blocks[-2:]))
    targets = [OtherScene(view.intensity, view.model) for view in views]
    overlaps = _overlaps(views, targets)
    if not overlaps:
        for view in views:
            refuse_camera_below(view.model, view.surface, view.intensity.source.path)
        raise InputError(
            "no two of these images overlap: "
            + ", ".join(os.path.basename(view.intensity.source.path) for view in views[:_NAMED])
            + ("" if len(views) <= _NAMED else ", ..."),
            remedy=Text(
                "give images that overlap (`ortho info IMAGE` shows where each is), or heights where they do: "
                "if the DEM covers only a part, fill the rest (",
                Setting("surface.fill"),
                ")",
            ),
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
                "); if the DEM covers only a part, fill the rest (",
                Setting("surface.fill"),
                "); or measure tie points by hand",
            ),
        )
    return block.ties()


def _overlaps(views: Sequence[SceneView], targets: Sequence[OtherScene]) -> dict[tuple[int, int], Array]:
    """Return the overlapping pairs of scenes, with points ``(n, 2)`` of the first one that the second one shows."""
    overlaps = {}
    for first, second in itertools.combinations(range(len(views)), 2):
        shown = shared(views[first], targets[second])
        if len(shown) >= FEWEST:
            overlaps[first, second] = shown
    return overlaps


@dataclass(eq=False)
class _Track:
    """The position of a point in each scene, its covariance there, and the scenes that were searched."""

    places: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    searched: set[int] = field(default_factory=set)


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
        begun, cells, crowding = self._begun(home, view, placed, partners, grown)
        tracks = [*grown, *begun]

        def wanted(k: int, other: int) -> bool:
            return other not in tracks[k].places and (k < len(grown) or other in cells[k - len(grown)])

        matches = {}
        for other, pair in placed.items():
            due = [k for k, track in enumerate(tracks) if other not in track.searched and wanted(k, other)]
            places = np.array([tracks[k].places[home][0] for k in due]).reshape(-1, 2)
            seen = shows(view, self.targets[other], places) if len(places) else np.zeros(0, dtype=bool)
            index = np.array(due, dtype=int)[seen]
            if len(index):
                matches[other] = index, pair.match(places[seen])
        _drop_contradicting(matches)
        self._take(home, tracks, matches, placed, crowding)
        self.tracks += [track for track in begun if len(track.places) > 1]

    def _placed(self, home: int, view: SceneView, partners: Mapping[int, Array]) -> dict[int, Pair]:
        """Return the pairs of a home with a known relative position; record the others with their reason."""
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
    ) -> tuple[list[_Track], list[set[int]], float]:
        """Return new tracks, later scenes for each, and the crowding of their chips.

        A track begins in each cell without a tie to a later scene; these are its scenes.
        """
        shares = [len(partners[other]) / SAMPLES**2 for other in placed]
        factor = min(pair.factor for pair in placed.values())
        columns, rows = self._cells(view.size, shares, factor)
        x, y = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        centres = np.column_stack([x.ravel(), y.ravel()]) * view.size
        lacking = {other: shows(view, self.targets[other], centres) for other in placed}
        for track in grown:
            place = track.places[home][0] / view.size * (columns, rows)
            cell = int(np.clip(place[1], 0, rows - 1)) * columns + int(np.clip(place[0], 0, columns - 1))
            for other in placed:
                if other in track.places:
                    lacking[other][cell] = False
        cells = np.any(list(lacking.values()), axis=0).reshape(rows, columns)
        whole = (0, 0, *view.size)
        origins, numbers = candidates(view, whole, (columns, rows), SIDE, factor, cells, self.settings.apart)
        nothing = np.full((2, 2), np.nan)
        begun = [_Track({home: (origin + SIDE // 2 * float(factor), nothing)}) for origin in origins]
        crowding = (SIDE * factor) ** 2 * columns * rows / math.prod(view.size)
        return begun, [{other for other in placed if lacking[other][number]} for number in numbers.tolist()], crowding

    def _cells(self, size: tuple[int, int], shares: Sequence[float], factor: int) -> tuple[int, int]:
        """Return columns and rows of cells of a scene, of which its partners show these shares; chips have a factor."""
        count = min(round(self.settings.points / min(shares)), _MOST * self.settings.points)
        columns, rows = cells_of(*size, count)
        if not self.settings.apart:
            return columns, rows
        across, down = (extent // ((SIDE + 2 * RIM) * factor) for extent in size)
        if across * down * max(shares) < _FIT:
            return cells_of(*size, min(count, round(_SHARING / max(shares))))
        return min(columns, across), min(rows, down)

    def _take(
        self,
        home: int,
        tracks: Sequence[_Track],
        matches: Mapping[int, tuple[NDArray[np.int_], PairMatches]],
        placed: Mapping[int, Pair],
        crowding: float,
    ) -> None:
        """Add matches to the tracks."""
        own: dict[int, list[Array]] = {}
        for other, (index, matched) in matches.items():
            for row, k in enumerate(index.tolist()):
                tracks[k].searched.add(other)
                if matched.good[row]:
                    tracks[k].places[other] = matched.second[row], matched.second_covariance[row]
                    own.setdefault(k, []).append(matched.first_covariance[row])
            count = int(matched.good.sum())
            reason = "" if count else f"none of {counted(len(index), 'place')} matched"
            shift = placed[other].shift
            self.pairs.append(
                PairSummary((home, other), count, len(index), shift, matched.components, reason, crowding)
            )
        for k, parts in own.items():
            place, covariance = tracks[k].places[home]
            if np.isnan(covariance).any():
                tracks[k].places[home] = place, np.mean(parts, axis=0)

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


def _drop_contradicting(matches: Mapping[int, tuple[NDArray[np.int_], PairMatches]]) -> None:
    """Drop the worse of two matches of one chip that give different heights of the ground."""
    for (first_index, first), (second_index, second) in itertools.combinations(matches.values(), 2):
        _, rows, others = np.intersect1d(first_index, second_index, return_indices=True)
        both = first.good[rows] & second.good[others]
        rows, others = rows[both], others[both]
        apart = first.height[rows] - second.height[others]
        if len(apart) < FEWEST:
            continue
        apart = apart - np.median(apart)
        sigma = np.hypot(first.height_sigma[rows], second.height_sigma[others])
        # The correction of each pair absorbs a different trend of the heights.
        sigma = np.maximum(sigma, 1.4826 * float(np.median(np.abs(apart))))
        bad = np.abs(apart) > _SIGMAS * sigma
        worse = first.score[rows] < second.score[others]
        first.second[rows[bad & worse]] = np.nan
        second.second[others[bad & ~worse]] = np.nan
