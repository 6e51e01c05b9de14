"""The images of a block: a name for each, its points, and the model that its adjustment starts from."""

from __future__ import annotations

import filecmp
import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.start import Start
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.coordinate_swaps import refuse_swapped
from ortho_pipeline.estimation.family_fit import OWN, fit_family
from ortho_pipeline.files import states
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection, families, family_of, start_model
from ortho_pipeline.options import BlockOptions, MatchOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.points.formats import names_image

#: Bytes at the beginning of a file that tell most files of one size from each other.
_BEGINNING = 4096


def labels_of(images: Sequence[str | os.PathLike[str]]) -> list[str]:
    """Return a unique name for each image: its stem, after its folders if stems are equal.

    Raises
    ------
    InputError
        If an image is given twice.
    """
    paths = [Path(os.path.abspath(image)) for image in images]
    for number, path in enumerate(paths):
        if path in paths[:number]:
            raise InputError("this image is listed twice", file=images[number], remedy="list each image once")
    parts = [(*path.parent.parts[1:], path.stem) for path in paths]
    labels = ["_".join(part[-1:]) for part in parts]
    for depth in range(2, max(map(len, parts), default=1) + 1):
        labels = [
            "_".join(part[-depth:]) if [other.lower() for other in labels].count(label.lower()) > 1 else label
            for part, label in zip(parts, labels, strict=True)
        ]
    # The last resort: stems that differ by suffix alone (a.tif, a.jp2).
    seen: dict[str, int] = {}
    for number, label in enumerate(labels):
        seen[label.lower()] = seen.get(label.lower(), 0) + 1
        if seen[label.lower()] > 1:
            labels[number] = f"{label}_{seen[label.lower()]}"
    return labels


def refuse_copies(images: Sequence[str | os.PathLike[str]], scenes: Sequence[SceneOptions]) -> None:
    """Refuse copies of a file whose models are the same, too: ties between them fit whatever their common errors are.

    Raises
    ------
    InputError
        It names both files.
    """
    alike: dict[tuple[int, bytes], list[int]] = {}
    for number, image in enumerate(images):
        if os.path.isfile(image):
            with open(image, "rb") as file:
                alike.setdefault((os.path.getsize(image), file.read(_BEGINNING)), []).append(number)
    for first, second in (pair for numbers in alike.values() for pair in combinations(numbers, 2)):
        if filecmp.cmp(images[first], images[second], shallow=False) and _same_models(
            *(inputs.open_image(images[number], scenes[number], needs_model=False) for number in (first, second))
        ):
            raise InputError(
                f"this is a copy of {os.fspath(images[first])}, so its errors would count twice",
                file=images[second],
                remedy="leave one of the two out",
            )


def _same_models(one: Scene, other: Scene) -> bool:
    return bool(one.models and other.models) and one.model.to_dict() == other.model.to_dict()


def scenes_of(
    images: Sequence[str | os.PathLike[str]],
    scene: SceneOptions | Sequence[SceneOptions],
    models: Sequence[str | os.PathLike[str]] = (),
) -> list[SceneOptions]:
    """Return the options of each image: common or its own, with its saved model if given.

    Raises
    ------
    InputError
        If there are not as many as images.
    """
    scenes = [scene] * len(images) if isinstance(scene, SceneOptions) else list(scene)
    for field, values in (("scene", scenes), ("models", models)):
        if values and len(values) != len(images):
            what = counted(len(values), field.removesuffix("s"))
            raise InputError(
                f"{what} for {counted(len(images), 'image')}",
                field=field,
                remedy=f"give one {field.removesuffix('s')} file for each image, in their order"
                if field == "models"
                else "give one for each image, in their order",
            )
    return [replace(options, model=model) for options, model in zip(scenes, models, strict=True)] if models else scenes


def image_named(name: str, images: Sequence[str | os.PathLike[str]], field: str) -> int:
    """Return the index of the image that a name means: its stem or file name, after folders if needed.

    Raises
    ------
    InputError
        If it means none of them, or several.
    """
    meant = [number for number, image in enumerate(images) if names_image(name, image)]
    if len(meant) != 1:
        which = " or ".join(os.fspath(images[number]) for number in meant)
        raise InputError(
            f"{name!r} is ambiguous: {which}" if meant else f"there is no image {name!r}",
            field=field,
            remedy=f"use one of {', '.join(labels_of(images))}",
        )
    return meant[0]


def points_of_images(
    points: BlockPoints, images: Sequence[str | os.PathLike[str]], labels: Sequence[str], *, whole: bool = True
) -> tuple[BlockPoints, list[str]]:
    """Return the points with rays in the images, by the labels of these; and names that match no image.

    Parameters
    ----------
    whole : bool
        Each of the images has to have points.

    Raises
    ------
    InputError
        If a name could mean several images, or an image has no points.
    """
    owner: dict[int, int] = {}
    strangers = []
    for number, name in enumerate(points.images):
        meant = [k for k, image in enumerate(images) if names_image(name, image)]
        if len(meant) > 1:
            raise InputError(
                f"the name {name!r} is ambiguous: {' or '.join(os.fspath(images[k]) for k in meant)}",
                file=points.source,
                field="image",
                remedy="add the folder to the name in the points file, such as aft/BAND.tif",
            )
        if meant:
            owner[number] = meant[0]
        else:
            strangers.append(name)
    without = [os.fspath(image) for k, image in enumerate(images) if k not in owner.values()]
    if without and (whole or not owner):
        raise InputError(
            f"no point belongs to {without[0]}; the file has points of {', '.join(points.images[:5])}",
            file=points.source,
            field="image",
            remedy="correct the image names in the points file",
        )
    of_images = points.of_rays(np.isin(points.image, list(owner)))
    kept = replace(
        of_images,
        images=tuple(labels),
        image=np.array([owner[number] for number in of_images.image.tolist()], dtype=np.int64),
    )
    return kept.select(np.bincount(kept.point, minlength=len(kept)) > 0), strangers


def start_of(
    image: str | os.PathLike[str],
    options: BlockOptions,
    scene: SceneOptions,
    table: Points,
    heights: tuple[float, float] | None,
) -> Start:
    """Return what the adjustment of an image starts from.

    Parameters
    ----------
    table : Points
        Its points: a family is started from their control.
    heights : (float, float), optional
        Lowest and highest known ground of the block (m), for the domain of a family.

    Raises
    ------
    InputError
        For a model that the image does not have, or options that contradict each other.
    """
    named = {family.name for family in families()}
    opened = inputs.open_image(image, scene, needs_model=options.model not in named)
    name = options.model
    if name in named and name not in opened.models:
        return _family_start(opened, str(name), options, table, heights)
    if options.model_crs is not None:
        raise InputError(
            Text(Setting("points.model_crs"), " is only for fitted models"),
            field="points.model_crs",
            remedy=Text("leave it out, or set ", Setting("points.model"), f" to one of {', '.join(sorted(named))}"),
        )
    if name is not None and name not in opened.models:
        raise InputError(
            f"this image has no model {name!r}",
            file=image,
            field="points.model",
            remedy=f"use {', '.join(opened.models)}, or a model fitted to points: {', '.join(sorted(named))}",
        )
    own = name if name is not None else next(iter(opened.models))
    model = opened.models[own]
    correction = options.correction or (OWN if model.param_names else "shift")
    if correction == OWN and not model.param_names:
        raise InputError(
            f"the model {own!r} has no parameters of its own to adjust",
            file=image,
            field="points.correction",
            remedy="use shift, shift-drift or affine",
        )
    first = own == next(iter(opened.models))
    source = opened.model_source if first else f"metadata of {Path(opened.path).name}"
    if correction != OWN:
        refuse_swapped(model, table.select(np.isfinite(table.ground[:, :2]).all(axis=1)), opened.height)
        corrected = ImageCorrection.identity(model, correction, (opened.width / 2, opened.height / 2))
        return Start(opened, corrected, own if correction == "none" else f"{own}+{correction}", source)
    # The priors of a scene belong to its first model.
    return Start(opened, model, own, source, opened.priors if first else {})


def _family_start(
    opened: Scene, name: str, options: BlockOptions, table: Points, heights: tuple[float, float] | None
) -> Start:
    if options.correction not in (None, OWN):
        raise InputError(
            f"the model {name!r} is fitted to the points and takes no correction",
            field="points.correction",
            remedy=Text("leave out ", Setting("points.correction")),
        )
    size = opened.width, opened.height
    if family_of(name).variants:
        model = fit_family(name, table, crs=options.model_crs, size=size, heights=heights, robust=False).model
    else:
        model = start_model(name, table, crs=options.model_crs, size=size, heights=heights)
    control = int(table.control.sum())
    return Start(
        opened,
        model,
        getattr(model, "family", name),
        f"{counted(control, 'control point')} of {Path(table.source).name}",
    )


def state_of_files(
    images: Sequence[str | os.PathLike[str]],
    options: BlockOptions,
    scenes: Sequence[SceneOptions],
    match: MatchOptions,
    surface: SurfaceOptions,
) -> Ledger:
    """Return how the files that the user named are now."""
    requests = [Request(image, own) for image, own in zip(images, scenes, strict=True)]
    for file in (options.points, options.gcps, options.spot_heights):
        requests.append(Request(images[0], scenes[0], PointOptions(gcps=file), surface, match))
    return Ledger(begun=states(path for request in requests for _, path in request.files))
