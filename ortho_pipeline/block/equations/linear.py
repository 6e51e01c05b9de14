"""Observation equations of a block: its misfits at a state, with their partials."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem, Misfits, PseudoEquations, Selection, State
from ortho_pipeline.block.equations.unknowns import Mask, Ordering
from ortho_pipeline.block.projection.rays import linearised
from ortho_pipeline.models.base import Array


@dataclass(frozen=True, eq=False)
class Linear:
    """Misfits over their sigma, and their partials, at a state; zero for what takes no part.

    `by_params` has as many columns as the image with the most parameters; those that an image does not have are zero.
    """

    problem: BlockProblem
    state: State
    ordering: Ordering
    weights: Selection
    misfits: Misfits
    by_params: Array  # (M, 2, p)
    by_point: Array  # (M, 2, 3)
    ground_by_point: Array  # (N, 3, 3)
    pseudo: PseudoEquations

    @classmethod
    def at(cls, problem: BlockProblem, state: State, weights: Selection, ordering: Ordering | None = None) -> Linear:
        """Return the observation equations of a problem at a state; `ordering` is given where it is known."""
        points = problem.points
        ordering = problem.ordering(weights) if ordering is None else ordering
        places = problem.frame.places(state.local)
        root = np.sqrt(weights.ray_weights) / points.sigma_image
        of_images, widest, zeros = ordering.rays_of_image, problem.columns.widest, problem.buffers.zeros
        seen = linearised(places, state.models, of_images, points.point, root, widest, zeros)
        left_out = np.ones(points.rays, dtype=bool)
        left_out[ordering.rays] = False
        seen.image[left_out] = points.measured[left_out]
        by_point = points.whitened(seen.by_point, slice(None))
        by_params = points.whitened(seen.by_params, slice(None))
        pseudo = problem.pseudo_equations(state)
        ground, ground_by_point = problem.ground_equations(state.local, ordering, weights)
        misfits = Misfits(problem.ray_misfits(seen.image, weights), ground, pseudo.misfit)
        return cls(problem, state, ordering, weights, misfits, by_params, by_point, ground_by_point, pseudo)

    def _handed_over(self) -> tuple[Array, Array, Array]:
        """Return the partials, and leave none here: they are most of a block's memory, and are changed in place."""
        found = self.by_params, self.by_point, self.ground_by_point
        for name in ("by_params", "by_point", "ground_by_point"):
            object.__delattr__(self, name)
        return found

    def with_points_moved(self, local: Array, moved: Mask) -> Linear:
        """Return these equations with points at `local` ``(N, 3)``; only those `moved` ``(N,)`` are elsewhere.

        They take the partials of these along.
        """
        problem, points, numbers = self.problem, self.problem.points, np.flatnonzero(moved)
        place = np.zeros(len(points), dtype=np.int64)
        place[numbers] = np.arange(len(numbers))
        # Their rays, image by image, as if there were no others.
        parts = [of_image[moved[points.point[of_image]]] for of_image in self.ordering.rays_of_image]
        used, ends = np.concatenate(parts), np.cumsum([0, *map(len, parts)])
        of_images = [np.arange(begin, end) for begin, end in itertools.pairwise(ends.tolist())]
        root = np.sqrt(self.weights.ray_weights[used]) / points.sigma_image[used]
        places, widest = problem.frame.places(local[numbers]), problem.columns.widest
        seen = linearised(places, self.state.models, of_images, place[points.point[used]], root, widest)
        rays, (by_params, by_point, _) = self.misfits.rays.copy(), self._handed_over()
        rays[used] = points.whitened((points.measured[used] - seen.image) * root[:, None], used)
        by_point[used] = points.whitened(seen.by_point, used)
        by_params[used] = points.whitened(seen.by_params, used)
        ground, ground_by_point = problem.ground_equations(local, self.ordering, self.weights)
        return replace(
            self,
            state=replace(self.state, local=local),
            by_point=by_point,
            by_params=by_params,
            ground_by_point=ground_by_point,
            misfits=replace(self.misfits, rays=rays, ground=ground),
        )

    def reweighted(self, weights: Selection) -> Linear:
        """Return these equations with other weights of what takes part; they take the partials of these along."""
        of_rays = np.sqrt(weights.ray_weights / self.weights.ray_weights)
        of_ground = np.sqrt(weights.ground_weights / self.weights.ground_weights)
        misfits, (by_params, by_point, ground_by_point) = self.misfits, self._handed_over()
        by_params *= of_rays[:, None, None]
        by_point *= of_rays[:, None, None]
        ground_by_point *= of_ground[:, None, None]
        return replace(
            self,
            weights=weights,
            by_params=by_params,
            by_point=by_point,
            ground_by_point=ground_by_point,
            misfits=replace(misfits, rays=misfits.rays * of_rays[:, None], ground=misfits.ground * of_ground[:, None]),
        )

    @property
    def lost(self) -> Mask:
        """Points ``(N,)`` that take part, but are outside of a model that shows them."""
        found = np.zeros(len(self.problem.points), dtype=bool)
        found[self.problem.points.point[~np.isfinite(self.misfits.rays).all(axis=1)]] = True
        return found

    @property
    def pseudo_design(self) -> Array:
        """Rows ``(k, P)`` of the pseudo-observations."""
        size, pseudo = self.problem.size, self.pseudo
        found = np.zeros((len(pseudo.rows), size + 1))
        found[np.arange(len(found))[:, None], self.problem.columns.padded[pseudo.image]] = pseudo.rows
        return found[:, :size]

    def pseudo_by_image(self, of: Mask) -> Iterator[tuple[int, Array]]:
        """Yield images with the rows ``(k, p)`` by their own parameters of some of their pseudo-observations."""
        counts = np.diff(self.problem.columns.offsets)
        for image in np.unique(self.pseudo.image[of]).tolist():
            yield image, self.pseudo.rows[of & (self.pseudo.image == image), : counts[image]]
