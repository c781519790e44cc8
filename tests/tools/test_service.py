"""`r2p service`: what is served and called, and calls from the shell."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.codecs import management, schemas
from r2p.msg import Led
from r2p.tools.bag.record import SNAPSHOT_SERVICE, record
from r2p.tools.service import call, find, info, list_
from r2p.tools.session import TimedOut, UsageError
from r2p.tools.topic.list import list_ as topics
from tests.services.common import Add, add
from tests.tools.rig import Firmware, keep_types, printed, robot, tool

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.virtual_time

TYPE = "tests.services.common:Add"
TYPES = {"add": TYPE}


async def serve(node: r2p.Node) -> None:
    @node.service("add", Add)
    async def handle(request: Add.Request) -> Add.Response:
        if request.a == 13:
            raise r2p.ServiceError("unlucky")
        return await add(request)

    await node.spin()


async def ask(node: r2p.Node) -> None:
    node.client("add", Add)
    await asyncio.Event().wait()


async def test_list_info_and_find(capsys: pytest.CaptureFixture[str]) -> None:
    row = {
        "service": "add",
        "type": "tests/Add",
        "servers": ["BOT/serve"],
        "callers": ["BOT/ask"],
    }
    async with robot(serve, ask), tool(types=TYPES) as session:
        await list_(session)
        assert printed(capsys) == [row]
        await info(session, "add")
        fields = {"request_fields": {"a": "u32", "b": "u32"}, "response_fields": {"total": "u64", "spare": "u64[3]"}}
        assert printed(capsys) == [row | fields]
        await find(session, TYPE)
        assert printed(capsys) == [row | {"match": "type"}]
        with pytest.raises(r2p.Error, match=r"no services of type r2p\.msg:Led found on memory:lab"):
            await find(session, "r2p.msg:Led")
        with pytest.raises(r2p.Error, match="there is no service sub; services found: add"):
            await info(session, "sub")
    async with robot(serve), tool() as session:
        await list_(session)
        assert printed(capsys) == [row | {"callers": []}], "the module gives the types"
        await find(session, "tests/Add")
        assert printed(capsys) == [row | {"callers": [], "match": "type"}]
        with pytest.raises(UsageError, match=r"^Add\.Request has no field x: it has a, b"):
            await call(session, "add", ["x=1"])
    async with robot(serve) as module, tool() as session:
        keep_types(module)
        await list_(session)
        assert printed(capsys) == [row | {"type": None, "callers": []}]


async def test_topics_of_services_are_hidden(capsys: pytest.CaptureFixture[str]) -> None:
    async def other(node: r2p.Node) -> None:
        node.advertise("imu_q", Led)
        await asyncio.Event().wait()

    async with robot(serve, other), tool() as session:
        await topics(session)
        assert [row["topic"] for row in printed(capsys)] == ["imu_q", "log"]
        await topics(session, all=True)
        assert [row["topic"] for row in printed(capsys)] == ["add_q", "add_r", "imu_q", "log"]


@pytest.mark.parametrize("request_", [["{a: 1, b: 2}"], ['{"a": 1, "b": 2}'], ["a=1", "b=2"]])
async def test_call_prints_the_response(capsys: pytest.CaptureFixture[str], request_: list[str]) -> None:
    async with robot(serve), tool(types=TYPES) as session:
        await call(session, "add", request_)
    assert printed(capsys) == [{"total": 3, "spare": [0, 0, 0]}]


async def test_call_takes_the_type_and_the_server_as_options(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(serve), tool() as session:
        await call(session, "add", ["a=1"])
        assert printed(capsys) == [{"total": 1, "spare": [0, 0, 0]}], "the module gives the types"
    async with robot(serve) as module, tool() as session:
        keep_types(module)
        await call(session, "add", type=TYPE, server="BOT")
        assert printed(capsys) == [{"total": 0, "spare": [0, 0, 0]}]
        with pytest.raises(UsageError, match=r"the types of service add are unknown: give --type"):
            await call(session, "add")
        with pytest.raises(UsageError, match=r"tests\.services\.common:Desk is not a service"):
            await call(session, "add", type="tests.services.common:Desk")
        with pytest.raises(UsageError, match="has no field x"):
            await call(session, "add", ["x=1"], type=TYPE)


class Blink(r2p.Service):
    """A request without fields, as that of other services."""

    class Request(r2p.Message):
        pass

    class Response(r2p.Message):
        ok: bool = False


class Rest(r2p.Service):
    """A request without fields, and a response without."""

    class Request(r2p.Message):
        pass

    class Response(r2p.Message):
        pass


class Tell(r2p.Service):
    """A response without fields."""

    class Request(r2p.Message):
        text: r2p.u8 = 0

    class Response(r2p.Message):
        pass


async def serve_bodies_without_fields(node: r2p.Node) -> None:
    async def blink(_request: Blink.Request) -> Blink.Response:
        return Blink.Response(ok=True)

    async def rest(_request: Rest.Request) -> Rest.Response:
        return Rest.Response()

    async def tell(_request: Tell.Request) -> Tell.Response:
        return Tell.Response()

    node.serve("blink", Blink, blink)
    node.serve("rest", Rest, rest)
    node.serve("tell", Tell, tell)
    await node.spin()


async def test_bodies_without_fields_need_no_type(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(serve_bodies_without_fields), tool() as session:
        await call(session, "blink")
        await call(session, "rest")
        await call(session, "tell", ["text=3"])
        assert printed(capsys) == [{"ok": True}, {}, {}]
        with pytest.raises(UsageError, match=r"^Blink\.Request has no field x"):
            await call(session, "blink", ["x=1"])
        await info(session, "tell")
        (details,) = printed(capsys)
        assert (details["request_fields"], details["response_fields"]) == ({"text": "u8"}, {})


@pytest.mark.parametrize("types", [{}, {"blink": f"{__name__}:Blink"}])
async def test_services_whose_topics_have_one_layout_have_their_own_names(
    types: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    async with robot(serve_bodies_without_fields), tool(types=types) as session:
        await list_(session)
        names = {row["service"]: row["type"] for row in printed(capsys)}
        assert names == {"blink": "tests/Blink", "rest": "tests/Rest", "tell": "tests/Tell"}
        for service, name in names.items():
            await info(session, service)
            assert printed(capsys)[0]["type"] == name
            await find(session, name)
            assert [row["service"] for row in printed(capsys)] == [service]


async def test_a_type_that_was_learnt_without_its_package_has_none(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So zenoh gives the types of observers, such as a recorder."""
    own = schemas.encode
    monkeypatch.setattr(schemas, "encode", lambda name, schema: own(name.rpartition("/")[2], schema))
    async with robot(serve), tool() as session:
        await list_(session)
        await info(session, "add")
    assert [each["type"] for each in printed(capsys)] == ["Add", "Add"]


async def test_a_recorder_writes_its_snapshot_when_called(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As docs/how-to/record.md has it: without a type."""
    async with tool() as recorder, robot(serve), tool() as session:
        recording = asyncio.create_task(record(recorder, all=True, output=tmp_path / "x.mcap", snapshot=30.0))
        await asyncio.sleep(1.0)
        await info(session, SNAPSHOT_SERVICE)
        await call(session, SNAPSHOT_SERVICE)
        details, response, *_ = printed(capsys)
        recording.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await recording
    assert (details["type"], details["request_fields"]) == ("std_srvs/Trigger", {})
    assert response == {"success": True, "message": str(tmp_path / "x-0001.mcap")}


async def test_how_a_call_ends(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(serve), tool(types=TYPES | {"ad": TYPE}) as session:
        with pytest.raises(TimedOut, match=r"there is no service ads on memory:lab; did you mean add\?"):
            await call(session, "ads")
        with pytest.raises(r2p.ServiceError, match="service add of BOT: unlucky"):
            await call(session, "add", ["a=13"])
        with pytest.raises(TimedOut, match=r"^service ad has no server within 5 s; did you mean add\?$"):
            await call(session, "ad")
        with pytest.raises(TimedOut, match="service add is not served by module IMU1: it is by BOT"):
            await call(session, "add", server="IMU1")
    assert not capsys.readouterr().out


async def test_firmware_that_serves_is_a_question_mark(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool(types=TYPES) as session:
        firmware = Firmware("IMU1")
        firmware.alive()
        firmware.advertise("add_r", 44)
        firmware.send(management.SubscribeRequest("add_q", 20, 5))
        await list_(session)
        await find(session, TYPE)
    listed, found = printed(capsys)
    assert (listed["servers"], listed["callers"], found["match"]) == (["IMU1/?"], [], "size")
