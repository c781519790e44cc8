"""The commands of r2p, for the tests of pages that name them."""

from collections.abc import Iterator
from typing import Any

from r2p.tools import main


def commands() -> Iterator[tuple[str, Any]]:
    """All commands by the heading that they have in `docs/command.md`, such as `r2p topic echo`."""
    for name in main.GROUPS | main.COMMANDS:
        command = main._load(name)
        if name in main.GROUPS:
            load = getattr(command, "load", command.commands.get)  # of a group that imports its commands when called
            yield from ((f"r2p {name} {inner}", load(inner)) for inner in command.commands)
        else:
            yield f"r2p {name}", command
