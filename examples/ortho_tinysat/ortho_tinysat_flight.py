"""The command `ortho flight`."""

import click

from ortho_pipeline.plugin import Command, image_argument, json_option, print_json, say


@click.command(cls=Command)
@image_argument
@json_option
def flight(image: str, as_json: bool) -> None:
    """Show how high and how fast TinySat-1 flew when it took IMAGE.

    The height is above the ellipsoid.
    """
    import numpy as np  # here: the help of the command does not need it

    from ortho_pipeline.plugin import geodetic, open_scene

    model = open_scene(image, "tinysat").model
    height = float(geodetic(np.array([model.position]))[0, 2])
    speed = float(np.linalg.norm(model.velocity))
    if as_json:
        print_json({"height": height, "speed": speed})
    else:
        say(f"{height / 1000:.0f} km, {speed / 1000:.1f} km/s")
