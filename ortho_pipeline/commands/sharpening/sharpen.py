"""`ortho sharpen`: a panchromatic and a multispectral ortho in; a pan-sharpened ortho and its quality out."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.commands.inputs import check_paths
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.results import Result, to_store
from ortho_pipeline.commands.sharpening.quality import reduced_quality
from ortho_pipeline.commands.sharpening.registration import Agreement, displaced, measure_agreement
from ortho_pipeline.commands.sharpening.samples import Sample, Weights, read_samples, regress
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import states, together, write_json
from ortho_pipeline.files.locations import Location, located, place
from ortho_pipeline.files.shell import converted
from ortho_pipeline.geodesy.naming import crs_text
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.caching.block_cache import cache_restored, limit_cache
from ortho_pipeline.raster.ortho import Profile, RasterWriter, refuse_empty
from ortho_pipeline.raster.pansharpened import CommonExtent, Pansharpened, colour_bands
from ortho_pipeline.raster.regridded import Regridded, coarser, grid_of, part_of, warped_bounds
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.raster.valid_area import doubtful_alpha
from ortho_pipeline.runtime.process_limits import Progress, one_blas_thread

SCHEMA_VERSION = 1
#: Least ratio of pixel sizes: below it there is no detail to add.
_LEAST_RATIO = 1.2
#: Share of the panchromatic variance that multispectral bands of the same scene explain at least.
_EXPLAINED = 0.5


@to_store(folder="sharpened")
@one_blas_thread()
@cache_restored()
def sharpen(
    pan: str | os.PathLike[str],
    colours: str | os.PathLike[str],
    folder: str | os.PathLike[str],
    *,
    weights: Sequence[float] | None = None,
    ratio: int | None = None,
    scene: SceneOptions = SceneOptions(),
    output: OutputOptions = OutputOptions(),
    progress: Progress | None = None,
) -> Result:
    """Sharpen a multispectral ortho with a panchromatic one of the same acquisition.

    The result has the grid of the panchromatic ortho where both overlap. A multispectral ortho with another CRS, or
    with pixels that are no whole number of panchromatic ones, is resampled once.

    Parameters
    ----------
    weights : sequence of float, optional
        Of each multispectral band in the panchromatic one. Default: by regression.
    ratio : int, optional
        Panchromatic pixels along an original multispectral pixel, if the ortho was resampled to smaller pixels.

    Returns
    -------
    Result
        `files` has ortho and json: weights, registration, and quality at reduced resolution.

    Raises
    ------
    InputError
        If an ortho has the wrong bands or no place on a map, or they do not overlap or show different scenes.

    Examples
    --------
    >>> flat = op.SurfaceOptions(height=800.0)
    >>> grids = {"pan": op.OutputOptions(resolution=5.0), "colours": op.OutputOptions(resolution=20.0, bands=(1, 1))}
    >>> made = {
    ...     name: op.rectify("sample_data/scene.tif", out / name, surface=flat, output=grid).files["ortho"]
    ...     for name, grid in grids.items()
    ... }
    >>> done = op.sharpen(made["pan"], made["colours"], out / "sharp")
    >>> sorted(done.files)
    ['json', 'ortho']
    """
    paths = [place(located(path, allow_network=scene.allow_network)) for path in (pan, colours)]
    stem = Path(pan).stem
    files = {
        name: Path(folder) / f"{stem}_sharpened{ending}" for name, ending in (("ortho", ".tif"), ("json", ".json"))
    }
    for path in (pan, colours):
        check_paths(files, Request(path, scene, output=output))
    ledger = Ledger(begun=states(path for path in paths if not Location(path).is_far))
    # Half of the memory for reading; what matches takes the rest.
    output = replace(output, memory=output.memory // 2)
    pair = OrthoPair.open(pan, colours, scene, output, ratio)
    stage = progress or (lambda name, share: None)
    stage("Weights", 0.0)
    samples = pair.samples()
    _refuse_negative(samples, colours)
    regression = regress(samples, len(pair.bands))
    chosen = _given_weights(weights, pair) if weights is not None else regression.values
    stage("Registration", 0.0)
    agreement, notices = _agreement(pair, regression)
    stage("Quality", 0.0)
    document = _document(pair, chosen, regression, weights is not None)
    document["registration"] = None if agreement is None else agreement.to_json()
    document["quality"] = reduced_quality(samples, chosen, pair.whole_ratio, pair.sources[1].dtype)
    notices += _no_gain(document["quality"])
    notices += doubtful_alpha(pair.sources[1].dataset)
    samples.clear()
    with together(folder, stem):
        document["valid_pixels"] = _write(pair, chosen, files["ortho"], stage)
        document |= to_document(notices)
        write_json(files["json"], document)
        ledger.require_unchanged()
    return Result(files, document, _summary(document))


# -- inputs ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OrthoPair:
    """Both orthos, opened and checked.

    Parameters
    ----------
    paths : (path, path)
        Panchromatic and multispectral.
    bands : tuple of int
        Numbers of the multispectral bands.
    ratio : float
        Panchromatic pixels along a multispectral one.
    """

    paths: tuple[str | os.PathLike[str], str | os.PathLike[str]]
    sources: tuple[RasterSource, RasterSource]
    grids: tuple[Grid, Grid]
    bands: tuple[int, ...]
    ratio: float
    overlap: CommonExtent
    scene: SceneOptions
    output: OutputOptions

    @classmethod
    def open(
        cls,
        pan: str | os.PathLike[str],
        colours: str | os.PathLike[str],
        scene: SceneOptions,
        output: OutputOptions,
        ratio: int | None,
    ) -> OrthoPair:
        """Open both orthos.

        Raises
        ------
        InputError
            With the ortho that cannot be used, and why.
        """
        access = {**scene.access, "memory": output.memory}
        sharp, wide = RasterSource(pan, **access), RasterSource(colours, **access)
        own, bands = panchromatic(sharp), multispectral(wide)
        grids = grid_of(pan, **scene.access), grid_of(colours, **scene.access)
        sources = RasterSource(pan, bands=own, **access), RasterSource(colours, bands=bands, **access)
        try:
            overlap = CommonExtent.of(*grids)
        except InputError as error:
            raise InputError(
                f"{error.message} ({crs_text(grids[0].crs)}, {crs_text(grids[1].crs)})",
                file=colours,
                remedy="give both orthos of one acquisition",
            ) from error
        return cls((pan, colours), sources, grids, bands, _ratio_of(grids, sharp, wide, ratio), overlap, scene, output)

    @property
    def whole_ratio(self) -> int:
        """The nearest whole ratio, at least 2."""
        return max(2, round(self.ratio))

    @property
    def small(self) -> int:
        """Bytes for caches and matching: windows are read once and in order, so a small cache suffices."""
        return self.output.memory // 2

    @cached_property
    def coarse(self) -> Grid:
        """The grid of whole original multispectral pixels within both orthos."""
        grid, (_, own) = self.overlap.grid, self.grids
        if self.ratio > 1.5 * _own_ratio(self.grids):
            factor = round(self.ratio)
            size = max(1, grid.width // factor), max(1, grid.height // factor)
            return coarser(grid, factor, *size)
        xmin, ymin, xmax, ymax = warped_bounds(grid, own.crs)
        left, right = math.ceil((xmin - own.left) / own.dx - 1e-6), math.floor((xmax - own.left) / own.dx + 1e-6)
        top, bottom = math.ceil((own.top - ymax) / own.dy - 1e-6), math.floor((own.top - ymin) / own.dy + 1e-6)
        left, top = max(left, 0), max(top, 0)
        size = max(1, min(right, own.width) - left), max(1, min(bottom, own.height) - top)
        return part_of(own, left, top, *size)

    def samples(self) -> list[Sample]:
        """Read windows of both orthos on the coarse grid."""
        memory = self.output.memory
        limit_cache(self.small, 1, *(source.block for source in self.sources))
        settings = {"resampling": "average", "memory": memory, **self.scene.access}
        pan, colours = (Regridded(path, self.coarse, **settings) for path in self.paths)
        return read_samples(pan, colours, self.bands, self.coarse, self.whole_ratio)


def panchromatic(source: RasterSource) -> tuple[int, ...]:
    """Return the number of the band of a panchromatic image; refuse an image with another count."""
    bands = colour_bands(source)
    if len(bands) != 1:
        raise InputError(
            f"this image has {counted(len(bands), 'band')}; a panchromatic image has one",
            file=source.path,
            remedy="give the panchromatic image first, then the multispectral one",
        )
    return _without_offset(source, bands)


def multispectral(source: RasterSource) -> tuple[int, ...]:
    """Return the numbers of the bands of a multispectral image; refuse an image with one band."""
    bands = colour_bands(source)
    if len(bands) < 2:
        raise InputError(
            f"this image has {counted(len(bands), 'band')}; a multispectral image has at least two",
            file=source.path,
            remedy="combine single bands of the same acquisition first: `gdalbuildvrt -separate ms.vrt BLUE GREEN RED "
            "NIR`. If they have RPC files, copy one to ms_rpc.txt",
        )
    return _without_offset(source, bands)


def _without_offset(source: RasterSource, bands: tuple[int, ...]) -> tuple[int, ...]:
    """Refuse bands whose value 0 is not the absence of light: pan-sharpening computes with ratios of values."""
    if any(source.dataset.GetRasterBand(number).GetOffset() for number in bands):
        raise InputError(
            "the values of this image have an offset, so their ratios are not those of the light",
            file=source.path,
            field="offset",
            remedy="apply scale and offset, and use the new file: "
            f"`gdal_translate -unscale -ot Float32 {converted(source.path, 'unscaled')}`",
        )
    return bands


def _own_ratio(grids: tuple[Grid, Grid]) -> float:
    """Return the width of a multispectral pixel in panchromatic ones."""
    pan, colours = grids
    xmin, _, xmax, _ = warped_bounds(colours, pan.crs)
    return (xmax - xmin) / pan.dx / colours.width


def _ratio_of(grids: tuple[Grid, Grid], pan: RasterSource, colours: RasterSource, ratio: int | None) -> float:
    own = _own_ratio(grids)
    if own < 1 / _LEAST_RATIO:
        raise InputError(
            "the panchromatic ortho is coarser than the multispectral one: its pixels are "
            f"{significant(1 / own)} times as wide",
            file=pan.path,
            remedy="give the panchromatic ortho first, then the multispectral one",
        )
    if ratio is not None:
        if not 2 <= ratio <= 100:
            raise InputError(f"{ratio} is not a ratio of pixel sizes", field="ratio", remedy="give 2 to 100, such as 4")
        return float(max(ratio, own))
    if own < _LEAST_RATIO:
        raise InputError(
            "both orthos have the same pixel size, so there is no detail to add",
            file=colours.path,
            field="ratio",
            remedy=Text(
                "give the multispectral ortho in its own resolution, or state with ",
                Setting("ratio"),
                " how many panchromatic pixels an original multispectral pixel is wide",
            ),
        )
    return own


def _given_weights(weights: Sequence[float], pair: OrthoPair) -> tuple[float, ...]:
    count = len(pair.bands)
    if len(weights) != count:
        raise InputError(
            f"{counted(len(weights), 'weight')} for {counted(count, 'band')}",
            file=pair.paths[1],
            field="weights",
            remedy=f"give {count} numbers, such as {','.join([significant(1 / count)] * count)}",
        )
    if not (np.isfinite(weights).all() and min(weights) >= 0 and max(weights) > 0):
        raise InputError(
            "weights must not be negative, and one must be positive", field="weights", remedy="correct the weights"
        )
    return tuple(map(float, weights))


def _refuse_negative(samples: Sequence[Sample], colours: str | os.PathLike[str]) -> None:
    """Refuse bands that are mostly negative, which count as 0."""
    values = np.concatenate([sample.colours[np.isfinite(sample.colours)] for sample in samples])
    if np.count_nonzero(values < 0) > len(values) / 2:
        raise InputError(
            "most values of this ortho are negative, so they are no amounts of light",
            file=colours,
            remedy="give digital numbers, radiance or reflectance; not decibels",
        )


# -- registration ----------------------------------------------------------------------------------------------------


def _agreement(pair: OrthoPair, regression: Weights) -> tuple[Agreement | None, list[Notice]]:
    """Return the displacement of the orthos, and warnings.

    Raises
    ------
    InputError
        If they show different scenes: they do not match, and the bands do not explain the panchromatic pixels.
    """
    alike = regression.explained >= _EXPLAINED
    share = max(regression.explained, 0.0)
    try:
        agreement = measure_agreement(*pair.paths, pair.scene, replace(pair.output, memory=pair.small))
    except (InputError, TooFewPoints) as error:
        if not alike:
            raise InputError(
                f"the panchromatic and the multispectral ortho show different scenes: they do not match, and the bands "
                f"explain {share:.0%} of the panchromatic variance",
                file=pair.paths[1],
                remedy="give both orthos of one acquisition and place",
            ) from error
        text = f"the registration of the orthos is unknown: they could not be matched ({error.message})"
        return None, [Notice("sharpen-not-matched", text)]
    ratio = pair.whole_ratio if _own_ratio(pair.grids) < _LEAST_RATIO else None
    notices = [] if (notice := displaced(agreement, *pair.paths, ratio)) is None else [notice]
    if not alike:
        text = f"the multispectral bands explain only {share:.0%} of the panchromatic variance; colours can be wrong"
        notices.append(Notice("sharpen-unlike", text, explained=share))
    return agreement, notices


def _no_gain(quality: Mapping[str, Any] | None) -> list[Notice]:
    """Return a warning if upsampling alone is closer to the truth at reduced resolution."""
    if quality is None or quality["sharpened"]["ergas"] < quality["upsampled"]["ergas"]:
        return []
    ergas = tuple(quality[name]["ergas"] for name in ("upsampled", "sharpened"))
    text = (
        f"at 1/{quality['ratio']} resolution, upsampling alone is closer to the true colours than pan-sharpening "
        f"(ERGAS {ergas[0]:.2f} and {ergas[1]:.2f})"
    )
    return [Notice("sharpen-no-gain", text, upsampled=ergas[0], sharpened=ergas[1])]


# -- pixels ----------------------------------------------------------------------------------------------------------


def _write(pair: OrthoPair, weights: Sequence[float], path: Path, stage: Progress) -> int:
    """Write the ortho; return the number of its valid pixels."""
    output, (pan, colours) = pair.output, pair.sources
    profile = Profile.of(colours, output.dtype, output.nodata)
    threads = limit_cache(pair.small, output.threads or os.cpu_count() or 1, pan.block, colours.block)
    image = Pansharpened(pan, colours, pair.grids, weights, profile, threads=threads, memory=pair.small // 8)
    grid, valid_pixels = image.overlap.grid, 0
    options: dict[str, Any] = {"driver": output.format, "creation_options": output.creation_options}
    with RasterWriter(path, grid, profile, threads=threads, progress=stage, **options) as writer:
        for top in range(0, grid.height, image.window):
            stage("Sharpening", top / grid.height)
            for left in range(0, grid.width, image.window):
                size = min(image.window, grid.width - left), min(image.window, grid.height - top)
                pixels, valid = image.read(left, top, *size)
                valid_pixels += int(np.count_nonzero(valid))
                writer.write(left, top, pixels, valid)
        refuse_empty(valid_pixels, path)
    return valid_pixels


# -- words -----------------------------------------------------------------------------------------------------------


def _document(pair: OrthoPair, weights: Sequence[float], regression: Weights, given: bool) -> dict[str, Any]:
    grid = pair.overlap.grid
    return {
        "schema_version": SCHEMA_VERSION,
        "pan": str(pair.paths[0]),
        "multispectral": str(pair.paths[1]),
        "crs": crs_text(grid.crs),
        "size": [grid.width, grid.height],
        "ratio": pair.ratio,
        "resampled": not pair.overlap.ratio,
        "weights": {
            "values": list(weights),
            "given": given,
            "regression": list(regression.values),
            "explained": regression.explained,
            "residual": regression.residual,
            "pixels": regression.pixels,
        },
    }


def _summary(document: Mapping[str, Any]) -> str:
    """Return what people read of a sharpened ortho."""
    weights, found, quality = document["weights"], document["registration"], document["quality"]
    numbers = ", ".join(f"{value:.3f}" for value in weights["values"])
    origin = "as given" if weights["given"] else f"they explain {max(weights['explained'], 0):.0%} of the PAN variance"
    lines = [f"Weights: {numbers} ({origin})"]
    if found is not None:
        lines.append(
            f"Registration: column {found['column_px']:+.2f} ± {found['sigma_column_px']:.2f} px, row "
            f"{found['row_px']:+.2f} ± {found['sigma_row_px']:.2f} px (PAN minus MS), RMS {found['rmse_px']:.2f} px"
        )
    if quality is None:
        text = (
            "Quality unknown: the areas with values in both orthos are too small to compare them at reduced resolution."
        )
        return "\n".join([*lines, text])
    lines.append(f"Quality at 1/{quality['ratio']} resolution:   ERGAS   angle   Q index")
    for name in ("sharpened", "upsampled"):
        row = quality[name]
        lines.append(f"  {name:<30} {row['ergas']:>5.2f} {row['sam_deg']:>6.2f}° {row['q']:>8.3f}")
    return "\n".join(lines)
