"""The reference is complete: every public name, every command with its options."""

import re
from pathlib import Path
from typing import Any

import pytest

import r2p
from tests.docs.blocks import ROOT, pages
from tests.docs.commands import commands

REFERENCE = ROOT / "docs" / "reference"
COMMAND = ROOT / "docs" / "command.md"

_ENTRY = re.compile(r"^::: r2p\.(\S+)$", re.MULTILINE)
_LINK = re.compile(r"!?\[[^]]*\]\(([^)\s]+)\)")


def test_every_public_name_has_an_entry() -> None:
    entries = [entry for page in REFERENCE.glob("*.md") for entry in _ENTRY.findall(page.read_text())]
    assert len(entries) == len(set(entries))
    public = set(r2p.__all__)
    assert public - set(entries) == set()
    others = {name for name in entries if "." not in name} - public
    assert others == {"messages", "errors", "msg", "testing", "codecs"}


@pytest.mark.parametrize(("heading", "command"), list(commands()))
def test_every_option_of_every_command_is_told(heading: str, command: Any) -> None:
    sections = re.split(r"^## ", COMMAND.read_text(), flags=re.MULTILINE)
    own = [section for section in sections if section.startswith(f"{heading}\n")]
    assert own, f"no section {heading}"
    told = set(re.findall(r"(?<![\w-])--?[a-z][a-z0-9-]*", own[0] + sections[1]))
    options = {name for each in command.params for name in each.opts if name.startswith("-")}
    assert options <= told | {"--help", "-h"}


def test_no_section_tells_of_a_command_that_is_gone() -> None:
    told = set(re.findall(r"^## (r2p \S.*)$", COMMAND.read_text(), flags=re.MULTILINE)) - {"r2p.toml"}
    assert told == {heading for heading, _ in commands()}


@pytest.mark.parametrize("page", pages()[:2], ids=lambda page: page.name)
def test_links_of_the_pages_outside_of_docs_lead_somewhere(page: Path) -> None:
    links = [link.partition("#")[0] for link in _LINK.findall(page.read_text()) if "://" not in link]
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_home_page_leads_to_every_guide() -> None:
    docs = ROOT / "docs"
    linked = set(_LINK.findall((docs / "index.md").read_text()))
    folders = ("tutorials", "how-to", "coming-from")
    guides = {str(page.relative_to(docs)) for folder in folders for page in (docs / folder).glob("*.md")}
    assert guides - linked == set()
