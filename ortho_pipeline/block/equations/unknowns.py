"""Places of the unknowns: columns of the parameters of each image, and the order in which points are eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.block.points import BlockPoints, Index

Mask = NDArray[np.bool_]
#: Points that are looked at at once.
_CHUNK = 2_000


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of the design matrix that the parameters of each image take, image by image.

    `offsets` ``(images + 1,)`` are where they begin; `padded` ``(images, p)`` has one row for each image, as long as
    for the image with the most parameters, and -1 for those that an image does not have.
    """

    offsets: Index
    padded: Index

    @classmethod
    def of(cls, counts: Sequence[int]) -> Columns:
        """Return the columns of images with so many parameters each."""
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        padded = np.full((len(counts), max(counts, default=0)), -1, dtype=np.int64)
        for image, count in enumerate(counts):
            padded[image, :count] = offsets[image] + np.arange(count)
        return cls(offsets, padded)

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return int(self.offsets[-1])

    @property
    def widest(self) -> int:
        """Number of parameters p of the image that has the most."""
        return self.padded.shape[1]

    def of_image(self, image: int) -> Index:
        """Return the columns of the parameters of an image."""
        return np.arange(self.offsets[image], self.offsets[image + 1])

    def image_and_place(self, columns: Sequence[int]) -> tuple[Index, Index]:
        """Return the images ``(k,)`` that some columns are of, and their places among the parameters of these."""
        given = np.asarray(columns, dtype=np.int64)
        images = np.searchsorted(self.offsets, given, side="right") - 1
        return images, given - self.offsets[images]


@dataclass(frozen=True, eq=False)
class Chunk:
    """Points ``(n,)`` with equally many rays ``(n, k)`` in images ``(n, k)``, and whether known ground weighs in."""

    points: Index
    rays: Index
    images: Index
    ground: bool


@dataclass(frozen=True, eq=False)
class Ordering:
    """Order in which the unknowns are eliminated: point by point, then the parameters.

    `rays` ``(K,)`` that take part stand by point and image, those of the n `numbers` of points between `starts`
    ``(n + 1,)``; `known` ``(n,)`` says whose known ground weighs in. `rays_of_image` are the rays of each image.
    Points that the same images show follow each other.
    """

    image: Index
    rays: Index
    starts: Index
    numbers: Index
    known: Mask
    rays_of_image: tuple[Index, ...]

    @classmethod
    def of(cls, points: BlockPoints, taking_part: Mask, grounded: Mask) -> Ordering:
        """Sort points by the images that show them.

        Parameters
        ----------
        taking_part : ndarray (M,) of bool
            Rays.
        grounded : ndarray (N,) of bool
            Points whose ground is known; those without rays do not take part.
        """
        rays = points.by_point[taking_part[points.by_point]]
        counts = np.bincount(points.point[rays], minlength=len(points))
        numbers = np.flatnonzero(counts)
        starts = np.cumsum(counts[numbers]) - counts[numbers]
        order = _by_images(points.image[rays], starts, counts[numbers])
        numbers, begin, counts = numbers[order], starts[order], counts[numbers[order]]
        starts = np.concatenate([[0], np.cumsum(counts)])
        rays = rays[np.arange(len(rays)) + np.repeat(begin - starts[:-1], counts)]
        of_image = tuple(rays_of[taking_part[rays_of]] for rays_of in points.rays_of_images)
        return cls(points.image, rays, starts, numbers, grounded[numbers], of_image)

    @cached_property
    def chunks(self) -> tuple[Chunk, ...]:
        """Points in parts of equally many rays, to be looked at side by side."""
        counts = np.diff(self.starts)
        chunks = []
        for count in np.unique(counts):
            for ground in (False, True):
                rows = np.flatnonzero((counts == count) & (self.known == ground))
                table = self.rays[self.starts[rows][:, None] + np.arange(count)]
                for begin in range(0, len(rows), _CHUNK):
                    part = slice(begin, begin + _CHUNK)
                    chunks.append(Chunk(self.numbers[rows[part]], table[part], self.image[table[part]], ground))
        return tuple(chunks)

    @property
    def grounded(self) -> Index:
        """Points whose known ground weighs in."""
        return self.numbers[self.known]

    @property
    def observations(self) -> int:
        """Number of image coordinates."""
        return 2 * len(self.rays)

    @property
    def points(self) -> int:
        """Number of points that take part."""
        return len(self.numbers)


def _by_images(image: Index, starts: Index, counts: Index) -> Index:
    """Return an order of points ``(n,)`` in which those of the same images follow each other, by their first image.

    `image` ``(K,)`` are those of their rays, point by point from `starts` on.
    """
    if not len(starts):
        return starts
    # Two sets of images that come to the same number would only lie side by side.
    numbers = np.random.default_rng(0).integers(0, 2**62, int(image.max()) + 1, dtype=np.uint64)
    return np.lexsort((np.add.reduceat(numbers[image], starts), counts, image[starts]))
