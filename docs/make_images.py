"""Draw the pictures of README.md (from a run on the sample scene) and of performance.md: ``make images``."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.options import PointOptions, SurfaceOptions

matplotlib.use("Agg")
from matplotlib import pyplot as plt

gdal.UseExceptions()
ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "sample_data"
#: Arrows are drawn this many times longer than the residuals.
MAGNIFIED = 12.0


def main() -> None:
    """Rectify the sample and write docs/images/sample.png; draw docs/images/performance.png."""
    draw_performance()
    image, points = SAMPLE / "scene.tif", PointOptions(gcps=SAMPLE / "gcps.geojson")
    with tempfile.TemporaryDirectory() as folder:
        surface = SurfaceOptions(dem=SAMPLE / "dem.tif")
        result = commands.rectify(image, folder, points=points, surface=surface)
        fit = json.loads(json.dumps(commands.fit(image, points, surface=surface).to_json()))
        ortho = gdal.Open(str(result.files["ortho"]))
        pixels = ortho.ReadAsArray().astype(float)
        pixels[ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() == 0] = np.nan
    scene = gdal.Open(str(image)).ReadAsArray()
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 6.2), layout="constrained")
    draw_residuals(left, scene, fit)
    low, high = np.nanpercentile(pixels, (1, 99))
    right.imshow(pixels, cmap="gray", vmin=low, vmax=high, interpolation="antialiased")
    right.set_title("Orthoimage: UTM, terrain removed")
    for axes in (left, right):
        axes.set_xticks([])
        axes.set_yticks([])
    path = ROOT / "docs" / "images" / "sample.png"
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=80)


def draw_performance() -> None:
    """Draw the wall time of both programs, by the CRS of the DEM, from docs/performance.json."""
    rows = json.loads((ROOT / "docs" / "performance.json").read_text())["dems"]
    figure, axes = plt.subplots(figsize=(8, 2.6), layout="constrained")
    places = np.arange(len(rows))
    for k, (part, name) in enumerate((("ours", "ortho rectify"), ("exact", "gdalwarp, exact"))):
        bars = axes.barh(places + 0.4 * k - 0.2, [row[part] for row in rows], 0.38, label=name)
        axes.bar_label(bars, fmt="%.2g s", padding=3, fontsize=9)
    axes.set_yticks(places, [f"DEM in\n{row['dem']}" for row in rows])
    axes.invert_yaxis()
    axes.set_xlabel("seconds of wall time")
    axes.set_title("12000 x 12000 px with RPC to an ortho of 160 million pixels, 2 cores")
    axes.legend(loc="center right")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / "images" / "performance.png", dpi=90)


def draw_residuals(axes: plt.Axes, scene: np.ndarray, fit: dict) -> None:
    """Draw residual arrows before and after the adjustment over the scene."""
    low, high = np.percentile(scene, (1, 99))
    axes.imshow(
        scene, cmap="gray", vmin=low, vmax=1.4 * high, alpha=0.55, extent=(0, scene.shape[1], scene.shape[0], 0)
    )
    measured = np.array([point["image"] for point in fit["points"]])
    after = np.array([point["residual"] for point in fit["points"]])
    shift = [fit["parameters"][name]["value"] for name in ("col_shift", "row_shift")]
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1 / MAGNIFIED, "width": 0.004}
    axes.quiver(*measured.T, *(after + shift).T, color="tab:red", label="as delivered", **arrows)
    axes.quiver(*measured.T, *after.T, color="tab:blue", label="adjusted", **arrows)
    for role, marker in (("control", "o"), ("check", "^")):
        chosen = measured[[point["role"] == role for point in fit["points"]]]
        axes.plot(*chosen.T, marker, color="black", markersize=5, fillstyle="none", label=f"{role} point")
    rmse = fit["rmse"]["check"] or fit["rmse"]["loo"]
    axes.set_title(f"Residuals x {MAGNIFIED:.0f}; check points after: {rmse['total']:.2f} px RMSE")
    axes.legend(loc="lower right", fontsize=8)


if __name__ == "__main__":
    main()
