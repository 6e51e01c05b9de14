"""What is marked as a kernel, before anything is compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Marked:
    """A function that is to be compiled: on its own, or `inline` within each kernel that calls it."""

    def __init__(self, function: Callable[..., Any], *, inline: bool) -> None:
        self.py_func, self.inline = function, inline
