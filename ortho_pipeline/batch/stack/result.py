"""What `ortho stack` returns: corrections of dates, files, and the aligned orthos as a lazy cube."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ortho_pipeline.batch.stack.matching import DatePair
from ortho_pipeline.commands.arrays.cube import cube_of
from ortho_pipeline.commands.results import Result
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.report.stack.records import DateRecord, StackRecord

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True)
class StackResult(Result):
    """A stack: `files` has aligned (a folder), json and html.

    Parameters
    ----------
    record : StackRecord
        Dates, pairs, closures, moving ground and steps.
    access : mapping
        Permissions to open the aligned orthos.
    """

    record: StackRecord = field(kw_only=True)
    access: Mapping[str, Any] = field(default_factory=dict, kw_only=True)

    @property
    def dates(self) -> tuple[DateRecord, ...]:
        """The dates in order of time, each with `time`, `east_north_m`, `sigma_m`, `shift_px` and `sigma_px`.

        A correction says how far (m, or px of the stack's grid) the ortho shows the ground displaced; None of dates
        that no accepted pair connects.
        """
        return self.record.dates

    @property
    def orthos(self) -> dict[str, Any]:
        """The aligned orthos by the names of dates, without dates that could not be corrected.

        They are paths, or addresses if the stack is in object storage.
        """
        aligned = self.files["aligned"]
        names = {one.name: Path(one.output).name for one in self.dates if one.output is not None}
        return {
            one: aligned / name if isinstance(aligned, Path) else f"{aligned}/{name}" for one, name in names.items()
        }

    def to_xarray(self, chunks: int | None = None) -> xarray.DataArray:
        """Return the aligned orthos as a lazy array ``(time, band, y, x)``, whose blocks dask reads when needed.

        Its coordinates along time are `name`, `east_m`, `north_m` and `sigma_m`.

        Parameters
        ----------
        chunks : int, optional
            Side of a block in pixels.

        Raises
        ------
        InputError
            Without xarray and dask, if the pixels were kept, or if dates differ in bands, type or scale.
        """
        known = [one for one in self.dates if one.output is not None]
        if not known or not all((one.output or "").endswith(".tif") for one in known):
            raise InputError(
                "a cube needs aligned orthos on one grid, and this stack has none",
                field="to_xarray",
                remedy=Text("leave out ", Setting("stack.corrections_only")),
            )
        moved = np.array([one.east_north_m for one in known], dtype=float)
        of_times = {
            "name": [one.name for one in known],
            "east_m": moved[:, 0],
            "north_m": moved[:, 1],
            "sigma_m": np.array([one.sigma_m for one in known], dtype=float),
        }
        times = [datetime.fromisoformat(one.time) for one in known]
        return cube_of([self.orthos[one.name] for one in known], times, of_times, chunks, self.access)


def summary(record: StackRecord, fresh: int = 0) -> str:
    """Return what people read of a stack."""
    sigmas = [max(one.sigma_px) for one in record.dates if one.sigma_px is not None]
    status = [one.status for one in record.pairs]
    lines = [
        f"{counted(len(record.dates), 'date')}, {sum(one.correction == 'affine' for one in record.dates)} with an "
        f"affine correction; sigma of a correction {np.median(sigmas):.3f} px (median)",
        f"Pairs: {len(status)} ({fresh} from an earlier run), {status.count('rejected')} rejected, "
        f"{status.count('not matched')} not matched",
    ]
    after = record.closure_after
    if after.median_px is not None:
        largest, rejected = (significant(one.largest_px or 0.0) for one in (after, record.closure_before))
        lines.append(
            f"Loops of three pairs: misclosure {after.median_px:.3f} px (median; largest {largest} px, "
            f"with rejected pairs {rejected} px)"
        )
    lines.append(f"Moving ground: {counted(len(record.moving), 'area')}; steps: {len(record.steps)}")
    return "\n".join(lines)


def part_summary(part: tuple[int, int], pairs: Sequence[DatePair]) -> str:
    """Return what people read of a part of the pairs."""
    fresh, matched = sum(pair.fresh for pair in pairs), sum(pair.matches is not None for pair in pairs)
    return (
        f"Part {part[0]} of {part[1]}: {counted(len(pairs), 'pair')} ({fresh} from an earlier run), "
        f"{len(pairs) - matched} not matched"
    )
