"""The parameters of a line scanner: their names, groups and order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ortho_pipeline.models.base import Array

#: Components of the path (m) and of the attitude (rad).
PATH, ATTITUDE = ("along", "across", "radial"), ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class Parameters:
    """All parameters in the order of their values.

    Parameters
    ----------
    path, attitude : int
        Coefficients per component of the splines.
    camera : tuple of str
        Names of the parameters of the line camera.
    """

    path: int
    attitude: int
    camera: tuple[str, ...]

    @cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names by group: the coefficients of the splines, their offsets and drifts, the camera."""
        groups = {
            group: tuple(f"{name}_{k}" for k in range(count) for name in names)
            for group, names, count in (("path", PATH, self.path), ("attitude", ATTITUDE, self.attitude))
        }
        for group, names in (("path", PATH), ("attitude", ATTITUDE)):
            for what in ("offset", "drift"):
                groups[f"{group}_{what}"] = tuple(f"{name}_{what}" for name in names)
        return {**groups, "camera": self.camera}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(name for names in self.groups.values() for name in names)

    @cached_property
    def first(self) -> dict[str, int]:
        """Index of the first parameter of each group."""
        ends = np.cumsum([0, *(len(names) for names in self.groups.values())])
        return dict(zip(self.groups, ends[:-1].tolist(), strict=True))

    def places(self, names: tuple[str, ...]) -> list[int]:
        """Return the indices of parameters among all."""
        place = {name: k for k, name in enumerate(self.names)}
        return [place[name] for name in names]

    def triples(self, group: str, basis: Array) -> list[tuple[int, Array]]:
        """Return the first of each three parameters that belong to the three axes, and its weights ``(N,)``.

        `basis` ``(N, size + 2)`` has the weights of the coefficients of `group`, of its offset and of its drift.
        """
        firsts = [self.first[group] + 3 * k for k in range(basis.shape[1] - 2)]
        firsts += [self.first[f"{group}_offset"], self.first[f"{group}_drift"]]
        return [(first, basis[:, k]) for k, first in enumerate(firsts)]

    def split(self, values: Array) -> list[Array]:
        """Return the values of path and attitude ``(size, 3)``, their lines ``(2, 3)``, and the camera."""
        sizes = np.cumsum([3 * self.path, 3 * self.attitude, 6, 6])
        *moving, camera = np.split(values, sizes)
        return [*(part.reshape(-1, 3) for part in moving), camera]
