"""The flag ``--open``: show the page that a command wrote in the browser of this machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from ortho_pipeline.cli.machine.terminal import say


def open_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--open``, and remember it until the page is written."""

    def remember(ctx: click.Context, _: click.Parameter, value: bool) -> None:
        ctx.meta["open"] = value

    return click.option(
        "--open", "open_", is_flag=True, expose_value=False, callback=remember, help="Open the report in your browser."
    )(command)


def require_page(flag: str, page: object) -> None:
    """Refuse ``--open`` of a command that writes a page only with another flag, if that is missing."""
    if click.get_current_context().meta.get("open") and page is None:
        raise click.UsageError(f"--open needs a report: add {flag}.")


def page_of(files: Mapping[str, Any]) -> Any:
    """Return the page among the files of a result: a path, an address in a store, or None without one."""
    return next((path for path in files.values() if str(path).endswith(".html")), None)


def show_page(page: Any) -> None:
    """Open a page if ``--open`` was given; say what to do if that is impossible."""
    if not click.get_current_context().meta.get("open"):
        return
    if page is None:
        say("Note: no report was written, so --open shows nothing.", err=True)
    elif not isinstance(page, Path):
        say("Note: --open cannot show a report in a store. Download it first.", err=True)
    elif not _opened(page):
        say("Note: there is no browser on this machine. Open the report on another one.", err=True)


def _opened(page: Path) -> bool:
    import webbrowser

    try:
        return webbrowser.open(page.resolve().as_uri())
    except webbrowser.Error:
        return False
