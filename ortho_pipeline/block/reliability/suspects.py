"""Suspects of gross errors, judged: each is asked which of its parts agree with everything that is trusted.

These are all of its parts, all but one ray, all but its known ground, or none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import Selection
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.equations.unknowns import Chunk, Mask
from ortho_pipeline.block.intersection import PARALLEL
from ortho_pipeline.block.points import Index
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.estimation.blunders import BLUNDER_RISK
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.models.base import Array

#: The chance at which a good part is rejected, for ground whose sigma is estimated: few points never reach a smaller
#: one, and a gross error that stays does more harm than a good point that goes.
_GROUND_RISK = 0.01
_EPSILON = float(np.finfo(float).eps)
#: The part of a suspect that is its known ground; the others are its rays, counted from 0.
_GROUND = -1


class GrossError(Record):
    """A measurement, the ground of a control point, or a whole point that was left out."""

    point: str
    what: Literal["ray", "ground", "point"]
    image: str | None
    reason: str


@dataclass(frozen=True, eq=False)
class Trusted:
    """The solution of everything but the suspects, with the sigmas that its observations have by themselves."""

    solved: Solved
    variances: Variances


def judge(trusted: Trusted, selection: Selection, suspects: Mask) -> tuple[Selection, dict[int, GrossError]]:
    """Take the parts of suspects that contradict the trusted solution out of a selection, and name these by point."""
    problem, solved = trusted.solved.problem, trusted.solved
    of_suspects = suspects[problem.points.point]
    alone = Selection.of(selection.rays & of_suspects, selection.ground & suspects)
    rays, ground = selection.rays.copy(), selection.ground.copy()
    rejected: dict[int, GrossError] = {}
    # A height of a surface is no test of a measurement: on a roof both are right.
    linear = Linear.at(problem.with_heights(None), solved.state, alone)
    limits = _Limits.of(trusted, selection)
    estimated = trusted.variances.of_ground(problem)
    for chunk in linear.ordering.chunks:
        suspect = _Suspects(chunk, linear, solved.cofactors)
        agree, agree_without = limits.verdicts(suspect, estimated[chunk.points])
        bad = np.flatnonzero(~agree)
        possible = np.array([agree_without[part][bad] for part in suspect.parts])
        only = np.where(possible.sum(axis=0) == 1, possible.argmax(axis=0), len(suspect.parts))
        for place, culprit in enumerate((*suspect.parts, None)):
            if not len(of := bad[only == place]):
                continue
            for k, size in zip(of.tolist(), suspect.sizes(of, culprit).tolist(), strict=True):
                number = int(chunk.points[k])
                rejected[number] = suspect.rejected(k, culprit, size)
                ground[number] &= culprit not in (_GROUND, None)
            if culprit != _GROUND:
                rays[chunk.rays[of] if culprit is None else chunk.rays[of, culprit]] = False
    return Selection.of(rays, ground), rejected


@dataclass(frozen=True)
class _Limits:
    """Limits of the squares of contradictions, by their degrees of freedom.

    What contradicts ground of an estimated sigma is judged with all the sigmas that are possible, and its risk is
    shared by the control points alone.
    """

    freedom: float
    risk: float
    ground_risk: float
    variances: Variances

    @classmethod
    def of(cls, trusted: Trusted, selection: Selection) -> _Limits:
        _, freedom = trusted.solved.unit_weight()
        active = trusted.solved.problem.active(selection)
        count, control = int(active.sum()), max(int((active & selection.ground).sum()), 1)
        return cls(max(freedom, 1.0), BLUNDER_RISK / count, _GROUND_RISK / control, trusted.variances)

    def verdicts(self, suspect: _Suspects, estimated: Mask) -> tuple[Mask, dict[int, Mask]]:
        """Return which points agree with the trusted, and which do without each of their parts."""
        found = {part: suspect.contradictions(part) for part in suspect.parts}
        whole, redundancy = suspect.contradictions(None)
        agree = self.passes(whole, redundancy)
        agree_without = {part: self.passes(*found[part]) for part in found}
        if _GROUND not in suspect.parts or not estimated.any():
            return agree, agree_without
        of_rays = found[_GROUND][1]
        for k in np.flatnonzero(estimated):
            placed = suspect.ground_apart(int(k)) if of_rays[k] > 0 else None
            if placed is None:
                agree[k] = self.passes_ground(whole[k], redundancy[k])
                continue
            apart, spread, axes = placed
            likely = self.variances.chance_of(apart, spread, axes) >= self.ground_risk
            agree[k] = likely and agree_without[_GROUND][k]
        for part, (squares, freedom) in found.items():
            if part != _GROUND:
                agree_without[part] = np.where(estimated, self.passes_ground(squares, freedom), agree_without[part])
        return agree, agree_without

    def passes(self, squares: Array, redundancy: Index) -> Mask:
        """Return whether squares are small enough for measurements and ground of stated sigmas."""
        return self._passes(squares, redundancy, self.freedom, self.risk)

    def passes_ground(self, squares: Array, redundancy: Index) -> Mask:
        """Return whether squares are small enough for ground of an estimated sigma."""
        return self._passes(squares, redundancy, min(self.freedom, self.variances.freedom), self.ground_risk)

    def _passes(self, squares: Array, redundancy: Index, freedom: float, risk: float) -> Mask:
        from scipy.special import fdtri

        limit = redundancy * fdtri(np.maximum(redundancy, 1), freedom, 1 - risk)
        return np.asarray((redundancy > 0) & (squares <= limit))


class _Suspects:
    """The rows of points of a chunk ``(n, m)``; their parts are their rays, and their ground if that is known."""

    def __init__(self, chunk: Chunk, linear: Linear, cofactors: Cofactors) -> None:
        self.problem, self.chunk, self.local = linear.problem, chunk, linear.state.local
        count, k = chunk.rays.shape
        self.design = linear.by_point[chunk.rays].reshape(count, 2 * k, 3)
        self.misfit = linear.misfits.rays[chunk.rays].reshape(count, 2 * k)
        self.parts = {c: np.arange(2 * c, 2 * c + 2) for c in range(k)}
        if chunk.ground:
            self.design = np.concatenate([self.design, linear.ground_by_point[chunk.points]], axis=1)
            self.misfit = np.concatenate([self.misfit, linear.misfits.ground[chunk.points]], axis=1)
            self.parts[_GROUND] = np.arange(2 * k, 2 * k + 3)
        self.spread = np.tile(np.eye(self.misfit.shape[1]), (count, 1, 1))
        for a in range(k):
            taken = linear.by_params[chunk.rays[:, a]]
            for b in range(a, k):
                between = cofactors.between(chunk.images[:, a], chunk.images[:, b])
                part = taken @ between @ linear.by_params[chunk.rays[:, b]].swapaxes(1, 2)
                self.spread[:, self.parts[a][:, None], self.parts[b]] += part
                if b > a:
                    self.spread[:, self.parts[b][:, None], self.parts[a]] += part.swapaxes(1, 2)

    def contradictions(self, without: int | None) -> tuple[Array, Index]:
        """Return the squares ``(n,)`` by which all parts but one miss each other and the block, and their freedom."""
        keep = self._all_but(without)
        # A row of an unknown coordinate is empty.
        redundancy = np.maximum((self.design[:, keep] != 0.0).any(axis=2).sum(axis=1) - 3, 0)
        if not redundancy.any():
            return np.full(len(self.misfit), math.inf), redundancy
        half = np.linalg.cholesky(self.spread[:, keep[:, None], keep])
        q, _ = np.linalg.qr(np.linalg.solve(half, self.design[:, keep]))
        misfit = np.linalg.solve(half, self.misfit[:, keep, None])
        left = misfit - q @ (q.swapaxes(1, 2) @ misfit)
        return np.where(redundancy > 0, (left**2).sum(axis=(1, 2)), math.inf), redundancy

    def ground_apart(self, k: int) -> tuple[Array, Array, tuple[int, ...]] | None:
        """Return how far known ground is from where its rays and the block put it: metres, covariance, known axes.

        None where parallel rays put it nowhere.
        """
        sigmas = self._sigmas(self.chunk.points[[k]])[0]
        axes = tuple(np.flatnonzero(np.isfinite(sigmas)).tolist())
        known = self.parts[_GROUND][list(axes)]
        rays = self._all_but(_GROUND)
        weights = np.linalg.inv(self.spread[k][np.ix_(rays, rays)])
        design, sigma = self.design[k, rays], sigmas[list(axes)]
        normal = design.T @ weights @ design
        if np.linalg.cond(normal) > PARALLEL**2:
            return None
        inverse = np.linalg.inv(normal)
        place = inverse @ design.T @ weights @ self.misfit[k, rays]
        turned = self.design[k, known] * sigma[:, None]
        return sigma * self.misfit[k, known] - turned @ place, turned @ inverse @ turned.T, axes

    def _sigmas(self, points: Index) -> Array:
        """Return those ``(n, 3)`` of the ground of some points."""
        return self.problem.on_points(self.local, points).sigmas

    def _all_but(self, without: int | None) -> np.ndarray:
        return np.concatenate([part for name, part in self.parts.items() if name != without])

    def sizes(self, of: Index, culprit: int | None) -> Array:
        """Return how far one part of some points is from where the others put it; all from each other if that is None.

        In metres for known ground, in pixels for rays.
        """
        points, chunk = self.problem.points, self.chunk
        apart = self._apart(of, culprit)
        if culprit is None:
            rays = chunk.rays[of]
            missed = points.in_pixels(apart[:, : 2 * rays.shape[1]].reshape(-1, 2), rays.ravel())
            return np.asarray(np.abs(missed).reshape(len(of), -1).max(axis=1))
        apart = apart[:, self.parts[culprit]]
        if culprit == _GROUND:
            sigmas = self._sigmas(chunk.points[of])
            known = np.isfinite(sigmas)
            return np.asarray(np.linalg.norm(np.where(known, apart * np.where(known, sigmas, 0.0), 0.0), axis=1))
        return np.asarray(np.linalg.norm(points.in_pixels(apart, chunk.rays[of, culprit]), axis=1))

    def rejected(self, k: int, culprit: int | None, size: float) -> GrossError:
        """Return what is said of a point when a part of it, or an unknown one, is so far off."""
        points, chunk = self.problem.points, self.chunk
        name = points.ids[chunk.points[k]]
        if culprit is None:
            known = _GROUND in self.parts
            who = "its ground and its measurements contradict each other" if known else "its rays miss each other"
            reason = f"gross error, {who} by {size:.1f} px, and it cannot be decided which is wrong"
            return GrossError(point=name, what="point", image=None, reason=reason)
        if culprit == _GROUND:
            return GrossError(
                point=name, what="ground", image=None, reason=f"gross error, {size:.1f} m from where its rays meet"
            )
        image = points.images[points.image[chunk.rays[k, culprit]]]
        return GrossError(
            point=name,
            what="ray",
            image=image,
            reason=f"gross error, {size:.1f} px from where the other rays and points put it",
        )

    def _apart(self, of: Index, without: int | None) -> Array:
        """Return the misfits ``(n, m)`` of all rows of some points at the places that all parts but one give."""
        keep = self._all_but(without)
        design, misfit = self.design[of], self.misfit[of]
        inverse = np.linalg.pinv(design[:, keep], rcond=_EPSILON * max(len(keep), 3))
        return np.asarray(misfit - (design @ (inverse @ misfit[:, keep, None]))[:, :, 0])
