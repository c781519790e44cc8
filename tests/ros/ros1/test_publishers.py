"""Queues of subscribers, latching, backpressure, servers: over a socket that takes what the test lets it."""

from __future__ import annotations

import asyncio
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.ros.middleware import Qos, RosEndpoint, RosServer, RosService, RosType
from r2p.ros.ros1 import tcpros
from r2p.ros.ros1.connections import HEADER_S, Ros1Context, TcprosConnection, TcprosListener
from r2p.ros.ros1.publishers import SLOW_S, Ros1Publication
from r2p.ros.ros1.services import REQUESTS_MAX, Ros1Server
from r2p.ros.ros1.subscribers import PublisherConnection, Ros1Subscription
from r2p.ros.ros1.xmlrpc import XmlRpcClient
from tests.ros.ros1.recorder import Recorder, Wire

pytestmark = pytest.mark.virtual_time

STRING = RosType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
SET_BOOL = RosService("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16")
CHAT = {"callerid": "/reader", "topic": "/chat", "type": "std_msgs/String", "md5sum": STRING.checksum}
SET = {"callerid": "/caller", "service": "/set", "md5sum": SET_BOOL.checksum, "persistent": "1"}

QOS = Qos()


class Node:
    """A node that publishes /chat and serves /set, without a network."""

    def __init__(self, qos: Qos = QOS) -> None:
        self.user = Recorder()
        self.context = Ros1Context(Counter())
        self.context.begin(self.user)
        self.listener = TcprosListener("/talker", "127.0.0.1", self.context)
        self.chat = Ros1Publication(RosEndpoint("/talker", "/chat", STRING, qos), self.context)
        self.set = Ros1Server(RosServer("/talker", "/set", SET_BOOL), self.context)
        self.listener.topics["/chat"] = self.chat
        self.listener.services["/set"] = self.set
        self.listener.close()  # no real connections

    def connect(self, data: bytes = b"") -> Wire:
        self.listener.closed = False
        wire = Wire()
        wire.connect(self.listener.protocol())
        if data:
            wire.receive(data)
        return wire

    def join(self) -> Wire:
        """A subscriber whose header is answered."""
        wire = self.connect(tcpros.encode_header(CHAT))
        assert b"latching" in wire.sent()
        return wire


def texts(data: bytes) -> list[bytes]:
    return tcpros.FrameReader(1000).feed(data)


async def test_a_single_message_goes_out_at_once_and_those_behind_it_together() -> None:
    node = Node()
    wire = node.join()
    before = wire.counts["writes"]
    for number in range(10):
        node.chat.publish(b"%d" % number)
    assert texts(wire.sent()) == [b"0"]
    await asyncio.sleep(0)
    assert texts(wire.sent()) == [b"%d" % number for number in range(1, 10)]
    assert wire.counts["writes"] == before + 2
    await asyncio.sleep(0.001)
    node.chat.publish(b"first of many?")
    assert texts(wire.sent()) == []
    await asyncio.sleep(0.001)
    assert texts(wire.sent()) == [b"first of many?"]
    node.chat.publish(b"no")
    assert texts(wire.sent()) == [b"no"]


async def test_a_subscriber_that_does_not_read_gets_the_newest_messages_and_stops_no_other_one() -> None:
    node = Node(Qos(depth=3, reliable=False))
    stuck, other = node.join(), node.join()
    stuck.takes = False
    for number in range(10):
        node.chat.publish(b"%d" % number)
        await asyncio.sleep(0)
    assert len(texts(other.sent())) == 10
    assert node.context.lost == Counter({"ROS subscriber too slow": 6})  # 0 is in the socket, 7 to 9 wait
    assert [each.dropped for each in node.chat.connections] == [6, 0]
    stuck.release()
    assert texts(stuck.sent()) == [b"0", b"7", b"8", b"9"]
    assert not node.context.without_room  # best effort never makes publishers wait


async def test_publishers_wait_for_a_subscriber_until_it_has_room_or_is_slow() -> None:
    node = Node(Qos(depth=2))
    wire = node.join()
    wire.takes = False
    for _ in range(3):
        node.chat.publish(b"x")
    assert node.context.without_room
    wire.release()
    assert not node.context.without_room
    assert node.user.log[-1] == ("made room",)
    await asyncio.sleep(0.001)
    wire.takes = False
    for _ in range(3):
        node.chat.publish(b"x")
    await asyncio.sleep(SLOW_S)
    assert not node.context.without_room
    assert "/reader reads [/chat] too slowly" in node.user.notices["slow subscriber: /chat"]
    node.chat.publish(b"x")
    assert not node.context.without_room  # it is still slow
    wire.release()
    await asyncio.sleep(0.001)
    wire.takes = False
    for _ in range(3):
        node.chat.publish(b"x")
    assert node.context.without_room  # it has read: it is waited for again


async def test_a_subscriber_that_reads_bit_by_bit_is_not_slow() -> None:
    node = Node(Qos(depth=1))
    wire = node.join()
    wire.takes = False
    node.chat.publish(b"x" * 1000)
    node.chat.publish(b"y")
    for _ in range(5):
        del wire.held[:100]
        await asyncio.sleep(SLOW_S)
        assert node.context.without_room
    wire.close()
    assert not node.context.without_room
    assert node.user.log[-2:] == [("made room",), ("subscribers gone", "/chat")]


async def test_a_latched_topic_gives_its_last_message_to_each_new_subscriber() -> None:
    node = Node(Qos(transient_local=True))
    assert texts(node.connect(tcpros.encode_header(CHAT)).sent())[1:] == []
    node.chat.publish(b"old")
    node.chat.publish(b"last")
    header, *messages = texts(node.connect(tcpros.encode_header(CHAT)).sent())
    assert (tcpros.decode_header(header)["latching"], messages) == ("1", [b"last"])


async def test_another_quality_of_service_keeps_the_connections() -> None:
    node = Node(Qos(depth=1, reliable=False))
    wire = node.join()
    node.chat.change(RosEndpoint("/talker", "/chat", STRING, Qos(depth=3, transient_local=True)))
    wire.takes = False
    for number in range(4):
        node.chat.publish(b"%d" % number)
    assert (node.context.lost, node.chat.last) == (Counter(), tcpros.frame(b"3"))
    wire.release()
    assert texts(wire.sent()) == [b"0", b"1", b"2", b"3"]


async def test_a_connection_that_was_given_up_is_closed_as_soon_as_it_is_there() -> None:
    wire, connection = Wire(), TcprosConnection(Node().context)
    connection.abort()
    wire.connect(connection)
    assert wire.closed


async def test_what_waits_is_sent_before_a_publication_closes() -> None:
    node = Node()
    wire = node.join()
    node.chat.publish(b"one")
    node.chat.publish(b"two")
    node.chat.close()
    assert (texts(wire.sent()), wire.closed) == ([b"one", b"two"], True)
    assert node.context.lost == Counter()


async def test_a_connection_that_is_not_to_be_read_stops_at_its_next_message() -> None:
    node = Node()
    subscription = Ros1Subscription(node.context, XmlRpcClient(), "/in")
    subscription.endpoints.append(RosEndpoint("/talker", "/in", STRING))
    wire = Wire()
    wire.connect(PublisherConnection(subscription, "http://other:1/"))
    wire.receive(tcpros.encode_header(CHAT | {"callerid": "/other"}) + tcpros.frame(b"one"))
    node.context.paused = True
    assert wire.reads
    wire.receive(tcpros.frame(b"two"))
    assert not wire.reads
    node.context.resume()
    assert wire.reads
    assert node.user.data("/in") == [b"one", b"two"]
    wire.close()


async def test_requests_of_one_connection_are_answered_in_turn_and_a_flood_is_not_read() -> None:
    node = Node()
    wire = node.connect(tcpros.encode_header(SET) + b"".join(tcpros.frame(b"%d" % n) for n in range(REQUESTS_MAX + 1)))
    wire.sent()
    assert (len(node.user.requests), wire.reads) == (1, False)
    for number in range(REQUESTS_MAX + 1):
        _, caller, request, answer, refuse = node.user.requests[number]
        assert (caller, request) == ("/caller", b"%d" % number)
        refuse("no") if number == 0 else answer(request)
        answer(b"twice")  # which counts for nothing
    responses = tcpros.ResponseReader().feed(wire.sent())
    assert [each.data for each in responses] == [b"no", *(b"%d" % n for n in range(1, REQUESTS_MAX + 1))]
    assert wire.reads


async def test_thousands_of_requests_in_one_piece_are_answered_while_the_caller_reads() -> None:
    node = Node()
    node.user.serve = bytes
    wire = node.connect(tcpros.encode_header(SET))
    wire.sent()
    wire.receive(tcpros.frame(b"") * 3000)
    assert len(tcpros.ResponseReader().feed(wire.sent())) == 3000
    wire.takes = False
    wire.receive(tcpros.frame(b"large") * 3000)
    assert (len(wire.held), wire.reads, len(node.user.requests)) == (len(b"\1\5\0\0\0large"), False, 3001)
    wire.release()
    assert (len(node.user.requests), wire.reads) == (6000, True)
    node.user.serve = None
    wire.sent()
    wire.receive(tcpros.frame(b"a") * 3)
    node.set.close()
    assert len(tcpros.ResponseReader().feed(wire.sent())) == 3
    assert len(node.user.requests) == 6001  # those that wait are refused, and not handled


async def test_connections_without_a_header_hold_little() -> None:
    node = Node()
    wire = node.connect((256 << 10).to_bytes(4, "little") + bytes(1000))
    assert not wire.closed
    wire = node.connect(((256 << 10) + 1).to_bytes(4, "little"))
    assert b"its header is not one of TCPROS: 262145 bytes are announced" in wire.sent()
    assert wire.closed


async def test_connections_over_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Connections that send no header keep out no other one, and subscribers and callers are not without a limit."""
    monkeypatch.setattr("r2p.ros.ros1.connections.CONNECTIONS_MAX", 2)
    node = Node()
    silent = [node.connect() for _ in range(3)]
    assert [each.closed for each in silent] == [True, False, False]
    first = node.join()
    node.connect(tcpros.encode_header(SET))
    third = node.connect(tcpros.encode_header(CHAT))
    assert b"[/talker] has 2 connections, and accepts no more" in third.sent()
    assert (third.closed, len(node.chat.connections), node.context.lost["connection not admitted"]) == (True, 1, 3)
    first.close()
    assert not node.join().closed


async def test_a_server_that_ends_refuses_and_a_caller_that_ends_cancels() -> None:
    node = Node()
    wire, gone = node.connect(tcpros.encode_header(SET)), node.connect(tcpros.encode_header(SET))
    wire.sent()
    wire.receive(tcpros.frame(b"a"))
    gone.receive(tcpros.frame(b"b"))
    gone.close()
    assert (node.user.log, node.context.lost) == ([("cancelled", "/set")], Counter({"ROS caller gone": 1}))
    node.set.close()
    assert tcpros.ResponseReader().feed(wire.sent()) == [(False, b"service [/set] is not served any more")]
    node.user.requests[0][3](b"late")
    node.user.requests[1][3](b"late")
    assert wire.closed


async def test_a_connection_without_a_header_is_closed() -> None:
    node = Node()
    wire = node.connect(b"\x10\0\0\0")
    await asyncio.sleep(HEADER_S)
    assert (wire.closed, node.context.lost) == (True, Counter({"bad connection header": 1}))
    assert b"no header came within 5 s" in wire.sent()
    assert not node.listener.pending


@given(st.lists(st.binary(max_size=50), max_size=4), st.sampled_from([b"", tcpros.encode_header(SET)]))
def test_hostile_bytes_end_in_an_answer_or_a_closed_connection(received: list[bytes], before: bytes) -> None:
    async def run() -> None:
        node = Node()
        wire = node.connect(before)
        for data in received:
            if not wire.closed:
                wire.receive(data)
        if not wire.closed:
            wire.close()
        assert not node.listener.pending
        assert not node.set.connections

    asyncio.run(run())
