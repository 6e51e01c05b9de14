"""The command groups ``ortho simulate`` and ``ortho reproduce``."""

from __future__ import annotations

import click

from ortho_pipeline.cli.command import Group
from ortho_pipeline.cli.options import folder_option, json_option
from ortho_pipeline.cli.printing import print_result, progress


@click.group(cls=Group)
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
    from ortho_pipeline.commands import studies

    result = studies.simulate_bilsat(folder, seed=seed, off_nadir_deg=off_nadir, size=size, all_cameras=all_cameras)
    print_result(result, as_json)


@simulate.command("ikonos")
@folder_option
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of hills, errors and noise.")
@click.option(
    "--off-nadir", type=click.FloatRange(0, 45), metavar="DEG", help="Tilt  [default: that of 'reproduce ikonos']"
)
@click.option("--size", type=int, default=1000, show_default=True, metavar="PX", help="Columns and rows.")
@click.option("--pixel", type=float, metavar="M", help="Size of a pixel  [default: so that the image covers 11 km]")
@click.option("--rpc/--no-rpc", default=True, help="Deliver _rpc.txt or not.")
@click.option("--ms", "multispectral", is_flag=True, help="Four bands in files of their own beside pan.")
@click.option("--components", type=int, default=1, show_default=True, help="Files that each image is cut into.")
@json_option
def simulate_ikonos(
    folder: str,
    seed: int,
    off_nadir: float | None,
    size: int,
    pixel: float | None,
    rpc: bool,
    multispectral: bool,
    components: int,
    as_json: bool,
) -> None:
    """Write an IKONOS Geo delivery over Tehran: images, metadata, RPC, DEM, 20 control and 20 check points, truth."""
    from ortho_pipeline.commands import studies

    result = studies.simulate_ikonos(
        folder, seed=seed, off_nadir_deg=off_nadir, size=size, pixel=pixel, rpc=rpc, multispectral=multispectral,
        components=components,
    )  # fmt: skip
    print_result(result, as_json)


@simulate.command("cartosat")
@folder_option
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of points and all noise.")
@click.option(
    "--size",
    type=int,
    default=1200,
    show_default=True,
    metavar="PX",
    help="Columns and rows; 12000 are the real ones (25 min), fewer are larger.",
)
@click.option(
    "--jitter",
    type=click.FloatRange(0, 10),
    default=0.0,
    show_default=True,
    metavar="PX",
    help="Swinging of the pitch.",
)
@json_option
def simulate_cartosat(folder: str, seed: int, size: int, jitter: float, as_json: bool) -> None:
    """Write a CARTOSAT-1 stereo pair over Hobart: BANDF and BANDA with _MET.TXT and _RPC.TXT, DEM, 69 points, truth."""
    from ortho_pipeline.commands import studies

    print_result(studies.simulate_cartosat(folder, seed=seed, size=size, jitter=jitter), as_json)


@simulate.command("orbview3")
@folder_option
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of points and all noise.")
@click.option(
    "--pixel", type=int, default=8, show_default=True, metavar="M", help="Metres; 1 is the real one, larger are fewer."
)
@json_option
def simulate_orbview3(folder: str, seed: int, pixel: int, as_json: bool) -> None:
    """Write two OrbView-3 scenes over Zonguldak: images with .pvl and _rpc.txt, DEM, 34 points, truth."""
    from ortho_pipeline.commands import studies

    print_result(studies.simulate_orbview3(folder, seed=seed, pixel=pixel), as_json)


@click.group(cls=Group)
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
    from ortho_pipeline.commands import studies

    with progress("Reproducing") as advance:
        result = studies.reproduce_bilsat(folder, realisations=realisations, progress=advance)
    print_result(result, as_json)


@reproduce.command("ikonos")
@click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help="Folder of the page.")
@click.option(
    "--realisations", type=click.IntRange(min=1), default=100, show_default=True, help="How often a scene is drawn."
)
@json_option
def reproduce_ikonos(folder: str | None, realisations: int, as_json: bool) -> None:
    """Table 2 and figure 4 of Amini and Hashemi, on simulated IKONOS scenes; and what the paper did not have."""
    from ortho_pipeline.commands import studies

    with progress("Reproducing") as advance:
        result = studies.reproduce_ikonos(folder, realisations=realisations, progress=advance)
    print_result(result, as_json)


@reproduce.command("cartosat")
@click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help="Folder of the page.")
@click.option(
    "--realisations", type=click.IntRange(min=1), default=50, show_default=True, help="How often a pair is drawn."
)
@json_option
def reproduce_cartosat(folder: str | None, realisations: int, as_json: bool) -> None:
    """Tables 2 to 6 of Willneff et al., on simulated CARTOSAT-1 stereo pairs; and curves over the control points."""
    from ortho_pipeline.commands import studies

    with progress("Reproducing") as advance:
        result = studies.reproduce_cartosat(folder, realisations=realisations, progress=advance)
    print_result(result, as_json)


@reproduce.command("orbview3")
@click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help="Folder of the page.")
@click.option(
    "--realisations", type=click.IntRange(min=1), default=100, show_default=True, help="How often a scene is drawn."
)
@json_option
def reproduce_orbview3(folder: str | None, realisations: int, as_json: bool) -> None:
    """Table 1 and figures 4 to 7 of Bueyueksalih et al., on simulated OrbView-3 scenes; and QuickBird beside them."""
    from ortho_pipeline.commands import studies

    with progress("Reproducing") as advance:
        result = studies.reproduce_orbview3(folder, realisations=realisations, progress=advance)
    print_result(result, as_json)
