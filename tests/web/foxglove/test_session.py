"""What viewers publish, call, read and set, and what they are refused."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

import r2p
from r2p.msg import Odometry, Text, Velocity3
from r2p.ros.cdr import cdr
from r2p.ros.topics import ros_class
from r2p.testing.network import Network, node_in
from r2p.web.foxglove import session
from r2p.web.foxglove.session import MISTAKES_MAX
from tests.web.foxglove.rig import Viewer, serving, until, viewer

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.virtual_time

Twist: Any = ros_class("geometry_msgs/Twist", 2)


class Scale(r2p.Service, name="lab_msgs/Scale"):
    """Multiplies."""

    class Request(r2p.Message):
        value: r2p.f64 = 0.0

    class Response(r2p.Message):
        result: r2p.f64 = 0.0


def published(channel: int, data: bytes) -> bytes:
    return struct.pack("<BI", 1, channel) + data


def advertise(one: Viewer, number: int, topic: str, encoding: str, name: str = "", **values: str) -> None:
    one.say("advertise", channels=[{"id": number, "topic": topic, "encoding": encoding, "schemaName": name, **values}])


# Publishing


async def test_viewers_publish_in_the_type_of_the_topic_or_in_that_of_ros() -> None:
    network = Network()
    async with (
        network.node("BASE") as node,
        network.module("PC", observer=True) as pc,
        serving(pc, allow_publish=True) as server,
    ):
        velocities: list[Velocity3] = []
        subscriber = node.subscribe("velocity_cmd", Velocity3)

        async def receive() -> None:
            async for velocity in subscriber:
                velocities.append(velocity)  # noqa: PERF401 - it is read meanwhile

        receiving = asyncio.create_task(receive())
        async with viewer(server) as one, viewer(server) as other:
            await until(lambda: "velocity_cmd" in pc.network.topics())
            advertise(one, 1, "/velocity_cmd", "cdr", "geometry_msgs/msg/Twist")
            advertise(other, 1, "/velocity_cmd", "json", "geometry_msgs/Twist")
            advertise(other, 2, "velocity_cmd", "json")
            advertise(other, 3, "/velocity_cmd", "json", "r2p_msgs/msg/Velocity3")
            await until(lambda: subscriber.publishers)
            forward = replace(Twist().linear, x=1.0)
            one.send(published(1, cdr(Twist).encode(Twist(linear=forward))))
            await until(lambda: len(velocities) == 1)
            other.send(published(1, b'{"linear":{"x":2},"angular":{"z":0.5}}'))
            other.send(published(2, b'{"linear":{"x":3}}'))
            other.send(published(3, b'{"x":4.0}'))
            await until(lambda: len(velocities) == 4)
            assert [(each.x, each.w) for each in velocities] == [(1.0, 0.0), (2.0, 0.5), (3.0, 0.0), (4.0, 0.0)]
            other.say("unadvertise", channelIds=[1, 3])
            one.say("unadvertise", channelIds=[1])
            other.send(published(2, b"{}"))
            await until(lambda: len(velocities) == 5)
            assert not one.status
            assert not other.status
        await until(lambda: not pc.network.topics()["velocity_cmd"].publishers)
        receiving.cancel()


async def test_a_viewer_publishes_a_topic_that_is_new_by_its_own_definition() -> None:
    network = Network()
    async with (
        network.module("PC", observer=True) as pc,
        serving(pc, allow_publish=True) as server,
        viewer(server) as one,
    ):
        advertise(one, 1, "/goal", "json", "lab_msgs/msg/Goal", schemaEncoding="ros2msg", schema="float32 x\n")
        advertise(one, 2, "/text", "json", "std_msgs/msg/String")
        await until(lambda: {"/goal", "/text"} <= one.channels.keys())  # which it may subscribe to
        one.subscribe("/goal", 5)
        one.send(published(1, b'{"x": 1.5}'))
        await until(lambda: one.data)
        assert one.decoded("/goal")[0].x == 1.5


@pytest.mark.parametrize(
    ("channel", "text"),
    [
        (("/a b", "json", "std_msgs/String"), "topic name"),
        (("/new", "json", ""), "the type of /new is unknown"),
        (("/new", "json", "lab_msgs/Nothing"), "Nothing"),
        (("/new", "json", "../../etc"), "is not the name of a ROS type"),
        (("/new", "protobuf", "foxglove.Log"), "publish cdr or json"),
        (
            ("/odometry", "cdr", "std_msgs/String"),
            "/odometry is nav_msgs/Odometry or r2p_msgs/Odometry, not std_msgs/String",
        ),
    ],
)
async def test_a_channel_that_can_not_be_published_is_refused_in_words(channel: Any, text: str) -> None:
    network = Network()
    async with network.node("A") as node, network.module("PC", observer=True) as pc:
        node.subscribe("odometry", Odometry)
        async with serving(pc, allow_publish=True) as server, viewer(server) as one:
            await until(lambda: "odometry" in pc.network.topics())
            advertise(one, 1, *channel)
            await until(lambda: one.status)
            assert text in one.status[0]
            assert server.refused == {"invalid channel": 1}
            one.send(published(1, b"{}"))
            await until(lambda: one.status[1:])
            assert one.status[1] == "channel 1 is not advertised"


@pytest.mark.parametrize("data", [b"", b"[", b"[1]", b'{"text": 5, "no": 1}', b'{"text":' + b"[" * 10_000, b"\xff"])
async def test_a_message_that_is_none_of_its_type_is_refused(data: bytes) -> None:
    network = Network()
    async with (
        network.module("PC", observer=True) as pc,
        serving(pc, allow_publish=True) as server,
        viewer(server) as one,
    ):
        advertise(one, 1, "/text", "json", "r2p_msgs/Text")
        advertise(one, 2, "/number", "cdr", "std_msgs/Float64")
        one.send(published(2, data))
        await until(lambda: one.status)
        if data:
            one.send(published(1, data))
            await until(lambda: one.status[1:])
        assert server.refused["invalid message"] == len(one.status)


async def test_without_permission_nothing_is_published_called_or_set() -> None:
    network = Network()
    async with (
        network.module("BASE") as base,
        network.module("PC", observer=True) as pc,
        serving(pc) as server,
        node_in(base) as node,
        viewer(server) as one,
    ):
        gain = node.parameter("gain", 1.5)
        node.serve("scale", Scale, _scale)
        await until(lambda: "scale_q" in pc.network.topics() and one.got("serverInfo"))
        assert one.got("serverInfo")[0]["capabilities"] == [
            "parameters",
            "parametersSubscribe",
            "connectionGraph",
            "time",
        ]
        advertise(one, 1, "/text", "json", "std_msgs/String")
        one.send(published(1, b"{}"))
        one.call(1, 7, "json", b"{}")
        one.say("setParameters", parameters=[{"name": "BASE/test.gain", "value": 2.0}])
        await until(lambda: one.got("parameterValues") and one.got("serviceCallFailure"))
        assert "start it with --allow-publish" in one.got("serviceCallFailure")[0]["message"]
        assert one.got("parameterValues")[0]["parameters"][0]["value"] == gain.value == 1.5
        assert [each.rpartition("start it with ")[2] for each in one.status] == [
            "--allow-publish",
            "--allow-publish",
            "--allow-control",
        ]
        assert not one.got("advertiseServices")
        assert sum(server.refused.values()) == 4


# Services


async def _scale(request: Scale.Request) -> Scale.Response:
    if request.value < 0:
        raise r2p.Error("below 0")
    return Scale.Response(2 * request.value)


async def test_services_are_called_in_cdr_and_json() -> None:
    network = Network()
    async with (
        network.node("BASE") as node,
        network.module("PC", observer=True) as pc,
        serving(pc, allow_publish=True) as server,
        viewer(server) as one,
    ):
        scale = node.serve("scale", Scale, _scale)
        await until(lambda: one.got("advertiseServices"))
        (service,) = one.got("advertiseServices")[0]["services"]
        assert (service["name"], service["type"]) == ("/scale", "lab_msgs/srv/Scale")
        assert service["request"] == {
            "encoding": "cdr",
            "schemaName": "lab_msgs/srv/Scale_Request",
            "schemaEncoding": "ros2msg",
            "schema": "float64 value\n",
        }
        one.call(service["id"], 1, "cdr", cdr(Scale.Request).encode(Scale.Request(2.0)))
        await until(lambda: one.binary(3))
        one.call(service["id"], 2, "json", b'{"value": 3}')
        await until(lambda: one.binary(3)[1:])
        answers = [(*struct.unpack_from("<III", each, 1), each[13:]) for each in one.binary(3)]
        body = cdr(Scale.Response).encode(Scale.Response(4.0))
        assert answers == [(service["id"], 1, 3, b"cdr" + body), (service["id"], 2, 4, b'json{"result":6.0}')]
        one.call(service["id"], 3, "json", b'{"value": -1}')
        one.call(service["id"], 4, "xml", b"")
        one.call(99, 5, "json", b"{}")
        await until(lambda: len(one.got("serviceCallFailure")) == 3)
        failures = {each["callId"]: each["message"] for each in one.got("serviceCallFailure")}
        assert failures[3] == "service scale of BASE: it failed; its log says why"
        assert "send cdr or json" in failures[4]
        assert failures[5] == "there is no service 99"
        scale.close()
        await until(lambda: one.got("unadvertiseServices"))
        assert one.got("unadvertiseServices")[0]["serviceIds"] == [service["id"]]


async def test_no_more_requests_wait_than_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "REQUESTS_MAX", 2)
    network = Network()
    async with network.node("BASE") as node, network.module("PC", observer=True) as pc:
        never = asyncio.Event()

        async def wait(request: Scale.Request) -> Scale.Response:
            await never.wait()
            return Scale.Response()

        node.serve("scale", Scale, wait)
        async with serving(pc, allow_publish=True) as server, viewer(server) as one:
            await until(lambda: one.got("advertiseServices"))
            for number in range(3):
                one.call(1, number, "json", b"{}")
            await until(lambda: one.got("serviceCallFailure"))
            assert one.got("serviceCallFailure")[0]["callId"] == 2


# Parameters


async def test_parameters_are_read_set_and_followed() -> None:
    network = Network()
    async with (
        network.module("BASE") as base,
        network.module("PC", observer=True) as pc,
        node_in(base) as node,
        serving(pc, allow_control=True) as server,
        viewer(server) as one,
    ):
        gain = node.parameter("gain", 1.5, max=10.0)
        steps = node.parameter("steps", 3)
        node.parameter("limits", (1.0, 2.0))
        await until(lambda: any(each.name == "BASE" for each in pc.network.modules()))
        one.say("getParameters", parameterNames=[], id="all")
        one.say("getParameters", parameterNames=["BASE/test.steps", "BASE/test.none", "X/y.z"], id="one")
        await until(lambda: len(one.got("parameterValues")) == 2)
        by_id = {each["id"]: each["parameters"] for each in one.got("parameterValues")}
        assert by_id["all"] == [
            {"name": "BASE/test.gain", "value": 1.5, "type": "float64"},
            {"name": "BASE/test.steps", "value": 3},
            {"name": "BASE/test.limits", "value": [1.0, 2.0], "type": "float64_array"},
        ]
        assert by_id["one"] == [{"name": "BASE/test.steps", "value": 3}]
        one.say("subscribeParameterUpdates", parameterNames=["BASE/test.gain"])
        await asyncio.sleep(3.0)
        values = [{"name": "BASE/test.gain", "value": 2}, {"name": "BASE/test.steps", "value": 4.0}]
        one.say("setParameters", parameters=values, id="set")
        await until(lambda: len(one.got("parameterValues")) == 4)
        assert (gain.value, steps.value) == (2.0, 4)
        answer, news = sorted(one.got("parameterValues")[2:], key=lambda each: "id" not in each)
        assert [each["value"] for each in answer["parameters"]] == [2.0, 4]
        assert news["parameters"] == [{"name": "BASE/test.gain", "value": 2.0, "type": "float64"}]
        one.say("unsubscribeParameterUpdates", parameterNames=["BASE/test.gain"])
        one.say("setParameters", parameters=[{"name": "BASE/test.gain", "value": None}], id="reset")
        await until(lambda: gain.value == 1.5)
        await asyncio.sleep(3.0)
        assert len(one.got("parameterValues")) == 5


@pytest.mark.parametrize(
    ("parameter", "text"),
    [
        ({"name": "BASE/test.gain", "value": 11}, "BASE/test.gain"),
        ({"name": "BASE/test.gain", "value": "much"}, "much"),
        ({"name": "BASE/test.steps", "value": 1 << 70}, "BASE/test.steps"),
        ({"name": "BASE/test.gain", "value": 1 << 2000}, "BASE/test.gain"),
        ({"name": "BASE/test.gain", "value": True}, "BASE/test.gain"),
        ({"name": "BASE/test.gain", "value": {"a": [1]}}, "BASE/test.gain"),
        ({"name": "BASE/test.gain", "value": [[1]]}, "BASE/test.gain"),
        ({"name": "BASE/test.gain", "value": "AAAA", "type": "byte_array"}, "are not bytes"),
        ({"name": "BASE/test.speed", "value": 1}, "there is no parameter BASE/test.speed"),
    ],
)
async def test_a_value_that_is_refused_leaves_all_as_they_are(parameter: dict[str, Any], text: str) -> None:
    network = Network()
    async with (
        network.module("BASE") as base,
        network.module("PC", observer=True) as pc,
        node_in(base) as node,
        serving(pc, allow_control=True) as server,
        viewer(server) as one,
    ):
        gain, steps = node.parameter("gain", 1.5, max=10.0), node.parameter("steps", 3)
        other = node.parameter("other", 3)
        await until(lambda: any(each.name == "BASE" for each in pc.network.modules()))
        one.say("setParameters", parameters=[{"name": "BASE/test.other", "value": 4}, parameter])
        await until(lambda: one.status and one.got("parameterValues"))
        assert text in one.status[0]
        assert (gain.value, steps.value, other.value) == (1.5, 3, 3)
        assert server.refused == {"invalid parameter": 1}


# The graph, assets, and hostile clients


async def test_the_graph_of_connections_changes() -> None:
    network = Network()
    async with (
        network.node("A") as node,
        network.module("PC", observer=True) as pc,
        serving(pc, allow_publish=True) as server,
        viewer(server) as one,
    ):
        one.say("subscribeConnectionGraph")
        node.advertise("text", Text)
        node.serve("scale", Scale, _scale)
        async with network.node("B") as other:
            subscriber = other.subscribe("text", Text)
            await until(lambda: _edges(one, "subscribedTopics").get("/text"))
            assert _edges(one, "publishedTopics")["/text"] == ["A/test"]
            assert _edges(one, "subscribedTopics")["/text"] == ["B/test"]
            await until(lambda: _edges(one, "advertisedServices") == {"/scale": ["A/test"]})
            assert "/scale_q" not in _edges(one, "subscribedTopics")
            subscriber.close()
            await until(lambda: _edges(one, "subscribedTopics")["/text"] == [])
        one.say("unsubscribeConnectionGraph")
        count = len(one.got("connectionGraphUpdate"))
        node.advertise("more", Text)
        await until(lambda: "/more" in one.channels)
        assert len(one.got("connectionGraphUpdate")) == count


def _edges(one: Viewer, key: str) -> dict[str, list[str]]:
    ids = {"publishedTopics": "publisherIds", "subscribedTopics": "subscriberIds", "advertisedServices": "providerIds"}
    found: dict[str, list[str]] = {}
    for update in one.got("connectionGraphUpdate"):
        found |= {each["name"]: each[ids[key]] for each in update[key]}
    return found


async def test_time_is_sent_where_it_is_not_utc_and_assets_are_refused_in_words() -> None:
    network = Network()
    async with network.module("PC", observer=True) as pc, serving(pc) as server, viewer(server) as one:
        one.say("fetchAsset", uri="package://robot", requestId=9)
        await until(lambda: one.binary(4) and one.binary(2)[10:])
        request, failed, size = struct.unpack_from("<IBI", one.binary(4)[0], 1)
        assert (request, failed, len(one.binary(4)[0])) == (9, 1, 10 + size)
        times = [struct.unpack_from("<Q", each, 1)[0] for each in one.binary(2)]
        assert times == sorted(times)
        assert 0 <= pc.space.clock.now() - times[-1] < 100_000_000


HOSTILE: list[Callable[[], str | bytes]] = [
    lambda: "{",
    lambda: b"\x02",
    lambda: json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 77}]}),
    lambda: json.dumps({"op": "subscribeParameterUpdates", "parameterNames": [str(n) for n in range(5000)]}),
]


async def test_each_mistake_is_answered_and_counted_and_nobody_else_is_disturbed() -> None:
    network = Network()
    async with network.node("A") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        texts = node.advertise("text", Text)
        async with viewer(server) as bad, viewer(server) as good:
            await until(lambda: "/text" in good.channels)
            good.subscribe("/text", 1)
            await texts.wait_subscriber()
            for make in HOSTILE:
                bad.send(make())
            bad.subscribe("/text", 3)
            bad.subscribe("/text", 4)
            bad.say("unsubscribe", subscriptionIds=[99])
            bad.say("unadvertise", channelIds=[99])
            await texts.publish(Text("still here"))
            await until(lambda: good.data and bad.data and len(bad.status) == 6)
            assert sum(server.refused.values()) == 4
            assert not good.status
        await until(lambda: not server.sessions)


@settings(max_examples=20)
@given(st.lists(st.binary(max_size=30), min_size=1, max_size=10))
async def test_no_bytes_end_a_session(messages: list[bytes]) -> None:
    network = Network()
    async with (
        network.module("PC", observer=True) as pc,
        serving(pc, allow_publish=True, allow_control=True) as server,
        viewer(server) as one,
    ):
        for each in messages:
            one.send(each)
        one.say("fetchAsset", uri="", requestId=1)
        await until(lambda: one.binary(4))


async def test_a_viewer_gets_all_of_a_large_network_as_fast_as_it_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.web.client.ANSWERS_BYTES", 200_000)
    network = Network()
    async with network.node("A") as node, network.module("PC", observer=True) as pc, serving(pc) as server:
        for number in range(200):
            node.advertise(f"robot{number}/odometry", r2p.msg.Odometry)
        async with viewer(server) as first:
            await until(lambda: len(first.channels) > 200)
        async with viewer(server) as one:
            await until(lambda: len(one.channels) > 200)
            assert one.connection.closed is None


async def test_a_flood_of_mistakes_is_counted_and_keeps_no_other_viewer_waiting() -> None:
    network = Network()
    async with (
        network.node("A") as node,
        network.module("PC", observer=True) as pc,
        serving(pc) as server,
        viewer(server) as bad,
        viewer(server) as good,
    ):
        texts = node.advertise("text", Text)
        await until(lambda: "/text" in good.channels)
        bad.say("subscribe", subscriptions=[{"id": 1, "channelId": 1 << 20}] * 10_000)
        bad.say("subscribe", subscriptions=[{"id": 1, "channelId": good.channels["/text"]["id"]}] * 10_000)
        good.subscribe("/text", 1)
        await texts.wait_subscriber()
        await texts.publish(Text("still here"))
        await until(lambda: good.data and server.refused["unknown channel"] == 10_000)
        assert len(bad.status) <= MISTAKES_MAX


async def test_a_viewer_that_reads_nothing_is_disconnected_when_its_answers_do_not_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("r2p.web.client.ANSWERS_BYTES", 20_000)
    network = Network()
    async with network.module("PC", observer=True) as pc, serving(pc) as server, viewer(server) as one:
        await until(lambda: one.got("serverInfo"))
        one.connection.reads.clear()
        for _ in range(1000):
            one.send("{")
        await until(lambda: one.connection.closed)
