"""The sentences of the paper that can be held against the experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ortho_pipeline.models.base import Array
from ortho_studies.simulation.tables import Statement

#: A height is determined "slightly better than 1 pixel", a position to less than one: the size of a pixel (m).
PIXEL = 2.5


def statements(medians: Mapping[str, Array]) -> list[Statement]:
    """Return the rankings of section 4 of the paper, each with whether our medians agree.

    Parameters
    ----------
    medians : mapping of label to (15,)
        Medians of a row in the order of `RMS`, `OTHERS` and the total error. Rankings whose rows were not computed are
        left out.
    """
    return [
        Statement(sentence, holds, detail, why, bool(why))
        for sentence, labels, test, why in _RANKINGS
        if set(labels) <= set(medians)
        for holds, detail in [test(*(medians[label] for label in labels))]
    ]


def _plan(row: Array) -> float:
    return float(np.hypot(row[4], row[5]))


def _axes(row: Array) -> str:
    return f"{row[4]:.2f}, {row[5]:.2f}, {row[6]:.2f} m"


def _both(name: str, first: float, other: str, second: float) -> str:
    return f"{name} {first:.2f} m, {other} {second:.2f} m"


_SHIFT, _DRIFT, _AFFINE, _NINE = "RPC shift", "RPC shift + drift", "RPC affine", "pushbroom, 9 GCPs"
#: The sentences of the paper, the rows that they are about, how to tell whether they hold, and why that proves nothing.
_RANKINGS: tuple[tuple[str, tuple[str, ...], Callable[..., tuple[bool, str]], str], ...] = (
    (
        "Direct georeferencing with the original RPCs is sub-optimal: some tens of metres, where any correction leaves "
        "less than a twentieth.",
        ("original RPC", _SHIFT),
        lambda raw, one: (raw[-1] > 20 * one[-1], _both("original", raw[-1], "shift", one[-1])),
        "The bias of the RPCs was set from table 3.",
    ),
    (
        "Nine control points give sub-pixel accuracy in planimetry and slightly better than a pixel in height.",
        ("affine3d UTM", _AFFINE),
        lambda affine3d, rpc: (
            max(affine3d[4:7].max(), rpc[4:7].max()) < PIXEL,
            f"3D affine {_axes(affine3d)}, RPC {_axes(rpc)}; a pixel is {PIXEL} m",
        ),
        "The noise was fitted to the column of the affine correction.",
    ),
    (
        "RPCs with an affine bias correction are slightly more accurate than the 3D affine model.",
        (_AFFINE, "affine3d UTM", "affine3d geocentric", "affine3d geographic"),
        lambda best, *rest: (
            all(best[-1] < row[-1] for row in rest),
            f"RPC {best[-1]:.2f} m, 3D affine {', '.join(f'{row[-1]:.2f}' for row in rest)} m",
        ),
        "",
    ),
    (
        "The generic pushbroom model also reaches sub-pixel accuracy, in every coordinate.",
        (_NINE,),
        lambda row: (row[4:7].max() < PIXEL, f"X, Y, Z {_axes(row)}"),
        "",
    ),
    (
        "It does so almost independently of the number of control points.",
        (_NINE, "pushbroom, 15 GCPs"),
        lambda few, many: (abs(few[-1] / many[-1] - 1) < 0.15, _both("9 points", few[-1], "15 points", many[-1])),
        "",
    ),
    (
        "Its errors are distributed differently from those of the RPCs, since its coordinates are geocentric and those "
        "of the RPCs east, north, height: more in X, less in Z …",
        (_NINE, _AFFINE),
        lambda push, rpc: (push[4] > 1.3 * rpc[4] and push[6] < rpc[6], f"{_axes(push)} and {_axes(rpc)}"),
        "",
    ),
    (
        "… but the overall accuracy is very similar.",
        (_NINE, _AFFINE),
        lambda push, rpc: (abs(push[-1] / rpc[-1] - 1) < 0.15, _both("pushbroom", push[-1], "RPC affine", rpc[-1])),
        "",
    ),
    (
        "The 3D affine model is better in UTM than in geographic coordinates …",
        ("affine3d UTM", "affine3d geographic"),
        lambda utm, geo: (utm[-1] < geo[-1], _both("UTM", utm[-1], "geographic", geo[-1])),
        "",
    ),
    (
        "… and very similar in geocentric coordinates and UTM.",
        ("affine3d UTM", "affine3d geocentric"),
        lambda utm, geo: (abs(utm[-1] / geo[-1] - 1) < 0.15, _both("UTM", utm[-1], "geocentric", geo[-1])),
        "",
    ),
    (
        "Drift parameters improve mainly the height.",
        (_SHIFT, _DRIFT),
        lambda one, two: (
            two[6] < one[6] and one[6] / two[6] > _plan(one) / _plan(two),
            _both("height with shift", one[6], "with drift", two[6]),
        ),
        "The slopes of the bias were fitted to the image rows in these columns, and the height follows from the rows.",
    ),
    (
        "The affine correction improves height and planimetry further, and the RMS in the images.",
        (_DRIFT, _AFFINE),
        lambda one, two: (
            two[6] < one[6] and _plan(two) < _plan(one) and sum(two[:4]) < sum(one[:4]),
            f"X, Y, Z {_axes(one)} and {_axes(two)}",
        ),
        "The slopes of the bias and the noise were fitted to these columns.",
    ),
    (
        "One or three control points do not give what nine give, but are precise all the same: a pixel or so.",
        ("RPC shift, 1 GCP", "RPC shift + drift, 3 GCPs", _AFFINE),
        lambda one, three, nine: (
            min(one[-1], three[-1]) > nine[-1] and max(one[4:7].max(), three[4:7].max()) < 1.5 * PIXEL,
            f"{one[-1]:.2f} and {three[-1]:.2f} m, nine points {nine[-1]:.2f} m",
        ),
        "",
    ),
)
