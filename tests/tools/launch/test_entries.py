"""What [launch.NAME] may say, and the errors that name the entry and the key."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from r2p.tools.config import ConfigFile, LaunchTable, UsageError
from r2p.tools.launch.entries import Entry, parse_entries


def parse(module: str | None = None, /, **tables: dict[str, Any]) -> list[Entry]:
    launch = {name: msgspec.convert({"command": "sim"} | table, LaunchTable) for name, table in tables.items()}
    return parse_entries(Path("robot.toml"), ConfigFile(module=module, launch=launch))


def test_an_entry_with_everything() -> None:
    ready = ["started", "port 2323", "port [::1]:80", "node PC1/blink", "topic leds", "module robot1/IMU1"]
    keys = {"ready": ready, "restart": "always", "required": True, "env": {"A": "b"}, "stop_timeout": "500ms"}
    _, entry = parse(first={}, second={"command": "run 'my robot.py:f' -v"} | keys)
    assert entry == Entry(
        name="second",
        arguments=("run", "my robot.py:f", "-v"),
        after=("first",),
        ports=(("127.0.0.1", 2323), ("::1", 80)),
        seen=(("topic", "leds"), ("node", "PC1/blink"), ("module", "robot1/IMU1")),
        restart="always",
        required=True,
        environment={"A": "b"},
        ready_timeout=30.0,
        stop_timeout=0.5,
    )
    assert entry.condition == "port 127.0.0.1:2323, port ::1:80, topic leds, node PC1/blink, module robot1/IMU1"


def test_each_starts_after_the_one_before_it_unless_it_says_so() -> None:
    entries = parse(a={}, b={}, c={"after": []}, d={"after": "a"}, e={"after": ["b", "c"]})
    assert [entry.after for entry in entries] == [(), ("a",), (), ("a",), ("b", "c")]


def test_the_word_r2p_may_stand_in_front() -> None:
    (entry,) = parse(a={"command": ["r2p", "topic", "echo", "my topic"]})
    assert entry.arguments == ("topic", "echo", "my topic")


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ({"command": ""}, "command is empty"),
        ({"command": "run 'x"}, "command: No closing quotation"),
        ({"command": "gatway"}, "r2p has no command gatway to launch; did you mean gateway?"),
        ({"command": "launch robot.toml"}, "r2p has no command launch to launch"),
        ({"ready": "topc leds"}, "ready = 'topc leds': write started, ended, topic NAME"),
        ({"ready": "topic"}, "ready = 'topic': write started"),
        ({"ready": "started now"}, "ready = 'started now': write started"),
        ({"ready": "topic a-b"}, "use letters, digits"),
        ({"ready": "port http"}, "write port HOST:PORT"),
        ({"ready": "port robot:99999"}, "write port HOST:PORT"),
        ({"restart": "on-falure"}, "restart = 'on-falure'; did you mean on-failure?"),
        ({"restart": "always", "ready": "ended"}, "never ends with restart = 'always'"),
        ({"ready_timeout": "soon"}, "ready_timeout: 'soon' is not a duration"),
        ({"stop_timeout": 0}, "stop_timeout must be greater than 0"),
        ({"after": "frist"}, "after: no entry frist; did you mean first?"),
    ],
)
def test_errors(table: dict[str, Any], problem: str) -> None:
    with pytest.raises(UsageError, match=re.escape("robot.toml: [launch.wheels] ") + ".*" + re.escape(problem)):
        parse(first={}, wheels=table)


@pytest.mark.parametrize(
    ("tables", "problem"),
    [
        ({}, "robot.toml has no table [launch.NAME]"),
        ({"a b": {}}, "[launch.a b] use letters, digits, - and _ in its name"),
        ({"a": {"after": "b"}, "b": {"after": "a"}}, "entries wait for each other: "),
        (
            {"a": {"command": "run x.py:f"}, "b": {"command": "run y.py:f"}, "c": {"command": "run z.py:f --module C"}},
            "a and b would be modules of the same name: add --module NAME",
        ),
    ],
)
def test_errors_of_several_entries(tables: dict[str, dict[str, Any]], problem: str) -> None:
    with pytest.raises(UsageError, match=re.escape(problem)):
        parse(None, **tables)


def test_run_and_gateway_share_the_name_that_the_file_gives() -> None:
    tables = {"a": {"command": "run x.py:f"}, "b": {"command": "gateway"}, "c": {"command": "gateway --name GW"}}
    assert len(parse(None, **tables)) == 3
    with pytest.raises(UsageError, match="a and b would be modules of the same name"):
        parse("PC1", **tables)
