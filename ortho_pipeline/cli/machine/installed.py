"""The commands `ortho sensors` and `ortho models`: lists of what is installed."""

from __future__ import annotations

import click

from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import json_option
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json, print_models


@click.command(cls=Command)
@json_option
def sensors(as_json: bool) -> None:
    """List the installed sensors."""
    from ortho_pipeline import commands

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
