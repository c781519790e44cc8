"""Calls and answers with anything in them: a node, a client of the master and a session live on."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from r2p.ros.ros1.environment import RosAddress
from r2p.ros.ros1.master import MasterClient, MasterError
from r2p.ros.ros1.registration import MasterSession
from r2p.ros.ros1.slave import _METHODS, request_topic
from r2p.ros.ros1.xmlrpc import XmlRpcClient, XmlRpcError
from r2p.ros.ros1.xmlrpc_codec import encode_result
from tests.ros.ros1.session import Recorder
from tests.ros.ros1.test_recorded_xmlrpc import METHODS
from tests.ros.ros1.test_xmlrpc_codec import VALUES

NAMES = st.sampled_from(["", "/", "/chat", "chat/", "/one", "/one/kp/", "//", "http://[::1", "http://a:1/", "TCPROS"])
ANYTHING = NAMES | VALUES | st.lists(st.lists(NAMES | st.integers(-1, 70000), max_size=3), max_size=3)


class Answering(XmlRpcClient):
    """A client that gets this answer to each call."""

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self._answer = answer

    async def call(self, uri: str, method: str, *arguments: object, timeout: float = 5.0, keep: bool = False) -> Any:
        return self._answer


async def _call(answer: Any) -> None:
    client = MasterClient(Answering(answer), "http://there:1")
    for call in METHODS.values():
        count = call.__code__.co_argcount - 1 - len(call.__defaults__ or ())
        with contextlib.suppress(MasterError, XmlRpcError):
            await call(client, *["/one"] * count)
    with contextlib.suppress(XmlRpcError):
        host, port = await request_topic(Answering(answer), "http://there:1/", "/one", "/chat", 1.0)
        assert (host.isprintable(), 0 < port < 65536) == (True, True)


@given(ANYTHING | st.tuples(st.sampled_from([-1, 0, 1]), NAMES, ANYTHING).map(list))
def test_any_answer(answer: Any) -> None:
    asyncio.run(_call(answer))


async def _ask(calls: list[tuple[str, list[Any]]]) -> None:
    recorder = Recorder()
    session = MasterSession(RosAddress("http://there:1", "127.0.0.1", "127.0.0.1"), recorder, Counter())
    session.add_node("/one")
    session.advertise("/one", "/chat", "std_msgs/String")
    session.subscribe("/one", "/chat", "std_msgs/String")
    session.watch_parameters("/one", recorder.parameter_changed)
    recorder.ports["/one", "/chat"] = 7
    node = session._nodes["/one"]
    for method, arguments in calls:
        encode_result(node.handle(method, arguments))
    await session._close()


METHOD = st.sampled_from([*_METHODS, "system.multicall", "nothing"])
CALLS = st.tuples(METHOD, st.lists(ANYTHING, max_size=4) | st.tuples(NAMES, NAMES, ANYTHING).map(list))
MULTICALL = st.lists(
    st.builds(lambda call: {"methodName": call[0], "params": call[1]}, CALLS) | ANYTHING, max_size=3
).map(lambda calls: ("system.multicall", [calls]))


@given(st.lists(CALLS | MULTICALL, max_size=6))
def test_any_call(calls: list[tuple[str, list[Any]]]) -> None:
    asyncio.run(_ask(calls))


async def _flood() -> None:
    session = MasterSession(RosAddress("http://127.0.0.1:1", "127.0.0.1", "127.0.0.1"), Recorder(), Counter())
    session.add_node("/one")
    call: tuple[str, list[Any]] = "shutdown", ["/master", "[/one] Reason: new node registered with same name"]
    for _ in range(100):
        session._nodes["/one"].handle(*call)
    assert len(session._tasks) == 1
    await asyncio.wait(session._tasks)
    session._nodes["/one"].handle(*call)
    assert len(session._tasks) == 1
    await session._close()


def test_the_master_is_asked_once_in_a_flood_of_calls_that_end_a_node() -> None:
    asyncio.run(_flood())
