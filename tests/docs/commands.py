"""The commands of r2p, for the tests of pages that name them."""

from collections.abc import Iterator
from typing import Any

from r2p.tools import main


def commands() -> Iterator[tuple[str, Any]]:
    """All commands by the heading that they have in `docs/command.md`, such as `r2p topic echo`."""
    for name in main.GROUPS | main.COMMANDS:
        command = main._load(name)
        if name in main.GROUPS:
            yield from ((f"r2p {name} {inner}", each) for inner, each in command.commands.items())
        else:
            yield f"r2p {name}", command
