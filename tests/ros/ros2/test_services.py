"""Services between two links, and what a bare zenoh session asks a server or answers a client."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
import zenoh

import r2p
from r2p.ros.middleware import RosPeerServer, RosService
from r2p.ros.ros2.keys import NO_HASH, data_key, decode_attachment, encode_attachment
from r2p.ros.ros2.middleware import Ros2Middleware
from r2p.ros.type_names import dds_type
from tests.ros.ros2.network import SET_BOOL, Recorder, RouterOfTests, endpoint, joined, matches, router, server
from tests.ros.ros2.recorded import recorded

pytestmark = pytest.mark.anyio
KEY = data_key(0, "/set", dds_type(SET_BOOL.name, service=True), SET_BOOL.checksum)
GID = bytes(range(16))


async def test_calls() -> None:
    """A server has the caller's name, and answers several callers at once; errors come back as text."""
    async with (
        router() as network,
        joined(network, "/server") as (a, user_a),
        joined(network, "/caller") as (b, user_b),
    ):
        a.serve(server("/server"))
        await user_b.until(lambda: user_b.graph.servers)
        assert user_b.graph.servers == {RosPeerServer("/server", "/set", SET_BOOL.name, SET_BOOL.checksum)}
        # The client's token is there before its second request.
        assert await b.call("/caller", "/set", SET_BOOL, b"first", 5) == b"first"
        calls = [b.call("/caller", "/set", SET_BOOL, bytes([number]) * 40_000, 5) for number in range(3)]
        assert await asyncio.gather(*calls) == [bytes([number]) * 40_000 for number in range(3)]
        assert user_a.requests[-1][:2] == ("/set", "/caller")
        user_a.handle = lambda _request, _answer, refuse: refuse("the motor is off")
        with pytest.raises(r2p.ServiceError, match="the motor is off"):
            await b.call("/caller", "/set", SET_BOOL, b"x", 5)
        a.unserve(server("/server"))
        await user_b.until(lambda: not user_b.graph.servers)
        with pytest.raises(r2p.NoServer, match="no ROS node serves /set"):
            await b.call("/caller", "/set", SET_BOOL, b"x", 5)
        assert not a.lost
        assert not b.lost


async def test_a_server_that_does_not_answer() -> None:
    """The caller's time runs out; when a server ends, those that wait get its error; a caller that ends is noticed."""
    async with router() as network, joined(network, "/caller") as (b, user_b):
        async with joined(network, "/server") as (a, user_a):
            a.serve(server("/server"))
            user_a.handle = lambda _request, _answer, _refuse: None
            await user_b.until(lambda: user_b.graph.servers)
            with pytest.raises(TimeoutError):
                await b.call("/caller", "/set", SET_BOOL, b"x", 0.05)
            waiting = asyncio.ensure_future(b.call("/caller", "/set", SET_BOOL, b"y", float("inf")))
            await user_a.until(lambda: len(user_a.requests) == 2)
            # The caller ends: what is handled for it is cancelled.
            b.remove_node("/caller")
            with pytest.raises(r2p.ServiceError, match="its ROS node is closed"):
                await waiting
            await user_a.until(lambda: user_a.events.count("cancelled /set") == 2)
            again = asyncio.ensure_future(b.call("/other", "/set", SET_BOOL, b"z", 5))
            await user_a.until(lambda: len(user_a.requests) == 3)
        with pytest.raises(r2p.ServiceError, match="the server of /set ended"):
            await again
        await network.stop()
        await user_b.until(lambda: "down: the connection is lost" in user_b.events)
        with pytest.raises(r2p.NoServer, match="is not connected to zenoh's router"):
            await b.call("/caller", "/set", SET_BOOL, b"x", 5)


async def test_a_server_with_another_type() -> None:
    async with router() as network, joined(network, "/old") as (a, _), joined(network, "/caller") as (b, user_b):
        a.serve(server("/old"))
        await user_b.until(lambda: user_b.graph.servers)
        with pytest.raises(r2p.NoServer, match="another definition of std_srvs/SetBool"):
            await b.call("/caller", "/set", RosService("std_srvs/SetBool", "RIHS01_" + "0" * 64), b"x", 5)
        with pytest.raises(r2p.NoServer, match="has it as std_srvs/Trigger"):
            await b.call("/caller", "/set", RosService("std_srvs/Trigger", NO_HASH), b"x", 5)
        assert len(user_b.notices) == 1  # said once for each pair of nodes


@asynccontextmanager
async def served(network: RouterOfTests) -> AsyncIterator[tuple[Any, Recorder, zenoh.Session]]:
    async with joined(network, "/server") as (a, user_a):
        a.serve(server("/server"))
        with network.plain_session() as session, session.declare_querier(KEY) as querier:
            await user_a.until(lambda: matches(querier))
            yield a, user_a, session


async def ask(session: zenoh.Session, data: bytes | None, attachment: bytes | None) -> list[zenoh.Reply]:
    replies = session.get(KEY, payload=data, attachment=attachment, timeout=5)
    return await asyncio.to_thread(lambda: [*replies])


async def test_recorded_requests() -> None:
    """Each recorded request is served or refused as the SDK's server did it.

    Two differences: a request repeated with its number is answered again, but not handled again; and the bytes of a
    request are no business of this module, so a request cut short is passed on.
    """
    async with router() as network, served(network) as (a, user_a, session):
        user_a.handle = lambda _, answer, __: answer(b"response")
        handled: set[bytes] = set()
        for case in recorded()["server_accepts"]:
            if case["note"] in ("other hash", "key with a wildcard for the hash"):
                continue  # these never get here
            data = None if case["payload"] is None else bytes.fromhex(case["payload"])
            header = None if case["attachment"] is None else bytes.fromhex(case["attachment"])
            (reply,) = await ask(session, data, header)
            served_there = bool(case["callback_calls"]) or case["note"] == "payload cut"
            assert (reply.ok is not None) == served_there, case["note"]
            if reply.ok is None or header is None or reply.ok.attachment is None:
                continue
            number, _, gid = decode_attachment(reply.ok.attachment.to_bytes())
            asked_number, _, asked_gid = decode_attachment(header)
            assert (number, gid) == (asked_number, asked_gid.ljust(16, b"\0")), case["note"]
            handled.add(header)
        assert len(user_a.requests) == len(handled) - len([each for each in handled if len(each) == 34])
        assert a.lost["wrong request"] == 4


async def test_repetitions() -> None:
    """A request that comes again is answered as the first one, before and after that is; another one is not it."""
    async with router() as network, served(network) as (_, user_a, session):
        waiting: list[Any] = []
        user_a.handle = lambda _, answer, __: waiting.append(answer)
        header = encode_attachment(1, 5, GID)
        first = asyncio.ensure_future(ask(session, b"a", header))
        await user_a.until(lambda: waiting)
        second = asyncio.ensure_future(ask(session, b"a", header))
        other = asyncio.ensure_future(ask(session, b"b", header))
        await user_a.until(lambda: len(waiting) == 2)
        waiting[1](b"other")
        (reply,) = await other
        waiting[0](b"same")
        replies = [reply, *await first, *await second, *await ask(session, b"a", header)]
        assert [each.ok and each.ok.payload.to_bytes() for each in replies] == [b"other", b"same", b"same", b"same"]
        assert len(user_a.requests) == 2


async def test_a_flood_of_repetitions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a request that is not answered yet the last repetitions wait; and none is taken while callers do not read."""
    monkeypatch.setattr("r2p.ros.ros2.services._REPETITIONS_MAX", 2)
    async with router() as network, served(network) as (a, user_a, session):
        waiting: list[Any] = []
        user_a.handle = lambda _, answer, __: waiting.append(answer)
        header = encode_attachment(1, 5, GID)
        asked = [asyncio.ensure_future(ask(session, b"a", header)) for _ in range(6)]
        await user_a.until(lambda: a.lost["too many calls"] == 4)
        waiting[0](b"same")
        replies = [reply for each in asked for reply in await each]
        assert len(replies) == 2
        monkeypatch.setattr("r2p.ros.ros2.services._REPLIES_MAX", 0)
        assert await ask(session, b"b", header) == []
        assert (len(user_a.requests), a.lost) == (1, {"too many calls": 5})


async def test_clients_that_call_no_more_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.ros.ros2.middleware._CLIENTS_MAX", 2)
    async with router() as network, joined(network, "/caller") as (b, user_b):
        await user_b.until(lambda: "up" in user_b.events)
        for name in ("/a", "/b", "/a", "/c"):
            with pytest.raises(r2p.NoServer):
                await b.call("/caller", name, SET_BOOL, b"x", 5)
        assert [service for _, service, _ in b._clients] == ["/a", "/c"]


async def test_responses_that_are_not_for_the_caller() -> None:
    """A response needs no attachment; with another number or gid it is not the one that is waited for."""
    headers: list[bytes | None] = []

    def answer(query: zenoh.Query) -> None:
        assert query.attachment is not None
        number, _, gid = decode_attachment(query.attachment.to_bytes())
        for wrong in (encode_attachment(number + 1, 0, gid), encode_attachment(number, 0, GID), b"short"):
            query.reply(KEY, b"wrong", attachment=wrong)
        headers.append(query.attachment.to_bytes())
        query.reply(KEY, b"right")
        query.drop()

    async with router() as network, joined(network, "/caller") as (b, user_b):
        with network.plain_session() as session, session.declare_queryable(KEY, answer, complete=True):
            b.subscribe(endpoint("/caller"))
            while b.lost["wrong response"] < 6:
                try:
                    assert await b.call("/caller", "/set", SET_BOOL, b"x", 5) == b"right"
                except r2p.NoServer:
                    continue  # its queryable is not known here yet
        assert decode_attachment(headers[1] or b"")[0] == decode_attachment(headers[0] or b"")[0] + 1
        assert not user_b.notices


def replies_to(note: str, query: zenoh.Query) -> None:
    """Answer a request as the recorded peer did."""
    assert query.attachment is not None
    number, _, gid = decode_attachment(query.attachment.to_bytes())
    headers = {
        "reply without attachment": None,
        "reply with another gid": encode_attachment(number, 0, GID),
        "short attachment in the reply": b"short",
    }
    data = {"reply payload cut": b"4", "reply payload empty": b""}.get(note, b"42")
    if note.startswith("error"):
        query.reply_err(b"no")
    if note not in ("error reply", "no reply at all"):
        query.reply(KEY, data, attachment=headers.get(note, encode_attachment(number, 0, gid)))
    if note == "two replies":
        query.reply(KEY, b"2", attachment=encode_attachment(number, 0, gid))
    query.drop()


async def test_recorded_responses() -> None:
    """Each call ends as one of the SDK's did, with four differences.

    A response with another gid, or an attachment that is cut short, is not for this caller: it is counted. Where no
    answer comes, the call ends at once, and not after its whole time. An error is raised, with its text. And the bytes
    of a response are no business of this module: what is cut short is passed on.
    """
    silent = "no ROS node serves /set"
    expected: dict[str, bytes | str] = {
        "reply with another gid": silent,
        "short attachment in the reply": silent,
        "error reply": "no",
        "error then reply": "no",
        "reply payload cut": b"4",
        "reply payload empty": b"",
        "no reply at all": silent,
        "no server exists": silent,
    }
    asked: list[str] = []
    note = "no server exists"

    def answer(query: zenoh.Query) -> None:
        replies_to(note, query)
        asked.append(note)

    async with router() as network, joined(network, "/caller") as (b, _):
        assert await outcome(b) == silent
        with network.plain_session() as session, session.declare_queryable(KEY, answer, complete=True):
            for case in recorded()["client_accepts"]:
                note = case["note"]
                if note == "no server exists":
                    continue
                found: bytes | str = ""
                while note not in asked:  # its queryable is not known here at first
                    found = await outcome(b)
                assert found == expected.get(note, b"42"), note
                assert isinstance(found, str) or case["result"] in (42, 2) or found != b"42", note
        assert b.lost["wrong response"] == 2


async def outcome(middleware: Ros2Middleware) -> bytes | str:
    """The response to a call, or the text of its error."""
    try:
        return await middleware.call("/caller", "/set", SET_BOOL, b"x", 5)
    except (r2p.ServiceError, r2p.NoServer) as error:
        return str(error)
