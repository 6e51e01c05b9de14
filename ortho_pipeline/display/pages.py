"""Pages of HTML: one environment of templates for all rooms, each of which keeps its own in a folder `templates`."""

from __future__ import annotations

import functools
from typing import Any

from ortho_pipeline.display.numbers import fixed, metres, plain_size, px, share, short, signed


def render(template: str, **values: Any) -> str:
    """Return a template filled with values, which are escaped.

    Parameters
    ----------
    template : str
        Room and name, such as ``report/block.html.j2``.

    Raises
    ------
    jinja2.UndefinedError
        If the template uses a value that is not given.
    """
    room, _, name = template.partition("/")
    return str(_environment().get_template(f"{room}/templates/{name}").render(**values))


@functools.cache
def _environment() -> Any:
    """Return the environment, with the filters that write numbers as people read them."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ortho_pipeline", ""), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "px": px, "m": metres, "signed": signed, "share": share, "fixed": fixed, "number": short, "plain": plain_size,
    }  # fmt: skip
    return environment
