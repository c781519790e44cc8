"""The pages themselves: no block escapes the tests, TOML is TOML, and frames are what the codecs make of them."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import r2p
import r2p.msg
from r2p.codecs import loader, management, services
from tests.docs.blocks import LANGUAGES, NOTES, Block, blocks, of_page, pages
from tests.vectors import cases

_NAMES = {
    "management": vars(management),
    "loader": vars(loader),
    "messages": vars(r2p.msg),
    "services": vars(services),
}


def _noted(note: str) -> list[Block]:
    return [block for block in blocks("text") if note in block.notes]


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_no_block_escapes_the_tests(page: Path) -> None:
    for block in of_page(page):
        assert block.language in LANGUAGES, f"{block} has the language {block.language!r}"
        assert set(block.notes) <= NOTES, f"{block} has the notes {block.notes}"


@pytest.mark.parametrize("block", blocks("toml"), ids=str)
def test_toml_is_toml(block: Block) -> None:
    assert tomllib.loads(block.text)


def test_only_commands_look_like_commands() -> None:
    """The button of a block copies what follows a prompt; for the site's lexer, `# ` in an output is one."""
    pygments = pytest.importorskip("pygments")
    lexer = pytest.importorskip("pygments.lexers").get_lexer_by_name("console")
    for block in blocks("console"):
        prompts = [text for token, text in pygments.lex(block.text, lexer) if str(token) == "Token.Generic.Prompt"]
        assert prompts == ["$ "] * len(re.findall(r"^\$ ", block.text, re.MULTILINE)), str(block)


@pytest.mark.parametrize("block", [each for each in blocks("console") if "not run" in each.notes], ids=str)
def test_what_is_not_run_says_why(block: Block) -> None:
    assert block.notes["not run"]


@pytest.mark.parametrize("block", _noted("frames"), ids=str)
def test_frames_are_what_the_codecs_make_of_them(block: Block) -> None:
    """Pairs of lines: a message, and its bytes in hex with blanks where they help."""
    codec = block.notes["frames"]
    lines = [line for line in block.text.splitlines() if line.strip()]
    for expression, frame in zip(lines[::2], lines[1::2], strict=True):
        message = eval(expression, dict(_NAMES[codec]))
        data = bytes.fromhex(frame)
        assert _encode(codec, message).hex(" ") == data.hex(" "), expression
        assert _decode(codec, message, data) == message, expression


def _encode(codec: str, message: object) -> bytes:
    if isinstance(message, r2p.Message):
        return message.encode()
    encode: Any = {"management": management, "loader": loader, "services": services}[codec].encode
    data: bytes = encode(message)
    return data


def _decode(codec: str, message: object, data: bytes) -> object:
    if isinstance(message, r2p.Message):
        return message.decode(data)
    decode: Any = {"management": management, "loader": loader, "services": services}[codec].decode
    found: object = decode(data)
    return found


@pytest.mark.golden
@pytest.mark.parametrize("block", _noted("recorded"), ids=str)
def test_what_firmware_is_said_to_send_was_recorded(block: Block) -> None:
    """Lines `> ...` went to the firmware, `< ...` came from it, one after the other in one session."""
    lines = [line.split()[:2] for line in block.text.splitlines() if line.startswith(("< ", "> "))]
    assert lines
    wanted = [("node->peer" if way == "<" else "peer->node", text.encode()) for way, text in lines]
    assert any(_follow(wanted, [(each.dir, each.data.strip()) for each in case.transcript]) for case in cases())


def _follow(wanted: list[tuple[str, bytes]], transcript: list[tuple[str, bytes]]) -> bool:
    """Whether all wanted lines come in this order."""
    rest = iter(transcript)
    return all(line in rest for line in wanted)
