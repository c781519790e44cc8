"""ROS 1 for the commands of a page: a master, and Debian's commands, which need Debian's Python.

A page has a network of its own, as its commands print what is on it: `rosnode list` shows no node of another test.
"""

import contextlib
import os
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.docs.blocks import Block
from tests.ros.ros1 import packages
from tests.ros.ros1.programs import Ros1

COMMANDS = ("rosnode", "rosparam", "rosservice", "rostopic")

_NEEDED = re.compile(rf"\bros1:|^\$ (?:{'|'.join(COMMANDS)}) ", re.MULTILINE)


def is_needed(blocks: list[Block]) -> bool:
    """Whether one of the blocks has commands of ROS 1, or a link to it."""
    return any(block.language == "console" and _NEEDED.search(block.text) for block in blocks)


@contextlib.contextmanager
def network(directory: Path) -> Iterator[dict[str, str]]:
    """A master, and the environment in which commands find it, and the shell finds them."""
    usr = packages.find()
    if isinstance(usr, str):
        (pytest.fail if os.environ.get("CI") else pytest.skip)(usr)
    directory.mkdir()
    master = Ros1(usr, directory)
    try:
        yield {**_settings(master), "PATH": f"{_commands(master, directory / 'bin')}:"}
    finally:
        master.close()


def _settings(master: Ros1) -> dict[str, str]:
    return {name: value for name, value in master.environment.items() if name.startswith("ROS_")}


def _commands(master: Ros1, folder: Path) -> Path:
    """Write a script for each command: what it needs of the environment would break a Python of another version."""
    folder.mkdir()
    apart = {"PYTHONPATH", "LD_LIBRARY_PATH", "PYTHONUNBUFFERED"} & master.environment.keys()
    settings = shlex.join(f"{name}={master.environment[name]}" for name in sorted(apart))
    for name in COMMANDS:
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec env {settings} {shlex.join(master.command(name))} "$@"\n')
        script.chmod(0o755)
    return folder
