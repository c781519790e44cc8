"""The screens, driven by keys, at 80 columns and 24 lines."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING, Any

import pytest

from r2p.monitoring.monitor import NetworkMonitor
from r2p.msg import Odometry, Pose3
from r2p.tools.output import notify
from r2p.tools.top.app import TopApp
from r2p.tools.top.figures_table import FiguresTable
from r2p.tools.top.text_lines import KeyLine
from r2p.tools.top.topic_screen import TopicScreen
from tests.tools.rig import robot, tool
from tests.tools.top.network import line_of, network, screen_lines, screen_text, topic

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from textual.pilot import Pilot
    from textual.strip import Strip

    import r2p
    from r2p.tools.session import Session

pytestmark = pytest.mark.virtual_time
SIZE = (80, 24)
Top = tuple[TopApp, "Pilot[None]"]


@contextlib.asynccontextmanager
async def opened(session: Session, **options: Any) -> AsyncIterator[Top]:
    """The command's screen, with the figures of the network that the session is on."""
    async with NetworkMonitor(session.module) as monitor:
        app = TopApp(session, monitor, **options)
        async with app.run_test(size=SIZE) as pilot:
            await pilot.pause()
            yield app, pilot


@contextlib.asynccontextmanager
async def shown(size: tuple[int, int] = SIZE, **options: Any) -> AsyncIterator[Top]:
    """The screen with made-up figures, of which there are no others."""
    async with tool() as session:
        app = TopApp(session, NetworkMonitor(session.module), **options)
        async with app.run_test(size=size) as pilot:
            app.show(network())
            await pilot.pause()
            yield app, pilot


async def test_topics_are_shown_with_their_figures() -> None:
    async with shown() as (app, _):
        assert "2 modules  3 topics  1.10k messages/s  rtcan:can0 34.0 %" in line_of(app, "r2p top")
        assert line_of(app, "encoder1 ").split() == ["encoder1", "-", "1.00k", "8", "1.50", "-", "-", "-", "-", "-"]
        assert line_of(app, "odometry").split() == ["odometry", "per", "100.0", "8", "-", "-", "-", "0", "0", "-"]
        assert line_of(app, "scan").split() == ["scan", "-", "-", "≤1500", "-", "0.40", "2.10", "-", "-", "7"]
        assert line_of(app, "q quit").startswith("q quit  ? help")


async def test_each_table_has_a_key() -> None:
    expected = {
        "2": "firmware",
        "3": "BOT/plan",
        "4": "tcp:1.2.3.4:5",
        "5": "S A . . A _",
        "6": "reset",
        "1": "odometry",
    }
    async with shown() as (app, pilot):
        for key, text in expected.items():
            await pilot.press(key)
            await appears(app, pilot, text)
        await pilot.press("tab")
        await appears(app, pilot, "firmware")


async def appears(app: TopApp, pilot: Pilot[None], text: str) -> None:
    """A view may be drawn after the key has been handled."""
    for _ in range(50):
        if text in screen_text(app):
            return
        await pilot.pause()
    raise AssertionError(f"{text} does not appear in\n{screen_text(app)}")


@pytest.mark.parametrize("size", [(80, 24), (40, 8), (20, 4), (200, 60)])
async def test_any_terminal_shows_the_names_and_no_line_is_too_long(size: tuple[int, int]) -> None:
    async with shown(size) as (app, pilot):
        for key in "123456":
            await pilot.press(key)
            assert max(map(len, screen_lines(app))) <= size[0]
        await pilot.press("1")
        assert any(line.split()[0] == "encoder1" for line in screen_lines(app) if line.strip())
        if size[0] == 200:
            assert "r2p_msgs/Encoder" in line_of(app, "encoder1 ")


async def test_rows_are_filtered_while_the_user_types() -> None:
    async with shown() as (app, pilot):
        await pilot.press("slash", *"sc")
        assert "encoder1 " not in screen_text(app)
        assert "1 of 3 with 'sc'" in screen_text(app)
        await pilot.press("enter", "r")  # the keys are those of the table again
        assert "scan" in screen_text(app)
        await pilot.press("escape")
        assert "encoder1 " in screen_text(app)


def order(app: TopApp) -> list[str]:
    lines = screen_lines(app)
    start = next(i for i, line in enumerate(lines) if line.startswith(" TOPIC"))
    return [line.split()[0] for line in lines[start + 1 : -1] if line]


async def test_rows_are_sorted_by_the_next_column_and_the_other_way() -> None:
    async with shown(sorted_by="size") as (app, pilot):
        assert order(app) == ["scan", "encoder1", "odometry"]
        assert "BYTES▼" in screen_text(app)
        await pilot.press("S")
        assert order(app) == ["encoder1", "odometry", "scan"]
        await pilot.press("r")
        assert order(app) == ["odometry", "encoder1", "scan"]
        assert "Hz▲" in screen_text(app)


async def test_the_cursor_stays_on_its_row_when_rows_change_places() -> None:
    async with shown(sorted_by="rate") as (app, pilot):
        await pilot.press("down")
        table = app.screen.query_one(FiguresTable)
        assert table.selected.name == "odometry"
        app.show(network(topics=[topic("odometry", rate=5000.0), topic("encoder1", rate=1.0)]))
        await pilot.pause()
        assert (order(app), table.selected.name) == (["odometry", "encoder1"], "odometry")


async def test_a_pause_freezes_what_is_shown_and_ends_with_the_newest() -> None:
    async with shown() as (app, pilot):
        await pilot.press("p")
        app.show(network(seconds=1, topics=[topic("leds")]))
        await pilot.pause()
        assert "PAUSED" in screen_text(app)
        assert "odometry" in screen_text(app)
        await pilot.press("p")
        assert order(app) == ["leds"]


async def test_a_topic_that_loses_messages_is_marked() -> None:
    async with shown() as (app, pilot):
        assert line_of(app, "odometry").startswith(" odometry")
        app.show(network(seconds=1, missed=2))
        await pilot.pause()
        assert line_of(app, "odometry").startswith("!odometry")


async def test_only_lines_that_changed_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand topics cost what is visible of them."""
    many = {f"t{i:03}": topic(f"t{i:03}", rate=1.0) for i in range(1000)}
    async with shown() as (app, pilot):
        app.show(network(topics=list(many.values())))
        await pilot.pause()
        drawn: list[int] = []
        table = app.screen.query_one(FiguresTable)
        draw = table.render_line

        def record(y: int) -> Strip:
            drawn.append(y)
            return draw(y)

        monkeypatch.setattr(table, "render_line", record)
        many["t003"] = topic("t003", rate=2.0)
        many["t900"] = topic("t900", rate=2.0)
        app.show(network(topics=list(many.values())))
        await pilot.pause()
        assert drawn == [4]


async def test_a_thousand_rows_are_scrolled_with_the_cursor_visible() -> None:
    async with shown() as (app, pilot):
        app.show(network(topics=[topic(f"t{i:03}") for i in range(1000)]))
        await pilot.press("end")
        assert order(app)[-1] == "t999"
        await pilot.press("pageup", "up")
        assert app.screen.query_one(FiguresTable).selected.name == "t979"
        await pilot.press("home")
        assert order(app)[0] == "t000"


async def test_columns_that_do_not_fit_are_reached_to_the_right() -> None:
    async with shown() as (app, pilot):
        assert "TYPE" not in screen_text(app)
        await pilot.press(*["right"] * 12)
        assert "r2p_msgs/Encoder" in line_of(app, "encoder1 ")
        await pilot.press(*["left"] * 12)
        assert "CLASS" in screen_text(app)


async def test_help_explains_keys_and_columns_and_any_key_closes_it() -> None:
    async with shown() as (app, pilot):
        await pilot.press("question_mark")
        assert "pause, and go on" in screen_text(app)
        assert "LAX ms" in screen_text(app)
        await pilot.press("q")
        assert "pause, and go on" not in screen_text(app)
        assert app.is_running


async def test_notices_and_log_records_take_the_line_of_keys_until_the_next_key() -> None:
    async with shown() as (app, pilot):
        notify("link tcp:1.2.3.4:5 is down\x1b[2J")
        print("second", file=sys.stderr)  # noqa: T201 - as the log does
        notify("link tcp:1.2.3.4:5 is up\x1b[2J")
        await pilot.pause()
        assert screen_lines(app)[-1] == r"r2p: link tcp:1.2.3.4:5 is up\x1b[2J"
        await pilot.press("down")
        assert screen_lines(app)[-1].startswith("q quit")


async def test_what_other_modules_write_is_shown_as_text() -> None:
    async with shown() as (app, pilot):
        app.tables.query_one(KeyLine).say("limit of \x1b]0;title\x07 [bold]is[/bold] 3")
        await pilot.pause()
        assert screen_lines(app)[-1] == r"limit of \x1b]0;title\x07 [bold]is[/bold] 3"
        app.tables.wanted = "\x1b[2J[/]"
        await pilot.press("slash")
        await pilot.pause()
        assert r"\x1b[2J[/]" in screen_text(app)


async def test_q_quits() -> None:
    async with shown() as (app, pilot):
        await pilot.press("q")
        assert not app.is_running


async def turn(node: r2p.Node) -> None:
    """Publish, log, and have a parameter."""
    speed = node.parameter("speed", 0.5, min=0.0, max=2.0, unit="m/s")
    publisher = node.advertise("odometry", Odometry)
    turns = 0
    async for _ in node.every(0.1):
        turns += 1
        if turns % 10 == 0:
            node.log.warning("turn %d", turns)
        await publisher.publish(Odometry(pose=Pose3(x=speed.value, y=float(turns))))


async def test_a_topic_opens_with_its_fields_and_is_measured_meanwhile() -> None:
    async with robot(turn), tool() as session, opened(session) as (app, pilot):
        await pilot.pause(2.0)
        assert order(app) == ["log", "odometry"]
        await pilot.press("down", "enter")
        await pilot.pause(2.0)
        screen = app.screen
        assert isinstance(screen, TopicScreen)
        assert screen.received >= 19
        x, y = line_of(app, "pose.x"), line_of(app, "pose.y")
        assert x.split()[:2] == ["pose.x", "0.5"]
        assert "▁▁▁▁" in x
        assert "█" in y
        assert "BOT/turn" in screen_text(app)
        await pilot.press("escape")
        await pilot.pause(1.0)
        assert order(app) == ["log", "odometry"]
        assert session.module.network.topics()["odometry"].subscribers == []


async def test_bytes_of_an_unknown_type_are_shown_in_hex() -> None:
    async with tool() as session, opened(session) as (app, pilot):
        screen = TopicScreen(app.details, "odometry")
        await app.push_screen(screen)
        screen.show_message(b"\x01\xfe" * 40)
        await pilot.pause()
        assert line_of(app, "bytes 4 ").split() == ["bytes", "4", "01", "fe", "01", "fe", "-", "-"]
        assert "name it in [types] of r2p.toml" in screen_text(app)


@contextlib.asynccontextmanager
async def node_opened(*, allow_control: bool) -> AsyncIterator[Top]:
    """The screen of the node."""
    async with robot(turn), tool() as session, opened(session, allow_control=allow_control) as (app, pilot):
        await pilot.pause(2.0)
        await pilot.press("3", "down", "enter")
        await pilot.pause(2.0)
        yield app, pilot


async def test_a_node_opens_with_its_log_and_parameters() -> None:
    async with node_opened(allow_control=False) as (app, pilot):
        assert "WARNING  turn" in screen_text(app)
        assert line_of(app, " speed ").split()[:6] == ["speed", "0.5", "m/s", "0.0", "to", "2.0"]
        assert "publishes log, odometry" in screen_text(app) or "publishes odometry" in screen_text(app)
        await pilot.press("enter")
        assert "start r2p top with --allow-control" in screen_text(app)
        await pilot.press("escape")
        assert "BOT/turn" in screen_text(app)


@pytest.mark.parametrize(("value", "result"), [("1.5", "= 1.5 (was 0.5)"), ("9", "2.0"), ("fast", "fast")])
async def test_a_parameter_is_set_where_that_is_allowed(value: str, result: str) -> None:
    async with node_opened(allow_control=True) as (app, pilot):
        await pilot.press("enter", *["backspace"] * 3, *value, "enter")
        await pilot.pause(2.0)
        assert result in screen_lines(app)[-1]
        assert line_of(app, " speed ").split()[1] == ("1.5" if value == "1.5" else "0.5")


async def test_a_module_opens_its_nodes() -> None:
    async with shown() as (app, pilot):
        await pilot.press("2", "enter")
        assert "BOT/plan" in screen_text(app)
        assert "2 of 2 with 'BOT/'" in screen_text(app)
