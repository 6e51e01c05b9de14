"""Find the DIMAP metadata of an image next to it, and warn about rigorous models that are not used."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ortho_pipeline.plugin import RPC, Array, InputError, Notice, Pushbroom, Text, listing
from ortho_rpc.bundle import DIMAP
from ortho_rpc.dimap import has_dimap_pushbroom, images_of, read_dimap_pushbroom
from ortho_rpc.dimap_file import DimapFile

#: A vendor's RPC follows its rigorous model to a fraction of a pixel, a corrected one to some tens; beyond this (px)
#: they belong to different images.
DISAGREEMENT = 100.0
#: The same (px) for products whose look angles could not be checked.
UNSEEN = {"PNEO_SENSOR": 2.0}
#: Where models are compared: parts of the width, of the height, and of the heights of the RPC.
_MIDDLE = np.array([[0.5, 0.5, 0.0]])
_WITHIN = np.array([[x, y, h] for x in (0.05, 0.5, 0.95) for y in (0.05, 0.5, 0.95) for h in (-0.4, 0.0)])


@dataclass(frozen=True)
class Rigorous:
    """The rigorous model next to an image, if there is one, and the reasons why others are not used.

    Parameters
    ----------
    model, path
        None without a model.
    left : dict of str to str
        Reasons by file name.
    """

    model: Pushbroom | None = None
    path: Path | None = None
    left: dict[str, str] = field(default_factory=dict)

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """A sentence for each model that was not read."""
        return tuple(
            Notice("rigorous-left-out", f"the rigorous model in {name} is not used: {reason}", file=name)
            for name, reason in self.left.items()
        )


def rigorous_beside(image: Path, size: tuple[int, int], rpc: RPC) -> Rigorous:
    """Return the rigorous model of an image of this size, from DIMAP metadata next to it."""
    try:
        beside = listing(image.parent)
    except (OSError, ValueError):
        return Rigorous()
    left: dict[str, str] = {}
    # Metadata that name this image go before those that name none; those that name another one are its own.
    candidates: dict[bool, list[DimapFile]] = {True: [], False: []}
    for path in filter(has_dimap_pushbroom, (image.parent / name for name in beside.matching(DIMAP))):
        try:
            file = DimapFile(path)
            named = set(images_of(file))
        except InputError as error:
            left[path.name] = _reason(error)
            continue
        if image.name.lower() in named or path.name == image.name:
            candidates[True].append(file)
        elif not any(beside.named(one) for one in named):
            candidates[False].append(file)
    models: dict[Path, tuple[Pushbroom, float | None]] = {}
    others: dict[str, str] = {}
    for file in candidates[True] or candidates[False]:
        try:
            model = read_dimap_pushbroom(file, image=image.name, heights=rpc.height_range)
        except InputError as error:
            left[file.path.name] = _reason(error)
            continue
        its = (model.camera.width, model.camera.height)
        if its == size:
            models[file.path] = model, UNSEEN.get(file.said("Metadata_Identification/METADATA_PROFILE") or "")
        else:
            others[file.path.name] = "it is for {} x {} pixels, but this image has {} x {}".format(*its, *size)
    if len(models) > 1:
        several = ", ".join(path.name for path in models)
        reason = f"there are several rigorous models of this size next to the image, so none is used: {several}"
        return Rigorous(left=left | {path.name: reason for path in models})
    for path, (model, limit) in models.items():
        apart = _apart(model, rpc, _MIDDLE if limit is None else _WITHIN)
        if apart > (DISAGREEMENT if limit is None else limit):
            place = "in the middle of" if limit is None else "within"
            why = (
                "they belong to different images"
                if limit is None
                else "the reader of its look angles was never tested with a real product"
            )
            left[path.name] = f"it is {apart:.3g} px off the RPC {place} the image: {why}"
            return Rigorous(left=left)
        return Rigorous(model, path, left)
    return Rigorous(left=left | others)


def _reason(error: InputError) -> str:
    what = Text(error.field, ": ", error.message) if error.field else error.message
    return Text(what, "; ", error.remedy) if error.remedy else what


def _apart(model: Pushbroom, rpc: RPC, places: Array) -> float:
    """Return the largest difference (px) of model and RPC at positions of the image; infinite if one has no ground.

    Parameters
    ----------
    places : (N, 3)
        As parts of the image's width and height, and of the height range of the RPC.
    """
    image = places[:, :2] * (model.camera.width, model.camera.height)
    seen = rpc.ground_to_image(model.image_to_ground(image, rpc.h_off + places[:, 2] * rpc.h_scale))
    apart = float(np.abs(seen - image).max())
    return apart if np.isfinite(apart) else np.inf
