"""Table 1, figures 4 to 7 and section 3.1 of Bueyueksalih, Akcin and Jacobsen, on simulated OrbView-3 scenes.

Every number is the median over realisations, with the 5th and 95th percentile. A realisation draws the 34 places, their
noise, and the attitude error of both scenes. Nothing is tuned per row: the free settings have the values that these
rows, over both scenes, ask for:

- the seconds of both scenes from abeam: their difference from the height-to-base ratio of 1.4, their ratio from
  RMSY of the 3D affine transformation (11.95 and 21.16 m), which goes with the distance along the track; the length of
  a scene from the sagitta of 11 m;
- extent of the test field and how heights rise inland: from RMSY of 3D affine with 8 and 12 parameters;
- how far the scan keeps its angular speed, and how fast the line turns: from RMSX of the same two and of 14 parameters;
- noise of 1.15 px: from the relative accuracy below 600 m (root mean square of the four numbers 1.18 m);
- drift and wobble of the attitude: from RPC shift and RPC affine (root mean squares 1.88 and 1.61 m); its bias from the
  circular error in the headers, 33 m at 90 %, which the paper divides by 2.3;
- QuickBird: noise from the improved 3D affine transformation; that it scans against the flight from RMSY of the simple
  one being larger than RMSX.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ortho_pipeline.covariance import CovarianceAnalysis, analyse
from ortho_pipeline.edge import analyse_edge
from ortho_pipeline.estimation import Fit, fit
from ortho_pipeline.experiments import orbview3_scene as simulated
from ortho_pipeline.experiments.tables import Curve, Number, Statement, make_document
from ortho_pipeline.ground_error import in_metres
from ortho_pipeline.model_choice import fit_family, prune
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.rational import RPC, Rational
from ortho_pipeline.points import Points

PAPER = "Bueyueksalih, Akcin and Jacobsen, Geometry of OrbView-3 images"
TITLES = {
    "1": "Discrepancies at 34 control points (root mean squares; RPC absolute: mean)",
    "3.1": "QuickBird OR Standard, root mean squares at 39 control points",
}
FAMILIES = ("affine3d", "affine12", "affine14", "dlt")
ABSOLUTE, RELATIVE, SHIFT, AFFINE = "RPC absolute", "RPC affine, relative", "RPC shift", "RPC affine"
#: The paper's numbers by row: X and Y of scene 471890, X and Y of 443940. Those of 12 parameters are in the text of
#: section 3.1, which also has 1.90 for the table's 2.88 and (in 3.3) 8.36 for the table's 8.56.
TABLE_1 = {
    "affine3d": (6.71, 11.95, 8.06, 21.16),
    "affine12": (5.14, 7.72, 6.69, 14.89),
    "affine14": (3.28, 1.90, 3.15, 2.88),
    "dlt": (4.98, 7.80, 7.69, 11.79),
    ABSOLUTE: (8.37, 8.56, 3.58, 13.61),
    SHIFT: (1.55, 1.57, 2.21, 2.09),
    AFFINE: (1.54, 1.26, 1.68, 1.89),
    RELATIVE: (1.17, 0.53, 1.33, 1.47),
}
QUICKBIRD = {"RPC shift": (0.38, 0.55), "affine3d": (0.57, 0.96), "affine12": (0.37, 0.42)}
QUICKBIRD_POINTS, QUICKBIRD_NOISE, QUICKBIRD_ATTITUDE = 39, 0.6, 0.2
#: QuickBird's images are narrower than the test field is long.
QUICKBIRD_AREA = (16e3, simulated.FIELD[1])
NEAR = 600.0
#: Edges (m) of the classes of distance of figure 7.
CLASSES = (0.0, 600.0, 1500.0, 3000.0, 5000.0, 7500.0, 10_000.0, 13_000.0)
#: From here on parameters count as inseparable; the paper lists such correlations as 1.000.
INSEPARABLE = 0.9995
#: Of the Student test; the paper does not state its own, but takes out two of four parameters in either scene.
SIGNIFICANCE = 0.1
#: Strengths of edge enhancement whose effect on an edge is measured.
ENHANCEMENTS = (0.0, 0.5, 1.0, 1.5)


@dataclass
class Findings:
    """What came out beside the numbers of the tables, over all realisations."""

    numbers: dict[str, list[float]] = field(default_factory=dict)
    pruned: dict[str, Counter[str]] = field(default_factory=dict)
    analyses: dict[str, list[CovarianceAnalysis]] = field(default_factory=dict)

    def add(self, name: str, value: float) -> None:
        """Keep a number."""
        self.numbers.setdefault(name, []).append(value)

    def median(self, name: str) -> float:
        """Return the median of what was kept under a name."""
        return float(np.median(self.numbers[name]))


def reproduce(realisations: int = 100, *, progress: Callable[[float], None] | None = None) -> dict[str, Any]:
    """Run the experiment and return the document of ``ortho reproduce orbview3 --json``.

    Returns
    -------
    dict
        As `tables.make_document` makes it.
    """
    coast = simulated.Coast()
    cameras = {name: simulated.scanner(name) for name in simulated.SCENES}
    rpcs = {name: simulated.vendor_rpc(camera) for name, camera in cameras.items()}
    quickbird = _quickbird()
    numbers, findings = _numbers(), Findings()
    found = np.full((realisations, len(numbers)), np.nan)
    for seed in range(realisations):
        ground = simulated.places(simulated.POINTS, coast, seed)
        values: list[Array] = []
        for index, (name, camera) in enumerate(cameras.items()):
            true = simulated.with_attitude_error(camera, seed)
            points = simulated.measure(true, ground, seed, image_number=index)
            values.append(_scene(points, rpcs[name], name, findings))
        table = np.concatenate(values, axis=1)
        found[seed] = np.concatenate([table.ravel(), _quickbird_numbers(*quickbird, coast, seed).ravel()])
        if progress:
            progress((seed + 1) / realisations)
    geometry = _geometry(cameras)
    return make_document(
        PAPER,
        sensor="orbview3",
        units="m",
        settings={
            "realisations": realisations,
            "seconds_from_abeam": {name: middle for name, (middle, _) in simulated.SCENES.items()},
            "field_m": simulated.FIELD,
            "turning": simulated.TURNING,
            "yaw_rate": simulated.YAW_RATE,
            "sigma_image_px": simulated.SIGMA_IMAGE,
            "sigma_ground_m": simulated.SIGMA_GROUND,
            "attitude_m": [simulated.SIGMA_BIAS, simulated.SIGMA_DRIFT, simulated.SIGMA_WOBBLE],
            **geometry,
        },
        settings_text=(
            f"{realisations} realisations, noise {simulated.SIGMA_IMAGE:g} px in the image and "
            f"{simulated.SIGMA_GROUND:g} m on the ground, attitude error {simulated.SIGMA_BIAS:g} m, drift "
            f"{simulated.SIGMA_DRIFT:g} m, wobble {simulated.SIGMA_WOBBLE:g} m per degree"
        ),
        numbers=numbers,
        found=found,
        titles=TITLES,
        statements=list(_statements(_medians(numbers, found), findings, geometry)),
        curves=[_figure_7(findings), _edge_curve()],
    )


def _numbers() -> list[Number]:
    columns = [f"{name} {axis}" for name in simulated.SCENES for axis in "XY"]
    one = [Number("1", row, column, paper) for row, papers in TABLE_1.items()
           for column, paper in zip(columns, papers, strict=True)]  # fmt: skip
    return one + [Number("3.1", row, axis, paper) for row, papers in QUICKBIRD.items()
                  for axis, paper in zip("XY", papers, strict=True)]  # fmt: skip


def _medians(numbers: list[Number], found: Array) -> dict[tuple[str, str, str], float]:
    keys = [(str(number.table), number.label, number.quantity) for number in numbers]
    return dict(zip(keys, np.nanmedian(found, axis=0).tolist(), strict=True))


# -- OrbView-3 -------------------------------------------------------------------------------------------------------


def _scene(measured: Points, rpc: RPC, name: str, findings: Findings) -> Array:
    """Return the rows of table 1 for one scene, ``(8, 2)``."""
    points = measured.to_crs(simulated.MAP_CRS)
    rows = []
    for family in FAMILIES:
        result = fit_family(family, points, robust=False)
        rows.append(_rms(_shifts(result)))
        if family == "dlt":
            findings.add(f"{name} dlt correlation", largest_correlation(result))
    rows.append(np.abs(_shifts(corrected(rpc, points, "none")).mean(axis=0)))
    rows.append(_rms(_shifts(corrected(rpc, points, "shift"))))
    full = corrected(rpc, points, "affine")
    shifts = _shifts(full)
    rows.append(_rms(shifts))
    analysis = analyse(points.ground[:, :2], shifts, near=NEAR, classes=CLASSES, draws=1)
    rows.append(np.array(analysis.relative or (np.nan, np.nan)))
    findings.analyses.setdefault(name, []).append(analysis)
    _prune(full, name, findings)
    east = np.abs(points.ground[:, 0] - np.median(points.ground[:, 0]))
    outer = np.argsort(east)[-6:]
    findings.add(f"{name} ends", float(np.hypot(*_rms(shifts[outer])) / np.hypot(*_rms(np.delete(shifts, outer, 0)))))
    return np.array(rows)


def corrected(rpc: RPC, points: Points, correction: str) -> Fit:
    """Return an RPC corrected by control points."""
    start = ImageCorrection.identity(rpc, correction, (simulated.COLUMNS / 2, simulated.LINES / 2))
    return fit(start, points, robust=False)


def _prune(full: Fit, name: str, findings: Findings) -> None:
    less, usual = prune(full, significance=SIGNIFICANCE), prune(full)
    slopes = [removed.name for removed in less.removed if not removed.name.endswith("_shift")]
    findings.pruned.setdefault(name, Counter()).update(slopes)
    findings.add(f"{name} pruned", float(len(slopes)))
    findings.add(f"{name} pruned ratio", _total(less.fit) / _total(full))
    findings.add(f"{name} usual ratio", _total(usual.fit) / _total(full))


def _total(result: Fit) -> float:
    return float(np.hypot(*_rms(_shifts(result))))


def _shifts(result: Fit) -> Array:
    """Return the residuals of a fit in metres east and north ``(N, 2)``."""
    return in_metres(result, result.residuals)


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt((values**2).mean(axis=0)))


def largest_correlation(result: Fit) -> float:
    """Return the largest correlation of two parameters of a DLT in the coordinates of map and image, not normalised.

    Source: formula 5; the parameters L1 to L11 are those of a 3 x 4 matrix whose last element is 1.
    """
    model = result.model
    assert isinstance(model, Rational)
    to_normalised = np.eye(4)
    to_normalised[:3, :3] = np.diag(1 / model.ground_scale)
    to_normalised[:3, 3] = -model.ground_offset / model.ground_scale
    to_pixels = np.eye(3)
    to_pixels[:2, :2] = np.diag(model.image_scale)
    to_pixels[:2, 2] = model.image_offset
    # A complex step gives derivatives without cancellation, which numbers of this size need.
    steps = model.params + 1e-30j * np.eye(11)
    constants, slopes = steps[:, [0, 4]], steps[:, [1, 2, 3, 5, 6, 7, 8, 9, 10]].reshape(11, 3, 3)
    matrix = np.concatenate([slopes, np.column_stack([constants, np.ones(11)])[:, :, None]], axis=2)
    raw = to_pixels @ matrix @ to_normalised
    lines = (raw / raw[:, 2:, 3:]).reshape(11, 12)[:, :11]
    jacobian = lines.imag.T / 1e-30
    covariance = jacobian @ result.covariance @ jacobian.T
    sigma = np.sqrt(np.diag(covariance))
    return float(np.abs(np.triu(covariance / np.outer(sigma, sigma), 1)).max())


# -- QuickBird -------------------------------------------------------------------------------------------------------


def _quickbird() -> tuple[simulated.Rectified, RPC]:
    product = simulated.Rectified.of(
        simulated.quickbird(), simulated.QUICKBIRD["plane"], simulated.QUICKBIRD["pixel"]
    )  # fmt: skip
    return product, simulated.vendor_rpc(product)


def _quickbird_numbers(product: simulated.Rectified, rpc: RPC, coast: simulated.Coast, seed: int) -> Array:
    """Return the rows of section 3.1, ``(3, 2)``."""
    ground = simulated.places(QUICKBIRD_POINTS, coast, seed, QUICKBIRD_AREA)
    camera = simulated.with_attitude_error(product.camera, seed, scale=QUICKBIRD_ATTITUDE)
    true = simulated.Rectified(camera, product.plane, product.pixel, product.west, product.north)
    measured = simulated.measure(true, ground, seed, image_number=2, sigma_image=QUICKBIRD_NOISE)
    points = measured.to_crs(simulated.MAP_CRS)
    rows = [_rms(_shifts(corrected(rpc, points, "shift")))]
    rows += [_rms(_shifts(fit_family(family, points, robust=False))) for family in ("affine3d", "affine12")]
    return np.array(rows)


# -- statements and curves -------------------------------------------------------------------------------------------


def _geometry(cameras: dict[str, simulated.Scanner]) -> dict[str, float]:
    """Return what the paper tells of the acquisition, as the cameras have it."""
    first, second = cameras.values()
    now = np.zeros(1)
    base = float(np.linalg.norm(first.flight(now)[0] - second.flight(now)[0]))
    step = np.array([-0.5, 0.5])
    speed = float(np.linalg.norm(np.diff(first.flight(step)[0], axis=0)))
    sagittas = []
    for camera in cameras.values():
        ends = [(column, row) for column in (0.0, 1.0) for row in (0.0, 0.5, 1.0)]
        seen = camera.meet(np.array(ends) * (camera.width, camera.height), simulated.level(simulated.LEVEL))
        xy = np.stack(simulated.local_metres(seen[:, 0], seen[:, 1]), axis=1)
        widths = np.linalg.norm(xy[:3] - xy[3:], axis=1)
        sagittas.append(abs(float(widths[1] - (widths[0] + widths[2]) / 2)))
    radius = first.radius
    return {
        "height_to_base": simulated.ALTITUDE / base,
        "slow_down_factor": speed * (radius - simulated.ALTITUDE) / radius / first.speed,
        "sagitta_m": float(np.mean(sagittas)),
    }


def _statements(
    ours: dict[tuple[str, str, str], float], findings: Findings, geometry: dict[str, float]
) -> Iterator[Statement]:
    def total(row: str, scene: str) -> float:
        return float(np.hypot(ours["1", row, f"{scene} X"], ours["1", row, f"{scene} Y"]))

    yield Statement(
        "Slow-down factor 1.42, height to base 1.4, and the middle of a scene is 11 m from the linear width.",
        abs(geometry["slow_down_factor"] - 1.42) < 0.03
        and abs(geometry["height_to_base"] - 1.4) < 0.05
        and abs(geometry["sagitta_m"] - 11) < 1,
        f"{geometry['slow_down_factor']:.2f}, {geometry['height_to_base']:.2f}, {geometry['sagitta_m']:.1f} m",
    )
    order = (AFFINE, SHIFT, "affine14", "affine12", "affine3d")
    for scene in simulated.SCENES:
        sizes = [total(row, scene) for row in order]
        yield Statement(
            f"Scene {scene}: RPC affine ≤ RPC shift < 14 < 12 < 8 parameters of the 3D affine transformation.",
            sizes[0] <= sizes[1] and all(a < b for a, b in itertools.pairwise(sizes[1:])),
            ", ".join(f"{size:.2f} m" for size in sizes),
        )
    correlations = [findings.median(f"{scene} dlt correlation") for scene in simulated.SCENES]
    unusable = all(total("dlt", scene) > 2 * total(SHIFT, scene) for scene in simulated.SCENES)
    yield Statement(
        f"DLT is not usable: errors of several metres, and correlations of its parameters above {INSEPARABLE}.",
        min(correlations) > INSEPARABLE and unusable,
        "largest correlations " + ", ".join(f"{value:.6f}" for value in correlations),
    )
    absolute = [ours["1", ABSOLUTE, f"{scene} {axis}"] for scene in simulated.SCENES for axis in "XY"]
    yield Statement(
        "Without control the mean discrepancies are below 14 m, the standard deviation from the header.",
        max(absolute) < 14.3,
        ", ".join(f"{value:.1f} m" for value in absolute),
    )
    yield from _statements_on_rpc(ours, findings)
    quickbird = {row: float(np.hypot(ours["3.1", row, "X"], ours["3.1", row, "Y"])) for row in QUICKBIRD}
    yield Statement(
        "QuickBird OR Standard: the simple 3D affine transformation is worse than RPC, the improved one is not.",
        quickbird["affine3d"] > 1.2 * quickbird["RPC shift"] and quickbird["affine12"] <= 1.02 * quickbird["RPC shift"],
        ", ".join(f"{row} {value:.2f} m" for row, value in quickbird.items()),
    )
    raw, enhanced = (edges(strength) for strength in (0.0, ENHANCEMENTS[-1]))
    yield Statement(
        "Pixels are two pixels of the image wide, yet edges hardly show it once they are enhanced.",
        min(raw["fwhm"]) > 1.7 and all(a < 0.6 * b for a, b in zip(enhanced["blur"], raw["blur"], strict=True)),
        f"blur beside the pixel's aperture along line and scan: {raw['blur'][0]:.2f} and {raw['blur'][1]:.2f} px, "
        f"enhanced {enhanced['blur'][0]:.2f} and {enhanced['blur'][1]:.2f} px",
    )


def _statements_on_rpc(ours: dict[tuple[str, str, str], float], findings: Findings) -> Iterator[Statement]:
    keys = [f"{scene} {axis}" for scene in simulated.SCENES for axis in "XY"]
    pairs = [(ours["1", RELATIVE, key], ours["1", AFFINE, key]) for key in keys]
    yield Statement(
        f"Points closer than {NEAR:g} m are more accurate to each other than they are by themselves.",
        all(near < alone for near, alone in pairs),
        ", ".join(f"{near:.2f} < {alone:.2f} m" for near, alone in pairs),
    )
    correlations = np.nanmean(
        [[one.correlation or (np.nan, np.nan) for one in findings.analyses[scene]] for scene in simulated.SCENES],
        axis=1,
    ).ravel()
    yield Statement(
        "Neighbouring points are correlated: errors remain that the affine correction leaves.",
        bool((correlations > 0).all()),
        "mean correlations " + ", ".join(f"{value:.2f}" for value in correlations) + "; the paper has 0.2 to 0.3",
    )
    rises = [values[0] < min(values[2:-1]) for values in _relative(findings).values()]
    yield Statement(
        "The relative standard deviation grows with the distance (figure 7).",
        all(rises),
        ", ".join(f"{name}: {values[0]:.2f} to {max(values):.2f} m" for name, values in _relative(findings).items()),
    )
    ends = [findings.median(f"{scene} ends") for scene in simulated.SCENES]
    yield Statement(
        "Discrepancies at the extreme left and right are larger.",
        min(ends) > 1,
        "the six outermost points over the others: " + ", ".join(f"{value:.2f}" for value in ends),
    )
    counts = [float(np.mean(findings.numbers[f"{scene} pruned"])) for scene in simulated.SCENES]
    yield Statement(
        "About two of the four linear parameters of the affine correction are not justified.",
        all(1 <= count <= 3 for count in counts),
        "; ".join(
            f"scene {scene}: {count:.1f} of 4 ("
            + ", ".join(f"{name} {100 * often / len(findings.numbers[f'{scene} pruned']):.0f} %"
                        for name, often in sorted(findings.pruned[scene].items()))
            + ")"
            for scene, count in zip(simulated.SCENES, counts, strict=True)
        ),
    )  # fmt: skip
    ratios, usual = ([findings.median(f"{scene} {key} ratio") for scene in simulated.SCENES]
                     for key in ("pruned", "usual"))  # fmt: skip
    yield Statement(
        "Without the parameters that are not justified the root mean square discrepancies do not change (2 %).",
        max(ratios) <= 1.02,
        "ratios "
        + ", ".join(f"{ratio:.3f}" for ratio in ratios)
        + "; with the usual significance of 5 % "
        + ", ".join(f"{ratio:.3f}" for ratio in usual),
    )


def _relative(findings: Findings) -> dict[str, list[float]]:
    """Return the relative standard deviation (m) per class of distance: scenes and axes, over all realisations."""
    found = {}
    for scene, analyses in findings.analyses.items():
        for k, axis in enumerate("XY"):
            squares: list[list[float]] = [[] for _ in CLASSES[1:]]
            for analysis in analyses:
                for one in analysis.classes:
                    squares[CLASSES.index(one.low)].append(one.relative[k] ** 2)
            found[f"{scene} {axis}"] = [float(np.sqrt(np.mean(part))) for part in squares]
    return found


def _figure_7(findings: Findings) -> Curve:
    middles = [(low + high) / 2 for low, high in itertools.pairwise(CLASSES)]
    return Curve(
        "Figure 7: relative standard deviation after the affine correction against distance, over all realisations",
        "distance [m]",
        "relative standard deviation [m]",
        {name: (middles, values) for name, values in _relative(findings).items()},
    )


def edges(enhancement: float) -> dict[str, tuple[float, float]]:
    """Return the width of an ideal edge in the image, pixels, along the line and along the scan.

    Returns
    -------
    dict
        ``fwhm`` (full width of the line spread at half its height) and ``blur`` (Gaussian beside the aperture).
    """
    size, oversampling, angle = 400, 4, np.radians(7.0)
    at = (np.arange(size * oversampling) + 0.5) / oversampling - size / 2
    along_line = (at * np.cos(angle) + at[:, None] * np.sin(angle) > 0).astype(np.float64)
    reach = np.tan(angle) * size / 2
    ends = ((size / 2 + reach, 0.0), (size / 2 - reach, float(size)))
    found = [
        analyse_edge(simulated.expose(along_line, oversampling, enhancement=enhancement), ends),
        analyse_edge(
            simulated.expose(along_line.T, oversampling, enhancement=enhancement), (ends[0][::-1], ends[1][::-1])
        ),
    ]
    return {"fwhm": (found[0].fwhm, found[1].fwhm), "blur": (found[0].psf_sigma, found[1].psf_sigma)}


def _edge_curve() -> Curve:
    found = [edges(strength) for strength in ENHANCEMENTS]
    names = {"fwhm": "width", "blur": "blur"}
    return Curve(
        "Edges of the staggered lines without TDI against the strength of an edge enhancement",
        "strength of the enhancement",
        "width at half height, and blur [pixels]",
        {
            f"{label} along the {axis}": (list(ENHANCEMENTS), [one[key][k] for one in found])
            for key, label in names.items() for k, axis in enumerate(("line", "scan"))
        },
    )  # fmt: skip


# -- figures ---------------------------------------------------------------------------------------------------------


def error_vectors(seed: int = 0) -> dict[str, tuple[Array, Array]]:
    """Return map coordinates and residuals (m) ``(34, 2)``, of figures 4, 5 and 6 in one realisation."""
    coast = simulated.Coast()
    ground = simulated.places(simulated.POINTS, coast, seed)
    found = {}
    for index, name in enumerate(simulated.SCENES):
        camera = simulated.scanner(name)
        true = simulated.with_attitude_error(camera, seed)
        points = simulated.measure(true, ground, seed, image_number=index).to_crs(simulated.MAP_CRS)
        where = points.ground[:, :2]
        found[f"{name} affine3d"] = where, _shifts(fit_family("affine3d", points, robust=False))
        found[f"{name} rpc"] = where, _shifts(corrected(simulated.vendor_rpc(camera), points, "affine"))
    return found
