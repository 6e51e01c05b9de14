"""Sensor plugin for SPOT 1 to 5 scenes of level 1A (DIMAP 1): an image with ``METADATA.DIM``, that file, or the folder.

There is no RPC in these products: the model is the rigorous one, which control points adjust.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from osgeo import gdal

from ortho_pipeline.plugin import InputError, Notice, Prior, Scene, Sensor, hookimpl, listing, place, read_bounded
from ortho_spot.dimap import read_spot

#: How well the vendor locates without control (m on the ground, one sigma per axis) and from which height (m): SPOT 1
#: to 4 350 m, SPOT 5 with its star tracker 30 m (SPOT handbook, and CNES's reports on the quality of SPOT 5).
LOCATION, STAR_TRACKER, ALTITUDE = 350.0, 30.0, 830e3
#: Rates of such errors (rad/s): a tenth of the offset in the nine seconds of a scene.
_DRIFT = 0.1 / 9.0


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``spot``."""
    yield Sensor(
        "spot",
        "SPOT 1 to 5 of level 1A with METADATA.DIM (image, METADATA.DIM or the folder)",
        recognises,
        open_scene,
        options={"attitude": "vendor (default), or speeds: integrated angular speeds, for SPOT 1 to 4"},
    )


def metadata_of(name: str) -> Path | None:
    """Return the DIMAP 1 metadata that an image, a folder or themselves are of; None without."""
    if not name:
        return None
    there = place(name)
    try:
        if there.suffix.lower() == ".dim":
            return there if there.is_file() else None
        folder = there if there.is_dir() else there.parent
        there_are = listing(folder)
        # Metadata of the image's own name first: the other ones may be of another scene in this folder.
        names = [*there_are.named(f"{there.stem}.dim"), *there_are.named("metadata.dim")]
        return next((folder / name for name in names if (folder / name).is_file()), None)
    except (OSError, ValueError, InputError):
        return None


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether a file is the metadata of a SPOT scene, or an image with them next to it."""
    path = metadata_of(dataset.GetDescription())
    try:
        return path is not None and b"<METADATA_PROFILE>SPOTSCENE" in read_bounded(path, 4000).replace(b" ", b"")
    except InputError:
        return False


def open_scene(dataset: gdal.Dataset, *, attitude: str = "vendor") -> Scene:
    """Open a scene with its rigorous model."""
    name = dataset.GetDescription()
    path = metadata_of(name)
    if path is None:
        raise InputError("no METADATA.DIM found next to this image", file=name, remedy="add it from the delivery")
    if attitude not in ("vendor", "speeds"):
        raise InputError("unknown attitude", field="attitude", remedy="give vendor or speeds")
    spot = read_spot(path, attitude=attitude)
    size, its = (dataset.RasterXSize, dataset.RasterYSize), spot.model.camera.size
    warnings = []
    if size != its:
        text = "the metadata are for {} x {} pixels, but this image has {} x {}. Is it a crop?".format(*its, *size)
        warnings.append(Notice("maybe-a-crop", text, metadata_size=list(its)))
    if spot.bands_differ > 0.5:
        text = f"the look angles of its bands differ by up to {spot.bands_differ:.1f} px; those of the first are used"
        warnings.append(Notice("bands-differ", text, difference_px=round(spot.bands_differ, 3)))
    sigma = (STAR_TRACKER if spot.facts.get("satellite") == "SPOT5" else LOCATION) / ALTITUDE
    priors = {}
    for axis in ("roll", "pitch", "yaw"):
        priors[f"{axis}_offset"] = Prior(0.0, sigma)
        priors[f"{axis}_drift"] = Prior(0.0, sigma * _DRIFT)
    return Scene(
        "spot",
        name,
        *size,
        {"pushbroom": spot.model},
        str(path),
        spot.facts | {"attitude": attitude},
        tuple(warnings),
        priors=priors,
    )
