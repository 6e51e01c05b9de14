"""What the recommendation of `ortho compare` costs where control is uneven, and what other rules would.

python benchmarks/recommend.py --seeds 100 108     calibration; about 15 minutes on one core
python benchmarks/recommend.py --seeds 200 208     scenes that nothing was chosen by

The four scenes of tests/estimation/test_compare.py, 16 to 60 control points that are even, in three clusters, along a
strip, without a corner or about at one height, all left out in turn. A line for each choice: the error of the
recommended model over the whole scene as a multiple of that of the best one (noise of measuring included), the same
for a rule that adds to the squared errors what the covariance of the parameters adds over the scene (mean variance
there less that at the control), the share of the image that control covers, and the chance p (one-sided, paired) by
which the points themselves could tell the truly best model from the recommended one.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from test_compare import MAPS, SENSORS, scene_of

from ortho_pipeline.estimation.comparison import _choose, _doubts, _tests, available_models, compare, own_name
from ortho_pipeline.estimation.statistics import student_of
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.points import Points
from ortho_pipeline.points.control_hull import empty_parts

LAYOUTS = ("even", "clusters", "strip", "corner", "flat")
COUNTS = (16, 24, 40, 60)
#: Those that the test leaves out too: they take long and are never the best.
SLOW = ("rfm3", "rfm3-common", "poly5", "poly1")


def arranged(points: Points, kind: str, count: int, size: tuple[int, int], random: np.random.Generator) -> Points:
    """Return so many of the points, laid out in one of `LAYOUTS`."""
    places = points.image / size
    if kind == "even":
        order = random.permutation(len(places))
    elif kind == "clusters":
        centres = places[random.choice(len(places), 3, replace=False)]
        order = np.argsort(np.hypot(*(places[:, None] - centres).transpose(2, 0, 1)).min(axis=1))
    elif kind == "strip":
        angle = random.uniform(0, math.pi)
        across = np.array([math.cos(angle), math.sin(angle)])
        order = np.argsort(np.abs((places - 0.5 - random.uniform(-0.2, 0.2, 2)) @ across))
    elif kind == "corner":
        empty = ((places - 0.5) * random.choice([-1, 1], 2) > 0).all(axis=1)
        order = random.permutation(len(places))
        order = order[~empty[order]]
    else:
        heights = points.ground[:, 2]
        order = np.argsort(np.abs(heights - np.quantile(heights, random.uniform())))
    return points.select(np.sort(order[:count]))


def choice(sensor: str, seed: int, kind: str, count: int) -> tuple[float, float, float, float] | None:
    """Return the losses of the rule and of the other one, the covered share and p; None where nothing is chosen."""
    pool, own, size, ground, image = scene_of(sensor, seed, 240)
    random = np.random.default_rng([seed, count, len(kind)])
    points = arranged(pool.to_crs(MAPS[sensor]), kind, count, size, random)
    names = [name for name in available_models(own) if name not in SLOW]
    heights = float(ground[:, 2].min()), float(ground[:, 2].max())
    done = compare(points, names, own=own, size=size, heights=heights)
    if done.recommended is None:
        return None
    rows = {row.model: row for row in done.rows}
    squares = {name: values for name, values in _tests(done.rows)[0].items() if not _doubts(rows[name], ())}
    errors, added = {}, {}
    for name, values in squares.items():
        fit = rows[name].fit
        assert fit is not None
        there = ground_transform("EPSG:4979", fit.model.crs)(ground)
        miss = ((fit.model.ground_to_image(there) - image) ** 2).sum(axis=1).mean()
        errors[name] = math.sqrt(miss + 2 * points.sigma_image.mean() ** 2)
        added[name] = values
        if fit.model.params.size:
            spread = [
                (fit.image_sigma(places) ** 2).sum(axis=1).mean() for places in (there, fit.points.ground[fit.used])
            ]
            added[name] = values + max(0.0, spread[0] - spread[1])
    preferred = [name for name in squares if own is not None and name.startswith(own_name(own, "none"))]
    best = min(errors, key=lambda name: errors[name])
    other = _choose(added, rows, preferred)[0]
    difference = squares[done.recommended] - squares[best]
    variance = difference.var(ddof=1) / len(difference)
    t, p = (
        student_of(difference.mean()[None], np.array([[variance]]), len(difference) - 1) if variance else ([0.0], [1.0])
    )
    chance = p[0] / 2 if t[0] > 0 else 1 - p[0] / 2
    share = empty_parts(points.image, size)[0]
    return errors[done.recommended] / errors[best], errors[other] / errors[best], share, chance


def main() -> None:
    """Print a line for each choice, and what they come to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=(100, 108), metavar=("FROM", "TO"))
    options = parser.parse_args()
    found: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for seed in range(*options.seeds):
        for sensor in SENSORS:
            for kind in LAYOUTS:
                count = COUNTS[(seed + len(kind)) % len(COUNTS)]
                one = choice(sensor, seed, kind, count)
                said = (
                    "nothing recommended" if one is None else "{:.2f} other {:.2f} share {:.2f} p {:.3f}".format(*one)
                )
                print(sensor, seed, kind, count, said, flush=True)
                if one is not None:
                    found[kind == "even"].append(one[:2])
    for even, losses in found.items():
        for name, values in zip(("the rule", "the other one"), np.array(losses).T, strict=True):
            beyond = 100 * (values > 1.3).mean()
            print(f"{'even' if even else 'uneven'}, {name}: {len(values)} choices, median {np.median(values):.2f}, "
                  f"largest {values.max():.2f}, beyond 1.3: {beyond:.1f} %")  # fmt: skip


if __name__ == "__main__":
    main()
