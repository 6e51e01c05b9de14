"""All that the author of a study reads.

A study is a module that is named in the entry-point group ``ortho_studies`` of an installed distribution
(``tinysat = "ortho_tinysat_study"`` under ``[project.entry-points.ortho_studies]``). The whole of one::

    from ortho_studies.hookspecs import Simulated, Study, hookimpl

    def simulate(folder, *, seed=0):
        return Simulated({"image": write_scene(folder, seed)}, "try ortho info scene.tif")

    @hookimpl
    def ortho_studies():
        yield Study("tinysat", "A TinySat-1 scene over Rome", simulate)

The papers of `ortho_studies` are registered in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pluggy

PROJECT_NAME = "ortho_studies"
#: The entry-point group, and the hook that is called in its modules.
GROUPS = {PROJECT_NAME: ("ortho_studies",)}
hookspec = pluggy.HookspecMarker(PROJECT_NAME)
hookimpl = pluggy.HookimplMarker(PROJECT_NAME)


@dataclass(frozen=True)
class Simulated:
    """The outcome of a simulation: its files by name, and what to try with them (text for the terminal)."""

    files: Mapping[str, Path]
    text: str


@dataclass(frozen=True)
class Reproduced:
    """The outcome of an experiment: a document of JSON values, its text for the terminal, and its page of HTML."""

    document: Mapping[str, Any]
    text: str
    page: Callable[[], str]


@dataclass(frozen=True)
class StudyOption:
    """An option of ``ortho simulate NAME``: a keyword argument of `Study.simulate`.

    Parameters
    ----------
    name : str
        The keyword; on the command line with dashes, unless `flag` says otherwise.
    help : str
        One line.
    kind : type
        int, float, or bool (a switch).
    default : optional
        None where the simulation has a default of its own.
    low, high : float, optional
        The least and the greatest value.
    unit : str
        Shown in place of the value.
    flag : str
        The switch as it is typed (``--rpc/--no-rpc``).
    """

    name: str
    help: str
    kind: type = float
    default: Any = None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    flag: str = ""


@dataclass(frozen=True)
class Study:
    """Scenes of known truth of one sensor, and the experiment of a paper on them.

    The first line of the docstrings of both functions is what ``--help`` says.

    Parameters
    ----------
    name : str
        ``ortho simulate NAME`` and ``ortho reproduce NAME``; unique among all plugins.
    title : str
        One line for the lists of both commands.
    simulate : callable(folder, *, seed, **options) -> Simulated, optional
        Writes a product with its DEM and points. Its files appear together, or none does.
    reproduce : callable(realisations, *, progress) -> Reproduced, optional
        Computes what a paper has tables of; calls `progress` with the share that is done (0 to 1).
    options : tuple of StudyOption
        Of `simulate`, besides the seed.
    realisations : int
        How often noise is drawn where the user does not say.
    """

    name: str
    title: str
    simulate: Callable[..., Simulated] | None = None
    reproduce: Callable[..., Reproduced] | None = None
    options: tuple[StudyOption, ...] = ()
    realisations: int = 100


@hookspec
def ortho_studies() -> Iterable[Study]:
    """Return studies; called for ``ortho simulate`` and ``ortho reproduce`` alone."""
    raise NotImplementedError
