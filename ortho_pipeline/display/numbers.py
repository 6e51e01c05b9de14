"""Numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any


def flat(value: Any, name: str = "") -> Iterable[tuple[str, str]]:
    """Yield the leaves of nested values as (path of keys, text); what is None, off or empty is left out."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from flat(item, f"{name} · {key}" if name else str(key))
    elif isinstance(value, list):
        if value:
            yield name, ", ".join(str(item) for item in value)
    elif value is not None and value is not False:
        yield name, str(value)


def px(value: float) -> str:
    """Return pixels."""
    return f"{fixed(value)} px"


def metres(value: float) -> str:
    """Return metres."""
    return f"{value:.2f} m" if abs(value) < 10 else f"{value:.1f} m"


def significant(value: float, digits: int = 2) -> str:
    """Return a value with some significant digits: 0.48, 14, 1,100; with an exponent only below 0.0001."""
    return f"{float(f'{value:.{digits}g}'):,.15g}"


def size_m(value: float) -> str:
    """Return a size or an error in metres with two digits: 0.48 m, 2.5 m, 14 m."""
    return f"{significant(value)} m"


def area_km2(square_metres: float) -> str:
    """Return an area in square kilometres with two digits: 7.4 km², 0.62 km², 120 km²."""
    return f"{significant(square_metres / 1e6)} km²"


def class_size(centimetres: int) -> str:
    """Return an accuracy class: whole centimetres; from a metre on metres of three digits, rounded up."""
    if centimetres < 100:
        return f"{centimetres} cm"
    step = 10 ** max(0, len(str(centimetres)) - 3)
    up = -(-centimetres // step) * step
    return f"{up / 100:.{max(0, 5 - len(str(up)))}f} m"


def fixed(value: float | None) -> str:
    """Return a value with two significant digits, at least two decimals and at most four.

    >>> fixed(12.345), fixed(0.19), fixed(0.0758), fixed(0.00148), fixed(0.0)
    ('12.35', '0.19', '0.076', '0.0015', '0.00')
    """
    if value is None:
        return "–"
    # Below 1e-9 it is rounding, and "0.00" is not "0.0000".
    size = abs(value)
    return f"{value:.{2 if size >= 0.0995 or size < 1e-9 else 3 if size >= 0.00995 else 4}f}"


def signed(value: float | None) -> str:
    """Return a value with its sign and two decimals."""
    if value is None:
        return "–"
    text = f"{value:+.2f}"
    return "0.00" if text[1:] == "0.00" else text.replace("-", "−")


def short(value: float | None, sign: str = "") -> str:
    """Return three significant digits; from a thousand to ten millions in full, with commas."""
    if value is None:
        return "–"
    # 999.6 is 1,000 in three digits, which `g` would write as 1e+03.
    text = f"{value:{sign},.0f}" if 999.5 <= abs(value) < 1e7 else f"{value:{sign}.3g}"
    return text.replace("-", "−") if value else "0"


def share(value: float | None) -> str:
    """Return a share (0 to 1) in per cent."""
    if value is None:
        return "–"
    # "100 %" is only said where it is so.
    return "100 %" if value >= 1 else f"{min(math.floor(value * 1000) / 10, 99.9):.1f} %"


def size_text(size: Iterable[int]) -> str:
    """Return columns x rows."""
    return " x ".join(str(side) for side in size)


def plain_size(bytes_: float) -> str:
    """Return a number of bytes."""
    for unit in ("bytes", "kB", "MB"):
        if bytes_ < 1000:
            return f"{bytes_:.3g} {unit}"
        bytes_ /= 1000
    return f"{bytes_:.3g} GB"
