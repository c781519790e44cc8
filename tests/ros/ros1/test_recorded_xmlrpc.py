"""The XMLRPC connections of real ROS 1 programs, with r2p in the place of either side.

Where r2p answers something else than the node that was recorded, the table of differences says what, and why.
"""

from __future__ import annotations

import asyncio
import functools
import json
import os
import re
from collections import Counter
from typing import Any, NamedTuple

import pytest

from r2p.errors import DecodeError
from r2p.ros.ros1 import xmlrpc
from r2p.ros.ros1.master import MasterClient, MasterError, SystemState
from r2p.ros.ros1.slave import BusConnection, SlaveNode, request_topic
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError, XmlRpcServer
from r2p.ros.ros1.xmlrpc_codec import XmlFault, XmlResult, encode_call
from tests.ros.recorded import GOLDEN
from tests.ros.ros1.session import Recorder, running

pytestmark = pytest.mark.anyio

Call = dict[str, Any]


@functools.cache
def connections() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((GOLDEN / "ros1_xmlrpc.json").read_text())["connections"]
    return found


def plain(value: Any) -> Any:
    """A value as the recording has it."""
    match value:
        case bytes():
            return {"base64": value.hex()}
        case float() if value != value or value in (float("inf"), float("-inf")):
            return str(value)
        case dict():
            return {key: plain(each) for key, each in value.items()}
        case list() | tuple():
            return [plain(each) for each in value]
    return value


async def documents(data: str, *, answers: bool) -> list[Any]:
    """What r2p's end of a connection reads."""
    reader = asyncio.StreamReader()
    reader.feed_data(data.encode())
    reader.feed_eof()
    found: list[Any] = []
    while not reader.at_eof():
        _, header = await xmlrpc._read_head(reader)
        parser = await xmlrpc._read_body(reader, header)
        found.append(parser.answer() if answers else parser.call())
    return found


async def test_calls_are_read() -> None:
    for each in connections():
        read = await documents(each["sent"], answers=False)
        assert [(call.method, plain(call.arguments)) for call in read] == [
            (call["method"], call["args"]) for call in each["calls"]
        ]


async def test_calls_are_written_as_python_writes_them() -> None:
    for each in connections():
        if "Python-xmlrpc" in each["sent"]:
            bodies = [part.partition("\r\n\r\n")[2] for part in each["sent"].split("POST ")[1:]]
            read = await documents(each["sent"], answers=False)
            assert [encode_call(call.method, tuple(call.arguments)).decode() for call in read] == bodies


async def test_answers_are_read() -> None:
    """Python's server compresses long ones for clients that offer it; r2p does not."""
    for each in connections():
        if "answered_hex" in each:
            with pytest.raises((xmlrpc._HttpError, DecodeError, UnicodeError)):
                await documents(bytes.fromhex(each["answered_hex"]).decode("latin-1"), answers=True)
            continue
        for answer, call in zip(await documents(each["answered"], answers=True), each["calls"], strict=False):
            match answer:
                case XmlResult(value):
                    assert plain(value) == call["result"]
                case XmlFault(code, text):
                    assert [code, text] == call["fault"]


# The slave API

SAME_BUT_TEXT = "the text is for people: roscpp has none, or another one"
OF_A_TEST = "the answer of a plain publisher that tries what rospy and roscpp accept"
SPOILT = "rospy's cache has a number where a namespace comes, and it can't take that; r2p's can"
ROSPY_STATS = "rospy counts nothing for the topic; r2p adds up the connections"
FAULT = "rospy and roscpp answer an unknown method with a fault; to r2p it is an error of the caller like others"
MISSING = "roscpp has only some of the methods"
ROSCPP_STATS = "roscpp leaves code and text out, and counts other things"
LENIENT = "roscpp says yes to topics that it does not publish, to parameters that it does not know, and to no caller"
UNKNOWN = "roscpp's word for an empty list and for an unknown topic"
DIFFERENCES = {
    ("param_subscribe", 5, 0): SPOILT,
    ("param_subscribe", 5, 1): SPOILT,
    ("slave_api_rospy", 5, 7): ROSPY_STATS,
    ("slave_api_rospy", 5, 19): FAULT,
    **{("slave_api_roscpp", 8, index): MISSING for index in (1, 2, 3)},
    ("slave_api_roscpp", 8, 7): ROSCPP_STATS,
    **{("slave_api_roscpp", 8, index): LENIENT for index in (9, 13, 14)},
    **{("slave_api_roscpp", 8, index): UNKNOWN for index in (10, 12)},
    ("slave_api_roscpp", 8, 15): FAULT,
    **{("topic_plain_publisher_to_rospy", index, 0): OF_A_TEST for index in (25, 26, 29)},
    **{("topic_plain_publisher_to_roscpp", index, 0): OF_A_TEST for index in (21, 22, 28)},
}


class Exchange(NamedTuple):
    """One recorded call of a node, with what the node had then."""

    place: tuple[str, int, int]
    node: str
    call: Call
    registered: list[Call]


def slave_calls() -> list[Exchange]:
    found = []
    for each in connections():
        if each["server"] in (None, "master"):
            continue
        same = [other for other in connections() if other["case"] == each["case"] and other["client"] == each["server"]]
        registered = [call for other in same if other["server"] == "master" for call in other["calls"]]
        for index, call in enumerate(each["calls"]):
            if "result" in call or "fault" in call:
                place = each["case"], each["connection"], index
                found.append(Exchange(place, each["server"], call, registered))
    return found


def slave(exchange: Exchange) -> SlaveNode:
    """A node that has what the recorded one had."""
    recorder = Recorder()
    node = SlaveNode(exchange.node, Owner(recorder, exchange))
    tables = {"registerPublisher": node.publications, "registerSubscriber": node.subscriptions}
    for call in exchange.registered:
        if call["method"] in tables:
            tables[call["method"]][call["args"][1]] = call["args"][2]
    result = exchange.call.get("result")
    match exchange.call["method"], result:
        case "requestTopic", [1, _, ["TCPROS", _, port]]:
            recorder.ports.update({(exchange.node, topic): port for topic in node.publications})
        case "requestTopic", _:
            recorder.ports.update({(exchange.node, topic): 7 for topic in node.publications})
        case "getBusInfo", [1, _, rows]:
            recorder.bus = [
                BusConnection(n, topic, peer, way, up, 0, 0, *more) for n, peer, way, _, topic, up, *more in rows
            ]
        case "getBusStats", [1, _, [published, subscribed, _]]:
            for topic, _, rows in published:
                recorder.bus += [BusConnection(row[0], topic, "", "o", row[3], row[1], row[2]) for row in rows]
            for topic, rows in subscribed:
                recorder.bus += [BusConnection(row[0], topic, "", "i", row[4], row[1], row[2]) for row in rows]
    return node


class Owner:
    """The session of a node."""

    master_uri = "http://127.0.0.1:11311"
    host = "127.0.0.1"

    def __init__(self, recorder: Recorder, exchange: Exchange) -> None:
        self.slaves = recorder
        self._exchange = exchange

    def publishers_updated(self, node: str, topic: str, publishers: list[str]) -> None: ...
    def shutdown_asked(self, node: str, caller: str, reason: str) -> None: ...

    def parameter_updated(self, node: str, key: str, value: object) -> bool:
        keys = [call["args"][2] for call in self._exchange.registered if call["method"] == "subscribeParam"]
        return any(f"{key}/".startswith(f"{each}/") for each in keys)

    def slave_uri(self, node: str) -> str:
        return str(next(each["args"][-1] for each in self._exchange.registered if "register" in each["method"]))


def same(answer: Any, recorded: Any) -> bool:
    """Whether code and value of two answers are the same; their texts are for people."""
    if not isinstance(recorded, list) or len(recorded) != 3:
        return False
    return bool(answer[0] == recorded[0] and answer[2] == recorded[2])


def test_slaves_answer_as_recorded() -> None:
    different = set()
    for exchange in slave_calls():
        call = exchange.call
        answer = plain(slave(exchange).handle(call["method"], call["args"]))
        if call["method"] == "getPid" and answer[0] == 1:
            assert answer[2] == os.getpid()
            answer[2] = call["result"][2]
        if not same(answer, call.get("result")):
            different.add(exchange.place)
    assert different == set(DIFFERENCES)


def test_rospys_texts_are_the_same() -> None:
    """Some tools show them."""
    for exchange in slave_calls():
        if exchange.place[0] == "slave_api_rospy" and exchange.place not in DIFFERENCES:
            call = exchange.call
            assert plain(slave(exchange).handle(call["method"], call["args"]))[1] == call["result"][1]


def test_several_calls_in_one() -> None:
    exchange = next(each for each in slave_calls() if each.call["method"] == "getName" and each.node == "/talker")
    calls: list[Any] = [{"methodName": "getName", "params": ["/me"]}, {"methodName": "no", "params": ["/me"]}, 7]
    assert slave(exchange).handle("system.multicall", [calls]) == [
        [[1, "", "/talker"]],
        [[-1, "unknown method no", 0]],
        {"faultCode": 1, "faultString": "a call has a methodName and params"},
    ]


# The other side: what subscribers and nodes make of answers


class Answers(XmlRpcClient):
    """A client that gets a recorded answer, and keeps what it was asked."""

    def __init__(self, call: Call) -> None:
        super().__init__()
        self.asked: list[object] = []
        self._call = call

    async def call(self, uri: str, method: str, *arguments: object, timeout: float = 5.0, keep: bool = False) -> Any:
        self.asked = [method, *arguments]
        if "result" not in self._call:
            raise XmlRpcError(str(self._call.get("fault")))
        return self._call["result"]


async def test_subscribers_find_their_publishers() -> None:
    found, refused = 0, []
    for exchange in slave_calls():
        if exchange.call["method"] != "requestTopic":
            continue
        try:
            host, _ = await request_topic(Answers(exchange.call), "http://there:1/", "/me", "/chat", 1.0)
            assert host == "127.0.0.1"
            found += 1
        except XmlRpcError as error:
            refused.append(str(error).partition("/chat at http://there:1/ ")[2])
    assert found == 63
    assert set(refused) == {
        "refuses the connection: Not a publisher of [/nope]",
        "refuses the connection: no supported protocol",
        "refuses the connection: no supported protocol implementations",
        "refuses the connection: not mine",
        "refuses the connection: ERROR: parameter [protocols] must be specified and non-empty",
        "refuses the connection: ERROR: parameter [topic] must be a non-empty string",
        "refuses the connection: Unknown Error",
        "does not say where to connect: ['OTHER', '127.0.0.1', 1]",
    }


_TOO_FEW = "Error: bad call arity"
METHODS: dict[str, Any] = {
    "registerPublisher": MasterClient.register_publisher,
    "unregisterPublisher": MasterClient.unregister_publisher,
    "registerSubscriber": MasterClient.register_subscriber,
    "unregisterSubscriber": MasterClient.unregister_subscriber,
    "registerService": MasterClient.register_service,
    "unregisterService": MasterClient.unregister_service,
    "lookupNode": MasterClient.lookup_node,
    "lookupService": MasterClient.lookup_service,
    "getSystemState": MasterClient.get_system_state,
    "getTopicTypes": MasterClient.get_topic_types,
    "getPid": MasterClient.get_pid,
    "getParam": MasterClient.get_param,
    "setParam": MasterClient.set_param,
    "deleteParam": MasterClient.delete_param,
    "subscribeParam": MasterClient.subscribe_param,
    "unsubscribeParam": MasterClient.unsubscribe_param,
}
OTHERS = ("getPublishedTopics", "getUri", "hasParam", "searchParam", "getParamNames")
"""Calls of other programs that r2p needs not; any call can be made."""


def meaning(method: str, value: Any) -> Any:
    """What a call of the master's client returns for a value."""
    match method:
        case "getSystemState":
            return SystemState(*map(dict, value))
        case "getTopicTypes":
            return dict(value)
        case "registerService" | "setParam" | "deleteParam":
            return None
    return value


async def test_the_masters_answers() -> None:
    """All calls of the master by all programs, with the arguments that they gave and the answers that they got."""
    seen = set()
    for each in connections():
        for call in each["calls"] if each["server"] == "master" else ():
            arguments = call["args"]
            method = call["method"]
            if method not in (*METHODS, *OTHERS) or call.get("result", ("", _TOO_FEW))[1] == _TOO_FEW:
                continue  # system.multicall, which r2p needs not; an unknown method; too few arguments
            client = Answers(call)
            master = MasterClient(client, each["server"])
            asked = METHODS[method](master, *arguments) if method in METHODS else master.call(method, *arguments)
            code, text, value = call["result"]
            if code == 1:
                assert await asked == meaning(call["method"], value)
            else:
                with pytest.raises(MasterError, match=re.escape(text)):
                    await asked
            assert client.asked == [call["method"], *arguments]
            seen.add(call["method"])
    assert seen == {*METHODS, *OTHERS}


# Whole lives


@pytest.mark.parametrize(
    ("case", "node"), [("node_life", "/life"), ("node_life_unregister", "/tidy"), ("node_name_collision", "/twin")]
)
async def test_what_a_node_registers_and_unregisters(case: str, node: str) -> None:
    """r2p unregisters one by one, in another order, and does not ask for rospy's parameters."""
    life = next(each for each in connections() if each["case"] == case and each["client"] == node)
    *calls, last = life["calls"]
    wanted = [call for call in calls if call["method"].startswith("register")]
    unregistered = {call["args"][1] for call in calls if call["method"].startswith("unregister")}
    unregistered |= {each["params"][1] for each in last["args"][0]}
    asked: list[tuple[str, list[Any]]] = []

    def answer(method: str, arguments: list[Any]) -> object:
        asked.append((method, arguments))
        known = {name: [node] for _, (_, name, *_) in filter(lambda each: "register" in each[0], asked)}
        tables = [[*known.items()]] * 3
        values = {"getSystemState": tables, "getPid": 7, "lookupNode": "", "getTopicTypes": []}
        return [1, "", values.get(method, [])]

    server = XmlRpcServer("127.0.0.1", answer, Counter())
    await server.start()
    async with running(f"http://127.0.0.1:{server.port}", node) as (session, recorder):
        for call in wanted:
            name, detail = call["args"][1:3]
            match call["method"]:
                case "registerPublisher":
                    session.advertise(node, name, detail)
                case "registerSubscriber":
                    session.subscribe(node, name, detail)
                case "registerService":
                    session.serve(node, name, int(detail.rpartition(":")[2]))
        await recorder.event("up")
        api = session.slave_uri(node)
    await server.close()
    registered = [(method, arguments) for method, arguments in asked if method.startswith("register")]
    assert sorted(registered) == sorted((call["method"], [*call["args"][:3], api]) for call in wanted)
    assert {arguments[1] for method, arguments in asked if method.startswith("unregister")} == unregistered
