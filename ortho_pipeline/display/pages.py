"""Pages of HTML: one environment of templates for all rooms, each of which keeps its own in a folder `templates`."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ortho_pipeline.display.numbers import fixed, flat, metres, plain_size, px, share, short, signed
from ortho_pipeline.errors.texts import Setting, counted
from ortho_pipeline.options.flags import flag_of


def render(template: str, package: str = "ortho_pipeline", **values: Any) -> str:
    """Return a template filled with values, which are escaped.

    Parameters
    ----------
    template : str
        Room and name, such as ``report/block.html.j2``.
    package : str
        The package that has the room.

    Raises
    ------
    jinja2.UndefinedError
        If the template uses a value that is not given.
    """
    room, _, name = template.partition("/")
    return str(_environment(package).get_template(f"{room}/templates/{name}").render(**values))


def _coded(text: str) -> Any:
    """Return a text with what stands between backticks as code, options as they are typed; everything is escaped."""
    return _marked(text, lambda quoted: flag_of(Setting.read(quoted)).strip("`"))


def _fields(text: str) -> Any:
    """Return a text as `_coded` does, options as they are in a pipeline file."""
    return _marked(text, str)


def _marked(text: str, shown: Callable[[str], str]) -> Any:
    from markupsafe import Markup, escape

    parts = str(text).split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(shown(part)) if number % 2 else escape(part)
        for number, part in enumerate(parts)
    )


@functools.cache
def _environment(package: str) -> Any:
    """Return the environment, with the filters that write numbers as people read them."""
    import jinja2

    class Kept(jinja2.BytecodeCache):
        """Templates compiled once per installation, where Python keeps its modules and under the same conditions."""

        def get_cache_key(self, name: str, filename: str | None = None) -> str:
            return importlib.util.cache_from_source(filename or name)

        def load_bytecode(self, bucket: Any) -> None:
            with contextlib.suppress(OSError), open(bucket.key, "rb") as file:
                bucket.load_bytecode(file)  # nothing, if the template has changed since

        def dump_bytecode(self, bucket: Any) -> None:
            if sys.dont_write_bytecode:
                return
            place = Path(bucket.key)
            with contextlib.suppress(OSError):
                place.parent.mkdir(exist_ok=True)
                # Another process may read it, or write it as well.
                temporary = place.with_name(f"{place.name}.{os.getpid()}")
                temporary.write_bytes(bucket.bytecode_to_string())
                temporary.replace(place)

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=Kept(),
    )
    environment.filters |= {
        "coded": _coded,
        "fields": _fields,
        "px": px,
        "m": metres,
        "signed": signed,
        "share": share,
        "fixed": fixed,
        "number": short,
        "flat": flat,
        "plain": plain_size,
        "counted": counted,
    }
    return environment
