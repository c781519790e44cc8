"""Topics between two links, and between a link and a bare zenoh session that does what rmw_zenoh does."""

import asyncio
from functools import partial

import msgspec
import pytest
import zenoh
import zenoh.ext

from r2p.ros.middleware import RosPeerEndpoint, RosType
from r2p.ros.ros2.keys import NO_HASH, data_key, encode_attachment
from r2p.ros.type_names import dds_type
from tests.ros.ros2.network import STRING, Recorder, endpoint, joined, matches, router
from tests.ros.ros2.recorded import recorded

pytestmark = pytest.mark.anyio
HELLO = b"\x00\x01\x00\x00\x03\x00\x00\x00hi\x00"


async def test_both_ways() -> None:
    """Messages arrive with their publisher's node, number, stamp and gid, and the graph shows both ends."""
    async with router() as network, joined(network, "/robot1/talker") as (a, user_a):
        a.advertise(endpoint("/robot1/talker"))
        async with joined(network, "/listener") as (b, user_b):
            b.subscribe(endpoint("/listener", reliable=False, depth=5))
            await user_a.until(lambda: "joined /chatter" in user_a.events)
            await user_b.until(lambda: "found /chatter /robot1/talker std_msgs/String" in user_b.events)
            for number in range(3):
                a.publish("/robot1/talker", "/chatter", HELLO + bytes([number]), 1_000 + number)
            await user_b.until(lambda: len(user_b.arrivals) == 3)
            first = user_b.arrivals[0]
            assert [each.data for each in user_b.arrivals] == [HELLO + bytes([n]) for n in range(3)]
            assert [(each.sequence, each.stamp) for each in user_b.arrivals] == [(1, 1_000), (2, 1_001), (3, 1_002)]
            assert (first.topic, first.node) == (b"/chatter", "/robot1/talker")
            await user_b.until(lambda: user_b.graph.publishers)
            (publisher,) = user_b.graph.publishers
            assert publisher == RosPeerEndpoint(
                "/robot1/talker", "/chatter", "std_msgs/String", STRING.checksum, endpoint("").qos, first.gid
            )
            assert user_b.graph.nodes == {"/robot1/talker"}
            await user_a.until(lambda: user_a.graph.subscribers)
            assert user_a.graph.nodes == {"/listener"}
        await user_a.until(lambda: "gone /chatter" in user_a.events and not user_a.graph.nodes)
        assert not a.lost


async def test_two_nodes_of_one_link_on_a_topic() -> None:
    """Each has a token of its own; a message is received once, and tells which of two nodes sent it."""
    async with router() as network, joined(network) as (a, user_a), joined(network) as (b, user_b):
        for node in ("/one", "/two"):
            a.advertise(endpoint(node))
            b.subscribe(endpoint(f"{node}_sub"))
        await user_a.until(lambda: "joined /chatter" in user_a.events and len(user_a.graph.subscribers) == 2)
        await user_b.until(lambda: len(user_b.graph.publishers) == 2)
        a.publish("/one", "/chatter", HELLO, 0)
        a.publish("/two", "/chatter", HELLO, 0)
        await user_b.until(lambda: len(user_b.arrivals) == 2)
        assert [(each.node, each.sequence) for each in user_b.arrivals] == [("/one", 1), ("/two", 1)]
        b.unsubscribe(endpoint("/one_sub"))
        await user_a.until(lambda: len(user_a.graph.subscribers) == 1)
        assert "gone /chatter" not in user_a.events
        b.remove_node("/two_sub")
        await user_a.until(lambda: "gone /chatter" in user_a.events)
        a.withdraw(endpoint("/two"))
        await user_b.until(lambda: len(user_b.graph.publishers) == 1)
        assert len(user_b.arrivals) == 2  # not twice


async def test_latched() -> None:
    """A later subscriber gets the last message, also behind a router that was restarted; a volatile one gets none."""
    async with router() as network, joined(network, "/map_server") as (a, user_a):
        latched = endpoint("/map_server", "/map", transient_local=True, depth=1)
        a.advertise(latched)
        for number in range(3):
            a.publish("/map_server", "/map", bytes([number]) * 4, 0)
        async with joined(network, "/late") as (b, user_b):
            b.subscribe(msgspec.structs.replace(latched, node="/late"))
            b.subscribe(endpoint("/late", "/other"))
            await user_b.until(lambda: user_b.arrivals)
            await user_b.until(lambda: "found /map /map_server std_msgs/String latched" in user_b.events)
            a.publish("/map_server", "/map", b"next", 0)
            await user_b.until(lambda: len(user_b.arrivals) == 2)
            assert [(each.data, each.sequence) for each in user_b.arrivals] == [(b"\2" * 4, 3), (b"next", 4)]
        await network.stop()
        await user_a.until(lambda: "down: the connection is lost" in user_a.events)
        await network.start()
        async with joined(network, "/later") as (b, user_b), joined(network, "/volatile") as (c, user_c):
            c.subscribe(endpoint("/volatile", "/map"))
            b.subscribe(msgspec.structs.replace(latched, node="/later"))
            await user_b.until(lambda: user_b.arrivals)
            assert user_b.arrivals[0].data == b"next"
            assert not user_c.arrivals


async def test_router_lost_and_back() -> None:
    """It is looked for from the start, and everything is declared again when it returns."""
    async with router() as network:
        await network.stop()
        async with joined(network, "/talker") as (a, user_a), joined(network, "/listener") as (b, user_b):
            a.advertise(endpoint("/talker"))
            b.subscribe(endpoint("/listener"))
            await user_a.until(lambda: user_a.events)
            assert "no program listens at 127.0.0.1" in user_a.events[0]
            assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in user_a.events[0]
            for times in (1, 2):
                await network.start()
                await user_a.until(partial(_happened, user_a, "joined", times))
                await user_b.until(partial(_happened, user_b, "found", times))
                a.publish("/talker", "/chatter", HELLO, 0)
                await user_b.until(partial(_arrived, user_b, times))
                await network.stop()
                await user_a.until(partial(_happened, user_a, "down: the connection is lost", times))
            a.publish("/talker", "/chatter", HELLO, 0)  # into the void
            assert [each.sequence for each in user_b.arrivals] == [1, 2]


def _happened(user: Recorder, start: str, times: int) -> bool:
    return sum(each.startswith(start) for each in user.events) == times


def _arrived(user: Recorder, times: int) -> bool:
    return len(user.arrivals) == times


@pytest.mark.parametrize(
    ("type", "words"),
    [
        (RosType("std_msgs/Int32", STRING.checksum), "give both one type (--ros-type)"),
        (RosType("std_msgs/String", "RIHS01_" + "0" * 64), "another definition of std_msgs/String"),
        (RosType("std_msgs/String", NO_HASH), "run /old with ROS 2 Jazzy or later"),
    ],
)
async def test_types_that_do_not_match_are_explained(type: RosType, words: str) -> None:
    async with router() as network, joined(network, "/talker") as (a, user_a), joined(network, "/old") as (b, _):
        a.advertise(endpoint("/talker"))
        b.subscribe(endpoint("/old", type=type))
        await user_a.until(lambda: user_a.notices)
        (text,) = user_a.notices
        assert text.startswith("node /old subscribes to the topic /chatter")
        assert words in text
        assert "joined /chatter" not in user_a.events


async def test_qos_that_does_not_match_is_explained_and_works() -> None:
    async with router() as network, joined(network, "/a") as (a, user_a), joined(network, "/b") as (b, user_b):
        a.advertise(endpoint("/a", reliable=False))
        b.subscribe(endpoint("/b", transient_local=True))
        await user_b.until(lambda: user_b.notices)
        (text,) = user_b.notices
        assert text.startswith("/chatter, from /a to /b: the publisher is volatile")
        await user_a.until(lambda: "joined /chatter" in user_a.events)
        a.publish("/a", "/chatter", HELLO, 0)
        await user_b.until(lambda: user_b.arrivals)


async def test_a_reader_that_pauses() -> None:
    """Messages wait in zenoh for it, in order."""
    async with router() as network, joined(network) as (a, user_a), joined(network) as (b, user_b):
        a.advertise(endpoint("/a"))
        b.subscribe(endpoint("/b"))
        await user_a.until(lambda: "joined /chatter" in user_a.events)
        b.pause()
        for number in range(100):
            a.publish("/a", "/chatter", bytes([number]), 0)
        c = endpoint("/a", "/done")
        a.advertise(c)
        b.subscribe(endpoint("/b", "/done"))
        await user_a.until(lambda: "joined /done" in user_a.events)
        assert not user_b.arrivals
        b.resume()
        await user_b.until(lambda: len(user_b.arrivals) == 100)
        assert [each.data[0] for each in user_b.arrivals] == [*range(100)]


async def test_large_messages() -> None:
    """They go by a thread, in order with short ones behind them; too many are counted, and there is room later.

    A publisher that keeps all waits for the network; from any other one zenoh may drop what comes too fast.
    """
    async with router() as network, joined(network) as (a, user_a), joined(network) as (b, user_b):
        a.advertise(endpoint("/a", depth=0))
        b.subscribe(endpoint("/b", depth=0))
        await user_a.until(lambda: "joined /chatter" in user_a.events)
        image = bytes(5 << 20)
        for _ in range(3):
            a.publish("/a", "/chatter", image, 0)
            a.publish("/a", "/chatter", b"short", 0)
        assert a.full
        await user_b.until(lambda: len(user_b.arrivals) == 6)
        assert [len(each.data) for each in user_b.arrivals] == [len(image), 5] * 3
        await user_a.until(lambda: "room" in user_a.events)
        assert not a.full
        for _ in range(10):
            a.publish("/a", "/chatter", image, 0)
        assert a.lost == {"send buffer full": 3}
        await user_b.until(lambda: len(user_b.arrivals) == 13)
        a.withdraw(endpoint("/a", depth=0))
        a.advertise(endpoint("/a"))
        await user_a.until(lambda: user_a.events.count("joined /chatter") == 2)
        a.publish("/a", "/chatter", image, 0)
        await user_b.until(lambda: len(user_b.arrivals) == 14)
        assert b.lost == {}


async def test_a_change_of_qos_loses_and_repeats_nothing() -> None:
    """A link withdraws an endpoint and registers the changed one in one turn, at any time."""
    async with router() as network, joined(network) as (a, user_a), joined(network) as (b, user_b):
        first, second = endpoint("/a"), endpoint("/a", transient_local=True, depth=1)
        a.advertise(first)
        b.subscribe(endpoint("/b"))
        await user_a.until(lambda: "joined /chatter" in user_a.events)
        a.publish("/a", "/chatter", b"1", 0)
        a.withdraw(first)
        a.advertise(second)
        a.publish("/a", "/chatter", b"2", 0)
        await user_b.until(lambda: len(user_b.arrivals) == 2)
        b.unsubscribe(endpoint("/b"))
        b.subscribe(endpoint("/b", transient_local=True))
        a.publish("/a", "/chatter", b"3", 0)
        await user_b.until(lambda: len(user_b.arrivals) == 3)
        assert [each.data for each in user_b.arrivals] == [b"1", b"2", b"3"]
        b.unsubscribe(endpoint("/b", transient_local=True))
        await user_a.until(lambda: "gone /chatter" in user_a.events)
        b.subscribe(endpoint("/b", transient_local=True))  # later: it is a new one, which gets the latched value
        await user_b.until(lambda: len(user_b.arrivals) == 4)
        assert user_b.arrivals[3].data == b"3"


async def test_recorded_history() -> None:
    """A late subscriber gets what a publisher of another program keeps, with two differences from the SDK's.

    It gets as many messages as its depth says, and not the last one alone; and it asks a publisher that has declared no
    token, too. A volatile one gets none.
    """
    for case in recorded()["transient_local"]:
        durability, history = case["subscriber_qos"].split(":")[1:3]
        depth = 0 if history.startswith("2") else int(history.split(",")[1])
        wanted = endpoint("/late", "/latched", transient_local=bool(durability), depth=depth)
        key = data_key(0, "/latched", dds_type(STRING.name), STRING.checksum)
        async with router() as network, joined(network, "/late") as (b, user_b):
            with network.plain_session() as session:
                publisher = zenoh.ext.declare_advanced_publisher(
                    session, key, cache=zenoh.ext.CacheConfig(max_samples=3), publisher_detection=True
                )
                token = case["publisher_token"] and session.liveliness().declare_token(case["publisher_token"])
                for number in range(5):
                    publisher.put(b"v%d" % number, attachment=encode_attachment(number + 1, 0, bytes(16)))
                await asyncio.to_thread(lambda: [*session.get("none")])  # now the router has all of them
                b.subscribe(wanted)
                kept = [b"v2", b"v3", b"v4"][-(depth or 3) :] if durability else []
                await user_b.until(partial(has, user_b, len(kept)))
                with session.declare_publisher(key) as live:
                    await user_b.until(lambda: matches(live))
                    live.put(b"end", attachment=encode_attachment(9, 0, bytes(range(16))))
                    await user_b.until(lambda: user_b.arrivals and user_b.arrivals[-1].data == b"end")
                assert [each.data for each in user_b.arrivals[:-1]] == kept, case["note"]
                assert {each.encode() for each in case["delivered"]} <= set(kept)
                if token:
                    token.undeclare()
                publisher.undeclare()


def has(user: Recorder, count: int) -> bool:
    return len(user.arrivals) >= count
