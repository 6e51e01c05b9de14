"""The command groups ``ortho simulate`` and ``ortho reproduce``: a command for each study of an installed package."""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.cli.options import folder_option, json_option, optional_folder
from ortho_pipeline.cli.parsing import Command, Group
from ortho_pipeline.cli.printing import print_result, progress
from ortho_pipeline.cli.survey.examples import with_examples

if TYPE_CHECKING:
    from ortho_studies.hookspecs import Study, StudyOption

#: Example in the help of every command of a group: purpose and command line with the name of the study.
_EXAMPLES = {
    "simulate": ("Always the same scene for the same seed:", "ortho simulate {0} --seed 1 -o {0}_1"),
    "reproduce": ("Fast, with rough percentiles:", "ortho reproduce {0} --realisations 3 -o {0}_page"),
}


class _Studies(Group):
    """A group with a command for each study that has a function of the group's name."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [name for name, study in _offered().items() if getattr(study, str(self.name))]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        study = _offered().get(cmd_name)
        if study is None or getattr(study, str(self.name)) is None:
            return None
        return _simulation(study) if self.name == "simulate" else _experiment(study)


def _offered() -> dict[str, Study]:
    from ortho_studies.studies import studies

    return dict(studies())


@click.group(cls=_Studies)
def simulate() -> None:
    """Write scenes of known truth."""


@click.group(cls=_Studies)
def reproduce() -> None:
    """Recompute the tables of four papers.

    Each table compares the numbers of the paper with ours.
    """


def _simulation(study: Study) -> click.Command:
    def run(folder: str, seed: int, as_json: bool, **options: Any) -> None:
        from ortho_studies import studies

        print_result(studies.simulate(study.name, folder, seed=seed, **options), as_json)

    callback = json_option(run)
    for option in reversed(study.options):
        callback = _option(option)(callback)
    seed_option = click.option(
        "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of all random numbers."
    )
    return click.command(study.name, cls=Command, help=_help(study, "simulate"), short_help=study.title)(
        folder_option(seed_option(callback))
    )


def _experiment(study: Study) -> click.Command:
    @optional_folder("Folder for the page.")
    @click.option(
        "--realisations",
        type=click.IntRange(min=1),
        default=study.realisations,
        show_default=True,
        help="Number of random realisations.",
    )
    @json_option
    def run(folder: str | None, realisations: int, as_json: bool) -> None:
        from ortho_studies import studies

        with progress() as show:
            advance = None if show is None else functools.partial(show, "Reproducing")
            result = studies.reproduce(study.name, folder, realisations=realisations, progress=advance)
        print_result(result, as_json)

    return click.command(study.name, cls=Command, help=_help(study, "reproduce"), short_help=study.title)(run)


def _option(option: StudyOption) -> Any:
    """Return the click decorator of a declared option."""
    flag = option.flag or f"--{option.name.replace('_', '-')}"
    shown = option.default is not None
    if option.kind is bool:
        return click.option(flag, option.name, is_flag=True, default=bool(option.default), help=option.help)
    kind: Any = option.kind
    if (option.low, option.high) != (None, None):
        of_range: Any = click.IntRange if kind is int else click.FloatRange
        kind = of_range(option.low, option.high)
    return click.option(
        flag,
        option.name,
        type=kind,
        default=option.default,
        show_default=shown,
        metavar=option.unit or None,
        help=option.help,
    )


def _help(study: Study, group: str) -> str | None:
    text = (inspect.getdoc(getattr(study, group)) or "").partition("\n\n")[0]
    about, line = _EXAMPLES[group]
    return with_examples(text, ((about, line.format(study.name)),))
