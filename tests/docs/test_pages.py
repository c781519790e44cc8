"""What the pages name exists: commands with their options, extras, parts of the benchmark, examples, and the names in
the tables of other libraries' calls and ours.
"""

import asyncio
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

import r2p
import r2p.ros
from benchmarks.__main__ import ALL
from r2p.msg import Led
from r2p.tools import main
from tests.docs.blocks import ROOT, of_page, pages
from tests.docs.commands import commands

DOCS = ROOT / "docs"
OPTIONS = {heading: {name for each in command.params for name in each.opts} for heading, command in commands()}
EVERYWHERE = {"--help", "-h"}
OF_R2P = {"--version", "--help", "-h", "--install-completion", "--show-completion"}

_INLINE = re.compile(r"(?<!`)`(r2p [^`]+)`(?!`)")
_IN_BLOCK = re.compile(r"(?:^|[ /])(r2p [a-z-].*)$", re.MULTILINE)
_END = re.compile(r"[|;&<>)]| 2>")
_OPTION = re.compile(r"(?<!\S)--?[a-z][a-z0-9-]*")
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")


def _named_commands(page: Path) -> Iterator[str]:
    """The commands in the sentences and blocks of a page, without what a shell makes of the rest of the line."""
    text = page.read_text(encoding="utf-8")
    inline = _INLINE.findall(re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL))
    shown = [
        line
        for block in of_page(page)
        if block.language in ("console", "text") and not block.notes.keys() & {"output", "recorded", "frames"}
        for line in _IN_BLOCK.findall(block.text.replace("\\\n", " "))
    ]
    for each in inline + shown:
        if "[OPTIONS]" not in each:  # else it is a line of a help text
            yield _END.split(_QUOTED.sub("Q", each.replace("\\", "")), maxsplit=1)[0]


@pytest.mark.parametrize("page", [page for page in pages() if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_every_command_that_a_page_names_exists(page: Path) -> None:
    for command in _named_commands(page):
        words = command.split()
        if words[1] in OF_R2P:
            continue
        assert words[1] in main.GROUPS | main.COMMANDS, f"{page.name}: {command}"
        heading = " ".join(words[: 3 if words[1] in main.GROUPS else 2])
        if words[1] in main.GROUPS and (len(words) == 2 or words[2] in EVERYWHERE):
            continue
        assert heading in OPTIONS, f"{page.name}: {command}"
        unknown = set(_OPTION.findall(command)) - OPTIONS[heading] - EVERYWHERE
        assert not unknown, f"{page.name}: {command}"


def test_the_extras_are_those_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    rows = dict(_rows(DOCS / "install.md", "extra"))
    assert {name.strip("`") for name in rows} == set(extras)
    named = {name.strip("`"): set(packages.split(", ")) for name, packages in rows.items() if name != "`all`"}
    wanted = {name: {re.split(r"[\[>]", each)[0] for each in extras[name]} for name in named}
    assert named == wanted


def test_the_page_on_performance_has_every_part_of_the_benchmark() -> None:
    assert [part.strip("`") for part, _ in _rows(DOCS / "performance.md", "part") if part] == list(ALL)


def test_every_example_is_on_the_page() -> None:
    included = re.findall(r'^--8<-- "(examples/.*)"$', (DOCS / "examples.md").read_text(), re.MULTILINE)
    assert sorted(included) == sorted(str(each.relative_to(ROOT)) for each in (ROOT / "examples").glob("*.py"))


def test_what_the_page_on_python_can_says_of_it() -> None:
    theirs = "\n".join(call for call, _ in _rows(DOCS / "coming-from" / "python-can.md", "python-can"))
    owners = {"can": can, "bus": can.BusABC, "message": can.Message}
    missing = {
        f"{owner}.{name}"
        for owner, name in re.findall(r"\b(can|bus|message)\.([A-Za-z_]+)", theirs)
        if not hasattr(owners[owner], name) and not hasattr(can.Message(), name)
    }
    assert missing == set()


@pytest.mark.virtual_time
@pytest.mark.parametrize("page", sorted((DOCS / "coming-from").glob("*.md")), ids=lambda page: page.stem)
async def test_our_side_of_the_tables_exists(page: Path) -> None:
    """Attributes of what a program holds, and names of the package."""
    ours = "\n".join(call for _, call in _rows(page, "rclpy", "rospy", "uROSnode", "pycyphal", "python-can"))
    async with r2p.Module("PC1", via="memory:lab") as module:
        node = module.start(_idle)
        subscriber = node.subscribe("leds", Led)
        publisher = node.advertise("leds", Led)
        await publisher.publish(Led())
        sample = subscriber.queue[0]
        owners = {
            "r2p": r2p,
            "module": module,
            "node": node,
            "publisher": publisher,
            "subscriber": subscriber,
            "sample": sample,
            "link": module.links[0],
        }
        named = re.findall(rf"(?<![\w./])({'|'.join(owners)})\.([A-Za-z_]\w*)", ours)
        assert len(named) > 10
        assert {f"{owner}.{name}" for owner, name in named if not hasattr(owners[owner], name)} == set()


def _rows(page: Path, *headers: str) -> Iterator[tuple[str, str]]:
    """The first two cells of the rows of the tables whose first column has one of these headers."""
    wanted = False
    for line in page.read_text(encoding="utf-8").splitlines():
        cells = [each.strip() for each in re.split(r"(?<!\\)\|", line)[1:3]]
        if not line.startswith("|"):
            wanted = False
        elif wanted and not cells[0].startswith("---"):
            yield cells[0], cells[1]
        elif cells[0] in headers:
            wanted = True


async def _idle(_node: r2p.Node) -> None:
    await asyncio.get_running_loop().create_future()
