"""The hook for studies, and what it returns.

A study is a module in the entry-point group ``ortho_studies`` of an installed distribution
(``tinysat = "ortho_tinysat_study"`` under ``[project.entry-points.ortho_studies]``). A complete one::

    from ortho_studies.hookspecs import Simulated, Study, hookimpl

    def simulate(folder, *, seed=0):
        return Simulated({"image": write_scene(folder, seed)}, "try ortho info scene.tif")

    @hookimpl
    def ortho_studies():
        yield Study("tinysat", "A TinySat-1 scene over Rome", simulate)

The studies of `ortho_studies` are registered in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pluggy

PROJECT_NAME = "ortho_studies"
#: The entry-point group, with the hook of its modules.
GROUPS = {PROJECT_NAME: ("ortho_studies",)}
hookspec = pluggy.HookspecMarker(PROJECT_NAME)
hookimpl = pluggy.HookimplMarker(PROJECT_NAME)


@dataclass(frozen=True)
class Simulated:
    """Result of a simulation.

    Parameters
    ----------
    files : mapping of str to Path
        Its files by name.
    text : str
        Text for the terminal, with commands to try.
    """

    files: Mapping[str, Path]
    text: str


@dataclass(frozen=True)
class Reproduced:
    """Result of an experiment.

    Parameters
    ----------
    document : mapping
        Its tables as JSON values.
    text : str
        Text for the terminal.
    page : callable() -> str
        Returns HTML. The host calls it if the user gives a folder.
    """

    document: Mapping[str, Any]
    text: str
    page: Callable[[], str]


@dataclass(frozen=True)
class StudyOption:
    """An option of ``ortho simulate NAME``: a keyword argument of `Study.simulate`.

    Parameters
    ----------
    name : str
        The keyword; with dashes on the command line, unless `flag` is given.
    help : str
        One line.
    kind : type
        int, float, or bool (a switch).
    default : optional
        None if the simulation has its own default.
    low, high : float, optional
        Smallest and largest value.
    unit : str
        Shown in place of the value.
    flag : str
        The switch on the command line (``--rpc/--no-rpc``).
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
    """Simulated scenes of one sensor with known truth, and the experiment of a paper on them.

    ``--help`` shows the first line of the docstrings of both functions.

    Parameters
    ----------
    name : str
        ``ortho simulate NAME`` and ``ortho reproduce NAME``; unique among all plugins.
    title : str
        One line for the lists of both commands.
    simulate : callable(folder, *, seed, **options) -> Simulated, optional
        Writes a product with its DEM and points. Its files appear together or not at all.
    reproduce : callable(realisations, *, progress) -> Reproduced, optional
        Computes the tables of a paper; calls `progress` with the finished share (0 to 1).
    options : tuple of StudyOption
        Options of `simulate`, besides the seed.
    realisations : int
        Default number of random realisations.
    """

    name: str
    title: str
    simulate: Callable[..., Simulated] | None = None
    reproduce: Callable[..., Reproduced] | None = None
    options: tuple[StudyOption, ...] = ()
    realisations: int = 100


@hookspec
def ortho_studies() -> Iterable[Study]:
    """Return studies; only called for ``ortho simulate`` and ``ortho reproduce``."""
    raise NotImplementedError
