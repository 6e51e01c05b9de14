"""A process that dies at one of its calls of the system: prepend `SOURCE` to the script that it runs."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from typing import Any

#: The calls that change a folder.
CALLS = ("replace", "unlink", "fsync", "open", "mkdir")


def die_at(deadline: int) -> Callable[[], int]:
    """Let the process end, as a kill does, at this call of the system that changes a folder, counted from 1.

    Return what tells how many calls there were.
    """
    calls = 0

    def dying(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **named: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == deadline:
                os._exit(7)
            return function(*given, **named)

        return call

    for name in CALLS:
        setattr(os, name, dying(getattr(os, name)))
    return lambda: calls


SOURCE = (
    "from __future__ import annotations\nimport os\nfrom typing import Any\n"
    f"CALLS = {CALLS!r}\n{inspect.getsource(die_at)}"
)
