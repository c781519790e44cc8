"""DDS between two participants of one program: what is sent arrives, and what can't work is said in words."""

from __future__ import annotations

import asyncio
import contextlib
import random
import threading
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.clock import SystemClock
from r2p.errors import ServiceError, TransportError
from r2p.msg import String
from r2p.ros.middleware import Qos, RosArrival, RosEndpoint, RosServer, RosService, RosType
from r2p.testing.network import node_in
from r2p.transports.url import open_transport
from tests.ros.ros1.recorder import Recorder

pytest.importorskip("cyclonedds", reason="Cyclone DDS has no wheels for this computer: no test of dds:")

from r2p.ros.dds.cyclone import DdsEvents, Participant
from r2p.ros.dds.middleware import SLOW, DdsMiddleware

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

pytestmark = pytest.mark.anyio

TEXT = RosType("std_msgs/String", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")


@pytest.fixture(scope="module")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {"use_uvloop": True}


@pytest.fixture(scope="module")
def domain() -> int:
    return random.SystemRandom().randrange(100, 200)


@contextlib.asynccontextmanager
async def participant(domain: int) -> AsyncGenerator[tuple[DdsMiddleware, Recorder], None]:
    middleware, user, opened = DdsMiddleware(domain, "lo"), Recorder(), asyncio.Event()
    running = asyncio.create_task(middleware.run(user, opened.set))
    try:
        await asyncio.wait([running, asyncio.create_task(opened.wait())], return_when=asyncio.FIRST_COMPLETED)
        if running.done():
            await running
        yield middleware, user
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


def endpoint(topic: str, node: str = "/a", type: RosType = TEXT, **qos: Any) -> RosEndpoint:
    return RosEndpoint(node, topic, type, Qos(**qos))


def found(user: Recorder) -> bool:
    return any(each[0] == "publisher found" for each in user.log)


def text(number: int) -> bytes:
    return b"\0\1\0\0" + (5).to_bytes(4, "little") + f"{number:04}".encode() + b"\0\0\0\0"


async def test_all_messages_arrive_in_order_also_while_the_reader_pauses(domain: int) -> None:
    async with participant(domain) as (sender, sends), participant(domain) as (receiver, receives):
        sender.add_node("/a")
        receiver.add_node("/b")
        sender.advertise(endpoint("/flow", depth=0))
        sender.subscribe(endpoint("/flow"))  # a link gets none of its own messages
        receiver.subscribe(endpoint("/flow", "/b", depth=0))
        receiver.subscribe(endpoint("/flow", "/c", depth=0))  # and each message once
        await sends.until(lambda: ("subscriber joined", "/flow") in sends.log)
        await receives.until(lambda: found(receives) and receives.graph.nodes == {"/a"})
        receiver.pause()
        for number in range(300):
            sender.publish("/a", "/flow", text(number), 0)
        receiver.resume()
        await receives.until(lambda: len(receives.arrivals) >= 300)
        assert receives.data("/flow") == [text(number) for number in range(300)]
        assert {each.node for each in receives.arrivals} == {"/a"}
        assert not sends.arrivals
        sender.withdraw(endpoint("/flow", depth=0))
        await receives.until(lambda: any(each[:2] == ("publisher gone", "/flow") for each in receives.log))
        assert not sender.lost
        assert not receiver.lost


async def test_messages_wait_for_a_writer_without_room_and_the_oldest_gives_way(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with participant(domain) as (sender, sends):
        sender.advertise(endpoint("/images", depth=3))
        cyclone = sender._participant
        assert cyclone is not None
        written: list[bytes] = []
        has_room = False

        def write(_number: int, data: bytes) -> bool:
            if has_room:
                written.append(data)
            return has_room

        monkeypatch.setattr(cyclone, "write", write)
        for number in range(5):
            sender.publish("/a", "/images", text(number), 0)
        assert sender.full
        assert sender.lost == {"send buffer full": 2}
        has_room = True
        await sends.until(lambda: ("made room",) in sends.log)
        assert [each for each in written if each.startswith(text(0)[:8])] == [text(number) for number in (2, 3, 4)]
        has_room = False
        sender.publish("/a", "/images", text(5), 0)
        monkeypatch.setattr(sender._clock, "monotonic", lambda: SystemClock().monotonic() + 2 * SLOW)
        assert not sender.full  # a subscriber that has not read for so long is not waited for


async def test_what_does_not_fit_is_said_with_what_to_change(domain: int) -> None:
    async with participant(domain) as (one, hears), participant(domain) as (other, notes):
        one.advertise(endpoint("/scan", reliable=False))
        one.advertise(endpoint("/pose"))
        other.subscribe(endpoint("/scan"))
        other.subscribe(endpoint("/pose", type=RosType("geometry_msgs/Pose", "RIHS01_00")))
        await hears.until(lambda: "qos /scan" in hears.notices)
        await notes.until(lambda: {"qos /scan", "type rt/pose"} <= notes.notices.keys())
        assert hears.notices["qos /scan"] == (
            "a subscriber of /scan asks for reliable delivery, which this publisher does not offer, so no messages "
            "flow between them: --qos scan=reliable makes them fit"
        )
        assert notes.notices["qos /scan"].endswith("--qos scan=best_effort makes them fit")
        assert (
            "has the type geometry_msgs/Pose here and std_msgs::msg::dds_::String_ elsewhere"
            in (notes.notices["type rt/pose"])
        )
        server = RosServer("/a", "/home", RosService("std_srvs/Trigger", ""))
        one.serve(server)
        assert "not served over DDS" in hears.notices["services"]
        with pytest.raises(ServiceError, match="use ros2:, with zenoh, for services"):
            await one.call("/a", "/home", server.type, b"", 1.0)
        one.publish("/a", "/nowhere", b"\0\1\0\0\0\0\0\0", 0)
        assert one.lost == {"not advertised": 1}


async def test_modules_meet_on_a_domain(domain: int) -> None:
    url = f"dds:?domain={domain},interface=lo"
    async with r2p.Module("PC1", via=url) as pc, node_in(pc, name="talker") as talker:
        chatter = talker.advertise("chatter", String)
        async with r2p.Module("PC2", via=url) as other, node_in(other, name="listener") as listener:
            heard = listener.subscribe("chatter", String)
            await chatter.wait_subscriber()
            await chatter.publish(String(data="hello"))
            assert await heard.fetch() == String(data="hello")


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("dds:eth0", "DDS finds the others by itself: write dds:, or dds:.domain=3&interface=eth0"),
        ("dds:?domain=233", "a domain of ROS is a number from 0 to 232"),
        ("dds:?interface=nope9", "has no such network interface; it has .*lo"),
        ("dds:?topic=x", "has no option 'topic'; it knows: domain, interface, ns, ros_nodes"),
    ],
)
async def test_urls_that_can_not_work(url: str, error: str) -> None:
    with pytest.raises(TransportError, match=error):
        open_transport(url)


async def test_the_environment_of_ros_counts(monkeypatch: pytest.MonkeyPatch, domain: int) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    async with r2p.Module("PC1", via="dds:") as module:
        assert [each.name for each in module.links] == [f"dds:?domain={domain}"]
        with pytest.raises(TransportError, match=f"one interface for domain {domain}"):
            async with r2p.Module("PC2", via=f"dds:?domain={domain},interface=eth0"):
                pass
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "0")
    config = "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='nope9'/></Interfaces></General></Domain>"
    monkeypatch.setenv("CYCLONEDDS_URI", f"{config}</CycloneDDS>")
    with pytest.raises(TransportError, match="Cyclone DDS can't"):
        async with r2p.Module("PC3", via="dds:"):
            pass
    monkeypatch.setenv("ROS_DOMAIN_ID", "x")
    with pytest.raises(TransportError, match="ROS_DOMAIN_ID=x: a domain of ROS is a number"):
        open_transport("dds:")
    open_transport("dds:?domain=3")  # what the URL says does not need it


async def test_a_link_that_ends_while_it_joins_leaves_no_participant(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cyclone DDS takes a while to join: what is there only afterwards would be on the network for good."""
    events: list[str] = []
    began, go, closed = threading.Event(), threading.Event(), threading.Event()

    class Slow:
        def __init__(self, *_place: object) -> None:
            began.set()
            go.wait(30)
            events.append("joined")

        def close(self) -> None:
            events.append("closed")
            closed.set()

    monkeypatch.setattr("r2p.ros.dds.middleware.Participant", Slow)
    running = asyncio.create_task(DdsMiddleware(domain, "lo").run(Recorder(), lambda: None))
    await asyncio.to_thread(began.wait, 30)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    go.set()
    assert await asyncio.to_thread(closed.wait, 30)
    assert events == ["joined", "closed"]


@pytest.mark.internal_errors
async def test_what_can_not_be_read_and_errors_of_users_do_not_end_the_rest(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One peer whose announcement has what is not text; and a user that raises, more often than may wait."""
    noted = Participant._note

    def note(self: Participant, each: Any, kind: int, events: DdsEvents) -> None:
        if getattr(each, "topic_name", "") == "rt/bad":
            raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte")
        noted(self, each, kind, events)

    monkeypatch.setattr(Participant, "_note", note)
    async with participant(domain) as (sender, sends), participant(domain) as (receiver, receives):
        receiver.subscribe(endpoint("/good", "/b", depth=0))
        sender.advertise(endpoint("/bad"))
        sender.advertise(endpoint("/good", depth=0))
        await sends.until(lambda: ("subscriber joined", "/good") in sends.log)
        await receives.until(lambda: found(receives))
        heard: list[bytes] = []

        def fail(messages: list[RosArrival]) -> None:
            heard.extend(each.data for each in messages)
            receives.note("heard")
            raise ZeroDivisionError

        monkeypatch.setattr(receives, "received", fail)
        for number in range(20):
            sender.publish("/a", "/good", text(number), 0)
            await receives.until(lambda: heard[-1:] == [text(number)])  # noqa: B023 - awaited here
        assert receiver.lost["announcement that can't be read"] >= 1
        assert receiver.lost["internal error"] == 20
