"""A table that draws only what is on the screen, and of that only the lines that have changed.

Textual's DataTable keeps a cell object for each of a thousand topics, and lays out all of them for each update. Here a
row costs something only while it is visible: its texts are made anew each time, and compared with those on the screen.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

from rich.cells import cell_len, set_cell_size
from rich.segment import Segment
from rich.style import Style
from textual import events
from textual.binding import Binding, BindingType
from textual.geometry import Region
from textual.message import Message
from textual.strip import Strip
from textual.widget import Widget

from r2p.tools.top.drawing import shortened
from r2p.tools.top.tables import ALARM, OK, WARNING, Column, View

_NAME_MIN = 16  # characters of a name that are shown before columns are left out for it
_NAME_MAX = 60
_MARKS = {OK: " ", WARNING: "!", ALARM: "!"}  # colours alone would say nothing on a terminal without them
_STYLES = {OK: Style(), WARNING: Style(color="yellow"), ALARM: Style(color="red", bold=True)}
_HEAD = Style(bold=True, color="cyan")
_CURSOR = Style(reverse=True)


class _Line(NamedTuple):
    """What one line of the screen has."""

    text: str
    alarm: int = OK
    is_cursor: bool = False


class FiguresTable(Widget, can_focus=True):
    """The rows of a view, with a cursor that stays on its row when rows change places."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,k", "move(-1)", show=False),
        Binding("down,j", "move(1)", show=False),
        Binding("pageup", "page(-1)", show=False),
        Binding("pagedown", "page(1)", show=False),
        Binding("home", "move(-1000000000)", show=False),
        Binding("end", "move(1000000000)", show=False),
        Binding("left", "shift(-1)", show=False),
        Binding("right", "shift(1)", show=False),
        Binding("enter", "open", show=False),
    ]

    class Opened(Message):
        """A row was chosen."""

        def __init__(self, row: Any) -> None:
            super().__init__()
            self.row = row

    def __init__(self, view: View, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self.sorted_by: tuple[str, bool] = ("", False)
        """The name of the column that the rows are sorted by, and whether that is reversed: for the head."""
        self._view = view
        self._rows: Sequence[Any] = ()
        self._alarm: Callable[[Any], int] = view.alarm
        self._selected: str | None = None  # None: the first row, whichever it is
        self._cursor = 0
        self._first_row = 0
        self._first_column = 1  # behind the name
        self._lines: list[_Line] = []
        self._styles: dict[tuple[int, bool], Style] = {}
        """Those of the lines that were drawn last, by alarm and cursor."""

    # What it shows

    def show_view(self, view: View) -> None:
        """Show another table, from its beginning."""
        self._view = view
        self._selected, self._cursor, self._first_row, self._first_column = None, 0, 0, 1
        self._rows = ()

    def show(self, rows: Sequence[Any], alarm: Callable[[Any], int] | None = None) -> None:
        """Show rows in this order; `alarm` replaces that of the view."""
        self._rows = rows
        self._alarm = alarm or self._view.alarm
        if self._selected is not None:
            keys = (i for i, row in enumerate(rows) if self._view.key(row) == self._selected)
            self._cursor = next(keys, self._cursor)
        self._redraw()

    @property
    def selected(self) -> Any:
        """The row at the cursor; None without rows."""
        return self._rows[self._cursor] if self._rows else None

    def columns(self) -> list[Column]:
        """Return the columns that fit."""
        return [column for column, _ in self._layout()]

    def _redraw(self) -> None:
        """Draw the lines that differ from those on the screen."""
        self._cursor = max(0, min(self._cursor, len(self._rows) - 1))
        self._scroll()
        self._styles.clear()
        lines, before = self._made_lines(), self._lines
        self._lines = lines
        changed = [i for i, line in enumerate(lines) if i >= len(before) or before[i] != line]
        if len(lines) != len(before):
            self.refresh()
        elif changed:
            self.refresh(*(Region(0, i, self.size.width, 1) for i in changed))

    def _scroll(self) -> None:
        """Keep the cursor on the screen."""
        visible = self._visible()
        last = max(0, len(self._rows) - visible)
        self._first_row = max(0, min(self._first_row, self._cursor, last))
        self._first_row = max(self._first_row, self._cursor - visible + 1)

    def _visible(self) -> int:
        return max(1, self.size.height - 1)

    def _made_lines(self) -> list[_Line]:
        layout = self._layout()
        lines = [_Line(self._head(layout))]
        for i in range(self._first_row, min(len(self._rows), self._first_row + self._visible())):
            row = self._rows[i]
            alarm = self._alarm(row)
            cells = (_cell(column.text(row), column, width) for column, width in layout)
            lines.append(_Line(_MARKS[alarm] + " ".join(cells), alarm, i == self._cursor))
        return lines + [_Line("")] * (self.size.height - len(lines))

    def _head(self, layout: list[tuple[Column, int]]) -> str:
        name, reverse = self.sorted_by
        cells = []
        for column, width in layout:
            arrow = ("▲" if column.is_text != reverse else "▼") if column.name == name else ""
            cells.append(_cell(column.head[: width - len(arrow)] + arrow, column, width))
        return " " + " ".join(cells)

    def _layout(self) -> list[tuple[Column, int]]:
        """Return the columns that fit, and their widths; the name gets what is left, at most as much as it needs."""
        name, *others = self._view.columns
        left = self.size.width - 1
        longest = max((len(name.text(row)) for row in self._visible_rows()), default=0)
        wanted = max(name.width, min(longest, _NAME_MAX))
        chosen: list[tuple[Column, int]] = []
        for column in others[self._first_column - 1 :]:
            width = max(column.width, len(column.head))
            used = sum(each + 1 for _, each in chosen) + width + 1
            if left - used < (wanted if column.extra and self._first_column == 1 else min(wanted, _NAME_MIN)):
                break
            chosen.append((column, width))
        rest = left - sum(width + 1 for _, width in chosen)
        return [(name, max(1, min(rest, wanted))), *chosen]

    def _visible_rows(self) -> Sequence[Any]:
        return self._rows[self._first_row : self._first_row + self._visible()]

    def render_line(self, y: int) -> Strip:
        """Return one line: called by Textual for those that were refreshed."""
        line = self._lines[y] if y < len(self._lines) else _Line("")
        width = self.size.width
        return Strip([Segment(set_cell_size(line.text, width), self._style_of(y, line))], width)

    def _style_of(self, y: int, line: _Line) -> Style:
        if y == 0:
            return self.rich_style + _HEAD
        key = line.alarm, line.is_cursor
        style = self._styles.get(key)
        if style is None:  # which is found out only once for all lines that are drawn together: it takes long
            own = _STYLES[line.alarm] + (_CURSOR if line.is_cursor else Style())
            style = self._styles[key] = self.rich_style + own
        return style

    # Keys and mouse

    def on_resize(self) -> None:
        """Draw everything anew."""
        self._lines = []
        self._redraw()

    def on_click(self, event: events.Click) -> None:
        """Put the cursor on a row; the second click opens it."""
        index = self._first_row + event.y - 1
        if event.y == 0 or index >= len(self._rows):
            return
        if index == self._cursor and event.chain > 1:
            self.action_open()
        self._select(index)

    def on_mouse_scroll_down(self) -> None:
        """Move the cursor down."""
        self.action_move(3)

    def on_mouse_scroll_up(self) -> None:
        """Move the cursor up."""
        self.action_move(-3)

    def action_move(self, rows: int) -> None:
        """Move the cursor; on the first row it stays there, whichever row that is."""
        self._select(max(0, min(self._cursor + rows, len(self._rows) - 1)))

    def action_page(self, pages: int) -> None:
        """Move the cursor by what is visible."""
        self.action_move(pages * max(1, self._visible() - 1))

    def action_shift(self, columns: int) -> None:
        """Show columns further to the right, or to the left."""
        last = len(self._view.columns) - 1
        self._first_column = max(1, min(self._first_column + columns, last))
        self._redraw()

    def action_open(self) -> None:
        """Open the row at the cursor."""
        if self._rows:
            self.post_message(self.Opened(self.selected))

    def _select(self, index: int) -> None:
        self._cursor = index
        self._selected = self._view.key(self._rows[index]) if index and self._rows else None
        self._redraw()


def _cell(text: str, column: Column, width: int) -> str:
    """Return a text in a cell; names and texts to the left, numbers to the right."""
    size = len(text) if text.isascii() else cell_len(text)
    if size > width:
        return set_cell_size(shortened(text, width), width)
    return text + " " * (width - size) if column.is_text else " " * (width - size) + text
