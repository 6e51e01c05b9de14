"""A drawing of lines, marks and text that can be shown as SVG or PNG.

The colours are CSS variables, so that one drawing suits a light page, a dark one and paper, and text stays text. Each
kind of thing has its look in one table, which the SVG style sheet and the PNG are both made from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, installing

#: Variables of the page and what they are outside of it.
_COLOURS = {"control": "#2563a8", "check": "#b4500b", "paper": "#ffffff", "ink": "#1b1f24", "stop": "#b3261e"}


@dataclass(frozen=True)
class Look:
    """Stroke and fill by name of colour (None for none), opacities, width and dashes in CSS pixels."""

    stroke: str | None = None
    fill: str | None = None
    width: float = 1.0
    stroke_opacity: float = 1.0
    fill_opacity: float = 1.0
    dash: str = ""


LOOKS = {
    "frame": Look("ink", None, 1.0, 0.45),
    "grid": Look("ink", None, 1.0, 0.13),
    "axis": Look("ink", None, 1.0, 0.5),
    "guide": Look("ink", None, 1.0, 0.55, dash="4 4"),
    "hull": Look("control", "control", 1.0, 0.35, 0.07, dash="5 4"),
    "control": Look("control", "control", 1.7),
    "check": Look("check", "paper", 1.8),
    "check-line": Look("check", None, 1.7),
    "check-head": Look(None, "check"),
    "control-head": Look(None, "control"),
    "loo": Look("control", "paper", 1.7),
    "out": Look("ink", None, 1.6, 0.6),
    "doubted": Look("stop", None, 2.4),
    "bar": Look("ink", "ink", 1.7),
    "rule": Look("ink", None, 1.7),
    "casing": Look("paper", None, 4.4, 0.6),
    "halo": Look(None, "paper", fill_opacity=0.45),
    "graticule": Look("ink", None, 0.8, 0.45),
    "land": Look(None, "ink", fill_opacity=0.22),
    "plus": Look(None, "control"),
    "minus": Look(None, "check"),
    "control-dash": Look("control", None, 1.7, dash="6 4"),
    "check-dash": Look("check", None, 1.7, dash="6 4"),
    "chance": Look(None, "ink", fill_opacity=0.1),
    "chosen": Look(None, "control", fill_opacity=0.1),
    "link": Look("ink", None, 1.2, 0.4),
    "link-wide": Look("ink", None, 3.2, 0.4),
    "weak": Look("stop", None, 3.2),
    "tie-mark": Look(None, "ink", fill_opacity=0.7),
    "outline-0": Look("ink", "ink", 1.8, 0.8, 0.04),
    "outline-1": Look("ink", "ink", 1.8, 0.8, 0.04, dash="7 3"),
    "outline-2": Look("ink", "ink", 1.8, 0.8, 0.04, dash="2 3"),
    "outline-3": Look("ink", "ink", 1.1, 0.5, 0.04),
    "outline-4": Look("ink", "ink", 1.1, 0.5, 0.04, dash="7 3"),
    "outline-5": Look("ink", "ink", 1.1, 0.5, 0.04, dash="2 3"),
    "series-0": Look("control", None, 1.9),
    "series-1": Look("check", None, 1.9),
    "series-2": Look("ink", None, 1.6, 0.75),
    "series-3": Look("control", None, 1.9, dash="7 3"),
    "series-4": Look("check", None, 1.9, dash="7 3"),
    "series-5": Look("ink", None, 1.6, 0.75, dash="7 3"),
    "series-6": Look("control", None, 1.9, dash="2 3"),
    "series-7": Look("check", None, 1.9, dash="2 3"),
    "series-8": Look("ink", None, 1.6, 0.75, dash="2 3"),
}
#: Width of a letter on average in a wide font, CSS px.
_LETTER = 7.4
#: Height of a line of names, CSS px.
_LINE = 12.0
_FONT = 'system-ui,-apple-system,"Segoe UI",Roboto,sans-serif'


@dataclass
class Drawing:
    """Things in drawing order; x to the right, y down, in CSS pixels."""

    width: float
    height: float
    label: str
    name: str
    items: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    #: Where names are: the first x, the baseline and the last x.
    names: list[tuple[float, float, float]] = field(default_factory=list)

    def line(self, kind: str, x1: float, y1: float, x2: float, y2: float) -> None:
        """Draw a line."""
        self.items.append(("line", {"kind": kind, "xy": [(x1, y1), (x2, y2)]}))

    def path(self, kind: str, *lines: Sequence[tuple[float, float]], closed: bool = False) -> None:
        """Draw one or several polylines as one thing."""
        self.items.append(("path", {"kind": kind, "lines": lines, "closed": closed}))

    def circle(self, kind: str, x: float, y: float, radius: float) -> None:
        """Draw a circle."""
        self.items.append(("circle", {"kind": kind, "x": x, "y": y, "r": radius}))

    def rect(self, kind: str, x: float, y: float, wide: float, tall: float, strength: float = 1.0) -> None:
        """Draw a rectangle whose fill has the opacity `strength` times that of its kind."""
        self.items.append(("rect", {"kind": kind, "x": x, "y": y, "w": wide, "h": tall, "strength": strength}))

    def text(
        self, x: float, y: float, text: str, *, anchor: str = "start", quiet: bool = False, turn: bool = False
    ) -> None:
        """Write text at its baseline; `turn` writes upwards."""
        self.items.append(("text", {"x": x, "y": y, "text": text, "anchor": anchor, "quiet": quiet, "turn": turn}))

    def caption(self, x: float, y: float, text: str, gap: float, *, left: bool, quiet: bool = False) -> None:
        """Write a name to the left or right of `x`, on the other side where only that has room for it.

        A name that would cover another one on both sides is left out: neither could be read.
        """
        size = gap + _LETTER * len(text)
        fits_left, fits_right = x >= size, x + size <= self.width
        left = (left and fits_left) or (not fits_right and (fits_left or x > self.width / 2))
        for side in (left, not left):
            start = x - size if side else x + gap
            box = (start, y, start + _LETTER * len(text))
            fits = side == left or (fits_left if side else fits_right)
            if fits and not any(abs(y - v) < _LINE and start < end and begin < box[2] for begin, v, end in self.names):
                self.names.append(box)
                self.text(x - gap if side else x + gap, y, text, anchor="end" if side else "start", quiet=quiet)
                return

    @contextmanager
    def titled(self, title: str, *, key: int | None = None) -> Iterator[None]:
        """Show `title` where the pointer rests on what is drawn within; a page finds it by `key` (``data-point``)."""
        self.items.append(("open", {"title": title, "key": key}))
        yield
        self.items.append(("close", {}))

    def arrow(self, kind: str, x: float, y: float, dx: float, dy: float) -> None:
        """Draw an arrow; nothing where it would be shorter than a pixel."""
        length = math.hypot(dx, dy)
        if length < 1.0:
            return
        ux, uy = dx / length, dy / length
        head = min(8.0, 0.6 * length + 2.0)
        tip_x, tip_y = x + dx, y + dy
        base_x, base_y, wing = tip_x - head * ux, tip_y - head * uy, 0.42 * head
        self.line("check-line" if kind == "check" else kind, x, y, base_x, base_y)
        points = [(tip_x, tip_y), (base_x - wing * uy, base_y + wing * ux), (base_x + wing * uy, base_y - wing * ux)]
        self.path(kind if kind == "bar" else f"{kind}-head", points, closed=True)

    def mark(self, kind: str, x: float, y: float) -> None:
        """Draw the mark of a point: a dot for control, a square for check, a cross for what is left out."""
        if kind == "out":
            self.path("out", [(x - 4.5, y - 4.5), (x + 4.5, y + 4.5)], [(x + 4.5, y - 4.5), (x - 4.5, y + 4.5)])
        elif kind == "check":
            self.rect("check", x - 3.6, y - 3.6, 7.2, 7.2)
        else:
            self.circle(kind, x, y, 3.4)

    # -- SVG ---------------------------------------------------------------------------------------------------------

    def svg(self, *, alone: bool = False) -> str:
        """Return the drawing as SVG: for a page, or `alone` with colours that every program knows."""
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" class="plot" viewBox="0 0 {self.width:.0f} {self.height:.0f}" '
            + (f'width="{self.width:.0f}" height="{self.height:.0f}" ' if alone else "")
            + f'role="img" aria-label="{escape(self.label)}" data-plot="{self.name}">'
        ]
        if alone:
            style = style_sheet(alone=True)
            parts.append(f'<style>{style}</style><rect width="100%" height="100%" fill="{_COLOURS["paper"]}"/>')
        parts += [_svg_item(what, **given) for what, given in self.items]
        return "\n".join([*parts, "</svg>"])

    # -- PNG ---------------------------------------------------------------------------------------------------------

    def png(self, *, scale: float = 2.0) -> bytes:
        """Return the drawing as PNG of `scale` pixels per CSS pixel.

        Raises
        ------
        InputError
            If matplotlib is not installed.
        """
        import io

        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise InputError(
                "PNG output needs matplotlib, which is not installed",
                field="kind",
                remedy=Text(f"{installing('plots')}, or use ", Setting("kind", "svg")),
            ) from error
        figure = Figure(figsize=(self.width / 100, self.height / 100), dpi=100 * scale, facecolor=_COLOURS["paper"])
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_xlim(0, self.width)
        axes.set_ylim(self.height, 0)
        axes.set_axis_off()
        for order, (what, given) in enumerate(self.items):
            _paint(axes, what, order, **given)
        out = io.BytesIO()
        FigureCanvasAgg(figure).print_png(out)
        return out.getvalue()


def style_sheet(*, alone: bool = False) -> str:
    """Return the CSS of all kinds of things."""

    def colour(name: str | None) -> str:
        if name is None:
            return "none"
        return _COLOURS[name] if alone else f"var(--{name})"

    rules = [f".plot text{{font:12px {_FONT};fill:{colour('ink')}}}", ".plot .quiet{opacity:.65}"]
    for kind, look in LOOKS.items():
        rule = f"fill:{colour(look.fill)};stroke:{colour(look.stroke)};stroke-width:{look.width}"
        if look.stroke_opacity != 1:
            rule += f";stroke-opacity:{look.stroke_opacity}"
        if look.fill_opacity != 1:
            rule += f";fill-opacity:{look.fill_opacity}"
        rules.append(f".plot .{kind}{{{rule}{f';stroke-dasharray:{look.dash}' if look.dash else ''}}}")
    return "\n".join(rules)


def _svg_item(what: str, **given: Any) -> str:
    makers: dict[str, Callable[..., str]] = {
        "open": _svg_group,
        "close": lambda: "</g>",
        "line": _svg_line,
        "path": _svg_path,
        "circle": lambda kind, x, y, r: f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{r:.1f}"/>',
        "rect": _svg_rect,
        "text": _svg_text,
    }
    return makers[what](**given)


def _svg_group(title: str, key: int | None) -> str:
    found = "" if key is None else f' data-point="{key}"'
    return f"<g{found}><title>{escape(title)}</title>"


def _svg_line(kind: str, xy: list[tuple[float, float]]) -> str:
    (x1, y1), (x2, y2) = xy
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _svg_path(kind: str, lines: Sequence[Sequence[tuple[float, float]]], closed: bool) -> str:
    end = "Z" if closed else ""
    data = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line) + end for line in lines)
    return f'<path class="{kind}" d="{data}"/>'


def _svg_rect(kind: str, x: float, y: float, w: float, h: float, strength: float) -> str:
    fill = "" if strength == 1 else f' fill-opacity="{strength:.3f}"'
    return f'<rect class="{kind}" x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}"{fill}/>'


def _svg_text(x: float, y: float, text: str, anchor: str, quiet: bool, turn: bool) -> str:
    place = f'transform="translate({x:.1f} {y:.1f}) rotate(-90)"' if turn else f'x="{x:.1f}" y="{y:.1f}"'
    kind = ' class="quiet"' if quiet else ""
    return f'<text{kind} {place} text-anchor="{anchor}">{escape(text)}</text>'


def _paint(axes: Any, what: str, order: int, **given: Any) -> None:
    """Paint one thing with matplotlib."""
    from matplotlib.patches import Circle, PathPatch, Rectangle
    from matplotlib.path import Path

    if what in ("open", "close"):
        return
    if what == "text":
        axes.text(
            given["x"],
            given["y"],
            given["text"],
            fontsize=12 * 0.72,
            color=_COLOURS["ink"],
            zorder=order,
            ha={"start": "left", "middle": "center", "end": "right"}[given["anchor"]],
            va="baseline",
            alpha=0.65 if given["quiet"] else 1.0,
            rotation=90 if given["turn"] else 0,
            rotation_mode="anchor",
            parse_math=False,
        )
        return
    look = LOOKS[given["kind"]]
    style: dict[str, Any] = {
        "edgecolor": _rgba(look.stroke, look.stroke_opacity),
        "facecolor": _rgba(look.fill, look.fill_opacity * given.get("strength", 1.0)),
        "linewidth": look.width * 0.72,
        "linestyle": (0, tuple(float(part) / look.width for part in look.dash.split())) if look.dash else "-",
        "zorder": order,
    }
    if what == "circle":
        axes.add_patch(Circle((given["x"], given["y"]), given["r"], **style))
    elif what == "rect":
        axes.add_patch(Rectangle((given["x"], given["y"]), given["w"], given["h"], **style))
    else:
        lines = [given["xy"]] if what == "line" else given["lines"]
        parts = [Path([*line, line[0]] if given.get("closed") else line) for line in map(list, lines)]
        if what == "line":
            style["facecolor"] = "none"
        axes.add_patch(PathPatch(Path.make_compound_path(*parts), **style))


def _rgba(name: str | None, opacity: float) -> Any:
    if name is None:
        return "none"
    code = _COLOURS[name]
    return (*(int(code[k : k + 2], 16) / 255 for k in (1, 3, 5)), opacity)


# -- axes --------------------------------------------------------------------------------------------------------------


class Axes:
    """A frame (x, y, width, height) in a drawing, and the values at its sides."""

    def __init__(
        self, drawing: Drawing, frame: tuple[float, ...], x: tuple[float, float], y: tuple[float, float]
    ) -> None:
        self.drawing, self.frame, self.x, self.y = drawing, frame, x, y

    def at(self, x: float, y: float) -> tuple[float, float]:
        left, top, wide, tall = self.frame
        return (
            left + wide * (x - self.x[0]) / (self.x[1] - self.x[0]),
            top + tall * (self.y[1] - y) / (self.y[1] - self.y[0]),
        )

    def draw(self, x_name: str, y_name: str, *, margin: float = 0.0) -> None:
        """Draw frame, grid and numbers; `margin` is where the drawing's part for this frame begins."""
        left, top, wide, tall = self.frame
        for value in ticks(*self.x):
            x, _ = self.at(value, self.y[0])
            self.drawing.line("guide" if value == 0 else "grid", x, top, x, top + tall)
            self.drawing.text(x, top + tall + 16, number(value), anchor="middle", quiet=True)
        for value in ticks(*self.y):
            _, y = self.at(self.x[0], value)
            self.drawing.line("guide" if value == 0 else "grid", left, y, left + wide, y)
            self.drawing.text(left - 6, y + 4, number(value), anchor="end", quiet=True)
        self.drawing.rect("frame", left, top, wide, tall)
        self.drawing.text(left + wide / 2, top + tall + 36, x_name, anchor="middle")
        self.drawing.text(margin + 13, top + tall / 2, y_name, anchor="middle", turn=True)


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Return round numbers between two values, some `about` of them."""
    step = round_down((high - low) / about * 1.6)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]


def number(value: float) -> str:
    """Return a tick as people write it."""
    return f"{value:g}".replace("-", "−")


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)):.6g}")
