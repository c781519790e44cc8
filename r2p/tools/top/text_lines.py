"""Lines of text above and below the tables: what is shown, the keys, and messages."""

from rich.segment import Segment
from rich.text import Text
from textual import events
from textual.strip import Strip
from textual.widget import Widget

from r2p.log_lines import printable


class TextLines(Widget):
    """Lines of text, drawn when they change; as high as they are many."""

    DEFAULT_CSS = "TextLines { height: 1; }"

    def __init__(self, *lines: str | Text, id: str | None = None) -> None:
        super().__init__(id=id)
        self._lines = [_text(each) for each in lines]

    def on_mount(self) -> None:
        """Take the height of the lines."""
        self.styles.height = len(self._lines) or 1

    def show(self, *lines: str | Text) -> None:
        """Show these lines instead."""
        texts = [_text(each) for each in lines]
        if texts == self._lines:
            return
        if len(texts) != len(self._lines):
            self.styles.height = len(texts) or 1
        self._lines = texts
        self.refresh()

    @property
    def plain(self) -> str:
        """What is shown, without colours."""
        return "\n".join(each.plain for each in self._lines)

    def render_line(self, y: int) -> Strip:
        """Return one line."""
        if y >= len(self._lines):
            return Strip.blank(self.size.width, self.rich_style)
        text = self._lines[y].copy()
        text.truncate(self.size.width, overflow="ellipsis", pad=True)
        base = self.rich_style
        segments = text.render(self.app.console)
        return Strip([Segment(part, base + style if style else base) for part, style, _ in segments])


class KeyLine(TextLines):
    """The keys, at the bottom. A message takes their place until a key is pressed."""

    def __init__(self, keys: str, *, id: str | None = None) -> None:
        super().__init__(id=id)
        self._keys = _keys(keys)
        self._lines = [self._keys]

    def say(self, message: str) -> None:
        """Show a message."""
        self.show(Text(printable(message), style="bold yellow"))

    def show_keys(self) -> None:
        """Show the keys again."""
        self.show(self._keys)

    def on_print(self, event: events.Print) -> None:
        """Show what the program prints, such as its log: written to the terminal it would tear the screen apart."""
        lines = event.text.strip().splitlines()
        if lines:
            self.say(lines[-1])


def _text(given: str | Text) -> Text:
    """Return a text without characters that move the cursor."""
    return given if isinstance(given, Text) else Text(printable(given))


def _keys(given: str) -> Text:
    """Return "q quit  ? help" with the keys highlighted: the first word of each part."""
    text = Text()
    for part in given.split("  "):
        key, _, what = part.partition(" ")
        text.append(key, style="bold cyan").append(f" {what}  ")
    return text
