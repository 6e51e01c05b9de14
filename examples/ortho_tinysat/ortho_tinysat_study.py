"""Scenes of known truth for TinySat-1, and an experiment: how well six control points tell roll and delay."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyproj
from ortho_studies.hookspecs import Reproduced, Simulated, Study, StudyOption, hookimpl
from ortho_tinysat import StraightScanner
from osgeo import gdal

import ortho_pipeline as op
from ortho_pipeline.plugin import geocentric

LON, LAT, SIZE, ROLL, DELAY = 12.5, 41.9, (120, 90), 1e-4, 0.004


def truth() -> StraightScanner:
    """Return the camera 500 km above Rome that flies south, with the roll and delay that its flight file hides."""
    up = np.radians(LAT), np.radians(LON)
    south = 7500 * np.array([np.sin(up[0]) * np.cos(up[1]), np.sin(up[0]) * np.sin(up[1]), -np.cos(up[0])])
    position = geocentric(np.array([[LON, LAT, 500e3]]))[0]
    box = ((LON - 0.01, LON + 0.01), (LAT - 0.01, LAT + 0.01), (0.0, 300.0))
    return StraightScanner(tuple(position.tolist()), tuple(south.tolist()), SIZE, 2e-5, 1 / 750, box, ROLL, DELAY)


def points(seed: int, noise: float) -> op.Points:
    """Draw six control points, measured with so much noise (px)."""
    random, model = np.random.default_rng(seed), truth()
    centre, half = model.domain
    ground = centre + random.uniform(-0.4, 0.4, (6, 3)) * half
    image = model.ground_to_image(ground) + random.normal(0.0, noise, (6, 2))
    crs, sigma = pyproj.CRS(model.crs), np.full(6, noise)
    return op.Points(tuple("ABCDEF"), image, ground, np.full(6, "control"), sigma, np.zeros((6, 3)), crs, "simulated")


def simulate(folder, *, seed: int = 0, noise: float = 0.3) -> Simulated:
    """Write a TinySat-1 scene over Rome: image, flight file, six control points."""
    files = {name: Path(folder) / f for name, f in (("image", "scene.tif"), ("gcps", "points.geojson"))}
    Path(folder).mkdir(parents=True, exist_ok=True)
    dataset = gdal.GetDriverByName("GTiff").Create(str(files["image"]), *SIZE)
    dataset.WriteArray(np.random.default_rng(seed).integers(1, 255, SIZE[::-1], dtype=np.uint8))
    dataset = None
    camera = {name: getattr(truth(), name) for name in ("position", "velocity", "pixel_angle", "line_period", "box")}
    files["flight"] = files["image"].with_suffix(".tinysat.json")
    files["flight"].write_text(json.dumps({"camera": camera}))
    op.write_points(points(seed, noise), files["gcps"])
    return Simulated(files, f"try\n  ortho fit {files['image']} --gcps {files['gcps']} --correction model")


def reproduce(realisations: int, *, progress=None) -> Reproduced:
    """Compare the spread of roll and delay with the standard errors that the adjustment claims."""
    start, found = truth().with_params([0.0, 0.0]), []
    for seed in range(realisations):
        fit = op.fit(start, points(seed, 0.3))
        found.append((fit.model.params - [ROLL, DELAY]) / fit.sigmas)
        if progress:
            progress((seed + 1) / realisations)
    roll, delay = np.sqrt(np.mean(np.square(found), axis=0)).tolist()
    document = {"study": "tinysat", "realisations": realisations, "spread": {"roll": roll, "delay": delay}}
    text = f"error over claimed standard error: roll {roll:.2f}, delay {delay:.2f} (Student's t: 1.12)"
    return Reproduced(document, text, lambda: f"<!doctype html><title>TinySat-1</title><p>{text}</p>")


NOISE = StudyOption("noise", "Of the measurements.", float, 0.3, low=0.0, unit="PX")
STUDY = Study("tinysat", "A TinySat-1 scene over Rome", simulate, reproduce, (NOISE,), realisations=200)


@hookimpl
def ortho_studies() -> Iterable[Study]:
    yield STUDY
