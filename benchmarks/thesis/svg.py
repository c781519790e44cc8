"""Small diagrams as SVG: axes, lines, steps, boxes. Enough for these figures, and no library to install."""

from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

COLOURS = ("#3f51b5", "#e65100", "#2e7d32", "#8e24aa")
_INK = "#555"
_GRID = "#ccc"


class Plot:
    """A diagram with a linear scale on either axis, from `x[0]` to `x[1]` and `y[0]` to `y[1]`."""

    def __init__(
        self,
        title: str,
        x: tuple[float, float],
        y: tuple[float, float],
        *,
        labels: tuple[str, str] = ("", ""),
        size: tuple[int, int] = (720, 300),
        legend: float = 0.78,
    ) -> None:
        """`size` in pixels; `legend`: where it begins, as a share of the width."""
        self._parts: list[str] = []
        self._title = title
        self._labels = labels
        self._x, self._y = x, y
        self._size = size
        self._left, self._right, self._top, self._bottom = 64, size[0] - 16, 34, size[1] - 46
        self._legend = self._left + legend * (self._right - self._left)
        self._named = 0

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where a point lies on the paper."""
        (x0, x1), (y0, y1) = self._x, self._y
        across = self._left + (x - x0) / (x1 - x0) * (self._right - self._left)
        return across, self._bottom - (y - y0) / (y1 - y0) * (self._bottom - self._top)

    def ticks(self, xs: Sequence[tuple[float, str]], ys: Sequence[tuple[float, str]] = ()) -> None:
        """Marks on the axes, with a line across for each on the y axis."""
        for value, text in xs:
            across, _ = self.at(value, 0)
            self.text(across, self._bottom + 16, text, anchor="middle")
            self.stroke([(across, self._bottom), (across, self._bottom + 4)], _INK)
        for value, text in ys:
            _, down = self.at(0, value)
            self.text(self._left - 6, down + 4, text, anchor="end")
            self.stroke([(self._left, down), (self._right, down)], _GRID)

    def line(self, points: Sequence[tuple[float, float]], colour: str, *, dash: str = "", dots: bool = False) -> None:
        """Points with lines between them."""
        places = [self.at(x, y) for x, y in points]
        self.stroke(places, colour, dash=dash, width=2)
        for across, down in places if dots else []:
            self._parts.append(f'<circle cx="{across:.1f}" cy="{down:.1f}" r="3" fill="{colour}"/>')

    def steps(self, bins: Sequence[tuple[float, float]], width: float, colour: str) -> None:
        """A histogram: (left end, height) of each bin, in order and without holes."""
        points = [(bins[0][0], self._y[0])]
        for left, height in bins:
            points += [(left, height), (left + width, height)]
        self.line([*points, (bins[-1][0] + width, self._y[0])], colour)

    def box(self, x: tuple[float, float], y: tuple[float, float], colour: str, text: str = "") -> None:
        """A filled box, and what is written in it."""
        left, bottom = self.at(x[0], y[0])
        right, top = self.at(x[1], y[1])
        self._parts.append(
            f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" height="{bottom - top:.1f}" '
            f'fill="{colour}" stroke="#fff" stroke-width="0.5"/>'
        )
        if text:
            self.text((left + right) / 2, (top + bottom) / 2 + 4, text, anchor="middle", colour="#fff")

    def name(self, text: str, colour: str, *, dash: str = "") -> None:
        """One line of the legend."""
        down = self._top + 10 + 16 * self._named
        self._named += 1
        self.stroke([(self._legend, down), (self._legend + 24, down)], colour, dash=dash, width=2)
        self.text(self._legend + 30, down + 4, text)

    def note(self, x: float, y: float, text: str, *, anchor: str = "start") -> None:
        """Words at a point of the diagram."""
        across, down = self.at(x, y)
        self.text(across, down, text, anchor=anchor)

    def text(self, across: float, down: float, text: str, *, anchor: str = "start", colour: str = _INK) -> None:
        """Words at a place on the paper."""
        self._parts.append(
            f'<text x="{across:.1f}" y="{down:.1f}" text-anchor="{anchor}" fill="{colour}">{escape(text)}</text>'
        )

    def stroke(self, places: Sequence[tuple[float, float]], colour: str, *, dash: str = "", width: float = 1) -> None:
        """Lines between places on the paper."""
        points = " ".join(f"{across:.1f},{down:.1f}" for across, down in places)
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width:g}"{dashed}/>'
        )

    def write(self, path: Path) -> None:
        """Put it into a file."""
        width, height = self._size
        frame = [(self._left, self._top), (self._left, self._bottom), (self._right, self._bottom)]
        self.stroke(frame, _INK)
        middle = (self._left + self._right) / 2
        self.text(middle, 18, self._title, anchor="middle")
        self.text(middle, height - 8, self._labels[0], anchor="middle")
        self.text(6, 18, self._labels[1])
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'font-family="sans-serif" font-size="12">'
        )
        background = f'<rect width="{width}" height="{height}" fill="#fff"/>'
        path.write_text("\n".join([head, background, *self._parts, "</svg>"]) + "\n")
