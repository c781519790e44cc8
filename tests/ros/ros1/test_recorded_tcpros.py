"""The TCPROS connections of real ROS 1 programs, with r2p in the place of either side.

Where r2p does something else than the program that was recorded, the table of differences says what, and why.
"""

from __future__ import annotations

import asyncio
import functools
import json
from collections import Counter
from typing import NamedTuple

import pytest

from r2p.errors import ServiceError
from r2p.ros.middleware import Qos, RosEndpoint, RosServer, RosService, RosType
from r2p.ros.ros1 import tcpros
from r2p.ros.ros1.connections import Ros1Context, TcprosListener
from r2p.ros.ros1.publishers import Ros1Publication
from r2p.ros.ros1.services import Ros1Server, Ros1ServerConnection
from r2p.ros.ros1.subscribers import PublisherConnection, Ros1Subscription
from r2p.ros.ros1.tcpros import Fields, FrameReader, ResponseReader, decode_header
from r2p.ros.ros1.xmlrpc import XmlRpcClient
from tests.ros.recorded import GOLDEN
from tests.ros.ros1.recorder import Recorder, Wire

pytestmark = pytest.mark.virtual_time

STRING = RosType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
POSE = RosType("geometry_msgs/PoseStamped", "d3812c3cbc69362b77dc0b19b345f8f5")
TOPICS = {"/chat": STRING, "/chat2": STRING, "/in": STRING, "/self": STRING, "/pose": POSE}
SERVICES = {
    "/set": RosService("std_srvs/SetBool", "09fb03525b03e7ea1fd3992bafd87e16"),
    "/trig": RosService("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522"),
    "/rosout/get_loggers": RosService("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0"),
}

NO_ANSWER = "roscpp and rospy leave such a client without an answer until it goes; r2p says what is wrong, and closes"
SILENT_END = "rospy closes without a word; r2p says what is wrong"
OF_A_TEST = "the answer of a plain publisher that tries what rospy and roscpp accept; r2p sends its own"
CRASH = "Debian's roscpp crashes after its first answer; r2p goes on to the next request"
SERVER_DIFFERENCES = {
    ("topic_headers_plain_roscpp", 8): NO_ANSWER,
    ("topic_headers_broken", 0): NO_ANSWER,
    ("topic_headers_broken", 1): SILENT_END,
    ("topic_headers_broken", 2): SILENT_END,
    ("topic_headers_broken", 5): NO_ANSWER,
    ("service_roscpp_plain_persistent", 0): CRASH,
    **{("topic_plain_publisher_to_rospy", index): OF_A_TEST for index in range(1, 8)},
    **{("topic_plain_publisher_to_roscpp", index): OF_A_TEST for index in range(1, 8)},
}
"""What differs where r2p has the place of the side that is connected to."""

LENIENT = "rospy and roscpp deliver messages of another type than the one subscribed to: garbage. r2p refuses them"
CLIENT_DIFFERENCES = {("topic_plain_publisher_to_rospy", 3): LENIENT, ("topic_plain_publisher_to_roscpp", 3): LENIENT}
"""What differs where r2p has the place of the side that connects."""


class Recorded(NamedTuple):
    """A connection: what each side has sent, in turns."""

    case: str
    number: int
    client: str | None
    server: str | None
    closed_first_by: str
    turns: list[tuple[str, bytes]]

    @property
    def key(self) -> tuple[str, int]:
        return self.case, self.number

    def side(self, direction: str) -> bytes:
        return b"".join(data for each, data in self.turns if each == direction)


@functools.cache
def connections() -> list[Recorded]:
    cases = json.loads((GOLDEN / "ros1_tcpros.json").read_text())["cases"]
    return [
        Recorded(
            case,
            index,
            each["client"],
            each["server"],
            each["closed_first_by"],
            [(way, bytes.fromhex(data)) for way, data in each["events"]],
        )
        for case, content in cases.items()
        for index, each in enumerate(content["connections"])
    ]


def split(data: bytes) -> tuple[Fields | None, bytes]:
    """The header at the beginning, if it is one, and what follows."""
    reader = FrameReader(tcpros.MESSAGE_MAX)
    block = reader.first(data)
    if block is None:
        return None, b""
    try:
        return decode_header(block), data[4 + len(block) :]
    except ValueError:
        return None, b""


def frames(data: bytes) -> list[bytes]:
    return FrameReader(tcpros.MESSAGE_MAX).feed(data)


every_connection = pytest.mark.parametrize("connection", connections(), ids=lambda each: f"{each.case}-{each.number}")


@every_connection
async def test_r2p_in_the_place_of_the_server(connection: Recorded) -> None:
    user, context = Recorder(), Ros1Context(Counter())
    context.begin(user)
    request, calls = split(connection.side(">"))
    reply, answers = split(connection.side("<"))
    node = (reply or {}).get("callerid") or connection.server or "/talker"
    listener = TcprosListener(node, "127.0.0.1", context)
    wire = Wire()
    wire.connect(listener.protocol())
    publication = offer(listener, context, node, request or {}, reply or {})
    wire.receive(connection.side(">")[: len(connection.side(">")) - len(calls)])
    own, _ = split(wire.sent())
    difference = SERVER_DIFFERENCES.get(connection.key)
    if difference in (NO_ANSWER, SILENT_END):
        assert (reply, wire.closed) == (None, True)
        assert own is not None
        assert "error" in own
    elif difference is OF_A_TEST:
        assert own is not None
        assert "error" not in own
    elif reply is not None and "error" in reply:
        assert own is not None
        assert set(own) == {"error"}
        assert (wire.closed, context.lost.total()) == (True, 1)
    else:
        assert own is not None
        assert reply is not None
        assert own == {**own, **reply}  # r2p sends all that roscpp or rospy sends, and what the other one has more
        if "service" in own:
            answer_calls(user, wire, calls, answers, difference)
            assert wire.closed == (request is not None and "persistent" not in request)
        else:
            await publish_all(publication, wire, answers)
    listener.close()


def offer(
    listener: TcprosListener, context: Ros1Context, node: str, request: Fields, reply: Fields
) -> Ros1Publication | None:
    """Have what the recorded server had."""
    for service, kind in SERVICES.items():
        if service == request.get("service"):
            listener.services[service] = Ros1Server(RosServer(node, service, kind), context)
    publication = None
    for topic, known in TOPICS.items():
        if topic == request.get("topic"):
            kind_of_topic = RosType(known.name, known.checksum, reply.get("message_definition", known.definition))
            qos = Qos(transient_local=reply.get("latching") == "1")
            publication = Ros1Publication(RosEndpoint(node, topic, kind_of_topic, qos), context)
            listener.topics[topic] = publication
    return publication


async def publish_all(publication: Ros1Publication | None, wire: Wire, recorded: bytes) -> None:
    """Publish the recorded messages: the same bytes go out."""
    assert publication is not None
    for each in frames(recorded):
        publication.publish(each)
        await asyncio.sleep(0)
    assert wire.sent() == recorded


def answer_calls(user: Recorder, wire: Wire, calls: bytes, answers: bytes, difference: str | None) -> None:
    """Answer the recorded requests as recorded: the same bytes go out."""
    responses = ResponseReader().feed(answers)
    for index, request in enumerate(frames(calls)):
        wire.receive(tcpros.frame(request))
        assert user.requests[index][2] == request
        if index >= len(responses):
            assert difference is CRASH or request == b""  # rospy's thread dies of a request that is too short
            return
        _, _, _, answer, refuse = user.requests[index]
        response = responses[index]
        answer(response.data) if response.ok else refuse(response.data.decode())
    assert wire.sent() == answers


@every_connection
async def test_r2p_in_the_place_of_the_client(connection: Recorded) -> None:
    user, context = Recorder(), Ros1Context(Counter())
    context.begin(user)
    request, calls = split(connection.side(">"))
    reply, answers = split(connection.side("<"))
    if request is None or reply is None or not {"topic", "service"} & request.keys():
        assert "_headers_" in connection.case  # no header of r2p's is answered like that
        return
    if "service" in request:
        await call_as_recorded(context, request, reply, connection.side("<"), calls, answers)
        return
    node, topic = request.get("callerid", "/x"), request["topic"]
    kind = RosType(request.get("type", "*"), request.get("md5sum", "*"), request.get("message_definition", ""))
    subscription = Ros1Subscription(context, XmlRpcClient(), topic)
    subscription.endpoints.append(RosEndpoint(node, topic, kind))
    publisher, wire = PublisherConnection(subscription, "http://other:1/"), Wire()
    wire.connect(publisher)
    own, _ = split(wire.sent())
    if connection.client not in ("/plain_client", "/x", None):  # a program of ROS, not bytes by hand
        # r2p asks for messages without delay, and leaves out the empty definition of a type that it does not know.
        recorded = {name: value for name, value in request.items() if value}
        assert own == recorded | {"tcp_nodelay": "1"}
    wire.receive(connection.side("<"))
    if CLIENT_DIFFERENCES.get(connection.key) is LENIENT and kind.checksum != "*":
        assert "00000000000000000000000000000000" in user.notices[f"connection refused: {topic}"]
        assert (wire.closed, user.arrivals) == (True, [])
    elif "error" in reply or not {"md5sum", "type"} <= reply.keys():
        assert (wire.closed, user.arrivals) == (True, [])
        assert context.lost == Counter({"connection refused": 1})
    else:
        assert user.log == [("publisher found", topic, reply.get("callerid", ""), reply["type"])]
        assert user.data(topic) == frames(answers)
    wire.close()


async def call_as_recorded(
    context: Ros1Context, request: Fields, reply: Fields, received: bytes, calls: bytes, answers: bytes
) -> None:
    service = request["service"]
    kind = RosService(SERVICES[service].name if service in SERVICES else "", request.get("md5sum", "*"))
    flags = {"persistent": "persistent" in request, "probe": "probe" in request}
    own = tcpros.caller_header(request.get("callerid", "/x"), service, kind, **flags)
    if {"callerid", "md5sum"} <= request.keys():  # rospy's users can add fields; r2p adds the type for the other side
        assert own.items() - {("type", kind.name)} == request.items() - {("cookie", "a=b")}
    server, wire = Ros1ServerConnection(context), Wire()
    wire.connect(server)
    wire.receive(received[: len(received) - len(answers)])
    assert await server.header == reply
    if "error" in reply:
        assert tcpros.refuse_server(reply, service, kind) == reply["error"]
    else:
        assert tcpros.refuse_server(reply, service, kind) == ""
        for data, response in zip(frames(calls), ResponseReader().feed(answers), strict=False):
            call = asyncio.ensure_future(server.request(data))
            await asyncio.sleep(0)
            assert wire.sent() == tcpros.frame(data)
            wire.receive(
                tcpros.encode_response(response.data) if response.ok else tcpros.encode_failure(response.data.decode())
            )
            if response.ok:
                assert await call == response.data
            else:
                with pytest.raises(ServiceError, match=response.data.decode()):
                    await call
    wire.close()
