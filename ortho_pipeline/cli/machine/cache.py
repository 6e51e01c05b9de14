"""``ortho cache``: downloaded files that are cached on this machine."""

from __future__ import annotations

from typing import Any

import click

from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import json_option
from ortho_pipeline.cli.parsing import Group
from ortho_pipeline.cli.printing import print_json
from ortho_pipeline.errors.texts import counted

_FAILED = 1


@click.group(cls=Group)
def cache() -> None:
    """List, verify or clear the downloaded DEM cells."""


@cache.command("list")
@json_option
def list_kept(as_json: bool) -> None:
    """List the cached files."""
    from ortho_pipeline import commands

    _print(commands.kept_files(), as_json)


@cache.command()
@json_option
@click.pass_context
def verify(ctx: click.Context, as_json: bool) -> None:
    """Compare each cached file with its checksum. Damaged files are downloaded again when needed."""
    from ortho_pipeline import commands

    document = commands.kept_files(verify=True)
    _print(document, as_json)
    if any(file["state"] != "sound" for file in document["files"]):
        ctx.exit(_FAILED)


@cache.command()
@json_option
def clear(as_json: bool) -> None:
    """Delete all cached files."""
    from ortho_pipeline import commands

    document = commands.forget_kept_files()
    if as_json:
        return print_json(document)
    say(f"Deleted {counted(document['files'], 'file')} ({document['bytes'] / 1e6:.1f} MB) from {document['folder']}")
    return None


def _print(document: dict[str, Any], as_json: bool) -> None:
    if as_json:
        return print_json(document)
    for file in document["files"]:
        say(f"{file.get('state', ''):<8} {file['bytes'] / 1e6:9.1f} MB  {file['address']}".lstrip())
    total = sum(file["bytes"] for file in document["files"])
    say(f"{counted(len(document['files']), 'file')}, {total / 1e6:.1f} MB, in {document['folder']}")
    return None
