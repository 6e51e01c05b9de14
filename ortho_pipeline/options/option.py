"""What an option is: its flag, its help, and the values that it may have."""

# Annotations are read from the classes: as values, not as text.
import functools
import inspect
import math
import os
import reprlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from ortho_pipeline.errors import InputError

#: Convention of a points file for the first pixel -> offset to (0, 0) at its outer corner.
PIXEL_ORIGINS = {
    "corner": 0.0,  # (0, 0) is the outer corner of the first pixel: GDAL, QGIS, this package
    "center": 0.5,  # (0, 0) is its centre: RPC files, OpenCV
    "corner-1": -1.0,  # (1, 1) is its outer corner: ENVI
    "center-1": -0.5,  # (1, 1) is its centre: MATLAB, Fortran, DIMAP, much older software
}
#: Types of pixels that an ortho may have, by GDAL's names.
PIXEL_TYPES = ("Byte", "UInt16", "Int16", "UInt32", "Int32", "Float32", "Float64")
#: What is adjusted: nothing, the image points, or the parameters of the model itself.
CORRECTIONS = ("none", "shift", "shift-drift", "affine", "model")
#: Kernels of resampling, and executors of a run.
RESAMPLING = ("nearest", "bilinear", "cubic", "lanczos", "average")
EXECUTORS = ("sequential", "processes", "dask")

#: Form of the value of an option that is neither a choice nor true or false.
Kind = Literal[
    "text",
    "file",
    "number",
    "integer",
    "pair",
    "box",
    "one or two",
    "number or word",
    "number or nan",
    "bytes",
    "integers",
    "files",
    "folders",
    "keys",
]
PathLike = str | os.PathLike[str]


def is_usable(number: float) -> bool:
    """Return whether a number is 0, or its cube and the cube of its inverse are finite.

    Examples
    --------
    >>> is_usable(1e30), is_usable(1e300)
    (True, False)
    """
    return number == 0 or 1e-100 <= abs(number) <= 1e100


def number_of(text: str | float) -> float:
    """Return the number that a user gave; NaN if it is not a number or not usable (`is_usable`).

    Examples
    --------
    >>> number_of("12.5"), number_of("twelve")
    (12.5, nan)
    """
    number = _float(text)
    return number if is_usable(number) else math.nan


def _float(text: str | float) -> float:
    try:
        return float(text)
    except (ValueError, OverflowError):
        return math.nan


def numbers_of(text: str) -> list[float]:
    """Return the numbers of a list with commas, each by `number_of`.

    Examples
    --------
    >>> numbers_of("10,12.5")
    [10.0, 12.5]
    """
    return [number_of(part) for part in text.split(",")]


def height_range(text: str) -> tuple[float, float]:
    """Return the lowest and the highest ground (m) that a user states as ``low,high``.

    Raises
    ------
    InputError
        If these are not two rising numbers.

    Examples
    --------
    >>> height_range("0,800")
    (0.0, 800.0)
    """
    numbers = numbers_of(text)
    if len(numbers) != 2 or not numbers[0] < numbers[1]:
        raise InputError(
            f"{text!r} is not a height range", field="heights", remedy="give low,high in metres, such as heights=0,800"
        )
    return numbers[0], numbers[1]


def pose_sigmas(text: str) -> tuple[float, float]:
    """Return the standard deviations of positions (m) and angles (degrees) that a user states as ``metres,degrees``.

    Raises
    ------
    InputError
        If these are not two positive numbers.

    Examples
    --------
    >>> pose_sigmas("0.1,0.02")
    (0.1, 0.02)
    """
    numbers = numbers_of(text)
    if len(numbers) != 2 or not all(number > 0 for number in numbers):
        raise InputError(f"{text!r} are not two standard deviations", field="sigmas", remedy="give metres,degrees")
    return numbers[0], numbers[1]


@dataclass(frozen=True)
class Option:
    """The flag and help of a field, and the values that it may have.

    Parameters
    ----------
    flags : str
        Flags on the command line; messages show the first.
    help : str
        One sentence.
    metavar : str
        Placeholder of the value in the help; several forms are separated by bars.
    unset : str
        Behaviour without the option, if the default of the field does not show it.
    choices : sequence of str
        The only values.
    above, below : float, optional
        Bounds, themselves excluded.
    in_file : bool
        Whether it is a key of the pipeline file.
    """

    flags: str
    help: str = ""
    metavar: str | None = None
    unset: str = ""
    kind: Kind = "text"
    choices: Sequence[str] = ()
    above: float | None = None
    below: float | None = None
    in_file: bool = True


_T = TypeVar("_T")


def options_of(group: type) -> dict[str, Option]:
    """Return the option of each field of a group."""
    return {field.name: get_args(field.type)[1] for field in fields(group)}


def documented(group: type[_T]) -> type[_T]:
    """Add the parameters to the docstring of a group."""
    lines = []
    for one in fields(group):  # type: ignore[arg-type]
        option: Option = get_args(one.type)[1]
        text = " ".join(part for part in (option.help, option.unset and f"Default: {option.unset}.") if part)
        kind = (
            f"{{{', '.join(map(repr, option.choices))}}}"
            if option.choices
            else inspect.formatannotation(get_args(one.type)[0])
        )
        lines.append(f"{one.name} : {kind}\n    {text}")
    text, heading, examples = inspect.cleandoc(str(group.__doc__)).partition("\n\nExamples\n")
    group.__doc__ = f"{text}\n\nParameters\n----------\n" + "\n".join(lines) + heading + examples
    types = {field.name: get_args(field.type)[0] for field in fields(group)}  # type: ignore[arg-type]
    group.__init__.__annotations__ = {**types, "return": None}
    group.__init__ = _checking(group.__init__)  # type: ignore[method-assign]
    group.__repr__ = _as_called  # type: ignore[method-assign]
    return group


def _as_called(self: Any) -> str:
    """Return the call that makes these options, without defaults."""
    defaults = {
        field.name: field.default if field.default_factory is MISSING else field.default_factory()
        for field in fields(self)
    }
    values = ((name, getattr(self, name)) for name in defaults)
    return (
        f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in values if value != defaults[name])})"
    )


#: What a value of a kind is called; texts and files have the types of their field.
_FORMS = {
    "number": "a number",
    "integer": "a whole number",
    "bytes": "a whole number of bytes",
    "pair": "a list of two numbers",
    "box": "a list of four numbers: xmin, ymin, xmax, ymax",
    "one or two": "a number or a list of two",
    "number or word": "a number or a text",
    "number or nan": "a number",
    "integers": "a list of whole numbers",
    "files": "a list of files",
    "folders": "a list of folders",
    "keys": "a mapping of names to texts",
}


def _checking(init: Any) -> Any:
    """Return an ``__init__`` that refuses values of a wrong type; NumPy's values and CRSs become plain ones."""

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **kwargs: Any) -> None:
        init(self, *args, **kwargs)
        for name, option in options_of(type(self)).items():
            value, kind = getattr(self, name), self.__init__.__annotations__[name]
            plain = _plain(value, option.kind, kind)
            fits = plain is None or _fits(plain, option.kind, kind)
            if not fits or not _within(plain, option):
                form = "True or False" if kind is bool else "a path" if os.PathLike in _types(kind) else "a text"
                form = _FORMS.get(option.kind, form) + (_range_of(option) if fits else "")
                form = " or ".join(option.choices) or form
                group = type(self).__name__.removesuffix("Options").lower()
                group = {"point": "points", "block": "points"}.get(group, group)
                raise InputError(f"{reprlib.repr(value)} is not {form}", field=f"{group}.{name}", remedy=f"give {form}")
            object.__setattr__(self, name, plain)

    return checked


def _within(value: Any, option: Option) -> bool:
    """Return whether a text is a choice of its option, and a single number between its bounds."""
    if option.choices and value is not None:
        if option.metavar:  # as on the command line
            return str(value).lower() in (choice.lower() for choice in option.choices)
        return value in option.choices
    if not isinstance(value, int | float) or option.above is option.below is None:
        return True
    low, high = -math.inf if option.above is None else option.above, math.inf if option.below is None else option.below
    return low < value < high


def _range_of(option: Option) -> str:
    bounds = (("above", option.above), ("below", option.below))
    return "".join(f" {word} {bound:,.10g}" for word, bound in bounds if bound is not None)


def _plain(value: Any, form: Kind, kind: Any) -> Any:
    if isinstance(value, type):
        return value
    if hasattr(value, "tolist"):  # of NumPy, which a record cannot hold
        value = value.tolist()
    elif hasattr(value, "to_wkt"):  # a CRS of pyproj
        value = value.to_string()
    elif type(value) in (list, tuple):
        value = type(value)(_plain(one, form, kind) for one in value)
    elif isinstance(value, Mapping):
        return {name: _plain(one, "text", str) for name, one in value.items()}
    return str(value) if _is_number(value) and form == "text" and kind is not bool else value


def _is_number(value: Any) -> bool:
    """Return whether this is a number, and no truth value, that a float can hold."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and not sys.float_info.max < abs(value) < math.inf


def _types(kind: Any) -> set[Any]:
    members = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    return {get_origin(member) or member for member in members}


def _is_path(value: object) -> bool:
    return isinstance(value, str | os.PathLike) and "\0" not in os.fspath(value)


def _fits(value: Any, form: Kind, kind: Any) -> bool:
    """Return whether a value has the type of its field, and as many numbers as its form needs."""
    types = _types(kind)
    if isinstance(value, bool):
        return bool in types
    if isinstance(value, str) and (form == "number or nan" or "\0" in value):
        return form == "number or nan" and (value.lower() == "nan" or not math.isnan(_float(value)))
    if form in ("text", "file") and kind is not bool:
        return isinstance(value, (*types, os.PathLike))
    if isinstance(value, int | float):
        number = bool(types & {float, bool} or form == "number or word" or (int in types and isinstance(value, int)))
        return number and (kind is bool or _is_number(value))
    if isinstance(value, str):
        return str in types
    return os.PathLike in types if isinstance(value, os.PathLike) else _all_fit(value, form, types)


def _all_fit(values: Any, form: Kind, types: set[Any]) -> bool:
    """Return whether values are as many, and of the type, as their form needs."""
    if isinstance(values, Mapping):
        return Mapping in types and all(isinstance(name, str) and _is_path(one) for name, one in values.items())
    if isinstance(values, bytes) or not isinstance(values, Sequence):
        return False
    if form in ("files", "folders"):
        return all(map(_is_path, values))
    counts = {"pair": (2,), "box": (4,), "one or two": (2,), "integers": range(1, 1000)}.get(form, ())
    numbers = all(map(_is_number, values)) and (form != "integers" or all(isinstance(one, int) for one in values))
    return len(values) in counts and numbers
