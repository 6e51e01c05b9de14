"""Run the tutorials and draw their pictures from what the commands wrote: ``make docs``, ``make images``."""

from __future__ import annotations

import doctest
import importlib
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager
from pathlib import Path

import matplotlib
import numpy as np
from ortho_studies.simulation.terrain import Landscape, Terrain
from osgeo import gdal
from scipy.ndimage import uniform_filter
from sessions import run

import ortho_pipeline as op
from ortho_pipeline.report.block_records import BlockReport
from ortho_pipeline.report.network.drawing import plot_network
from ortho_pipeline.report.stack.page import timeline
from ortho_pipeline.report.stack.records import StackRecord

matplotlib.use("Agg")
from matplotlib import pyplot as plt

gdal.UseExceptions()
ROOT = Path(__file__).resolve().parent.parent
SAMPLE, IMAGES = ROOT / "sample_data", ROOT / "docs" / "images" / "tutorials"


def main(folder: Path = IMAGES) -> None:
    """Run every tutorial in a folder of its own and write its pictures into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for page, pictures in FIGURES.items():
        with tempfile.TemporaryDirectory() as name:
            for step in played(ROOT / "docs" / "tutorials" / page, Path(name)):
                for picture, draw in pictures.items():
                    if step == EARLY.get(picture):
                        with chdir(name):
                            draw(folder / picture)


def played(page: Path, folder: Path, *, slow: bool = True) -> Iterator[int | None]:
    """Do what a page says in `folder`: its sessions, and its Python next to the files that it wrote.

    Gives the number of each step after it was done, and None at the end.

    Raises
    ------
    AssertionError
        If something else comes back than the page says.
    """
    (folder / "sample_data").symlink_to(SAMPLE)
    for number, done in enumerate(run(page, folder, slow=slow), 1):
        assert not done.wrong, f"{page.name}, line {done.step.line}: $ {done.step.command}\n{done.wrong}"
        yield number
    if ">>> " in page.read_text(encoding="utf-8"):
        with importable(folder), chdir(folder):
            found = doctest.testfile(str(page), module_relative=False, optionflags=doctest.ELLIPSIS)
        assert found.attempted
        assert not found.failed, page.name
    yield None


@contextmanager
def importable(folder: Path) -> Iterator[None]:
    """Let the modules of a folder be imported, and be forgotten afterwards."""
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for module in folder.glob("*.py"):
            sys.modules.pop(module.stem, None)
        importlib.invalidate_caches()


# -- ten minutes -----------------------------------------------------------------------------------------------------


def first_residuals(path: Path) -> None:
    """Draw the residuals before and after the adjustment over the scene."""
    document = json.loads(Path("out/scene_report.json").read_text())["adjustment"]
    points = document["points"]
    measured, after = (np.array([point[key] for point in points]) for key in ("image", "residual"))
    before = after + [document["parameters"][name]["value"] for name in ("col_shift", "row_shift")]
    check = np.array([point["role"] == "check" for point in points])
    figure, both = plt.subplots(1, 2, figsize=(11, 5.6), layout="constrained")
    for axes, off, longer, title in ((both[0], before, 12, "As delivered"), (both[1], after, 200, "Adjusted")):
        over(axes, "valley/scene.tif")
        for kind, colour, name in ((~check, "tab:blue", "control"), (check, "tab:red", "check")):
            arrows = axes.quiver(
                *measured[kind].T, *off[kind].T, color=colour, width=0.005, angles="xy", scale_units="xy",
                scale=1 / longer,
            )  # fmt: skip
            axes.plot(*measured[kind].T, "o", color=colour, markersize=4, label=f"{name} points")
        size = 60 / longer
        axes.quiverkey(arrows, 0.78, 0.05, size, f"{size:g} px", labelpos="E", coordinates="axes", color="black")
        axes.set_title(f"{title}: {longer} times as long", fontsize=10)
    both[0].legend(loc="lower left", fontsize=8)
    save(figure, path)


def first_ortho(path: Path) -> None:
    """Draw a part of the ortho beside what it should show, and the difference."""
    dataset = gdal.Open("out/scene_ortho.tif")
    left, top, side = 560, 480, 300
    ortho = dataset.GetRasterBand(1).ReadAsArray(left, top, side, side).astype(float)
    west, size, _, north, _, _ = dataset.GetGeoTransform()
    x, y = np.meshgrid(west + size * (left + np.arange(side) + 0.5), north - size * (top + np.arange(side) + 0.5))
    said = json.loads((SAMPLE / "truth.json").read_text())
    ground = {key: said["terrain"][key] for key in ("crs", "x0", "y0", "lake_level", "relief", "seed")}
    landscape = Landscape(Terrain(**ground), 2.5, seed=said["seeds"]["landscape"])
    truth = 60 + 1900 * landscape(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
    figure, all_axes = plt.subplots(1, 3, figsize=(12, 4.4), layout="constrained")
    low, high = np.percentile(truth, (1, 99))
    error, around = ortho - truth, ((low - high) / 2, (high - low) / 2)
    for axes, values, title, limits in (
        (all_axes[0], ortho, "The ortho, 750 m of it", (low, high)),
        (all_axes[1], truth, "The ground, as it was simulated", (low, high)),
        (all_axes[2], error, f"Their difference: {np.sqrt((error**2).mean()):.0f} DN RMS of {truth.std():.0f}", around),
    ):
        axes.imshow(values, cmap="gray", vmin=limits[0], vmax=limits[1])
        axes.set_title(title, fontsize=10)
        bare(axes)
    save(figure, path)


# -- without control -------------------------------------------------------------------------------------------------


def matches(path: Path) -> None:
    """Draw chips of the scene next to those of the reference."""
    found = op.match_scene(
        op.open_scene("sample_data/scene.tif"),
        op.MatchOptions(reference=["sample_data/reference.tif"], points=100),
        op.open_dem("sample_data/dem.tif"),
    ).matches
    kept = np.flatnonzero(found.reason == "")[::8][:8]
    figure, rows = plt.subplots(2, len(kept), figsize=(12, 3.3), layout="constrained")
    for axes, k in zip(rows.T, kept, strict=True):
        for one, chip, name in ((axes[0], found.scene[k], "scene"), (axes[1], found.target[k], "reference")):
            one.imshow(chip, cmap="gray")
            middle = (np.array(chip.shape[::-1]) - 1) / 2
            at = middle if name == "scene" else middle + found.found[k]
            one.plot(*at, "+", color="gold", markersize=14, markeredgewidth=1.4)
            bare(one)
            if k == kept[0]:
                one.set_ylabel(name)
    save(figure, path)


def reference_off(path: Path) -> None:
    """Draw the residuals of surveyed points against the model that was matched."""
    model = op.read_rpc("relative/scene_RPC.TXT")
    points = op.read_points("sample_data/gcps.geojson")
    off = points.image - model.ground_to_image(points.ground)
    figure, axes = plt.subplots(figsize=(6.4, 6.4), layout="constrained")
    over(axes, "sample_data/scene.tif")
    arrows = axes.quiver(*points.image.T, *off.T, angles="xy", scale_units="xy", scale=1 / 60, color="tab:red")
    axes.quiverkey(arrows, 0.82, 0.04, 1, "1 px = 2.5 m", labelpos="E", coordinates="axes")
    axes.set_title("Surveyed minus matched: 60 times as long", fontsize=10)
    save(figure, path)


# -- which model -----------------------------------------------------------------------------------------------------


def compared(path: Path) -> None:
    """Draw the RMSEs of the models."""
    scene, points = (
        op.open_scene("sample_data/ikonos/po_39001_pan_0000000.tif"),
        op.read_points("sample_data/ikonos/gcps.csv"),
    )
    names = [
        "rpc",
        "rpc+shift",
        "rpc+affine",
        "affine2d",
        "poly3",
        "poly4",
        "affine3d",
        "affine12",
        "affine14",
        "dlt",
        "rfm1",
        "rfm2",
    ]
    found = op.compare(points, names, own=scene.models["rpc"], size=(scene.width, scene.height))
    figure, axes = plt.subplots(figsize=(8, 4.6), layout="constrained")
    op.plot(found, axes)
    save(figure, path)


# -- stereo ----------------------------------------------------------------------------------------------------------


def network(path: Path) -> None:
    """Draw the network as the page of the block does."""
    report = BlockReport.read(json.loads(Path("block/block_report.json").read_text()))
    drawing = plot_network(report)
    assert drawing is not None
    path.write_bytes(drawing.png(scale=1.2))


def heights(path: Path) -> None:
    """Draw the DEM minus the heights of intersected ties."""
    points = np.genfromtxt("heights.csv", delimiter=",", names=True, skip_header=2, usecols=(1, 2, 3))
    surface = op.open_dem("sample_data/cartosat/dem.tif")
    off = surface.heights(np.stack([points["x"], points["y"]], axis=1), "EPSG:4326") - points["h"]
    figure, axes = plt.subplots(figsize=(7, 5.2), layout="constrained")
    shown = axes.scatter(points["x"], points["y"], c=off, cmap="viridis", vmin=-60, vmax=0, edgecolors="0.4")
    axes.set_aspect(1 / np.cos(np.radians(points["y"].mean())))
    axes.set_xlabel("longitude")
    axes.set_ylabel("latitude")
    axes.set_title(f"DEM minus stereo: {np.mean(off):+.0f} m on average (pixels are 76 m)", fontsize=10)
    figure.colorbar(shown, label="m", shrink=0.8)
    save(figure, path)


# -- a thousand scenes -----------------------------------------------------------------------------------------------


def mosaic(path: Path) -> None:
    """Draw the mosaic, and which pixels come from which scene."""
    dataset = gdal.Open("coast/out/mosaic.tif")
    values = dataset.GetRasterBand(1).ReadAsArray()
    figure, axes = plt.subplots(figsize=(9, 4.2), layout="constrained")
    low, high = np.percentile(values[values > 0], (1, 99))
    axes.imshow(np.where(values > 0, values, np.nan), cmap="gray", vmin=low, vmax=high)
    west, size, _, north, _, _ = dataset.GetGeoTransform()
    votes = np.zeros(values.shape)
    for sign, ortho in zip((1, -1), sorted(Path("coast/out").glob("3v*/*_ortho.tif")), strict=True):
        one = gdal.Open(str(ortho))
        x, _, _, y, _, _ = one.GetGeoTransform()
        left, top = round((x - west) / size), round((north - y) / size)
        pixels = one.GetRasterBand(1).ReadAsArray()
        here = np.s_[top : top + pixels.shape[0], left : left + pixels.shape[1]]
        votes[here] += sign * ((pixels == values[here]) & (pixels > 0))
    source = np.where(values > 0, uniform_filter(votes, 15), np.nan)
    axes.contour(source, levels=[0.0], colors="tab:orange", linewidths=1.4)
    axes.set_title("The mosaic; the seam runs where both scenes look alike", fontsize=10)
    bare(axes)
    save(figure, path)


def run_page(path: Path) -> None:
    """Take a picture of the page of the run; without a browser the old one stays."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1100, "height": 620})
        page.goto(Path("coast/out/index.html").resolve().as_uri())
        page.evaluate(
            "(folder) => document.body.innerHTML = document.body.innerHTML.replaceAll(folder, '')", f"{Path.cwd()}/"
        )
        page.screenshot(path=path, type="jpeg", quality=80)
        browser.close()


# -- a sensor --------------------------------------------------------------------------------------------------------


def panoramic(path: Path) -> None:
    """Draw what is left of the right camera and of the one with flat film."""
    with importable(Path.cwd()):
        from flat import Flat
        from panoramic import Panoramic

        given = {
            "place": (33.0, 39.0, 185_000.0), "heading": np.radians(170), "size": (40_000, 3_000),
            "focal": 0.61 / 14e-6, "box": ((32.2, 33.8), (38.8, 39.2), (600.0, 1900.0)),
        }  # fmt: skip
        random = np.random.default_rng(3)
        low, high = (32.4, 38.96, 700), (33.6, 39.04, 1800)
        ground = np.column_stack([random.uniform(a, b, 60) for a, b in zip(low, high, strict=True)])
        seen = Panoramic(**given).with_params([0.004, -0.002, 0.003]).ground_to_image(ground)
        points = op.Points.of(seen + random.normal(0, 0.5, (60, 2)), ground, "EPSG:4979")
        figure, rows = plt.subplots(2, 1, figsize=(9, 5), layout="constrained", sharex=True)
        for axes, camera, name in ((rows[0], Panoramic, "Film on a cylinder"), (rows[1], Flat, "Flat film")):
            found = op.fit(camera(**given), points, robust=False)
            off = found.residuals
            axes.axhline(0, color="0.7", linewidth=0.8)
            axes.plot(points.image[:, 0], off[:, 0], "o", markersize=4, color="tab:blue", label="column")
            axes.plot(points.image[:, 0], off[:, 1], "s", markersize=3, color="tab:orange", label="row")
            axes.set_title(f"{name}: {found.rmse('control').total:.3g} px", fontsize=10)
            axes.set_ylabel("residual, px")
        rows[1].set_xlabel("column")
        rows[0].legend(fontsize=8, loc="upper right")
        save(figure, path)


# -- time series -----------------------------------------------------------------------------------------------------


def corrections(path: Path) -> None:
    """Draw the timeline as the page of the stack does."""
    record = StackRecord.read(json.loads(Path("stacked/stack.json").read_text()))
    path.write_bytes(timeline(record).png(scale=1.2))


# -- all -------------------------------------------------------------------------------------------------------------


def over(axes: plt.Axes, path: str) -> None:
    """Show a scene palely, in its own pixels, to draw on."""
    picture = gdal.Open(path).ReadAsArray()
    low, high = np.percentile(picture, (1, 99))
    rows, columns = picture.shape
    axes.imshow(picture, cmap="gray", vmin=low, vmax=1.4 * high, alpha=0.55, extent=(0, columns, rows, 0))
    bare(axes)


def bare(axes: plt.Axes) -> None:
    """Take the numbers off a picture."""
    axes.set_xticks([])
    axes.set_yticks([])


def save(figure: plt.Figure, path: Path) -> None:
    """Write a picture without the date, so that the same drawing is the same file."""
    told = {"pil_kwargs": {"quality": 82}} if path.suffix == ".jpg" else {"metadata": {"Software": None}}
    figure.savefig(path, dpi=80, **told)
    plt.close(figure)


#: Pages in the order of the site, and their pictures.
FIGURES: dict[str, dict[str, Callable[[Path], None]]] = {
    "first-ortho.md": {"first-residuals.jpg": first_residuals, "first-ortho.jpg": first_ortho},
    "without-control.md": {"matches.jpg": matches, "reference-off.jpg": reference_off},
    "is-my-ortho-right.md": {},
    "which-model.md": {"compared.png": compared},
    "stereo-and-blocks.md": {"block.png": network, "heights.png": heights},
    "drone-photos.md": {},
    "pan-sharpening.md": {},
    "sensor-of-your-own.md": {"panoramic.png": panoramic},
    "many-scenes.md": {"run.jpg": run_page, "mosaic.jpg": mosaic},
    "time-series.md": {"timeline.png": corrections},
}

#: Pictures of what a later step changes, and after which step they are drawn.
EARLY = {"run.jpg": 9, "timeline.png": 7}

if __name__ == "__main__":
    main()
