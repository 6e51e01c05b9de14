"""What the recommendation of `ortho compare` costs on scenes of known truth, and what other rules would cost.

python benchmarks/recommend.py                         300 scenes of sensors and layouts that no rule was chosen by
python benchmarks/recommend.py --half development      those that the rule was chosen by

Half of the scenes have even control, half uneven; 8 to 60 points; noise of 0.2 to 1 px. No point has a gross error, and
none is looked for. The truth is a dense grid over the whole image, on the terrain, without noise.

A line for each scene, then for each rule by layout and number of points: the share of choices whose error is more than
1.3 and 1.6 times that of the best of all candidates, the median and the largest ratio. Errors are root mean squares
over the grid. `with noise` adds the noise of measuring to both, as check points would show them; `without` does not.
The oracle knows the truth, and what each model cannot follow of it, but not what the noise of these points did: it
takes the smallest error to be expected. No rule can do better but by chance.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "estimation"))
from known_scenes import DEVELOPMENT, HELD_OUT, KnownScene, known_scene

from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.choice.comparison import available_models, compare
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.geodesy.crs import ground_transform

COUNTS = (8, 10, 12, 14, 17, 20, 25, 32, 40, 60)
CLASSES = ((8, 11), (12, 19), (20, 33), (34, 60))
UNEVEN = {
    "development": ("clusters", "strip", "corner", "one height"),
    "held-out": ("road", "one side", "towns", "one height"),
}
SENSORS = {"development": DEVELOPMENT, "held-out": HELD_OUT}
#: The seeds of the held-out scenes were used for nothing else.
FIRST_SEED = {"development": 1000, "held-out": 70000}


def plan(half: str, count: int) -> list[tuple[int, str, int, int]]:
    """Return index of the sensor, layout, number of points and seed of each scene."""
    uneven, sensors = UNEVEN[half], SENSORS[half]
    scenes = []
    for k in range(count):
        pair, turn = k // 2, k // (2 * len(sensors))
        layout = "even" if k % 2 == 0 else uneven[turn % len(uneven)]
        scenes.append((pair % len(sensors), layout, COUNTS[(pair + pair // 20) % len(COUNTS)], FIRST_SEED[half] + k))
    return scenes


def errors_of(scene: KnownScene, rows: Mapping[str, ComparedModel]) -> tuple[dict[str, float], dict[str, float]]:
    """Return the true error (px) of each model over the scene, and that to be expected before noise is drawn."""
    true, risk = {}, {}
    for name, row in rows.items():
        fit = row.fit
        if fit is None:
            continue
        model = fit.model
        ground = ground_transform("EPSG:4979", model.crs)(scene.ground)
        miss = model.ground_to_image(ground) - scene.image
        true[name] = math.sqrt((miss**2).sum(axis=1).mean())
        risk[name] = _risk(scene, fit, ground, miss)
    return {name: value for name, value in true.items() if math.isfinite(value)}, risk


def _risk(scene: KnownScene, fit: Fit, ground: np.ndarray, miss: np.ndarray) -> float:
    """Return the error (px) that is to be expected: what the model cannot follow, and what noise does on average.

    By the linear response of the fit to the noise, which is known here.
    """
    if not len(fit.model.params) or fit.sigma0 is None:
        return math.sqrt((miss**2).sum(axis=1).mean()) if fit.sigma0 is not None else math.inf
    control = ground_transform("EPSG:4979", fit.model.crs)(scene.control)
    noise = np.where(fit.used[:, None], fit.points.image - scene.camera.project(scene.control), 0.0)
    factors = fit.covariance / (fit.sigma0 * fit.points.sigma_image[0]) ** 2
    there, here = fit.model.param_partials(ground), fit.model.param_partials(control)
    response = there @ (factors @ np.einsum("nij,ni->j", here, noise))
    spread = np.einsum("nij,jk,nik->n", there, factors, there).mean() * scene.noise**2
    return math.sqrt(((miss - response) ** 2).sum(axis=1).mean() + spread)


def choices(
    scene: KnownScene, rows: Mapping[str, ComparedModel], recommended: str | None, risk: Mapping[str, float]
) -> dict[str, str | None]:
    """Return what each rule takes."""
    fits = {name: row.fit for name, row in rows.items() if row.fit is not None}
    left_out = {
        name: found.total
        for name, fit in fits.items()
        if (found := fit.rmse("loo" if fit.model.params.size else "control")) and fit.redundancy > 0
    }
    akaike = {}
    for name, fit in fits.items():
        count, parameters = 2 * int(fit.used.sum()), fit.effective_parameters + 1
        if fit.sigma0 is not None and count - parameters - 1 > 0:
            mean = fit.sigma0**2 * fit.degrees_of_freedom / count
            akaike[name] = count * math.log(mean) + 2 * parameters * (1 + (parameters + 1) / (count - parameters - 1))
    fixed = "rpc+shift" if scene.own is not None else "affine3d"
    return {
        "recommended": recommended,
        "smallest leave-one-out": min(left_out, key=left_out.__getitem__, default=None),
        "AICc": min(akaike, key=akaike.__getitem__, default=None),
        "always shift or affine3d": fixed if fixed in fits else None,
        "oracle": min(risk, key=risk.__getitem__, default=None),
    }


def table(results: list[tuple[str, int, dict[str, tuple[float, float]]]], rule: str) -> None:
    """Print what one rule costs, by layout and number of points."""
    layouts = ["even", "uneven", *dict.fromkeys(layout for layout, _, _ in results if layout != "even")]
    groups = [(f"even, {low} to {high} points", "even", low, high) for low, high in CLASSES]
    groups += [(f"uneven, {low} to {high} points", "uneven", low, high) for low, high in CLASSES]
    groups = [(layout, layout, 0, 99) for layout in layouts] + groups
    print(f"\n{rule}: choices, and with noise | without: beyond 1.3 (%), beyond 1.6 (%), median, largest")
    for title, wanted, low, high in groups:
        ratios = np.array([
            one[rule] for layout, count, one in results
            if rule in one and low <= count <= high and (layout == wanted or (wanted == "uneven" and layout != "even"))
        ])  # fmt: skip
        if len(ratios):
            shown = [
                f"{100 * (r > 1.3).mean():5.1f} {100 * (r > 1.6).mean():5.1f} {np.median(r):5.2f} {r.max():6.2f}"
                for r in ratios.T
            ]
            print(f"  {title:26s} {len(ratios):4d}  {shown[0]} | {shown[1]}")


def main() -> None:
    """Print a line for each scene, and what each rule costs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=tuple(SENSORS), default="held-out")
    parser.add_argument("--scenes", type=int, default=300)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    results = []
    for index, layout, count, seed in plan(options.half, options.scenes):
        sensor = SENSORS[options.half][index]
        scene = known_scene(sensor, layout, count, seed)
        names = [name for name in available_models(scene.own) if name != "poly1"]  # which is affine2d
        done = compare(scene.points, names, own=scene.own, size=scene.size, heights=scene.heights, robust=False)
        rows = {row.model: row for row in done.rows}
        true, risk = errors_of(scene, rows)
        taken = choices(scene, rows, done.recommended, {name: risk[name] for name in true})
        best = min(true, key=true.__getitem__)
        noise = math.sqrt(2) * scene.noise
        ratios = {
            rule: (math.hypot(true[name], noise) / math.hypot(true[best], noise), true[name] / true[best])
            for rule, name in taken.items() if name in true
        }  # fmt: skip
        results.append((layout, count, ratios))
        said = ", ".join(f"{rule} {name} {ratios[rule][0]:.2f}" for rule, name in taken.items() if name in true)
        print(
            f"{sensor.name}, {layout}, {count} points, seed {seed}: best {best} {true[best]:.2f} px; {said}", flush=True
        )
    for rule in ("recommended", "oracle", "smallest leave-one-out", "AICc", "always shift or affine3d"):
        table(results, rule)


if __name__ == "__main__":
    main()
