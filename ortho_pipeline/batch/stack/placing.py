"""The common grid of a stack, and the corrected model of each date on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.errors import CrsError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.naming import crs_definition
from ortho_pipeline.models import ImageCorrection, MapGrid
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface


@dataclass(frozen=True, eq=False)
class Placed:
    """The grid of a stack: that of its first date, extended to the area of all that are corrected."""

    grid: Grid

    @classmethod
    def of(cls, dates: Sequence[Dated]) -> Placed:
        """Return the grid of orthos of one CRS as they were delivered."""
        models = [map_grid_of(one) for one in dates]
        return cls._over(models[0], [model.corners for model in models], 1e-6)

    @classmethod
    def _over(cls, first: MapGrid, areas: Sequence[Array], least: float) -> Placed:
        """Return a grid with the pixels of the first date over areas, each of corners of an ortho ``(n, 3)``.

        Less than a part of a pixel (`least`) adds none.
        """
        if parse_crs(first.map_crs).is_geographic:
            # Across the antimeridian some orthos have longitudes near -180, and others near 180.
            middle = first.corners.mean(axis=0)
            turns = [np.round((middle - area.mean(axis=0)) / 360.0) * (1, 0, 0) for area in areas]
            areas = [area + 360.0 * turn for area, turn in zip(areas, turns, strict=True)]
        corners, step = np.concatenate(areas), np.array(first.pixel)
        origin = np.array([first.corners[:, 0].min(), first.corners[:, 1].max()])
        places = (corners[:, :2] - origin) / step * (1, -1)
        begin, end = np.floor(places.min(axis=0) + least), np.ceil(places.max(axis=0) - least)
        left, top = (origin + begin * step * (1, -1)).tolist()
        width, height = (end - begin).astype(int).tolist()
        return cls(Grid(parse_crs(first.map_crs), left, top, float(step[0]), float(step[1]), width, height))

    def of_corrected(self, dates: Sequence[Dated], stack: AdjustedStack) -> tuple[Placed, AdjustedStack]:
        """Return the grid over the corrected area of all dates that are corrected, and the same stack on that grid.

        It has all of the first date as delivered, too: that ortho may be there for its grid.
        """
        first = map_grid_of(dates[0])
        areas = [first.corners] if stack.determined[0] else []
        for number, one in enumerate(dates):
            if stack.determined[number]:
                corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (one.scene.width, one.scene.height)
                areas.append(self.corrected(one, stack, number).image_to_ground(corners, 0.0))
        # Pixels whose middle is outside have no value.
        found = Placed._over(first, areas, 0.5)
        old, new = self.grid, found.grid
        moved = np.rint([(new.left - old.left) / old.dx, (old.top - new.top) / old.dy])
        return found, replace(stack, cells=stack.cells._replace(low=stack.cells.low - moved))

    @property
    def model(self) -> MapGrid:
        """The grid as a model."""
        return MapGrid(crs_definition(self.grid.crs), self.grid.geotransform, (self.grid.width, self.grid.height))

    def at(self, plan: Array) -> Array:
        """Return places ``(n, 2)`` px of map coordinates ``(n, 2)``."""
        return self.model.ground_to_image(np.column_stack([plan, np.zeros(len(plan))]))

    def on(self, surface: Surface, place: Array) -> Array:
        """Return the ground ``(n, 3)`` in map coordinates at places ``(n, 2)`` px on a surface."""
        ground = self.model.image_to_ground(place, 0.0)
        ground[:, 2] = surface.heights(ground[:, :2], self.model.crs)
        return ground

    def shared(self, dates: Sequence[Dated], pairs: Sequence[tuple[int, int]]) -> tuple[Array, Array]:
        """Return the lowest and highest place (px) of what two dates of a pair show; a reference shows all."""
        places = [self.at(map_grid_of(one).corners[:, :2]) for one in dates]
        known = [[number for number in pair if number < len(dates)] for pair in pairs]
        low = [np.max([places[number].min(axis=0) for number in some], axis=0) for some in known]
        high = [np.min([places[number].max(axis=0) for number in some], axis=0) for some in known]
        return np.min(low, axis=0), np.max(high, axis=0)

    def corrected(self, one: Dated, stack: AdjustedStack, date: int) -> ImageCorrection:
        """Return the model of an ortho with its correction."""
        own, size = map_grid_of(one), (one.scene.width, one.scene.height)
        origin = np.array(size) / 2

        def moved(image: Array) -> Array:
            place = self.at(own.image_to_ground(image, 0.0)[:, :2])
            shown = place + stack.at(place)[0][date]
            return own.ground_to_image(self.model.image_to_ground(shown, 0.0)) - image

        middle, right, below = moved(origin + np.array([[0.0, 0.0], [size[0] / 2, 0.0], [0.0, size[1] / 2]]))
        across, down = (right - middle) / (size[0] / 2), (below - middle) / (size[1] / 2)
        kind = "affine" if stack.sloped[date] else "shift"
        if kind == "shift":
            across, down = np.zeros(2), np.zeros(2)
        coefficients = np.array([middle[0], across[0], down[0], middle[1], across[1], down[1]])
        return ImageCorrection(own, kind, (float(origin[0]), float(origin[1])), coefficients)


def require_one_crs(orthos: Sequence[Dated]) -> None:
    """Refuse orthos whose CRS differ.

    Raises
    ------
    CrsError
        It names the first that has another one.
    """
    for one in orthos:
        if parse_crs(map_grid_of(one).map_crs) != parse_crs(map_grid_of(orthos[0]).map_crs):
            raise CrsError(
                f"this ortho has another CRS than {orthos[0].path.name}",
                file=one.path,
                field="orthos",
                remedy="reproject it to the same CRS, or leave it out",
            )


def map_grid_of(one: Dated) -> MapGrid:
    """Return the map grid of an ortho."""
    model = one.scene.model
    assert isinstance(model, MapGrid)
    return model


def geotransform_of(model: ImageCorrection) -> tuple[float, ...]:
    """Return the geotransform of a map grid with a correction."""
    origin, right, below = model.image_to_ground(np.array([[0.0, 0.0], [1000.0, 0.0], [0.0, 1000.0]]), 0.0)[:, :2]
    across, down = (right - origin) / 1000.0, (below - origin) / 1000.0
    return (origin[0], across[0], down[0], origin[1], across[1], down[1])


def pixel_of(one: Dated) -> float:
    """Return the size of a pixel of an ortho, in units of its map."""
    return float(np.sqrt(np.prod(map_grid_of(one).pixel)))
