"""`ortho ties`: several scenes and heights in, the tie points between them out."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj

from ortho_pipeline.block.points import BlockPoints, shape_of
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.block_images import labels_of, scenes_of
from ortho_pipeline.commands.control.crops import settled_options
from ortho_pipeline.commands.control.search import rotation_of, search_of
from ortho_pipeline.commands.heights.opening import open_surface, require_heights
from ortho_pipeline.commands.resolved.opening import on_surface
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import Result, to_store
from ortho_pipeline.commands.stac.given import with_items
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.display.numbers import metres, px
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import write_text
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import MatchOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points.image_errors import sigma_of_covariance
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.surface.accuracy import typical_sigma
from ortho_pipeline.surface.base import Surface

if TYPE_CHECKING:
    # What matches takes a while to load, and few commands match.
    from ortho_pipeline.imaging.ties import Ties

#: Assumed sigma (m) of the heights of a DEM without a stated accuracy, and of flat ground.
DEM_SIGMA, FLAT_SIGMA = 10.0, 30.0
#: Fewer ties than this between two scenes give a notice.
_FEW = 30
#: So many ties a pixel are crowded: an adjustment, which takes them for independent, then has sigmas that are too
#: small (docs/engineering/matching.md).
_CROWDED = 2.0


@dataclass(frozen=True, eq=False)
class Tied:
    """Ties between scenes, with their notices.

    Parameters
    ----------
    points : BlockPoints
        Tie points with covariances, by the labels of the images.
    ties : Ties
    search, dem_sigma : float
        Metres.
    notices : tuple of Notice
    """

    points: BlockPoints
    ties: Ties
    search: float
    dem_sigma: float
    notices: tuple[Notice, ...] = field(default=())

    def to_json(self) -> dict[str, Any]:
        """Return the section ``ties`` of documents (docs/engineering/formats.md)."""
        names = self.points.images
        counts = np.bincount(np.bincount(self.points.point))
        found: dict[str, Any] = {
            "search_m": self.search,
            "dem_sigma_m": self.dem_sigma,
            "tracks": len(self.points),
            "tracks_by_images": {str(count): int(number) for count, number in enumerate(counts) if number},
            "sigma_px": float(np.median(self.points.sigma_image)),
            "pairs": [
                {
                    "images": [names[pair.images[0]], names[pair.images[1]]],
                    "ties": len(self.ties.of_pair(*pair.images)),
                    "tried": pair.tried,
                    "matched": pair.ties,
                    "shift_px": [-pair.shift[0], -pair.shift[1]],
                    "height_m": None if pair.components is None else pair.components.height,
                    "reason": pair.reason,
                }
                for pair in self.ties.pairs
            ],
        }
        document: dict[str, Any] = json_value(found)
        return document

    def summary(self) -> str:
        """Return the summary for people."""
        document = self.to_json()
        tracks = ", ".join(
            f"{number} in {counted(int(count), 'image')}" for count, number in document["tracks_by_images"].items()
        )
        lines = [f"{counted(document['tracks'], 'tie point')}: {tracks}; median sigma {px(document['sigma_px'])}"]
        for entry in document["pairs"]:
            pair = f"{entry['images'][0]} - {entry['images'][1]}"
            if entry["reason"]:
                through = (
                    f"{counted(entry['ties'], 'tie point')} through other images" if entry["ties"] else "no tie points"
                )
                lines.append(f"{pair}: {through} ({entry['reason']})")
                continue
            column, row = entry["shift_px"]
            heights = f"; heights differ by {metres(entry['height_m'])}" if entry["height_m"] else ""
            lines.append(
                f"{pair}: {counted(entry['ties'], 'tie point')} ({entry['matched']} of {entry['tried']} matches "
                f"between them succeeded); delivered models differ by column {column:+.2f} px, row {row:+.2f} px"
                f"{heights}"
            )
        return "\n".join(lines)


@cache_restored()
def tie_scenes(
    scenes: Mapping[str, Scene], options: MatchOptions, surface: Surface, opened: SceneOptions = SceneOptions()
) -> Tied:
    """Find tie points between scenes, by their names.

    Raises
    ------
    InputError
        For a scene without a model, fewer than two scenes, and scenes that cannot be tied together.
    """
    from ortho_pipeline.imaging.matching import SceneView
    from ortho_pipeline.imaging.matching.targets import metres_per_pixel
    from ortho_pipeline.imaging.ties import TieSettings, tie

    if len(scenes) < 2:
        raise InputError("tie points need at least two images", field="images", remedy="give more images")
    for scene in scenes.values():
        if not scene.models:
            raise InputError(
                "this image has no sensor model, which matching needs",
                file=scene.path,
                field="images",
                remedy="measure tie points yourself",
            )
    views = [
        SceneView(Intensity(RasterSource(*(scene.rasters or (scene.path,)), **opened.access)), scene.model, surface)
        for scene in (on_surface(one, surface) for one in scenes.values())
    ]
    searches = [
        search_of(scene, options, metres_per_pixel(view)) for scene, view in zip(scenes.values(), views, strict=True)
    ]
    search = max(one.distance for one in searches)
    usual = FLAT_SIGMA if surface.provenance.get("constant_height") is not None else DEM_SIGMA
    stated = typical_sigma(surface)
    sigma = usual if stated is None else stated
    settings = TieSettings(
        search,
        points=options.wanted,
        apart=options.points is None,
        dem_sigma=sigma,
        threads=os.cpu_count() or 1,
        rotation_deg=max(rotation_of(scene, options) for scene in scenes.values()),
    )
    ties = tie(views, settings)
    notices = [*_few(ties, tuple(scenes)), *_crowded(ties, options.points)]
    if stated is None:
        text = f"accuracy of the heights not given; assuming {metres(sigma)}"
        notices.append(Notice("dem-sigma-by-default", text, dem_sigma_m=sigma))
    return Tied(_points(ties, tuple(scenes)), ties, search, sigma, tuple(notices))


def _points(ties: Ties, names: tuple[str, ...]) -> BlockPoints:
    count = int(ties.track.max()) + 1
    digits = len(str(count))
    return BlockPoints(
        ids=tuple(f"tie{number + 1:0{digits}}" for number in range(count)),
        ground=np.full((count, 3), np.nan),
        roles=np.full(count, "tie"),
        sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS.from_epsg(4326),
        images=names,
        point=ties.track.astype(np.int64),
        image=ties.image.astype(np.int64),
        measured=ties.measured,
        sigma_image=sigma_of_covariance(ties.covariance),
        source="ties by matching",
        shape_image=shape_of(ties.covariance),
    )


def _few(ties: Ties, names: tuple[str, ...]) -> list[Notice]:
    """Return notices of pairs that were not tied, and of those with few ties."""
    notices = []
    for pair in ties.pairs:
        label = f"{names[pair.images[0]]} and {names[pair.images[1]]}"
        number = len(ties.of_pair(*pair.images))
        if number >= _FEW:
            continue
        why = f" ({pair.reason})" if pair.reason else ""
        few = f"only {counted(number, 'tie point')} (fewer than {_FEW})"
        text = f"{few} between {label}, which show the same ground{why}"
        notices.append(Notice("few-ties", text, images=[names[image] for image in pair.images], count=number))
    return notices


def _crowded(ties: Ties, points: int | None) -> list[Notice]:
    """Return the notice that neighbouring ties have the same errors, of the most crowded pair."""
    crowding = max((pair.crowding for pair in ties.pairs if pair.ties), default=0.0)
    if crowding < _CROWDED:
        return []
    fewer = None if points is None else max(1, round(points / crowding))
    remedy = (
        ("The images are too small for more ties",)
        if fewer is None
        else ("Ask for fewer: ", Setting("match.points", str(fewer)))
    )
    text = Text(
        f"neighbouring ties share the pixels that they were matched by ({crowding:.1f} ties a pixel), and so "
        "their errors. An adjustment takes ties for independent: its sigmas are too small, and its tests of shifts "
        "and cameras find too much. ",
        *remedy,
    )
    return [Notice("crowded-ties", text, crowding=crowding, points=fewer)]


@with_items
@to_store(output=None)
@one_blas_thread()
def ties(
    images: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    match: MatchOptions = MatchOptions(),
    *,
    scene: SceneOptions | Sequence[SceneOptions] = SceneOptions(),
    surface: SurfaceOptions = SurfaceOptions(),
) -> Result:
    """Find tie points between overlapping scenes and write them as points of a block.

    Parameters
    ----------
    output : path
        A ``.csv`` file (docs/formats/block-points.md), written whole or not at all.
    scene : SceneOptions or sequence of SceneOptions
        How all images are opened, or each.

    Raises
    ------
    InputError
        If an input or an option is wrong.
    """
    names = names_of(images)
    files = {"ties": Path(output)}
    if files["ties"].suffix.lower() != ".csv":
        raise InputError(
            "tie points cannot be written in this format", file=output, field="output", remedy="give a .csv file"
        )
    require_heights(surface)
    options = scenes_of(images, scene)
    for image, own in zip(images, options, strict=True):
        inputs.check_paths(files, Request(image, own, surface=surface))
    options, placed = settled_options(images, options, surface)
    opened = (inputs.open_scene(image, own) for image, own in zip(images, options, strict=True))
    scenes = dict(zip(names, opened, strict=True))
    heights = open_surface(surface, options[0], under=scenes.values())
    tied = tie_scenes(scenes, match, heights, options[0])
    write_text(output, _csv(tied.points))
    notices = placed + [notice.in_image(name) for name, one in scenes.items() for notice in one.notices]
    return Result(files, {"ties": tied.to_json(), **to_document([*notices, *tied.notices])}, tied.summary())


def names_of(images: Sequence[str | os.PathLike[str]]) -> list[str]:
    """Return a name for each image as files of points have it: its file, with folders ahead where files are the same.

    Raises
    ------
    InputError
        If an image is given twice.
    """
    labels_of(images)
    parts = [PurePath(os.path.abspath(image)).parts[1:] for image in images]
    names = [part[-1] for part in parts]
    for depth in range(2, max(map(len, parts), default=1) + 1):
        stems = [str(PurePath(name).with_suffix("")).lower() for name in names]
        names = [
            "/".join(part[-depth:]) if stems.count(stem) > 1 else name
            for part, name, stem in zip(parts, names, stems, strict=True)
        ]
    return names


def _csv(points: BlockPoints) -> str:
    """Return tie points as a table that --points reads."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("id", "image", "col", "row", "role", "var_col", "var_row", "cov_col_row"))
    for point, image, place, covariance in zip(
        points.point.tolist(),
        points.image.tolist(),
        points.measured.tolist(),
        points.covariance_image.tolist(),
        strict=True,
    ):
        (column, both), (_, row) = covariance
        writer.writerow(
            [points.ids[point], points.images[image], *map(repr, place), "tie", *map(repr, (column, row, both))]
        )
    return out.getvalue()
