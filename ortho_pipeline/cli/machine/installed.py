"""The commands `ortho sensors` and `ortho models`: lists of what is installed."""

from __future__ import annotations

import click

from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import json_option, tested_options
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json, print_models, print_sensor_test
from ortho_pipeline.options import SceneOptions


@click.command(cls=Command)
@click.argument("image", required=False, type=click.Path())
@click.option("--test", metavar="NAME", help="Test the plugin of this sensor (or package) with IMAGE.")
@tested_options
@json_option
def sensors(image: str | None, test: str | None, scene: SceneOptions, as_json: bool) -> None:
    """List the installed sensors.

    With --test: check that a sensor recognises and opens IMAGE, and that its models keep the contract of plugins.
    """
    from ortho_pipeline import commands

    if test is not None:
        tested = commands.sensor_test(test, image, scene)
        return print_json(tested) if as_json else print_sensor_test(tested)
    if image is not None or scene.sensor_options:
        word = image or "--sensor-option"
        click.get_current_context().fail(
            f"Unexpected argument {word!r} for 'sensors'; to test a plugin: ortho sensors --test NAME IMAGE"
        )
    document = commands.sensors()
    if as_json:
        return print_json(document)
    for sensor in document["sensors"]:
        say(f"{sensor['name']:<14} {sensor['description']}   [{sensor['distribution']} {sensor['version']}]")
        for option, text in sensor["options"].items():
            say(f"{'':<14}   {option}: {text}")
    for broken in document["broken"]:
        say(f"Warning: plugin {broken['plugin']} was skipped ({broken['error']})", err=True)
    return None


@click.command(cls=Command)
@json_option
def models(as_json: bool) -> None:
    """List the models that can be fitted to points."""
    from ortho_pipeline import commands

    listed = commands.models()
    if as_json:
        return print_json(listed)
    return print_models(listed)
