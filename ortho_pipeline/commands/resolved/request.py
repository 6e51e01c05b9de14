"""The request of a command for one scene."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

from ortho_pipeline.commands.heights.opening import dem_files, sigma_file
from ortho_pipeline.options import MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions

#: In place of a file of points: the ground control points that the image itself holds.
OWN_POINTS = "own"


@dataclass(frozen=True, eq=False)
class Request:
    """The request for one scene: its image, and the options of the user.

    Parameters
    ----------
    image : path or Scene
        A scene is open already.
    """

    image: Any
    scene: SceneOptions = SceneOptions()
    points: PointOptions = PointOptions()
    surface: SurfaceOptions = SurfaceOptions()
    match: MatchOptions = MatchOptions()
    output: OutputOptions = OutputOptions()

    @property
    def has_control(self) -> bool:
        """Whether there is anything to adjust to."""
        return self.points.gcps is not None or bool(self.match.reference)

    @property
    def point_file(self) -> str | os.PathLike[str] | None:
        """The file of points; None where there is none, or they are read already."""
        gcps = self.points.gcps
        return gcps if isinstance(gcps, str | os.PathLike) else None

    @property
    def named(self) -> list[tuple[str, str | os.PathLike[str]]]:
        """The files that the user named, each with its role; a DEM may be a pattern of several."""
        named: list[tuple[str, Any]] = [
            ("image", self.image),
            *self.scene.files.items(),
            ("points", self.point_file),
            ("DEM", self.surface.dem),
            ("geoid", self.surface.vertical),
            ("DEM accuracy", sigma_file(self.surface)),
            *(("reference", path) for path in self.match.reference),
            *self.output.files.items(),
        ]
        return [(role, path) for role, path in named if path is not None]

    @property
    def files(self) -> list[tuple[str, str | os.PathLike[str]]]:
        """The files that the user named, each with its role; of a pattern, those that there are."""
        dem = [("DEM", path) for path in dem_files(self.surface)]
        return [file for role, path in self.named for file in (dem if role == "DEM" else [(role, path)])]

    def asked(self, *groups: str) -> dict[str, Any]:
        """Return the named groups of options that are not empty, for the record of a result."""
        return {name: getattr(self, name) for name in groups if name != "match" or self.match.reference}
