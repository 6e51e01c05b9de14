"""``ortho doctor``: what is installed on this machine."""

from __future__ import annotations

import click

from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import json_option
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json


@click.command(cls=Command)
@click.option("--fetch-grids", is_flag=True, help="Download the missing geoid grids once, from PROJ's server.")
@json_option
def doctor(fetch_grids: bool, as_json: bool) -> None:
    """Show versions, drivers, geoid grids and plugins."""
    from ortho_pipeline import commands
    from ortho_pipeline.cli.program import cli

    document = commands.doctor(fetch_grids=fetch_grids)
    document["plugins"] += [vars(package) for package in cli.added.packages()]
    document["broken"] += [vars(package) for package in cli.added.broken()]
    if as_json:
        return print_json(document)
    gdal, proj = document["gdal"], document["proj"]
    say("Packages   " + ", ".join(f"{name} {version}" for name, version in document["packages"].items()))
    say(f"GDAL       {gdal['version']} (bindings {gdal['bindings']}), reads {', '.join(gdal['drivers'])}")
    if gdal["missing_drivers"]:
        say(f"{'':<10} missing drivers: {', '.join(gdal['missing_drivers'])}")
    say(f"PROJ       {proj['proj']}, searches {', '.join(proj['search_path'])}")
    for grid in document["grids"]:
        say(f"{grid['datum']:<10} " + (f"{grid['path']}" if grid["found"] else f"missing: {grid.get('remedy')}"))
    for fetched in document["fetched"]:
        say(f"downloaded {fetched['grid']} to {fetched['path']}")
    for plugin in document["plugins"]:
        say(f"plugin     {plugin['plugin']} ({plugin['distribution']} {plugin['version']})")
    say(f"formats    {', '.join(document['formats'])}")
    for broken in document["broken"]:
        say(f"broken     {broken['plugin']}: {broken['error']}")
    return None
