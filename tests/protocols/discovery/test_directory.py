"""Aliases of long names, and what they stand for."""

from __future__ import annotations

import pytest

from r2p.codecs import management
from r2p.errors import NameTooLong
from r2p.names import module_alias, module_path
from r2p.protocols.discovery.directory import Aliases

NAMES = ["robot1/MOTOR1", "a/b", "ABC_DEFGH", "sixteen_letters_/MOTOR_1"]


def test_short_names_are_their_own_aliases() -> None:
    assert module_alias("MOTOR1") == "MOTOR1"
    assert management.alias_messages("MOTOR1") == []


@pytest.mark.parametrize("name", NAMES)
def test_a_name_travels_in_pieces(name: str) -> None:
    aliases = Aliases()
    alias = module_alias(module_path(name))
    assert len(alias) <= 7
    assert aliases.name_of(alias) == alias
    received = [management.decode(management.encode(each)) for each in management.alias_messages(name)]
    complete = [aliases.receive(each) for each in reversed(received) if isinstance(each, management.Name)]
    assert complete[-1] == name
    assert aliases.name_of(alias) == name


def test_an_alias_that_does_not_fit_is_not_believed() -> None:
    aliases = Aliases()
    assert aliases.receive(management.Name("MOTOR1", 0, "robot1/MOTOR1")) is None
    assert aliases.name_of("MOTOR1") == "MOTOR1"


def test_made_up_aliases_are_bounded() -> None:
    aliases = Aliases()
    for number in range(10_000):
        name = f"robot/{number}"
        aliases.receive(management.Name(module_alias(name), 0, name))
        aliases.receive(management.Name(f"x{number}", 0x0F, "part"))
    assert len(aliases._names) <= 4096
    assert len(aliases._parts) <= 256


def test_how_an_alias_is_made() -> None:
    """As docs/PROTOCOL.md 9 has it."""
    assert module_alias("robot1/MOTOR1") == "robzofu"
    assert module_alias("r/MOTOR1")[:3] == "r_M"


def test_too_long() -> None:
    with pytest.raises(NameTooLong, match="at most 24"):
        module_path("sixteen_letters_/MOTOR_12")
