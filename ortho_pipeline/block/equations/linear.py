"""Observation equations of a block: its misfits at a state, with their partials."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem, Misfits, PseudoEquations, Selection, State
from ortho_pipeline.block.equations.unknowns import Mask, Ordering
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
        predicted = points.measured.copy()
        by_point = np.zeros((points.rays, 2, 3))
        by_params = np.zeros((points.rays, 2, problem.columns.widest))
        for model, used in zip(state.models, ordering.rays_of_image, strict=True):
            predicted[used], by_point[used], partials = places.linearised(model, points.point[used])
            by_params[used, :, : partials.shape[2]] = partials
        root = (np.sqrt(weights.ray_weights) / points.sigma_image)[:, None, None]
        by_point = points.whitened(np.multiply(by_point, root, out=by_point), slice(None))
        by_params = points.whitened(np.multiply(by_params, root, out=by_params), slice(None))
        pseudo = problem.pseudo_equations(state)
        misfits = problem.misfits_of(predicted, state.local, pseudo, ordering, weights)
        ground_by_point, rows = np.zeros((len(points), 3, 3)), ordering.grounded
        scale = np.sqrt(weights.ground_weights[rows])[:, None] / problem.ground_sigmas[rows]
        ground_by_point[rows] = problem.enu[rows] * scale[:, :, None]
        return cls(problem, state, ordering, weights, misfits, by_params, by_point, ground_by_point, pseudo)

    def with_points_moved(self, local: Array, moved: Mask) -> Linear:
        """Return these equations with points at `local` ``(N, 3)``; only those `moved` ``(N,)`` are elsewhere."""
        problem, points, numbers = self.problem, self.problem.points, np.flatnonzero(moved)
        place = np.zeros(len(points), dtype=np.int64)
        place[numbers] = np.arange(len(numbers))
        places = problem.frame.places(local[numbers])
        root = np.sqrt(self.weights.ray_weights) / points.sigma_image
        rays, by_point, by_params = self.misfits.rays.copy(), self.by_point.copy(), self.by_params.copy()
        for model, of_image in zip(self.state.models, self.ordering.rays_of_image, strict=True):
            used = of_image[moved[points.point[of_image]]]
            if not len(used):
                continue
            image, by_place, partials = places.linearised(model, place[points.point[used]])
            scale = root[used]
            rays[used] = points.whitened((points.measured[used] - image) * scale[:, None], used)
            by_point[used] = points.whitened(by_place * scale[:, None, None], used)
            by_params[used, :, : partials.shape[2]] = points.whitened(partials * scale[:, None, None], used)
        ground = problem.ground_misfits(local, self.ordering, self.weights)
        return replace(
            self, state=replace(self.state, local=local), by_point=by_point, by_params=by_params,
            misfits=replace(self.misfits, rays=rays, ground=ground),
        )  # fmt: skip

    def reweighted(self, weights: Selection) -> Linear:
        """Return these equations with other weights of what takes part."""
        of_rays = np.sqrt(weights.ray_weights / self.weights.ray_weights)
        of_ground = np.sqrt(weights.ground_weights / self.weights.ground_weights)
        misfits, each = self.misfits, (slice(None), None, None)
        return replace(
            self, weights=weights, by_params=self.by_params * of_rays[each], by_point=self.by_point * of_rays[each],
            misfits=replace(misfits, rays=misfits.rays * of_rays[:, None], ground=misfits.ground * of_ground[:, None]),
            ground_by_point=self.ground_by_point * of_ground[each],
        )  # fmt: skip

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

    def changes(self, step: Array, shift: Array) -> Misfits:
        """Return what a step of the parameters ``(P,)`` and of the points ``(N, 3)`` takes off, to first order."""
        points = self.problem.points
        of_image = np.append(step, 0.0)[self.problem.columns.padded]
        rays = np.einsum("nij,nj->ni", self.by_params, of_image[points.image])
        rays += np.einsum("nij,nj->ni", self.by_point, shift[points.point])
        ground = np.einsum("nij,nj->ni", self.ground_by_point, shift)
        return Misfits(rays, ground, (self.pseudo.rows * of_image[self.pseudo.image]).sum(axis=1))
