"""The log of the server; its size does not grow with the requests of others."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Repeated(logging.Filter):
    """Pass the 1st, 10th, 100th … message of a kind, with its number."""

    def __init__(self) -> None:
        super().__init__()
        self._count: Counter[tuple[str, str, Any]] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a message is written."""
        kind = record.name, str(record.msg).partition("\n")[0], record.exc_info and record.exc_info[0]
        self._count[kind] += 1
        number = self._count[kind]
        if number > 1:
            record.msg, record.args = f"{record.getMessage()} ({number:,} times)", ()
        return str(number).rstrip("0") == "1"


@contextmanager
def repetitions_counted(*names: str) -> Iterator[None]:
    """Count repeated messages of loggers while the context lasts, instead of writing each."""
    filters = {logging.getLogger(name): Repeated() for name in names}
    for logger, repeated in filters.items():
        logger.addFilter(repeated)
    try:
        yield
    finally:
        for logger, repeated in filters.items():
            logger.removeFilter(repeated)
