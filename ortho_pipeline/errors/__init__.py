"""Errors that a caller can act on, and the texts of messages, which name options.

::

    OrthoError
        InputError            the user can correct it (exit code 2)
            TooFewPoints      fewer points than the model needs
            DegeneratePoints  enough points, but in a geometry that does not determine the model
            CrsError          a coordinate system or a transformation between two is missing or wrong
            DatumError        a height datum is missing, contradicts itself, or its grid is not installed
            CoverageError     the DEM does not cover the scene
        ModelError            the computation failed
            NotConverged      an iteration did not converge
        PluginError           a plugin broke the contract
        StorageError          a store of objects or a server failed, also after retries
        ReportError           the report could not be made; the other outputs are complete (exit code 3)

A bad point is NaN; a bad request is one of these.
"""

from __future__ import annotations

import contextlib
import functools
import traceback
from collections.abc import Callable, Iterator
from os import PathLike, fspath
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")


class OrthoError(Exception):
    """Base of all errors of this package.

    Parameters
    ----------
    message : str
        What is wrong, in one sentence. A `Text` if it names options, as `remedy` is.
    file : path, optional
        File that has the error.
    field : str, optional
        Field, key, column or option that has the error.
    remedy : str, optional
        What the user can do about it.

    Attributes
    ----------
    choices : tuple of (Setting, str)
        Alternative options, each with its meaning. The command line prints one command for each.

    Examples
    --------
    >>> try:
    ...     op.open_scene("missing.tif")
    ... except op.OrthoError as error:
    ...     print(error.file, error.remedy, sep=": ")
    missing.tif: check the path
    """

    choices: tuple[tuple[Any, str], ...] = ()

    def __init__(
        self,
        message: str,
        *,
        file: str | PathLike[str] | None = None,
        field: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.message = message
        self.file = None if file is None else str(fspath(file) if isinstance(file, PathLike) else file)
        self.field = field
        self.remedy = remedy
        super().__init__(message)

    def complete(self, file: object, field: str | None, remedy: str | None) -> None:
        """Add file, field and remedy where the error has none."""
        if self.file is None and isinstance(file, str | PathLike):
            self.file = str(fspath(file))
        self.field = self.field or field
        self.remedy = self.remedy or remedy

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.field) if part)
        text = f"{where}: {self.message}" if where else self.message
        return f"{text}\n  Remedy: {self.remedy}" if self.remedy else text

    def __reduce__(self) -> tuple[Any, ...]:
        # Keyword-only arguments do not survive the default pickling, and errors cross process borders in batch runs.
        return _rebuild, (type(self), self.message, self.file, self.field, self.remedy)


@contextlib.contextmanager
def completed(
    file: object = None, *, field: str | None = None, remedy: str | None = None, of: str | None = None
) -> Iterator[None]:
    """Complete an error that is raised inside with file, field and remedy, where it has none.

    A reader knows its file and what a valid one looks like; the line that finds a fault may not. With `of`, only
    errors about that field are completed.
    """
    try:
        yield
    except OrthoError as error:
        if of is None or error.field == of:
            error.complete(file, field, remedy)
        raise


@contextlib.contextmanager
def of_option(name: str) -> Iterator[None]:
    """Set the option as the field of an error that is raised inside and names no file."""
    try:
        yield
    except OrthoError as error:
        if error.file is None:
            error.field = name
        raise


def reads(remedy: str, field: str | None = None) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Decorate a function whose first argument is the file that it reads: complete its errors (see `completed`).

    Examples
    --------
    >>> @reads("give a table with a header")
    ... def read_table(path):
    ...     raise InputError("this is no table")
    >>> try:
    ...     read_table("gcps.csv")
    ... except InputError as error:
    ...     print(error)
    gcps.csv: this is no table
      Remedy: give a table with a header
    """

    def decorate(function: Callable[_P, _R]) -> Callable[_P, _R]:
        @functools.wraps(function)
        def reading(*args: _P.args, **named: _P.kwargs) -> _R:
            try:
                return function(*args, **named)
            except OrthoError as error:
                error.complete(args[0] if args else None, field, remedy)
                raise

        return reading

    return decorate


def _rebuild(
    kind: type[OrthoError], message: str, file: str | None, field: str | None, remedy: str | None
) -> OrthoError:
    return kind(message, file=file, field=field, remedy=remedy)


class InputError(OrthoError):
    """The input is wrong. The message says what to do.

    Examples
    --------
    >>> print(InputError("the file has 2 columns", file="gcps.csv", remedy="give id, x, y and h"))
    gcps.csv: the file has 2 columns
      Remedy: give id, x, y and h
    """


class TooFewPoints(InputError):
    """There are fewer points than the model needs."""


class DegeneratePoints(InputError):
    """The points do not determine the model (collinear, coplanar, clustered)."""


class CrsError(InputError):
    """A coordinate reference system, or a transformation between two, is missing or wrong.

    Examples
    --------
    >>> try:
    ...     parse_crs("EPSG:0")
    ... except CrsError as error:
    ...     print(error.message)
    'EPSG:0' is not a coordinate system
    """


class DatumError(InputError):
    """A height datum is unknown, contradictory, or its geoid grid is not installed.

    Examples
    --------
    >>> try:
    ...     Vertical.parse("sea level")
    ... except DatumError as error:
    ...     print(error.message)
    'sea level' is not a height datum
    """


class CoverageError(InputError):
    """The DEM does not cover the scene."""


class ModelError(OrthoError):
    """The computation failed although the input looked right.

    Examples
    --------
    >>> print(ModelError("the camera looks away from the ground", field="exterior"))
    exterior: the camera looks away from the ground
    """


class NotConverged(ModelError):
    """An iteration did not converge."""


class PluginError(OrthoError):
    """A plugin broke the contract of `ortho_pipeline.plugin`.

    Examples
    --------
    >>> print(PluginError("its sensor has no name", field="tinysat"))
    tinysat: its sensor has no name
    """


class StorageError(OrthoError):
    """A store of objects or a server failed, also after retries."""


class ReportError(OrthoError):
    """The report could not be made; the other outputs of the command are complete."""


def described(error: BaseException, culprit: object) -> str:
    """Return kind, text and place of an error. The place is the last line of the plugin in the traceback.

    `culprit` is a function or class of the plugin, or the name of its module.
    """
    module = culprit if isinstance(culprit, str) else getattr(culprit, "__module__", "")
    package = module.partition(".")[0]
    frames = list(traceback.walk_tb(error.__traceback__))
    own = [one for one in frames if one[0].f_globals.get("__name__", "").partition(".")[0] == package]
    where = ""
    if own:
        frame, line = own[-1]
        where = f" at {Path(frame.f_code.co_filename).name}:{line}"
    return f"{type(error).__name__}: {error}{where}"


def error_document(error: BaseException) -> dict[str, Any]:
    """Return an error as JSON values: kind, message, file, field, remedy. Unexpected errors also have the traceback."""
    kind = type(error).__name__
    if isinstance(error, OrthoError):
        return {
            "kind": kind,
            "message": error.message,
            "file": error.file,
            "field": error.field,
            "remedy": error.remedy,
        }
    trace = "".join(traceback.format_exception(error))
    return {"kind": kind, "message": str(error) or kind, "file": None, "field": None, "remedy": None, "trace": trace}
