"""Signals end a command as an exception would, at any moment."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

#: Signals that end a command; Windows has one of them.
_ENDING = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
#: Seconds until a lost signal is raised again.
_AGAIN = 0.01


class Terminated(BaseException):
    """A signal ends the process. Like `KeyboardInterrupt` it is no `Exception`, and no `SystemExit` of a plugin."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block by `Terminated`, as SIGINT does by `KeyboardInterrupt`.

    Python prints and drops an exception that a signal raises in a destructor; here it is raised again.
    After the block a signal ends the process at once, without a traceback of the interpreter that shuts down: the
    outputs have their names.
    """
    for ending in _ENDING:
        # Under nohup a command is to survive the end of its terminal.
        if signal.getsignal(ending) == signal.SIG_DFL:
            signal.signal(ending, _end)
    before, sys.unraisablehook = sys.unraisablehook, _ask_again
    try:
        yield
    finally:
        for ending in (signal.SIGINT, *_ENDING):
            if signal.getsignal(ending) in (signal.default_int_handler, _end):
                signal.signal(ending, signal.SIG_DFL)
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        sys.unraisablehook = before


@contextlib.contextmanager
def called_by_gdal(report: Callable[[float], object]) -> Iterator[Callable[..., int]]:
    """Yield a progress function for GDAL, which ends its work at a signal or an error; the block raises it then.

    GDAL prints and drops an exception of such a function, and says that it could not write.
    """
    came, errors, before = list[int](), list[BaseException](), dict[int, Any]()

    def advance(share: float, *_: Any) -> int:
        try:
            report(share)
        except BaseException as error:
            errors.append(error)
        return not (came or errors)

    # Only the main thread may set what signals do, and only there they raise.
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, *_ENDING):
            if signal.getsignal(number) in (signal.default_int_handler, _end):
                before[number] = signal.signal(number, lambda number, _: came.append(number))
    try:
        yield advance
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came:
            before[number](number, None)
        if errors:
            raise errors[0]


def _end(number: int, _: Any) -> None:
    """End as after an exception, so that temporary files go and locks are released."""
    raise Terminated(128 + number)


def _ask_again(lost: Any) -> None:
    """Raise the lost exception of a signal again a moment later; print other errors of destructors."""
    error = lost.exc_value
    if not isinstance(error, KeyboardInterrupt | Terminated):
        from ortho_pipeline.runtime.process_limits import is_told_already

        if not is_told_already(lost):
            sys.__unraisablehook__(lost)
        return

    def end(*_: Any) -> None:
        raise error.with_traceback(None)

    if not hasattr(signal, "setitimer"):  # Windows: a person presses Ctrl-C once more
        return
    signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, _AGAIN)
