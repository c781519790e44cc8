"""`r2p top` without a screen, and when it has one."""

from __future__ import annotations

import importlib.util
import io
from typing import TYPE_CHECKING

import pytest

from r2p.msg import Led
from r2p.tools import top as command
from r2p.tools.output import Output
from r2p.tools.session import UsageError
from r2p.tools.top import top
from r2p.tools.top.plain import PlainTop
from r2p.tools.top.tables import VIEWS
from tests.tools.rig import printed, robot, tool
from tests.tools.top.network import START, network

if TYPE_CHECKING:
    from collections.abc import Callable

    import r2p

pytestmark = pytest.mark.virtual_time


class Terminal(io.StringIO):
    """A terminal of 80 columns."""

    def isatty(self) -> bool:
        return True


async def blink(node: r2p.Node) -> None:
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.01):
        await publisher.publish(Led())


async def test_topics_of_a_network_are_printed_as_records(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), tool() as session:
        await top(session, filter="led", count=2, format="json")
    first, second = printed(capsys)
    assert second["time"] - first["time"] == pytest.approx(1e9, rel=0.1)
    known = {name: second[name] for name in ("topic", "type", "size", "class", "publishers", "subscribers")}
    assert known == {
        "topic": "leds",
        "type": "r2p_msgs/Led",
        "size": 5,
        "class": "non real-time",
        "publishers": 1,
        "subscribers": 0,
    }


async def test_a_measured_topic_has_a_latency(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), tool() as session:
        await top(session, measure=["leds"], filter="led", count=2, format="json")
    _, last = printed(capsys)
    assert last["rate"] == pytest.approx(100.0, rel=0.05)
    assert 0 <= last["p50"] <= last["p99"] < 0.01
    assert last["lost_here"] == 0


async def test_a_module_that_ends_is_gone(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        async with robot(blink):
            await top(session, "modules", once=True, format="json")
        await top(session, "modules", once=True, format="json")
    (record,) = printed(capsys)
    assert (record["module"], record["state"], record["kind"]) == ("BOT", "running", "r2p")


@pytest.mark.parametrize("view", VIEWS)
async def test_each_table_is_printed_at_a_terminal(view: str) -> None:
    terminal = Terminal()
    await PlainTop(Output("text", terminal), VIEWS[view]).put(network())
    lines = terminal.getvalue().splitlines()
    rows = VIEWS[view].rows(network())
    assert lines[0].endswith(f"  {view}: {len(rows)}" + (" row" if view == "buses" else ""))
    assert len(lines) >= 2 + len(rows)
    names = {VIEWS[view].columns[0].text(row) for row in rows}
    assert all(any(line.startswith(name) for line in lines[2:]) for name in names)


async def test_csv_has_the_columns_of_the_table() -> None:
    stream = io.StringIO()
    await PlainTop(Output("csv", stream), VIEWS["buses"], sorted_by="share").put(network())
    assert stream.getvalue().splitlines() == [
        "time,topic,kind,module,share,budget,slots,frames",
        f"{START},encoder1,hrt,IMU,0.1,0.05,2,1000.0",
    ]


async def test_a_column_that_does_not_exist_is_a_usage_error() -> None:
    async with tool() as session:
        with pytest.raises(UsageError, match="--sort speed: the columns of modules are module, state"):
            await top(session, "modules", sort="speed", once=True)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"count": None, "format": None}, True),
        ({"count": 3, "format": None}, False),
        ({"count": None, "format": "text"}, False),
    ],
)
def test_there_is_a_screen_unless_tables_are_asked_for(
    given: dict[str, object], expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    wants: Callable[..., bool] = command._wants_screen
    monkeypatch.setattr("sys.stdin", Terminal())
    monkeypatch.setattr("sys.stdout", Terminal())
    assert wants(**given) is expected
    monkeypatch.setattr("sys.stdout", io.StringIO())
    assert wants(**given) is False


def test_without_textual_tables_are_printed_and_a_notice_says_why(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "textual" else find(name))
    monkeypatch.setattr("sys.stdin", Terminal())
    monkeypatch.setattr("sys.stdout", Terminal())
    assert command._wants_screen(count=None, format=None) is False
    assert "pip install 'r2p[ui]'" in capsys.readouterr().err
