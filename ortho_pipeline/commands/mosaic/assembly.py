"""`ortho mosaic`, and the mosaic of a run: orthos on one grid in; one raster, its record and its page out."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.results import ENDINGS, Result, attempted, to_store
from ortho_pipeline.errors import InputError, ReportError
from ortho_pipeline.files import allowed, states, together, write_json
from ortho_pipeline.files.folders import listed_paths
from ortho_pipeline.files.locations import Location, located, place
from ortho_pipeline.options import MosaicOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored
from ortho_pipeline.report.document import read_report
from ortho_pipeline.report.mosaic.document import mosaic_document, summary_text
from ortho_pipeline.report.mosaic.page import write_page
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.warp.mosaic import (
    Ortho,
    Overlap,
    along_seams,
    balanced,
    lay_out,
    measure_seam,
    overlaps,
    owners_of,
    write_cog,
    write_vrt,
)

Measure = Callable[[Sequence[Overlap]], list[dict[str, Any]]]


@to_store(path=None)
@cache_restored()
def mosaic(
    orthos: Sequence[str | os.PathLike[str]],
    path: str | os.PathLike[str],
    options: MosaicOptions | None = None,
    *,
    resources: Resources | None = None,
    allow_network: bool = False,
) -> Result:
    """Make one raster of orthos that share a grid.

    How each was seen is taken from its report next to it (`<stem>_report.json`), how accurate it is from
    `<stem>_accuracy.tif`.

    Parameters
    ----------
    path : path
        Path of the mosaic, which ends in .tif or .vrt; its record and page get the same name.
    allow_network : bool
        Allow addresses for orthos and mosaic; a VRT cannot have one.

    Raises
    ------
    InputError
        If an ortho is given twice or would be overwritten, and as `warp.mosaic.lay_out`.

    Examples
    --------
    >>> boxes = {"west": (530e3, 4121.5e3, 532e3, 4123.5e3), "east": (531e3, 4121.5e3, 533e3, 4123.5e3)}
    >>> orthos = []
    >>> for name, box in boxes.items():
    ...     grid = op.OutputOptions(crs="EPSG:32636", resolution=20.0, extent=box)
    ...     done = op.rectify("sample_data/scene.tif", out / name, surface=op.SurfaceOptions(height=800.0), output=grid)
    ...     orthos.append(done.files["ortho"])
    >>> result = op.mosaic(orthos, out / "mosaic.tif")
    >>> op.RasterSource(result.files["mosaic"]).width
    150
    """
    paths = [place(located(ortho, allow_network=allow_network)) for ortho in listed_paths(orthos, "orthos")]
    path = Path(path)
    options = options or MosaicOptions(format="VRT" if path.suffix.lower() == ".vrt" else "COG")
    if options.format == "VRT":
        _refuse_far(paths, path)
    files = mosaic_files(path)
    _check_paths(paths, files, options.format)
    layers = [_ortho(ortho, name) for ortho, name in zip(paths, _names(paths), strict=True)]
    ledger = Ledger(begun=states([*paths, *(ortho.accuracy for ortho in layers if ortho.accuracy)]))
    with together(path.parent, path.stem):
        document, failure = assemble(layers, files, options, resources=resources)
        write_json(files["seams"], document)
        ledger.require_unchanged()
    return Result(files, {"mosaic": document}, summary_text(document), failure)


def mosaic_files(path: Path) -> dict[str, Path]:
    """Return the outputs by kind."""
    return {"mosaic": path, "seams": path.with_suffix(".json"), "page": path.with_suffix(".html")}


def _refuse_far(orthos: Sequence[Path], path: Path) -> None:
    folder = path.parent.resolve()
    for ortho in orthos:
        far = Location(ortho).is_far
        if far or not ortho.resolve().is_relative_to(folder):
            name = "use a name of the mosaic that ends in .tif"
            raise InputError(
                "a VRT can only refer to orthos in its folder or below",
                file=ortho,
                field="output",
                remedy=name if far else f"write the mosaic to a folder that contains all orthos, or {name}",
            )


def _check_paths(orthos: Sequence[Path], files: Mapping[str, Path], file_format: str) -> None:
    endings = {"VRT": (".vrt",)}.get(file_format, (".tif", ".tiff"))
    if files["mosaic"].suffix.lower() not in endings:
        raise InputError(
            f"a mosaic of the format {file_format} needs a name that ends in {endings[0]}",
            file=files["mosaic"],
            field="output",
            remedy="use such a name; one that ends in .vrt makes a VRT",
        )
    known = [ortho.resolve() for ortho in orthos]
    for path in map(allowed, files.values()):
        if path.resolve() in known:
            raise InputError(
                "this file is both input and output", file=path, field="output", remedy="choose another name"
            )
    for ortho in orthos:
        if known.count(ortho.resolve()) > 1:
            raise InputError("this ortho is listed twice", file=ortho, field="orthos", remedy="list it once")


def assemble(
    orthos: Sequence[Ortho],
    files: dict[str, Path],
    options: MosaicOptions,
    *,
    resources: Resources | None = None,
    measure: Measure | None = None,
) -> tuple[dict[str, Any], ReportError | None]:
    """Write a mosaic and its page; return its document (docs/mosaic.md), which the caller writes.

    The error means that only the page could not be made.

    Parameters
    ----------
    files : dict
        `mosaic` and `page`, which is taken out if it could not be made.
    measure : callable, optional
        Measures all overlaps, as the processes of a run do; one after the other without.

    Raises
    ------
    InputError
        If a VRT cannot do what the options request, and as the functions of `warp.mosaic`.
    """
    resources, placed = resources or Resources(), lay_out(orthos, options.order)
    for field in ("seamlines", "balance"):
        if options.format == "VRT" and getattr(options, field):
            raise InputError(
                "a VRT cannot change pixels",
                file=files["mosaic"],
                field=f"mosaic.{field}",
                remedy="write a COG, or leave it out",
            )
    pairs = overlaps(placed) if options.seams or options.balance else []
    memory, threads = resources.memory, resources.threads or 1
    balance = balanced(placed, pairs, memory=memory) if options.balance else None
    owners, clamped = None, 0.0
    if options.seamlines or options.balance:
        owners = owners_of(placed, balance, seamlines=options.seamlines, memory=memory)
    if options.format == "VRT":
        write_vrt(placed, files["mosaic"])
    else:
        clamped = write_cog(
            placed,
            files["mosaic"],
            owners=owners if options.seamlines else None,
            balance=balance,
            memory=memory,
            threads=threads,
        )
    seams: list[dict[str, Any]] = []
    if options.seams:
        seams = [measure_seam(pair) for pair in pairs] if measure is None else measure(pairs)
        if owners is not None:
            before = along_seams(placed, owners.ordered, owners.cell, None, memory=memory)
            after = along_seams(placed, owners.owners, owners.cell, balance, memory=memory)
            seams = [{**seam, "before": _of(before, seam), "after": _of(after, seam)} for seam in seams]
    document = {
        "file": files["mosaic"].name,
        **mosaic_document(placed, seams, balance, owners if options.seamlines else None, clamped),
    }
    return document, attempted(lambda: write_page(document, files["page"], files["mosaic"], owners), files, "page")


def _of(seams: Mapping[tuple[str, str], dict[str, Any]], seam: Mapping[str, Any]) -> dict[str, Any] | None:
    return seams.get((seam["first"], seam["second"]))


def _names(paths: Sequence[Path]) -> list[str]:
    """Return unique names of orthos: their stems, with folders if stems are equal."""
    ending = Path(ENDINGS["ortho"]).stem
    stems = [path.stem.removesuffix(ending) for path in paths]
    if len(set(stems)) < len(stems):
        stems = [f"{path.resolve().parent.name}/{stem}" for path, stem in zip(paths, stems, strict=True)]
    if len(set(stems)) < len(stems):
        stems = [str(path) for path in paths]
    return stems


def _ortho(path: Path, name: str) -> Ortho:
    stem = path.stem.removesuffix(Path(ENDINGS["ortho"]).stem)
    report, accuracy = (path.with_name(f"{stem}{ENDINGS[kind]}") for kind in ("report", "accuracy"))
    lean, resampling = None, None
    if report.is_file():
        made = read_report(report)
        lean = made.scene.lean_m_per_m
        resampling = ((made.provenance.options or {}).get("output") or {}).get("resampling")
    return Ortho(name, path, lean, accuracy if accuracy.is_file() else None, resampling)
