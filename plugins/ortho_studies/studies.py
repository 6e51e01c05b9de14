"""Find the studies that installed packages offer in the hook ``ortho_studies``, and run them."""

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
    """Return the studies of all installed packages by name; they are looked for once per process.

    Raises
    ------
    PluginError
        If a package offers what is no study, two offer one name, or a hook is misspelt.
    """
    registry = Registry(False, specs=hookspecs)
    registry.register_installed()
    return registry.named("ortho_studies", "study", Study)


def simulate(name: str, folder: str | os.PathLike[str], *, seed: int = 0, **options: Any) -> Result:
    """Write a simulated product with its DEM and points; its files appear together.

    Parameters
    ----------
    name : str
        Of a study that simulates (``ortho simulate --help``).
    seed : int
        Of everything that is drawn.
    options
        Those that the study declares; None is its own default.

    Raises
    ------
    InputError
        If there is no such simulation or option, such a scene is not possible, or the folder cannot be written.
    """
    study = _study(name, "simulate")
    known = {option.name for option in study.options}
    for option in options:
        if option not in known:
            listed = ", ".join(sorted(known)) or "none"
            raise InputError(f"the study {name!r} has no option {option!r} (its options: {listed})", field=option)
    assert study.simulate
    with together(folder, "simulated"):
        given = {option: value for option, value in options.items() if value is not None}
        made = study.simulate(folder, seed=seed, **given)
    return Result(dict(made.files), {}, made.text)


def reproduce(
    name: str,
    folder: str | os.PathLike[str] | None = None,
    *,
    realisations: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Compute the tables of a paper on simulated scenes, beside the paper's numbers.

    Parameters
    ----------
    name : str
        Of a study that has an experiment (``ortho reproduce --help``).
    folder : path, optional
        Where ``<name>.json`` and the page ``<name>.html`` go.
    realisations : int, optional
        How often noise is drawn; the study's own number without it.

    Returns
    -------
    Result
        `document` is the study's own; those of the bundled plugins have paper, settings, summary and tables
        (docs/engineering/formats.md).
    """
    study = _study(name, "reproduce")
    assert study.reproduce
    files = (
        {} if folder is None else {ending: allowed(Path(folder) / f"{name}.{ending}") for ending in ("json", "html")}
    )
    found = study.reproduce(realisations or study.realisations, progress=progress)
    if folder is None:
        return Result({}, dict(found.document), found.text)
    with together(folder, name):
        write_json(files["json"], found.document)
        write_text(files["html"], found.page())
    return Result(files, dict(found.document), found.text)


def _study(name: str, field: Literal["simulate", "reproduce"]) -> Study:
    """Return the study of a name that can do what the field is for."""
    offered = studies()
    if name not in offered or getattr(offered[name], field) is None:
        able = ", ".join(key for key, study in offered.items() if getattr(study, field)) or "none"
        what = {"simulate": "simulates", "reproduce": "reproduces a paper"}[field]
        raise InputError(f"no installed study {name!r} {what}", field="name", remedy=f"there are: {able}")
    return offered[name]
