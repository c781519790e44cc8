"""What a page gets of a recording."""

from __future__ import annotations

import itertools
import struct
from typing import TYPE_CHECKING, Any

import pytest

from tests.web.dash.recordings import GAP, PEAK, SECONDS, T0, S, drive, foreign, shown

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.web.rig import FakePage


pytestmark = pytest.mark.anyio  # real time, as a thread reads the files


@pytest.fixture(scope="module")
def anyio_backend() -> str:
    return "asyncio"  # what is tested does not depend on the event loop


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(tmp_path_factory.mktemp("recorded") / "drive.mcap")


async def news(page: FakePage, op: str, wanted: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """The last of the news of a kind that is as wanted; requests pass the time."""
    while not (found := [each for each in page.news(op) if wanted(each)]):
        await page.ask("timeline")
    return found[-1]


def rows(page: FakePage, table: str) -> dict[str, Any]:
    """A table as the page has it."""
    found: dict[str, Any] = {}
    for each in page.news("state"):
        for key in each["gone"].get(table, ()):
            found.pop(key, None)
        found |= each["changed"].get(table, {})
    return found


async def row(page: FakePage, table: str, key: str, wanted: Callable[[Any], object]) -> Any:
    while not wanted(found := rows(page, table).get(key)):
        await page.ask("timeline")
    return found


def decoded(data: bytes) -> tuple[int, tuple[float, ...], list[tuple[float, ...]]]:
    """The stream, the times and the columns of points."""
    _, columns, stream, count = struct.unpack_from("<BBHI", data)
    values = [struct.unpack_from(f"<{count}d", data, 8 + 8 * count * index) for index in range(columns + 1)]
    return stream, values[0], values[1:]


async def plotted(page: FakePage, stream: int) -> tuple[tuple[float, ...], list[tuple[float, ...]]]:
    """The points of a stream when all is read."""
    await news(page, "plotted", lambda each: each["stream"] == stream and each["share"] == 1)
    return next((times, columns) for number, times, columns in map(decoded, reversed(page.points)) if number == stream)


async def test_a_page_begins_at_the_end_with_the_figures_of_then(recording: Path) -> None:
    async with shown(recording) as (page, _):
        hello = page.messages[0]
        assert (hello["op"], hello["recording"], hello["publish"], hello["title"]) == (
            "hello",
            True,
            False,
            "drive.mcap",
        )
        assert (await news(page, "clock", lambda _: True))["time"] == T0 + (100 * SECONDS - 1) * S // 100
        topic = await row(page, "topics", "wheels", lambda each: each and each.get("size"))
        assert (topic["rate"], topic["rate_source"], topic["type"]) == (100.0, "recorded", "test_msgs/Wheels")
        assert topic["varies"]
        assert topic["missed"] == SECONDS - 1
        assert topic["publishers"] == [
            {
                "module": "ROBOT",
                "node": "drive",
                "link": "tcp",
                "publisher_class": "periodic",
                "rate": 100.0,
                "sent": 100 * (SECONDS - 1),
                "missed": SECONDS - 1,
                "late": 0,
            }
        ]
        await news(page, "timeline", lambda each: each["share"] == 1)
        await row(page, "modules", "ROBOT", lambda each: each is None)  # it has gone


async def test_figures_are_those_of_the_instant(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await news(page, "timeline", lambda each: each["share"] == 1)
        await page.result("seek", time=T0 + 14 * S)
        module = await row(page, "modules", "ROBOT", lambda each: each and each.get("uptime") == 19.0)
        assert (module["state"], module["kind"], module["release"], module["cpu"]) == ("running", "r2p", "1.2", 0.25)
        assert module["nodes"] == [{"name": "drive", "running": True, "restarts": 0, "publishes": ["wheels"]}]
        bus = rows(page, "buses")["rtcan:can0"]
        assert (bus["master"], bus["slots"]) == ("ROBOT", [{"topic": "wheels", "module": "ROBOT", "slots": [2]}])
        assert "share" not in bus
        await page.result("seek", time=T0 + 10 * S)
        assert (await row(page, "topics", "wheels", lambda each: each["rate"] == 0.0))["missed"] == 10
        await page.result("seek", time=T0 - S)  # before the start
        topic = await row(page, "topics", "wheels", lambda each: "rate" not in each)
        assert topic["publishers"][0]["sent"] == 0
        assert "rate" not in topic["publishers"][0]


async def test_a_plot_shows_the_peak_of_one_message(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await page.result("plot", stream=3, fields=["wheels.left", "wheels.names[1]"], points=100)
        times, (left, second) = await plotted(page, 3)
        assert len(times) <= 102
        assert list(times) == sorted(times)
        assert max(left) == PEAK
        assert max(each for each in second if each == each) > 1900
        assert times[0] == T0 / S
        gap = max(after - before for before, after in itertools.pairwise(times))
        assert GAP[1] - GAP[0] <= gap < GAP[1] - GAP[0] + 1


async def test_a_plot_of_a_part_has_all_its_messages(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await page.result(
            "plot", stream=1, fields=["wheels.right"], start=T0 / S + 7.765, end=T0 / S + 7.785, points=100
        )
        times, (right,) = await plotted(page, 1)
        assert [round(each - T0 / S, 2) for each in times] == [7.77, 7.78]
        assert right[0] == -PEAK
        await page.result("plot", stream=1, fields=["wheels.right"], start=0, end=1)
        await news(page, "plotted", lambda each: each["messages"] == 0)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ([], "1 to 64 fields"),
        (["wheels.middle"], "has no number 'middle'; it has left, right, names[]"),
        (["odometry.x"], "no topic 'odometry'"),
        (["wheels.left", "odometry.x"], "of one topic"),
    ],
)
async def test_a_plot_that_is_not_possible_is_refused(recording: Path, fields: list[str], why: str) -> None:
    async with shown(recording) as (page, _):
        assert why in await page.error("plot", stream=1, fields=fields)


async def test_messages_are_those_of_the_instant(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await page.result("watch", topic="wheels")
        assert (await news(page, "message", lambda _: True))["sequence"] == 100 * SECONDS
        await page.result("seek", time=T0 + 10 * S)  # within the gap
        message = await news(page, "message", lambda each: each["sequence"] == 100 * GAP[0])
        assert (message["module"], message["node"], message["time"]) == ("ROBOT", "drive", T0 + GAP[0] * S - S // 100)
        assert message["fields"]["names"] == [100 * GAP[0] - 1]
        assert "no topic 'odometry'" in await page.error("watch", topic="odometry")


async def test_the_log_is_that_up_to_the_instant(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await page.result("log", level="INFO")
        log = await news(page, "log", lambda each: each["records"])
        assert log["cleared"]
        assert len(log["records"]) == SECONDS + 1
        assert log["records"][-1] == {
            "time": T0 + (SECONDS - 1) * S,
            "level": 20,
            "module": "ROBOT",
            "node": "drive",
            "text": f"second {SECONDS - 1}",
        }
        await page.result("seek", time=T0 + 6 * S)
        await news(page, "log", lambda each: len(each["records"]) == 8)
        await page.result("log", level="WARNING")
        log = await news(page, "log", lambda each: len(each["records"]) == 1)
        assert log["records"][0]["text"] == "battery low"
        assert "is not a level" in await page.error("log", level="loud")


async def test_the_time_line_has_events_misses_and_gaps(recording: Path) -> None:
    async with shown(recording) as (page, _):
        answer = await page.result("timeline")
        assert (answer["start"], answer["files"], answer["problems"]) == (T0, ["drive.mcap"], [])
        await news(page, "timeline", lambda each: each["share"] == 1)
        events = [event for each in page.news("timeline") for event in each["events"]]
        kinds = {each["kind"] for each in events}
        assert kinds == {"module", "log", "missed", "overdue", "slots", "parameter"}
        assert next(each for each in events if each["kind"] == "missed")["about"] == "wheels of ROBOT/drive"
        misses = [tuple(miss) for each in page.news("timeline") for miss in each["misses"]]
        assert ("wheels", "missed", 5 * S // answer["step"], 3) in misses
        assert sum(count for _, kind, _, count in misses if kind == "overdue") == 16
        gaps = [gap for each in page.news("timeline") for gap in each["gaps"]]
        assert gaps == [["wheels", T0 + GAP[0] * S - S // 100, T0 + GAP[1] * S]]


async def test_parameters_are_those_of_the_instant(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await news(page, "timeline", lambda each: each["share"] == 1)
        await page.result("seek", time=T0 + 3 * S)
        (gain,) = await page.result("parameters", module="ROBOT")
        assert (gain["name"], gain["value"], gain["unit"], gain["origin"]) == ("gain", 0.0, "1/s", "run time")
        await page.result("seek", time=T0 + 13 * S)
        assert (await page.result("parameters", module="ROBOT"))[0]["value"] == 1.0
        assert await page.result("parameters", module="OTHER") == []


async def test_a_recording_plays_to_its_end(recording: Path) -> None:
    async with shown(recording) as (page, _):
        await page.result("log", level="INFO")
        await news(page, "log", lambda _: True)
        await page.result("play", rate=200)  # from the start, as it is at the end
        await news(page, "clock", lambda each: each["playing"] and each["time"] < T0 + 19 * S)
        end = await news(page, "clock", lambda each: not each["playing"] and each["rate"] == 200)
        assert end["time"] == T0 + (100 * SECONDS - 1) * S // 100
        texts = [record["text"] for each in page.news("log")[1:] for record in each["records"]]
        assert texts == sorted(set(texts), key=texts.index), "each record comes once"
        assert "0.01 to 1000" in await page.error("play", rate=-1)


async def test_what_would_change_something_is_refused_in_words(recording: Path) -> None:
    async with shown(recording) as (page, source):
        for op, values in (
            ("publish", {"topic": "wheels", "value": {}}),
            ("call", {"service": "s", "value": {}}),
            ("set_parameters", {"module": "ROBOT", "node": "drive", "values": {"gain": 1}}),
            ("node", {"module": "ROBOT", "node": "drive", "order": "stop"}),
        ):
            assert "this is a recording, which can only be looked at" in await page.error(op, **values)
        assert source.refused["recording"] == 4


async def test_types_are_described(recording: Path) -> None:
    async with shown(recording) as (page, _):
        found = await page.result("describe", topic="wheels")
        assert [each["path"] for each in found["fields"] if each.get("plottable")] == ["left", "right", "names"]


async def test_a_recording_of_another_program_is_shown(tmp_path: Path) -> None:
    path = foreign(tmp_path / "theirs.mcap", topics=("/temp", "/a.b/temp"))
    async with shown(path) as (page, _):
        topic = await row(page, "topics", "temp", lambda each: each and "rate" in each)
        assert (topic["rate"], topic["type"]) == (10.0, "their_msgs/Reading")
        assert "publishers" not in topic
        assert rows(page, "modules") == {}
        await page.result("watch", topic="temp")
        assert (await news(page, "message", lambda _: True))["fields"] == {
            "temperature": 1.0,
            "axis": [1.0, 1.0, 1.0],
            "name": "a",
        }
        await page.result("plot", stream=1, fields=["a.b/temp.temperature", "a.b/temp.axis[2]"])
        assert (await plotted(page, 1))[1] == [(1.0,) * 10, (1.0,) * 10]


async def test_several_files_are_one_recording(tmp_path: Path) -> None:
    first = foreign(tmp_path / "a.mcap")
    second = foreign(tmp_path / "b.mcap", times=range(T0 + 10 * S, T0 + 11 * S, S // 10))
    async with shown(first, second) as (page, _):
        assert page.messages[0]["title"] == "a.mcap and 1 more"
        await page.result("plot", stream=1, fields=["temp.temperature"])
        assert len((await plotted(page, 1))[0]) == 20
        await news(page, "timeline", lambda each: each["share"] == 1)
        gaps = [gap for each in page.news("timeline") for gap in each["gaps"]]
        assert gaps == [["temp", T0 + S * 9 // 10, T0 + 10 * S]]
