"""The map of the code is true: the picture is that of the imports, and messages take the ways that the page shows."""

import ast
import asyncio
import importlib.util
import re
import sys
from types import FrameType, ModuleType

import pytest

import r2p
from r2p.testing.network import node_in
from tests.docs.blocks import ROOT

GUARD = 30.0  # s
PAGE = (ROOT / "docs" / "architecture.md").read_text()

_FILE = re.compile(r"`([a-z_/]+(?:\.py|/))`")
_PLACE = re.compile(r"`([a-z_/]+\.py)`, `([A-Za-z_.]+)`")


def _load_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("draw_architecture", ROOT / "docs" / "draw_architecture.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


@pytest.fixture(scope="module")
def script() -> ModuleType:
    pytest.importorskip("grimp")
    return _load_script()


def test_the_picture_is_that_of_the_code(script: ModuleType) -> None:
    drawn = (ROOT / "docs" / "assets" / "architecture.svg").read_text()
    assert drawn == script.draw(), "run `python docs/draw_architecture.py`"


def test_an_import_that_leads_upwards_is_refused(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    upside_down = dict(reversed(script.LAYERS.items()))
    monkeypatch.setattr(script, "LAYERS", upside_down)
    with pytest.raises(script.DrawingError, match="in a layer above its own"):
        script.draw()


def test_a_package_without_a_layer_is_refused(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    layers = {label: tuple(each for each in packages if each != "bus") for label, packages in script.LAYERS.items()}
    monkeypatch.setattr(script, "LAYERS", layers)
    with pytest.raises(script.DrawingError, match=r"r2p\.bus is in no layer"):
        script.draw()


@pytest.mark.parametrize("path", sorted(set(_FILE.findall(PAGE))))
def test_each_file_exists(path: str) -> None:
    root = ROOT if path.startswith(("docs/", "tests/")) else ROOT / "r2p"
    assert (root / path).exists()


@pytest.mark.parametrize(("path", "name"), sorted(set(_PLACE.findall(PAGE))))
def test_each_function_exists(path: str, name: str) -> None:
    scope: list[ast.stmt] = ast.parse((ROOT / "r2p" / path).read_text()).body
    for part in name.split("."):
        found = [
            each
            for each in scope
            if isinstance(each, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and each.name == part
        ]
        assert found, f"{path} has no {name}"
        scope = found[0].body


def test_the_vocabulary_has_about_forty_entries() -> None:
    words = PAGE.partition("## Vocabulary")[2].count("\n| ") - 2
    assert 35 <= words <= 45


def _walk(heading: str) -> list[tuple[str, str]]:
    """The files and functions of the first table under a heading, in order."""
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    return _PLACE.findall(section.partition("\n| 1 | ")[2].partition("\n\n")[0])


@pytest.fixture(scope="module")
async def called() -> set[tuple[str, str]]:
    """The functions that run while one message of a new type goes through TCP, from a publisher to a subscriber."""
    seen: set[tuple[str, str]] = set()
    root = f"{ROOT / 'r2p'}/"

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(root):
            seen.add((frame.f_code.co_filename.removeprefix(root), frame.f_code.co_qualname))

    sys.setprofile(note)
    try:
        await _send_one()
    finally:
        sys.setprofile(None)
    return seen


async def _send_one() -> None:
    class Walker(r2p.Message):
        steps: r2p.u32 = 0

    async with asyncio.timeout(GUARD), r2p.Module("A", via="tcp-listen:127.0.0.1:0", watchdog=False) as a:
        ((_, address),) = a.addresses
        async with r2p.Module("B", via=f"tcp:{address}", watchdog=False) as b, node_in(a) as one, node_in(b) as other:
            subscriber, publisher = one.subscribe("walks", Walker), other.advertise("walks", Walker)
            await publisher.wait_subscriber()
            await publisher.publish(Walker(9))
            async for message in subscriber:
                assert message == Walker(9)
                break


@pytest.mark.anyio
@pytest.mark.parametrize(("heading", "files"), [("A message in", 9), ("A message out", 8)])
async def test_a_message_takes_that_way(called: set[tuple[str, str]], heading: str, files: int) -> None:
    walk = _walk(heading)
    assert len({path for path, _ in walk}) == files
    functions = {each for each in walk if not each[1].rpartition(".")[2][0].isupper()}  # a class shows no call
    assert functions - called == set()
