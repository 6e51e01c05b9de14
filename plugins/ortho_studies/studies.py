"""Find the studies of installed packages (hook ``ortho_studies``), and run them."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import allowed, together, write_json, write_text
from ortho_pipeline.host.registry import Registry
from ortho_studies import hookspecs
from ortho_studies.hookspecs import Study


@functools.cache
def studies() -> Mapping[str, Study]:
    """Return the studies of all installed packages by name; they are searched once per process.

    Raises
    ------
    PluginError
        If an offer is not a study, two packages use the same name, or a hook is misspelt.
    """
    registry = Registry(False, specs=hookspecs)
    registry.register_installed()
    return registry.named("ortho_studies", "study", Study)


def simulate(name: str, folder: str | os.PathLike[str], *, seed: int = 0, **options: Any) -> Result:
    """Write a simulated product with its DEM and points; its files appear together.

    Parameters
    ----------
    name : str
        A study that can simulate (``ortho simulate --help``).
    seed : int
        Seed of all random numbers.
    options
        Options of the study; None means its default.

    Raises
    ------
    InputError
        If the study or an option is unknown, the scene is not possible, or the folder cannot be written.
    """
    study = _study(name, "simulate")
    known = {option.name for option in study.options}
    for option in options:
        if option not in known:
            listed = ", ".join(sorted(known)) or "none"
            raise InputError(f"the study {name!r} has no option {option!r}; its options: {listed}", field=option)
    assert study.simulate
    with together(folder, "simulated"):
        chosen = {option: value for option, value in options.items() if value is not None}
        simulated = study.simulate(folder, seed=seed, **chosen)
    return Result(dict(simulated.files), {}, simulated.text)


def reproduce(
    name: str,
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute the tables of a paper on simulated scenes, and compare them with the paper's numbers.

    Parameters
    ----------
    name : str
        A study with an experiment (``ortho reproduce --help``).
    folder : path, optional
        Folder for ``<name>.json`` and the page ``<name>.html``.
    realisations : int, optional
        Number of random realisations; default: that of the study.

    Returns
    -------
    Result
        `document` depends on the study; bundled ones have paper, settings, summary and tables
        (docs/engineering/formats.md).
    """
    study = _study(name, "reproduce")
    assert study.reproduce
    files = (
        {} if folder is None else {ending: allowed(Path(folder) / f"{name}.{ending}") for ending in ("json", "html")}
    )
    reproduced = study.reproduce(realisations or study.realisations, progress=progress)
    if folder is None:
        return Result({}, dict(reproduced.document), reproduced.text)
    with together(folder, name):
        write_json(files["json"], reproduced.document)
        write_text(files["html"], reproduced.page())
    return Result(files, dict(reproduced.document), reproduced.text)


def _study(name: str, field: Literal["simulate", "reproduce"]) -> Study:
    """Return the study of a name, if it has the function `field`."""
    offered = studies()
    if name not in offered or getattr(offered[name], field) is None:
        able = ", ".join(key for key, study in offered.items() if getattr(study, field)) or "none"
        what = {"simulate": "simulates", "reproduce": "reproduces a paper"}[field]
        raise InputError(f"no installed study {name!r} {what}", field="name", remedy=f"use one of: {able}")
    return offered[name]
