"""The guts of ``ortho simulate`` and ``ortho reproduce``: scenes of known truth, and the papers' tables."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.commands.results import Result
from ortho_pipeline.files import together, write_text
from ortho_pipeline.simulation.page import text


def simulate_bilsat(
    folder: str | os.PathLike[str],
    *,
    seed: int = 0,
    off_nadir_deg: float | None = None,
    size: int | None = None,
    all_cameras: bool = False,
) -> Result:
    """Write a simulated BILSAT-1 scene: image, imaging survey, DEM, 44 points, truth.

    Parameters
    ----------
    off_nadir_deg, size : optional
        Tilt, and columns and rows; those of the paper's reproduction and of the real camera without them.
    all_cameras : bool
        Take the image with each of the four XS cameras.

    Raises
    ------
    InputError
        If such a scene is not possible, or the folder cannot be written.
    """
    from ortho_bilsat.simulation import write_product
    from ortho_bilsat.truth import OFF_NADIR_DEG, SIZE, XS_CAMERAS

    files = _simulated(
        write_product, folder, seed=seed, off_nadir_deg=OFF_NADIR_DEG if off_nadir_deg is None else off_nadir_deg,
        size=size or SIZE, cameras=tuple(XS_CAMERAS) if all_cameras else ("red",),
    )  # fmt: skip
    return Result(files, {}, f"A simulated BILSAT-1 scene (seed {seed}); try\n  ortho rectify {files['image']} "
                  f"--gcps {files['gcps']} --dem {files['dem']} --correction model -o out")  # fmt: skip


def reproduce_bilsat(
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int = 100,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute the tables of the BILSAT-1 paper on a simulated scene, beside the paper's numbers.

    Parameters
    ----------
    folder : path, optional
        Where ``bilsat.json`` and the page ``bilsat.html`` go.

    Returns
    -------
    Result
        `document` has paper, settings, summary and tables (docs/formats.md).
    """
    from ortho_bilsat import experiment as bilsat
    from ortho_bilsat import page as bilsat_page

    document = bilsat.reproduce(realisations, progress=progress)
    return _written("bilsat", document, folder, lambda: bilsat_page.page(document, *bilsat.error_vectors()))


def simulate_ikonos(
    folder: str | os.PathLike[str],
    *,
    seed: int = 0,
    off_nadir_deg: float | None = None,
    size: int = 1000,
    pixel: float | None = None,
    rpc: bool = True,
    multispectral: bool = False,
    components: int = 1,
) -> Result:
    """Write a simulated IKONOS Geo delivery: images, metadata, RPC, DEM, 20 control and 20 check points, truth.

    Parameters
    ----------
    off_nadir_deg : float, optional
        Tilt; that of the paper's reproduction without it.
    size, pixel : int, float, optional
        Columns and rows, and metres of a pixel; without the latter they cover 11 km.
    rpc, multispectral, components
        Deliver RPCs; four bands beside pan; number of files that each image is cut into.

    Raises
    ------
    InputError
        If such a scene is not possible, or the folder cannot be written.
    """
    from ortho_ikonos.simulation import write_product
    from ortho_ikonos.truth import OFF_NADIR_DEG

    files = _simulated(
        write_product, folder, seed=seed, off_nadir_deg=OFF_NADIR_DEG if off_nadir_deg is None else off_nadir_deg,
        size=size, pixel=pixel, rpc=rpc, multispectral=multispectral, components=components,
    )  # fmt: skip
    return Result(files, {}, f"A simulated IKONOS Geo scene (seed {seed}); try\n  ortho rectify {files['image']} "
                  f"--gcps {files['gcps']} --dem {files['dem']} -o out")  # fmt: skip


def reproduce_ikonos(
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int = 100,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute table 2 and figure 4 of the IKONOS paper on simulated scenes, beside the paper's numbers.

    Parameters
    ----------
    folder : path, optional
        Where ``ikonos.json`` and the page ``ikonos.html`` go.
    """
    from ortho_ikonos import experiment as ikonos
    from ortho_ikonos import page as ikonos_page

    document = ikonos.reproduce(realisations, progress=progress)
    return _written("ikonos", document, folder, lambda: ikonos_page.page(document, ikonos.error_vectors()))


def simulate_cartosat(
    folder: str | os.PathLike[str], *, seed: int = 0, size: int = 1200, jitter: float = 0.0
) -> Result:
    """Write a simulated CARTOSAT-1 stereo pair: two images with metadata and RPCs, DEM, 69 points, truth.

    Parameters
    ----------
    size : int
        Columns and rows of both images; 12000 are the real ones, fewer are larger.
    jitter : float
        Swinging of the pitch, px of the full size.

    Raises
    ------
    InputError
        If such a pair is not possible, or the folder cannot be written.
    """
    from ortho_cartosat.simulation import write_product

    files = _simulated(write_product, folder, seed=seed, size=size, jitter=jitter)
    return Result(files, {}, f"A simulated CARTOSAT-1 stereo pair (seed {seed}); try\n  ortho adjust {files['fore']} "
                  f"{files['aft']} --points {files['points']} --model rpc --correction affine -o out")  # fmt: skip


def reproduce_cartosat(
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int = 50,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute tables 2 to 6 of the CARTOSAT-1 paper on simulated stereo pairs, beside the paper's numbers.

    Parameters
    ----------
    folder : path, optional
        Where ``cartosat.json`` and the page ``cartosat.html`` go.
    """
    from ortho_cartosat import experiment as cartosat
    from ortho_cartosat import page as cartosat_page

    document = cartosat.reproduce(realisations, progress=progress)
    vectors = {model: cartosat.error_vectors(model) for model in cartosat_page.DRAWN}
    return _written("cartosat", document, folder, lambda: cartosat_page.page(document, vectors))


def simulate_orbview3(folder: str | os.PathLike[str], *, seed: int = 0, pixel: int = 8) -> Result:
    """Write both simulated OrbView-3 scenes of the paper: images with labels and RPCs, DEM, 34 points, truth.

    Parameters
    ----------
    pixel : int
        Metres of a pixel; 1 m is the real one, larger ones are fewer.

    Raises
    ------
    InputError
        If such scenes are not possible, or the folder cannot be written.
    """
    from ortho_orbview3.simulation import write_product

    files = _simulated(write_product, folder, seed=seed, pixel=pixel)
    return Result(files, {}, f"Two simulated OrbView-3 scenes (seed {seed}); try\n  ortho fit {files['image_471890']} "
                  f"--gcps {files['gcps_471890']} --correction affine --prune")  # fmt: skip


def reproduce_orbview3(
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int = 100,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute table 1 and figures 4 to 7 of the OrbView-3 paper on simulated scenes, beside the paper's numbers.

    Parameters
    ----------
    folder : path, optional
        Where ``orbview3.json`` and the page ``orbview3.html`` go.
    """
    from ortho_orbview3 import experiment as orbview3
    from ortho_orbview3 import page as orbview3_page

    document = orbview3.reproduce(realisations, progress=progress)
    return _written("orbview3", document, folder, lambda: orbview3_page.page(document, orbview3.error_vectors()))


def _simulated(
    write: Callable[..., dict[str, Path]], folder: str | os.PathLike[str], **options: Any
) -> dict[str, Path]:
    """Write a simulated product; all of its files appear together."""
    with together(folder, "simulated"):
        return write(folder, **options)


def _written(
    name: str, document: Mapping[str, Any], folder: str | os.PathLike[str] | None, page: Callable[[], str]
) -> Result:
    """Write document and page of a reproduction where there is a folder for them."""
    files = {} if folder is None else {ending: Path(folder) / f"{name}.{ending}" for ending in ("json", "html")}
    if not files or folder is None:
        return Result(files, document, text(document))
    with together(folder, name):
        write_text(files["json"], json.dumps(document, indent=1, allow_nan=False) + "\n")
        write_text(files["html"], page())
    return Result(files, document, text(document))
