"""The code blocks of the documentation, as its tests see them.

A block is what stands between two fences. Its language says how it is tested:

| language | test |
| --- | --- |
| python | executed under virtual time, in a namespace of its own; and type-checked |
| console | `$ command`, then what it prints: run in a shell of the page, in the page's order |
| toml | parsed |
| csv | a file for the commands of its page |
| json5 | a configuration of zenoh: loaded, and tried in `test_zenoh` |
| text, c, ini | not tested, unless a note says so |

`title="blink.py"` behind the language makes the block a file of that name for the commands of its page. HTML comments
right before a block are notes, `<!-- key -->` or `<!-- key: value -->`:

| note | meaning |
| --- | --- |
| `continues` | python: in the namespace of the page's block before |
| `output` | text: what the python block before prints |
| `pytest` | python: a file of tests, run by pytest |
| `frames: codec` | text: pairs of a message and its bytes, checked against `r2p.codecs` |
| `recorded` | text: lines of the original firmware, looked up in the recordings |
| `keeps running` | console: the last command goes on to the end of the page |
| `exits: 3` | console: the exit code of its commands, else 0 |
| `not run: why` | console: shown, but not run |
| `compiled` | c: compiled together with the others of the page, and called |

A block that consists of `--8<-- "FILE"` shows a file, which has tests of its own, and is not seen here.

In what a block prints, `...` stands for any text in a line, and alone in a line for any lines; columns may be wider,
and where a machine is slow, a command may say what it waits for, such as a program that does not listen yet.
"""

import re
import textwrap
from functools import cache
from pathlib import Path

import msgspec

ROOT = Path(__file__).parents[2]
LANGUAGES = {"python", "console", "toml", "csv", "json5", "text", "c", "hex", "ini"}
NOTES = {"continues", "output", "pytest", "frames", "recorded", "keeps running", "exits", "not run", "compiled"}

_FENCE = re.compile(
    r"^(?P<indent> *)```(?P<info>[^`\n]*)\n(?P<text>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
_NOTES = re.compile(r"(?:^ *<!-- [^\n]* -->\n+)+\Z", re.MULTILINE)
_NOTE = re.compile(r"<!-- ([a-z ]+)(?:: (.*))? -->")
_WAITING = "(?:r2p: (?:waiting for .*|warning: link .*: Connection refused: .*)\n)*"
_TITLE = re.compile(r'title="([^"]+)"')
_FILE = re.compile(r'\s*--8<-- "[^"\n]*"\s*')


class Block(msgspec.Struct, frozen=True):
    """One block; `line` is its first line in the page, from 1."""

    page: Path
    line: int
    language: str
    title: str
    notes: dict[str, str]
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def name(self) -> str:
        """A name for the block as a module."""
        return f"{self.page.relative_to(ROOT).with_suffix('')}_{self.line}".replace("/", "_").replace("-", "_")


def pages() -> list[Path]:
    """All pages for users."""
    return [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]


@cache
def of_page(page: Path) -> tuple[Block, ...]:
    """The blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return tuple(_block(page, text, fence) for fence in _FENCE.finditer(text) if not _FILE.fullmatch(fence["text"]))


def blocks(language: str) -> list[Block]:
    """The blocks of all pages in that language."""
    return [block for page in pages() for block in of_page(page) if block.language == language]


def _block(page: Path, text: str, fence: re.Match[str]) -> Block:
    language, _, attributes = fence["info"].strip().partition(" ")
    title = _TITLE.search(attributes)
    before = _NOTES.search(text[: fence.start()])
    return Block(
        page=page,
        line=text.count("\n", 0, fence.start("text")) + 1,
        language=language,
        title=title[1] if title else "",
        notes={note[1]: note[2] or "" for note in _NOTE.finditer(before[0])} if before else {},
        text=textwrap.dedent(fence["text"]),
    )


def pattern(shown: str) -> re.Pattern[str]:
    """What a shown output matches."""
    return re.compile("".join(f"{_WAITING}{_line_pattern(line)}" for line in shown.splitlines()))


def _line_pattern(line: str) -> str:
    if line.strip() == "...":
        return "(?:.*\n)*?"
    text = ".*?".join(map(re.escape, line.rstrip().split("...")))
    return re.sub(r"(?:\\ ){2,}", " {2,}", text) + " *\n"
