"""The topic commands over zenoh: a type whose code is in another program is asked for."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.tools.rig import process

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.processes

TYPE = '''
import r2p


class Wheel(r2p.Message):
    """Only its publisher has it."""

    speed: r2p.f32 = 0.0
    currents: tuple[r2p.u8, r2p.u8] = (0, 0)
'''
LISTEN = "zenoh:?mode=peer&listen=tcp/127.0.0.1:0&scouting=off&network=lab"


@pytest.fixture
def via(tmp_path: Path) -> Iterator[str]:
    """How to reach the publisher of `wheel`."""
    file = tmp_path / "wheels.py"
    file.write_text(TYPE)
    wheel = ("topic", "pub", "wheel", "{speed: 1.5, currents: [3, 4]}", "--type", f"{file}:Wheel", "--rate", "50")
    with process(*wheel, "-v", "--via", LISTEN) as child:
        assert child.stderr is not None
        line = next((line for line in child.stderr if "takes connections at" in line), "")
        assert line
        yield f"zenoh:{line.split()[-1]}?scouting=off&network=lab"


def test_echo_decodes(via: str) -> None:
    with process("topic", "echo", "wheel", "--once", "--via", via) as echo:
        out, err = echo.communicate()
    assert json.loads(out) == {"speed": 1.5, "currents": [3, 4]}
    assert (err, echo.returncode) == ("", 0)


def test_list_shows_it(via: str) -> None:
    with process("topic", "list", "--via", via) as shown:
        rows = [json.loads(line) for line in shown.communicate()[0].splitlines()]
    assert [(row["topic"], row["type"], row["size"]) for row in rows] == [("wheel", "Wheel", 6)]


def test_info_shows_its_fields(via: str) -> None:
    with process("topic", "info", "wheel", "-v", "--via", via) as info:
        found = json.loads(info.communicate()[0])
    assert (found["type"], found["size"]) == ("Wheel", 6)
    assert found["fields"] == {"speed": "f32", "currents": "u8[2]"}
    assert [each["class"] for each in found["publishers"]]


def test_pub_takes_the_type_from_the_network(via: str) -> None:
    echo, pub = ("topic", "echo", "wheel"), ("topic", "pub", "wheel", "speed=2", "--once")
    with process(*echo, "--via", via), process(*pub, "--via", via) as publisher:
        _, err = publisher.communicate()
    assert publisher.returncode == 0, err
