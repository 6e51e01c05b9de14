"""The command groups ``ortho simulate`` and ``ortho reproduce``."""

from __future__ import annotations

import click

from ortho_pipeline.cli_options import folder_option, json_option
from ortho_pipeline.cli_text import print_result, progress


@click.group()
def simulate() -> None:
    """Make scenes of known truth."""


@simulate.command("bilsat")
@folder_option
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all noise.")
@click.option(
    "--off-nadir", type=click.FloatRange(0, 30), metavar="DEG", help="Tilt  [default: that of 'reproduce bilsat']"
)
@click.option("--size", type=int, metavar="PX", help="Columns and rows; fewer are larger  [default: 2048]")
@click.option("--xs", "all_cameras", is_flag=True, help="An image of each of the four XS cameras, not of the red one.")
@json_option
def simulate_bilsat(
    folder: str, seed: int, off_nadir: float | None, size: int | None, all_cameras: bool, as_json: bool
) -> None:
    """Write a BILSAT-1 frame over Ankara: image, imaging survey, DEM, 44 points, truth."""
    from ortho_pipeline import studies

    result = studies.simulate_bilsat(folder, seed=seed, off_nadir_deg=off_nadir, size=size, all_cameras=all_cameras)
    print_result(result, as_json)


@click.group()
def reproduce() -> None:
    """Compute the tables of the papers that this package implements, beside the papers' numbers."""


@reproduce.command("bilsat")
@click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help="Folder of the page.")
@click.option(
    "--realisations", type=click.IntRange(min=1), default=100, show_default=True, help="How often noise is drawn."
)
@json_option
def reproduce_bilsat(folder: str | None, realisations: int, as_json: bool) -> None:
    """Tables 3, 4 and 5 and figure 2 of Ok and Turker, on simulated BILSAT-1 scenes."""
    from ortho_pipeline import studies

    with progress("Reproducing") as advance:
        result = studies.reproduce_bilsat(folder, realisations=realisations, progress=advance)
    print_result(result, as_json)
