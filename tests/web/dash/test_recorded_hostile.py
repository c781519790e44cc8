"""Recordings that are damaged, or made to harm whoever opens them: the page shows what there is."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from r2p.recording.bag import Bag
from r2p.recording.bag_file import BagFile
from r2p.recording.mcap_reader import TIME_MAX
from r2p.recording.message_index import indexed, read_index
from r2p.recording.observations import NETWORK
from r2p.web.dash.recorded.plots import MinMaxSteps, spread
from r2p.web.dash.recorded.reader import ChunkCache
from r2p.web.dash.recorded.scan import History
from r2p.web.dash.recorded.source import RecordedSource
from tests.transports.rtcan.networks import until
from tests.web.dash.recordings import DEFINITION, T0, S, drive, foreign, shown
from tests.web.dash.test_recorded import anyio_backend as anyio_backend
from tests.web.dash.test_recorded import news, plotted, row, rows
from tests.web.rig import open_page

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.anyio


async def test_a_file_that_was_cut_is_shown_as_far_as_it_goes(tmp_path: Path) -> None:
    path = drive(tmp_path / "cut.mcap", finish=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    async with shown(path) as (page, _):
        (problem,) = (await page.result("timeline"))["problems"]
        assert "r2p bag recover" in problem
        await page.result("plot", stream=1, fields=["wheels.left"])
        times, _ = await plotted(page, 1)
        assert T0 / S + 2 < times[-1] < T0 / S + 19
        await news(page, "timeline", lambda each: each["share"] == 1)


async def test_a_damaged_chunk_is_left_out_and_counted(tmp_path: Path) -> None:
    path = drive(tmp_path / "damaged.mcap")
    with Bag(path) as bag:
        chunk = bag.files[0].summary.chunks[3]
    data = bytearray(path.read_bytes())
    data[chunk.offset + 60 : chunk.offset + 100] = bytes(40)
    path.write_bytes(data)
    async with shown(path) as (page, _):
        await page.result("plot", stream=1, fields=["wheels.left"])
        await plotted(page, 1)
        assert 1000 < page.news("plotted")[-1]["messages"] < 1600
        await news(page, "timeline", lambda each: each["share"] == 1 and each["damaged"] == 1)


async def test_times_are_as_far_apart_as_a_file_can_have_them(tmp_path: Path) -> None:
    path = foreign(tmp_path / "times.mcap", times=[0, 1, T0, TIME_MAX - 1, TIME_MAX])
    async with shown(path) as (page, _):
        await page.result("play", rate=1000)
        for time in (0, 1, TIME_MAX, 1 << 80, -(1 << 80)):
            await page.result("seek", time=time)
        await page.result("plot", stream=1, fields=["temp.temperature"], start=-1e300, end=1e300, points=2)
        times, _ = await plotted(page, 1)
        assert len(times) <= 3
        await page.result("watch", topic="temp")
        assert (await news(page, "message", lambda _: True))["time"] in {0, 1}
        await news(page, "timeline", lambda each: each["share"] == 1)


async def test_names_may_be_absurd(tmp_path: Path) -> None:
    names = [
        "",
        "/",
        "__proto__",
        "a\x00b\x1b[2J",
        "x" * 60_000,
        "../../etc",
        "<img src=x onerror=alert(1)>",
        "\u202eabc",
    ]
    path = foreign(tmp_path / "names.mcap", topics=names)
    async with shown(path) as (page, _):
        found = rows(page, "topics")
        assert len(found) == len(names) - 2  # two have the same name without slashes, one is too long
        assert "__proto__" in found
        assert await page.error("plot", stream=1, fields=[f"{'y' * 60_000}.x"])
        await news(page, "timeline", lambda each: each["share"] == 1)


async def test_thousands_of_channels_take_a_moment(tmp_path: Path) -> None:
    path = foreign(tmp_path / "many.mcap", topics=[f"/robot/{i}/temp" for i in range(2000)], times=[T0, T0 + S])
    async with shown(path) as (page, _):
        await row(page, "topics", "robot/1999/temp", lambda each: each)
        assert len(rows(page, "topics")) == 2000
        await page.result("seek", time=T0)
        await row(page, "topics", "robot/1999/temp", lambda each: "rate" not in each)


async def test_the_description_of_the_network_is_read_only_if_it_can_be_one(tmp_path: Path) -> None:
    path = tmp_path / "described.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "other")
        for content in (b"[" * 100_000, b'{"nodes": 7}', b"\xff", b" " * (2 << 20)):
            writer.add_attachment(0, 0, NETWORK, "application/json", content)
        good = b'{"nodes": [{"module": "IMU", "node": "gyro", "publishes": ["gyro"], "subscribes": ["tick"]}]}'
        writer.add_attachment(0, 0, NETWORK, "application/json", good)
        writer.finish()
    async with shown(path) as (page, _):
        (node,) = (await row(page, "modules", "IMU", lambda each: each))["nodes"]
        assert (node["publishes"], node["subscribes"]) == (["gyro"], ["tick"])
        assert [each["node"] for each in rows(page, "topics")["tick"]["subscribers"]] == ["gyro"]


async def test_what_is_not_a_recording_ends_the_page_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "text.mcap"
    path.write_text("hello")
    async with RecordedSource([path]) as source, open_page(source) as page:
        await until(lambda: page.connection.closed)
        code, reason = page.connection.closed or (0, "")
        assert code == 1011
        assert "is not an MCAP file" in reason


def overlong(path: Path, count: int) -> Path:
    """A chunk with one long message, which its index names many times."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "other")
        schema = writer.register_schema("their_msgs/msg/Reading", "ros2msg", DEFINITION)
        channel = writer.register_channel("/long", "cdr", schema)
        for time in range(count):
            writer.add_message(channel, T0 + time, bytes(10_000), T0 + time)
        writer.finish()
    return path


def test_an_index_that_names_a_message_often_is_not_believed(tmp_path: Path) -> None:
    path = overlong(tmp_path / "long.mcap", 9)
    file = BagFile(path)
    (chunk,) = file.summary.chunks
    index = read_index(file, chunk)
    assert index is not None
    ((channel, entries),) = index.items()
    data = bytearray(path.read_bytes())
    data[data.index(entries) : data.index(entries) + len(entries)] = entries[:16] * 9
    path.write_bytes(data)
    with Bag(path) as bag:
        found = indexed(bag.files[0], chunk, [channel])
    assert [each[0] - T0 for each in found] == list(range(9)), "the chunk itself was read"
    file.file.close()


@given(st.binary(max_size=120), st.integers(0, 200))
@settings(max_examples=60, deadline=None)
def test_an_index_may_have_any_bytes(tmp_path_factory: pytest.TempPathFactory, noise: bytes, at: int) -> None:
    path = overlong(tmp_path_factory.mktemp("noise") / "noise.mcap", 4)
    file = BagFile(path)
    (chunk,) = file.summary.chunks
    data = bytearray(path.read_bytes())
    begin = chunk.offset + chunk.length + min(at, chunk.index_length)
    end = min(begin + len(noise), chunk.offset + chunk.length + chunk.index_length)
    data[begin:end] = noise[: end - begin]
    file.file.close()
    path.write_bytes(data)
    with Bag(path) as bag:
        found = indexed(bag.files[0], chunk, [*bag.files[0].channels])
    assert len(found) <= 4


values = st.floats(allow_nan=True, allow_infinity=True, width=64)


@given(st.lists(st.tuples(st.integers(0, TIME_MAX), values), max_size=60), st.integers(-5, 40))
def test_steps_have_the_least_and_the_greatest_value_of_all(messages: list[tuple[int, float]], points: int) -> None:
    messages.sort(key=lambda each: each[0])
    span = (messages[0][0], messages[-1][0]) if messages else (0, 0)
    steps = MinMaxSteps(1, span, max(points, 2))
    for time, value in messages:
        steps.add([time], [[value]])
    times, columns = steps.points()
    assert len(times) <= max(points, 2) + 2
    assert list(times) == sorted(times)
    numbers = [value for _, value in messages if value == value]
    found = [value for value in (columns[0] if times else ()) if value == value]
    assert bool(numbers) == bool(found)
    if numbers:
        assert (min(found), max(found)) == (min(numbers), max(numbers))


@given(st.integers(0, 300))
def test_a_spread_order_has_each_item_once(count: int) -> None:
    assert sorted(spread(range(count))) == list(range(count))


def pair(value: int) -> tuple[int, int]:
    return value, 100


def test_what_is_kept_is_bounded() -> None:
    cache = ChunkCache(1000)
    assert [cache.get(key, partial(pair, key)) for key in (1, 2, 3, 1)] == [1, 2, 3, 1]
    assert cache.get("large", lambda: (1, 10_000)) == 1
    assert cache.get("large", lambda: (2, 10_000)) == 2, "it was not kept"
    history = History[str, int](limit=1000)
    kept = [history.add(f"{i}", i, i, 10) for i in range(100)]
    assert kept.count(True) == 5
    assert history.left_out == 95
    assert history.at(2) == {"0": 0, "1": 1, "2": 2}
