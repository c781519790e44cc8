"""Aliases of long names, and what they stand for."""

from __future__ import annotations

import pytest

from r2p.codecs import management
from r2p.errors import NameTooLong
from r2p.names import module_alias, module_path
from r2p.protocols.discovery import peers as aliases
from r2p.protocols.discovery.peers import Aliases

NAMES = ["robot1/MOTOR1", "a/b", "ABC_DEFGH", "sixteen_letters_/MOTOR_1"]


def test_short_names_are_their_own_aliases() -> None:
    assert module_alias("MOTOR1") == "MOTOR1"
    assert aliases.told("MOTOR1") == []


@pytest.mark.parametrize("name", NAMES)
def test_what_is_told_is_understood(name: str) -> None:
    heard = Aliases()
    alias = module_alias(module_path(name))
    assert len(alias) <= 7
    assert heard.name_of(alias) == alias
    told = [management.decode(management.encode(each)) for each in aliases.told(name)]
    news = [heard.heard(each) for each in reversed(told) if isinstance(each, management.Name)]
    assert news[-1] == name
    assert heard.name_of(alias) == name


def test_an_alias_that_does_not_fit_is_not_believed() -> None:
    heard = Aliases()
    assert heard.heard(management.Name("MOTOR1", 0, "robot1/MOTOR1")) is None
    assert heard.name_of("MOTOR1") == "MOTOR1"


def test_lies_are_bounded() -> None:
    heard = Aliases()
    for number in range(10_000):
        name = f"robot/{number}"
        heard.heard(management.Name(module_alias(name), 0, name))
        heard.heard(management.Name(f"x{number}", 0x0F, "part"))
    assert len(heard._names) <= 4096
    assert len(heard._parts) <= 256


def test_how_an_alias_is_made() -> None:
    """As docs/PROTOCOL.md 9 has it."""
    assert module_alias("robot1/MOTOR1") == "robzofu"
    assert module_alias("r/MOTOR1")[:3] == "r_M"


def test_too_long() -> None:
    with pytest.raises(NameTooLong, match="at most 24"):
        module_path("sixteen_letters_/MOTOR_12")
