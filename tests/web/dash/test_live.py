"""What a page gets of a running network."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
from typing import TYPE_CHECKING, Annotated, Any

import pytest

import r2p
from r2p.messages import SIZE_MAX
from r2p.msg import Odometry
from r2p.testing.network import Network, node_in
from r2p.web.dash import protocol
from tests.transports.rtcan.networks import until
from tests.web.rig import FakePage, live, open_page

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.virtual_time


class Wheel(r2p.Message):
    speed: r2p.f32 = 0.0
    on: bool = False


class Drive(r2p.Message):
    name: Annotated[str, r2p.Max(20)] = ""
    wheels: Annotated[tuple[Wheel, ...], r2p.Max(4)] = ()
    ticks: r2p.u32 = 0


class Scale(r2p.Service):
    class Request(r2p.Message):
        value: r2p.f32 = 0.0

    class Response(r2p.Message):
        doubled: r2p.f32 = 0.0


@contextlib.asynccontextmanager
async def robot_and_page(
    *topics: str, publish: bool = False, control: bool = False
) -> AsyncIterator[tuple[r2p.Node, FakePage, r2p.Module]]:
    """A robot's node, a page beside it that knows these topics, and the module that serves it."""
    network = Network()
    async with network.node("ROBOT", name="drive") as node, network.module("PC", observer=True) as pc:
        for topic in topics:
            node.advertise(topic, Drive if topic == "drive" else Odometry)
        async with live(pc, publish=publish, control=control) as source, open_page(source) as page:
            await until(lambda: set(topics) <= pc.network.topics().keys() and page.messages)
            await asyncio.sleep(2.0)
            yield node, page, pc


def publisher(node: r2p.Node, topic: str) -> Any:
    return next(each for each in node.publishers if each.topic == topic)


def decoded(data: bytes) -> tuple[int, tuple[float, ...], list[tuple[float, ...]]]:
    """The stream, the times and the columns of points."""
    kind, columns, stream, count = struct.unpack_from("<BBHI", data)
    assert kind == protocol.POINTS
    assert len(data) == 8 + 8 * count * (1 + columns)
    values = [struct.unpack_from(f"<{count}d", data, 8 + 8 * count * index) for index in range(columns + 1)]
    return stream, values[0], values[1:]


async def test_the_first_news_are_what_is_allowed_and_all_figures() -> None:
    async with robot_and_page("drive") as (_, page, _):
        hello, state = page.messages[:2]
        assert (hello["op"], hello["publish"], hello["control"], hello["recording"]) == ("hello", False, False, False)
        assert "ROBOT" in {key for each in page.news("state") for key in each["changed"].get("modules", ())}
        assert state["op"] == "state"


async def test_plots_of_one_topic_get_the_numbers_that_they_ask_for() -> None:
    async with robot_and_page("drive") as (node, page, _):
        await page.result("plot", stream=1, fields=["drive.ticks", "drive.wheels[1].speed"])
        await page.result("plot", stream=2, fields=["drive.wheels[0].on"])
        await asyncio.sleep(2.0)  # the robot learns of the subscription
        wheels = (Wheel(1.5, on=True), Wheel(2.5))
        await publisher(node, "drive").publish(Drive("a", wheels, 7))
        await publisher(node, "drive").publish(Drive("longer", wheels[:1], 8))
        await until(lambda: len(page.points) == 2)
        (first, times, ticks_and_speed), (second, _, on) = map(decoded, page.points)
        assert (first, second) == (1, 2)
        assert ticks_and_speed[0] == (7.0, 8.0)
        assert ticks_and_speed[1][0] == 2.5
        assert ticks_and_speed[1][1] != ticks_and_speed[1][1], "there is no second wheel"
        assert on == [(1.0, 1.0)]
        assert abs(times[0] - node.now() / 1e9) < 1.0
        await page.result("stop_plot", stream=1)
        await publisher(node, "drive").publish(Drive(ticks=9))
        await until(lambda: len(page.points) == 3)
        assert decoded(page.points[-1])[0] == 2


async def test_what_is_not_plotted_any_more_is_not_subscribed_to() -> None:
    async with robot_and_page("drive") as (node, page, _):
        await page.result("plot", stream=1, fields=["drive.ticks"])
        await page.result("watch", topic="drive")
        await until(lambda: publisher(node, "drive").subscribers)
        await page.result("stop_plot", stream=1)
        await page.result("unwatch", topic="drive")
        await until(lambda: not publisher(node, "drive").subscribers)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        (["drive.wheels.speed"], "has no number 'wheels.speed'; it has wheels[].speed"),
        (["drive.name"], "has no number 'name'"),
        (["drive"], "'drive' names no field: write TOPIC.FIELD"),
        (["drive.ticks", "odometry.x"], "those of one topic, not of drive, odometry"),
        (["nothing.x"], "there is no topic 'nothing'"),
        ([], "a plot has 1 to 64 fields, not 0"),
        (["drive.ticks"] * 65, "a plot has 1 to 64 fields, not 65"),
    ],
)
async def test_what_can_not_be_plotted_is_an_error(fields: list[str], why: str) -> None:
    async with robot_and_page("drive", "odometry") as (node, page, _):
        assert why in await page.error("plot", stream=1, fields=fields)
        assert not publisher(node, "drive").subscribers


async def test_a_watched_topic_shows_its_newest_message_and_counts_the_others() -> None:
    async with robot_and_page("drive") as (node, page, _):
        await page.result("watch", topic="drive")
        await asyncio.sleep(2.0)
        for number in range(5):
            await publisher(node, "drive").publish(Drive("x", ticks=number))
        await asyncio.sleep(1.0)
        shown = page.news("message")
        assert shown[-1]["fields"] == {"name": "x", "wheels": [], "ticks": 4}
        assert len(shown) + sum(each["skipped"] for each in shown) == 5
        assert shown[-1]["module"] == "ROBOT"
        assert shown[-1]["sequence"] == 5
        await asyncio.sleep(1.0)
        rows = [each["changed"].get("topics", {}).get("drive", {}) for each in page.news("state")]
        assert any(row.get("measured") for row in rows), "a topic that is watched is measured"


async def test_the_log_from_a_level_on() -> None:
    async with robot_and_page("drive") as (node, page, _):
        await page.result("log", level="WARNING")
        await asyncio.sleep(3.0)
        node.log.info("not of interest")
        node.log.error("stuck")
        await until(lambda: page.news("log"))
        (record,) = page.news("log")[0]["records"]
        assert (record["level"], record["node"], record["text"]) == (logging.ERROR, "drive", "stuck")
        assert "'LOUD' is not a level of the log: write one of DEBUG" in await page.error("log", level="LOUD")


async def test_types_of_topics_and_services() -> None:
    async with robot_and_page("drive") as (node, page, _):
        described = await page.result("describe", topic="drive")
        wheels = described["fields"][1]  # bounds are no part of a type that is learnt
        assert described["fields"] == [
            {"path": "name", "kind": "text", "limit": SIZE_MAX},
            {"path": "wheels", "kind": "message", "max": wheels["max"]},
            {"path": "wheels[].speed", "kind": "f32", "plottable": True},
            {"path": "wheels[].on", "kind": "bool", "plottable": True},
            {"path": "ticks", "kind": "u32", "plottable": True},
        ]
        assert described["zero"] == {"name": "", "wheels": [], "ticks": 0}
        node.serve("scale", Scale.Request, Scale.Response, _scale)
        await until(lambda: "scale_q" in page.messages.__str__())
        types = await page.result("describe", service="scale")
        assert [types[each]["fields"][0]["path"] for each in ("request", "response")] == ["value", "doubled"]


async def _scale(request: Scale.Request) -> Scale.Response:
    return Scale.Response(2 * request.value)


async def test_a_page_publishes_once_and_at_a_rate() -> None:
    async with robot_and_page(publish=True) as (node, page, pc):
        received: list[Odometry] = []
        subscriber = node.subscribe("odometry", Odometry)
        await until(lambda: "odometry" in pc.network.topics())
        reading = asyncio.create_task(_read(subscriber, received))
        assert await page.result("publish", topic="odometry", value={"pose": {"x": 1.5}}) == {"subscribers": 1}
        await until(lambda: received)
        assert received[0].pose.x == 1.5
        await page.result("publish", topic="odometry", value={"pose": {"x": 2}}, rate=10)
        await asyncio.sleep(2.05)
        await page.result("stop_publishing", topic="odometry")
        last = page.news("published")[-1]
        assert (last["running"], last["topic"]) == (False, "odometry")
        assert 20 <= last["sent"] <= 22
        assert "has no field z" in await page.error("publish", topic="odometry", value={"z": 1})
        assert "at most 200 messages per second" in await page.error("publish", topic="odometry", value={}, rate=1e9)
        reading.cancel()


async def _read(subscriber: r2p.Subscriber[Odometry], received: list[Odometry]) -> None:
    async for message in subscriber:
        received.append(message)  # noqa: PERF401 - the list is looked at meanwhile


async def test_a_page_calls_a_service() -> None:
    async with robot_and_page(publish=True) as (node, page, pc):
        node.serve("scale", Scale.Request, Scale.Response, _scale)
        await until(lambda: "scale_q" in pc.network.topics())
        assert await page.result("call", service="scale", value={"value": 4}) == {"doubled": 8.0}
        assert "there is no topic 'nothing_q'" in await page.error("call", service="nothing", value={})
        assert "the time-out of a call" in await page.error("call", service="scale", value={}, timeout=-1)


async def test_parameters_and_orders() -> None:
    async with robot_and_page(control=True) as (node, page, pc):
        node.parameter("gain", 1.5, min=0.0, max=2.0)
        (gain,) = await page.result("parameters", module="ROBOT")
        assert (gain["name"], gain["value"], gain["kind"]) == ("gain", 1.5, "float")
        await page.result("set_parameters", module="ROBOT", node="drive", values={"gain": 2})
        assert (await page.result("parameters", module="ROBOT"))[0]["value"] == 2.0
        assert "gain" in await page.error("set_parameters", module="ROBOT", node="drive", values={"gain": 3})
        await page.result("module", module="ROBOT", order="stop")
        await until(lambda: "stopped" in {each.state for each in pc.network.modules()})
        await page.result("module", module="ROBOT", order="start")
        await until(lambda: "stopped" not in {each.state for each in pc.network.modules()})
        assert "module ROBOT runs already" in await page.error("module", module="ROBOT", order="start")
        assert "there is no other module NO" in await page.error("module", module="NO", order="stop")


@pytest.mark.parametrize(
    ("op", "values", "option"),
    [
        ("publish", {"topic": "drive", "value": {}}, "--allow-publish"),
        ("call", {"service": "x", "value": {}}, "--allow-publish"),
        ("set_parameters", {"module": "ROBOT", "node": "drive", "values": {}}, "--allow-control"),
        ("save_parameters", {"module": "ROBOT"}, "--allow-control"),
        ("node", {"module": "ROBOT", "node": "drive", "order": "stop"}, "--allow-control"),
        ("module", {"module": "ROBOT", "order": "stop"}, "--allow-control"),
    ],
)
async def test_pages_only_look_unless_they_are_allowed_more(op: str, values: dict[str, Any], option: str) -> None:
    network = Network()
    async with network.module("PC") as pc, live(pc) as source, open_page(source) as page:
        assert await page.error(op, **values) == f"{op}: not allowed: start r2p dash with {option}"
        assert source.refused == {option: 1}


async def test_a_publisher_that_comes_back_with_another_type_is_plotted_on() -> None:
    network = Network()
    async with network.module("PC", observer=True) as pc, live(pc) as source, open_page(source) as page:
        async with network.node("ROBOT") as node:
            node.advertise("speed", Wheel)
            await until(lambda: pc.network.topics().get("speed"))
            await asyncio.sleep(2.0)
            await page.result("plot", stream=1, fields=["speed.speed"])
        await asyncio.sleep(60.0)
        async with network.module("ROBOT") as again, node_in(again) as node:
            speed = node.advertise("speed", Faster)
            await until(lambda: speed.subscribers)
            for _ in range(30):
                await speed.publish(Faster(0.25, 8.0))
                await asyncio.sleep(0.5)
        assert decoded(page.points[-1])[2] == [(8.0,)]
        assert source.refused["messages of another type"] >= 1, "until the new type was known"


class Faster(r2p.Message):
    trust: r2p.f64 = 0.0
    speed: r2p.f64 = 0.0
