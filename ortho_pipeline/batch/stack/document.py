"""The document of a stack, from its adjustment, and the chips of its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.batch.stack.dates import Dated
from ortho_pipeline.batch.stack.matching import DatePair
from ortho_pipeline.batch.stack.placing import Placed, map_grid_of
from ortho_pipeline.batch.stack.recorded import RecordedFolder
from ortho_pipeline.block.stack.adjustment import AdjustedStack
from ortho_pipeline.commands.resolved.ledger import as_asked, software
from ortho_pipeline.commands.results import SCHEMA_VERSION
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.ground_residuals import metre_partials
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.raster.regridded import part_of
from ortho_pipeline.report.stack.chips import ChipSheet, DateFiles, sheet_of
from ortho_pipeline.report.stack.records import (
    CellRecord,
    ClosureRecord,
    DateRecord,
    GridRecord,
    MovingRecord,
    PairRecord,
    StackRecord,
    StepRecord,
)

#: Columns and rows of a chip.
_CHIP = 128
#: Loops that leave more px (RMS) open are told.
_APART = 0.5


def record_of(
    dates: Sequence[Dated],
    placed: Placed,
    pairs: Sequence[DatePair],
    stack: AdjustedStack,
    outputs: dict[str, str],
    options: Mapping[str, Any],
) -> StackRecord:
    """Return the record of a stack; `outputs` are the files of dates by name, `options` the groups by theirs."""
    metres = _metres(placed)
    matched = [pair for pair in pairs if pair.matches is not None]
    notices = _notices(dates, stack, matched, len(pairs))
    shifts, usable = stack.trends.value[:, 0], stack.trends.good
    grid = placed.grid
    low, size = stack.cells.low, stack.cells.side * np.array(stack.cells.shape)
    at_corners = stack.at(low + size * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
    return StackRecord(
        schema_version=SCHEMA_VERSION,
        datum=options["stack"].datum,
        grid=GridRecord(
            crs=placed.model.crs, geotransform=grid.geotransform, size=(grid.width, grid.height),
            pixel_m=float(np.sqrt(abs(np.linalg.det(metres)))),
        ),
        dates=tuple(_date(dates, number, stack, metres, outputs, at_corners) for number in range(len(dates))),
        pairs=tuple(_pairs(dates, pairs, stack)),
        closure_before=closures(stack, shifts, usable),
        closure_after=closures(stack, shifts, stack.closures.accepted),
        moving=tuple(_moving(stack, placed, metres)),
        cells=tuple(
            CellRecord(
                place=_pair(place), tested=bool(tested), moving=bool(moving), form=str(form) if moving else None,
                rate_px_per_year=_pair(rate), sigma_px_per_year=_pair(np.minimum(sigma, 1e6)),
            )
            for place, tested, moving, form, rate, sigma in zip(
                stack.cells.middles, stack.motion.tested, stack.motion.moving, stack.motion.form, stack.motion.rate,
                stack.motion.sigma, strict=True,
            )
        ),
        steps=tuple(
            StepRecord(date=dates[one.date].name, size_px=one.size, sigma_px=one.sigma, chance=one.chance)
            for one in stack.steps
        ),
        provenance={"options": _chosen(options), "software": software()},
        **to_document(notices),
    )  # fmt: skip


def _chosen(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that differ from their defaults, of each group that has one.

    The command is no part of it: runs with other workers, or with the images in another order, write the same bytes.
    """
    found: dict[str, Any] = {}
    for group, values in options.items():
        usual = as_asked(type(values)())
        for name, value in as_asked(values).items():
            if value != usual.get(name) and name != "rebuild":
                found.setdefault(group, {})[name] = value
    return found


def _metres(placed: Placed) -> Array:
    """Return metres to true east and north ``(2, 2)`` of a pixel along columns and rows, in the middle."""
    model = placed.model
    middle = model.image_to_ground(np.array([model.size]) / 2, 0.0)
    return np.asarray(np.linalg.inv(metre_partials(model, middle)[0][0]))


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _date(
    dates: Sequence[Dated],
    number: int,
    stack: AdjustedStack,
    metres: Array,
    outputs: dict[str, str],
    at_corners: tuple[Array, Array],
) -> DateRecord:
    one, known = dates[number], bool(stack.determined[number])
    accepted, edges = stack.closures.accepted, stack.edges
    count = int((accepted & ((edges.first == number) | (edges.second == number))).sum())
    shift, sigma = stack.network.value[number, 0], stack.sigma[number]
    there, spread = (values[number] for values in at_corners)
    return DateRecord(
        name=one.name,
        path=str(one.image),
        time=one.time.isoformat(),
        time_from=one.source,
        correction=("affine" if stack.sloped[number] else "shift") if known else None,
        shift_px=_pair(shift) if known else None,
        sigma_px=_pair(sigma) if known else None,
        corner_px=float(np.hypot(*there.T).max()) if known else None,
        corner_sigma_px=float(spread.max()) if known else None,
        east_north_m=_pair(metres @ shift) if known else None,
        sigma_m=float(np.sqrt(np.trace(metres @ np.diag(sigma**2) @ metres.T) / 2)) if known else None,
        pairs=count,
        output=outputs.get(one.name),
        cloud_percent=_known(one.conditions.cloud_percent),
        sun_elevation_deg=_known(one.conditions.sun_elevation_deg),
    )


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _pairs(dates: Sequence[Dated], pairs: Sequence[DatePair], stack: AdjustedStack) -> list[PairRecord]:
    names = [one.name for one in dates]
    found, edge = [], 0
    for pair in pairs:
        first, second = names[pair.first], names[pair.second] if pair.second < len(names) else "reference"
        if pair.matches is None:
            found.append(
                PairRecord(
                    first=first, second=second, status="not matched", reason=pair.reason, matches=0, shift_px=None,
                    closure_px=None, ratio=None,
                )
            )  # fmt: skip
            continue
        usable = bool(stack.trends.good[edge])
        tested = bool(np.isfinite(stack.closures.ratio[edge])) and usable
        accepted = bool(stack.closures.accepted[edge])
        status = ("accepted" if tested else "untested") if accepted else "rejected"
        reason = ""
        if not accepted and tested:
            reason = "does not close with the other pairs"
        elif not accepted:
            reason = "contradicts another pair, and no loop tells which is right" if usable else "too few places"
        found.append(
            PairRecord(
                first=first, second=second, status=status, reason=reason, matches=pair.matches.kept,
                shift_px=_pair(stack.trends.value[edge, 0]),
                closure_px=_pair(stack.closures.error[edge]) if tested else None,
                ratio=float(stack.closures.ratio[edge]) if tested else None,
            )
        )  # fmt: skip
        edge += 1
    return found


def closures(stack: AdjustedStack, shifts: Array, some: NDArray[np.bool_]) -> ClosureRecord:
    """Return the closing errors of loops of three of some edges ``(E,)``."""
    edges, nodes = stack.edges, len(stack.determined)
    number = {(int(a), int(b)): e for e, (a, b) in enumerate(zip(edges.first, edges.second, strict=True)) if some[e]}
    found = []
    for (one, other), edge in number.items():
        # Dates have pairs with earlier ones; a reference, which is the last node, is the second of its pairs.
        for third in range(nodes):
            back, long = number.get((other, third)), number.get((one, third))
            if back is not None and long is not None:
                found.append(float(np.hypot(*(shifts[edge] + shifts[back] - shifts[long]))))
    if not found:
        return ClosureRecord(loops=0, median_px=None, p95_px=None, largest_px=None)
    return ClosureRecord(
        loops=len(found), median_px=float(np.median(found)), p95_px=float(np.quantile(found, 0.95)),
        largest_px=max(found),
    )  # fmt: skip


def _moving(stack: AdjustedStack, placed: Placed, metres: Array) -> list[MovingRecord]:
    motion, found = stack.motion, []
    to_lon_lat = ground_transform(placed.model.crs, "EPSG:4979")
    cell = (stack.cells.side**2) * abs(float(np.linalg.det(metres)))
    for area in motion.areas(stack.cells):
        rate, sigma, ratio = motion.typical(area, stack.cells)
        rate, sigma = metres @ rate, sigma * float(np.sqrt(abs(np.linalg.det(metres))))
        middle = placed.model.image_to_ground(stack.cells.middles[area].mean(axis=0)[None], 0.0)
        lon, lat, _ = to_lon_lat(middle)[0]
        core = motion.core(area, stack.cells)
        strongest = core[int(motion.ratio[core].argmax())]
        found.append(
            MovingRecord(
                lon=float(lon), lat=float(lat), cells=len(area), area_m2=len(area) * cell,
                east_m_per_year=float(rate[0]), north_m_per_year=float(rate[1]), sigma_m_per_year=sigma,
                significance=float(np.sqrt(ratio)), form=str(motion.form[strongest]),
            )
        )  # fmt: skip
    return found


def _notices(dates: Sequence[Dated], stack: AdjustedStack, matched: Sequence[DatePair], tried: int) -> list[Notice]:
    found = []
    lost = [one.name for one, known in zip(dates, stack.determined, strict=False) if not known]
    if lost:
        text = f"no accepted pair connects {counted(len(lost), 'date')} with the others, so they are not corrected"
        found.append(Notice("stack-not-connected", text, dates=lost))
    if len(matched) < 0.7 * tried:
        text = f"only {len(matched)} of {counted(tried, 'pair')} could be matched"
        found.append(Notice("stack-pairs-unmatched", text, matched=len(matched), pairs=tried))
    closed = stack.closures.accepted & np.isfinite(stack.closures.ratio)
    apart = float(np.sqrt((stack.closures.error[closed] ** 2).sum(axis=1).mean())) if closed.any() else 0.0
    if apart > _APART:
        text = f"accepted pairs contradict the other pairs by {apart:.1f} px (RMS), so one of them can be wrong"
        found.append(Notice("stack-pairs-disagree", text, error_px=apart))
    for step in stack.steps:
        size = float(np.hypot(*step.size))
        text = f"from {dates[step.date].name} on, all orthos are displaced by {size:.1f} px relative to those before"
        found.append(Notice("stack-step", text, date=dates[step.date].name, size_px=list(step.size)))
    for part in stack.parts:
        name, size = dates[part.date].name, float(np.hypot(*part.shift))
        text = (
            f"{part.cells} of {counted(part.of, 'cell')} of {name} are displaced by {size:.1f} px from the rest of it"
        )
        found.append(Notice("stack-part-displaced", text, date=name, cells=part.cells, shift_px=list(part.shift)))
    moving = int(stack.motion.moving.sum())
    if moving > 0.4 * max(int(stack.motion.tested.sum()), 1):
        text = f"{moving} of {counted(int(stack.motion.tested.sum()), 'cell')} move, so the stable ground is uncertain"
        found.append(Notice("stack-mostly-moving", text, cells=moving))
    return found


def chips_of(
    dates: Sequence[Dated],
    placed: Placed,
    stack: AdjustedStack,
    aligned: RecordedFolder,
    names: Mapping[str, str],
    scene: SceneOptions,
) -> ChipSheet | None:
    """Return chips of the dates with the largest corrections; None if nothing can be shown.

    Parameters
    ----------
    aligned, names
        Folder of the aligned orthos, and their files by the names of dates.
    """
    place = _chip_place(stack)
    if place is None:
        return None
    whole = np.array([placed.grid.width, placed.grid.height])
    size = np.minimum(_CHIP, whole)
    corner = np.clip(np.rint(place - size / 2), 0, whole - size)
    window = part_of(placed.grid, *corner.tolist(), *size.tolist())
    middle = corner + size / 2
    shift = stack.at(middle[None])[0][:, 0]
    some = []
    for number, one in enumerate(dates):
        area = placed.at(map_grid_of(one).corners[:, :2])
        if stack.determined[number] and (area.min(axis=0) <= middle).all() and (middle <= area.max(axis=0)).all():
            # That of a raw scene is its ortho with the delivered model.
            after = aligned.path(names[one.name])
            some.append(DateFiles(one.name, one.time.isoformat(), _pair(shift[number]), one.path, after))
    return sheet_of(some, window, _pair(middle), scene.access)


def _chip_place(stack: AdjustedStack) -> Array | None:
    """Return the still place ``(2,)`` px that most accepted pairs see; of several the one nearest to the middle."""
    cells = stack.cells
    seen = stack.edges.measured[stack.closures.accepted].sum(axis=0)
    still = np.flatnonzero((seen > 0) & ~stack.motion.touched(cells))
    apart = np.hypot(*cells.place.T).round(6)
    found = min(still.tolist(), key=lambda cell: (-seen[cell], apart[cell], cell), default=None)
    return None if found is None else cells.middles[found]
