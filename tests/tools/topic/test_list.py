"""`r2p topic list`, `info` and `find`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from typing import Annotated, Any

import pytest

import r2p
from r2p.msg import LaserScan, Led, Velocity3
from r2p.names import topic_alias
from r2p.tools import module as modules
from r2p.tools import node
from r2p.tools.session import UsageError
from r2p.tools.topic.list import find, info, list_
from tests.tools.rig import VIA, Firmware, printed, robot, tool
from tests.transports.test_aliases import ONE, OTHER

FIXED = {"varies": False}


async def blink(node: r2p.Node) -> None:
    node.advertise("leds", Led)
    node.advertise("speed", Velocity3, r2p.Periodic(0.1, Velocity3))
    await asyncio.Event().wait()


async def scan(node: r2p.Node) -> None:
    publisher = node.advertise("scan", LaserScan)
    async for _ in node.every(0.1):
        await publisher.publish(LaserScan())


async def watch(node: r2p.Node) -> None:
    node.subscribe("leds", Led)
    await asyncio.Event().wait()


def by_topic(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {row.pop("topic"): row for row in rows}


@pytest.mark.virtual_time
async def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink, watch), tool() as session:
        await list_(session)
    captured = printed(capsys)
    assert by_topic(captured) == {
        "leds": {"type": "r2p_msgs/Led", "size": 5, **FIXED, "publishers": ["BOT/blink"], "subscribers": ["BOT/watch"]},
        "log": {"type": "r2p_msgs/Log", "size": 152, **FIXED, "publishers": ["BOT/log"], "subscribers": []},
        "speed": {"type": "r2p_msgs/Velocity3", "size": 12, **FIXED, "publishers": ["BOT/blink"], "subscribers": []},
    }


@pytest.mark.virtual_time
async def test_names_and_with_v_their_aliases(capsys: pytest.CaptureFixture[str]) -> None:
    topic, module = "front_left/wheel/velocity_estimate", "front_left_wheel_controller"

    async def velocity_estimator(node: r2p.Node) -> None:
        node.advertise(topic, Led)
        await asyncio.Event().wait()

    async with robot(velocity_estimator, name=module), tool(verbose=1) as session:
        await list_(session)
        rows = by_topic(printed(capsys))
        assert rows.keys() == {topic, "log"}
        assert (rows[topic]["alias"], rows["log"]["alias"]) == ("front_left_w446v", None)
        assert rows[topic]["publishers"] == [f"{module}/velocity_estimator"]
        for name in (topic, "front_left_w446v"):
            await info(session, name)
            (details,) = printed(capsys)
            assert (details["topic"], details["alias"]) == (topic, "front_left_w446v")
        await node.list_(session)
        aliases = {row["node"]: row["alias"] for row in printed(capsys)}
        assert aliases == {f"{module}/velocity_estimator": "veloa6tr", f"{module}/log": None}
        await modules.list_(session)
        (row,) = printed(capsys)
        assert (row["module"], row["alias"]) == (module, "frowhja")


@pytest.mark.virtual_time
async def test_info_names_both_topics_that_have_one_alias(capsys: pytest.CaptureFixture[str]) -> None:

    async def publish(node: r2p.Node) -> None:
        node.advertise(ONE, Led)
        await asyncio.Event().wait()

    async def subscribe(node: r2p.Node) -> None:
        await node.subscribe(OTHER, Led).fetch()

    async with robot(publish, name="A"), robot(subscribe, name="B"), tool() as session:
        await asyncio.sleep(5.0)
        text = f"topics {ONE} and {OTHER} have one alias, {topic_alias(ONE)}: choose another one for either"
        for name in (ONE, OTHER, topic_alias(ONE)):
            await info(session, name)
            captured = capsys.readouterr()
            assert text in captured.err
            guarantees = json.loads(captured.out)["guarantees"]
            assert guarantees == {f"{VIA} nrt": "carried for one of the topics with its alias, or for none"}


@pytest.mark.virtual_time
async def test_list_of_firmware(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        imu = Firmware("IMU")
        asyncio.get_running_loop().call_later(0.1, imu.alive)
        asyncio.get_running_loop().call_later(0.6, imu.advertise, "imu", 26)
        await list_(session)
        rows = printed(capsys)
    assert rows == [{"topic": "imu", "type": None, "size": 26, **FIXED, "publishers": ["IMU/?"], "subscribers": []}]


@pytest.mark.virtual_time
async def test_list_behind_a_gateway(capsys: pytest.CaptureFixture[str]) -> None:
    """It answers at once, but only with its name: it announces what others have once it may forward."""
    inside = "memory:inside"
    async with r2p.Module("BOT", via=inside) as module, tool() as session:
        module.start(blink)
        async with r2p.Module("GW", via=[inside, VIA], bridge=True):
            await list_(session)
    assert set(by_topic(printed(capsys))) == {"leds", "log", "speed"}


@pytest.mark.virtual_time
async def test_list_of_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        await list_(session)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"r2p: no topics yet on {VIA} (heard 0 modules)")


@pytest.mark.virtual_time
async def test_info(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink, watch), tool() as session:
        await info(session, "/speed")
        await info(session, "leds")
    speed, leds = printed(capsys)
    assert speed == {
        "topic": "speed",
        "type": "r2p_msgs/Velocity3",
        "size": 12,
        "varies": False,
        "fingerprint": r2p.layout(Velocity3).fingerprint.hex(),
        "publishers": [{"node": "BOT/blink", "class": "periodic", "link": VIA}],
        "subscribers": [],
        "guarantees": {f"{VIA} periodic": "best effort, in order"},
    }
    assert leds["subscribers"] == [{"node": "BOT/watch", "link": VIA}]
    assert list(leds["guarantees"]) == [f"{VIA} nrt"]


@pytest.mark.virtual_time
async def test_what_varies_in_length(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    size = r2p.layout(LaserScan).size
    async with robot(scan), tool(verbose=1) as session:
        await info(session, "scan")
        await find(session, "sensor_msgs/LaserScan")
        with pytest.raises(r2p.Error, match="no topics of type"):
            await find(session, str(size))
        monkeypatch.setattr("sys.stdout.isatty", lambda: True)
        lines = len(capsys.readouterr().out.splitlines())
        await info(session, "scan")
        await list_(session)
    assert lines == 2
    out = capsys.readouterr().out
    assert "type: sensor_msgs/LaserScan\nsize: up to 131 380 bytes\nvaries: true\n" in out
    assert "\n  ranges: f32[]\n" in out
    assert re.search(rf"\nscan +sensor_msgs/LaserScan +up to {size} ", out)


class Words(r2p.Message):
    text: Annotated[str, r2p.Max(300)] = ""


@pytest.mark.virtual_time
async def test_info_says_what_a_link_does_not_carry(capsys: pytest.CaptureFixture[str]) -> None:
    async def speak(node: r2p.Node) -> None:
        node.advertise("words", Words)
        await asyncio.Event().wait()

    async with robot(speak), tool() as session:
        await info(session, "words")
        link: Any = session.module.links[0]
        link.max_payload = 100
        await info(session, "words")
        await info(session, "log")
    words, short, log = (next(iter(each["guarantees"].values())) for each in printed(capsys))
    assert "carr" not in words
    reason = "up to 304 bytes, and it carries at most 100 in a message"
    assert short == f"{words}; its longest messages are not carried: {reason}"
    assert log == "not carried: 152 bytes, and it carries at most 100 in a message"


@pytest.mark.virtual_time
async def test_info_with_more(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), tool(verbose=1) as session:
        await info(session, "leds")
        Firmware().advertise("raw", 5)
        await info(session, "raw")
    leds, raw = printed(capsys)
    assert leds["fields"] == {"led": "u32", "value": "u8"}
    assert 0 <= leds["age"] < 5
    assert raw["type"] is None
    assert (raw["fields"], raw["maybe"]) == (None, ["r2p_msgs/Led"])


@pytest.mark.virtual_time
async def test_info_for_people(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    async with robot(blink), tool(verbose=1) as session:
        await info(session, "leds")
    out = capsys.readouterr().out
    assert "\nfields:\n  led: u32\n  value: u8\n" in out
    assert re.search(r"\nage: [0-9.]+ s\n", out)


@pytest.mark.virtual_time
async def test_info_of_a_topic_that_nobody_knows() -> None:
    async with robot(blink), tool() as session:
        with pytest.raises(r2p.Error, match="bus_load is published only while it has a subscriber"):
            await info(session, "bus_load")
        with pytest.raises(r2p.Error, match="power has no publisher and no subscriber; known topics: leds, log, speed"):
            await info(session, "power")
        with pytest.raises(r2p.Error, match=r"led has no publisher and no subscriber; did you mean leds\?"):
            await info(session, "led")


@pytest.mark.virtual_time
async def test_info_waits_for_the_only_module_if_that_is_late(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        showing = asyncio.create_task(info(session, "log"))
        await asyncio.sleep(3.0)
        async with robot():
            await showing
    assert printed(capsys)[0]["topic"] == "log"


def late_firmware() -> None:
    """Firmware that comes to one of its topics after three seconds."""
    imu = Firmware()
    imu.alive()
    imu.advertise("gyro", 12)
    asyncio.get_running_loop().call_later(3.2, imu.advertise, "imu", 26)


@pytest.mark.virtual_time
@pytest.mark.parametrize("nodes", [[], [blink]])
async def test_info_waits_for_firmware_to_come_to_the_topic_and_no_longer(
    nodes: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    async with contextlib.AsyncExitStack() as stack:
        if nodes:
            await stack.enter_async_context(robot(*nodes))
        session = await stack.enter_async_context(tool())
        loop, start = asyncio.get_running_loop(), asyncio.get_running_loop().time()
        late_firmware()
        await info(session, "imu")
        assert loop.time() - start == pytest.approx(3.2, abs=0.1)
        (details,) = printed(capsys)
        assert (details["topic"], details["size"]) == ("imu", 26)
        start = loop.time()
        with pytest.raises(r2p.Error, match=r"^mag has not been announced; .*: gyro.*listen longer with --wait 10$"):
            await info(session, "mag")
        assert 5.0 < loop.time() - start < 7.0


@pytest.mark.virtual_time
async def test_info_tells_of_different_types(capsys: pytest.CaptureFixture[str]) -> None:
    async def other(node: r2p.Node) -> None:
        node.subscribe("leds", Velocity3)
        await asyncio.Event().wait()

    async with robot(blink), tool() as session:
        session.module.start(other)
        await info(session, "leds")
    assert "leds has different types" in capsys.readouterr().err


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("what", "found"),
    [
        ("r2p_msgs/Led", {"leds": "type", "raw": "size"}),
        ("Led", {"leds": "type", "raw": "size"}),
        (r2p.layout(Led).fingerprint.hex(), {"leds": "type"}),
        ("5", {"leds": "size", "raw": "size"}),
        ("12", {"speed": "size"}),
    ],
)
async def test_find(what: str, found: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), tool() as session:
        asyncio.get_running_loop().call_later(0.1, Firmware().advertise, "raw", 5)
        await find(session, what)
    assert {row["topic"]: row["match"] for row in printed(capsys)} == found


@pytest.mark.virtual_time
async def test_find_nothing() -> None:
    async with robot(blink), tool() as session:
        with pytest.raises(r2p.Error, match="no topics of type StampedPose3 yet on"):
            await find(session, "StampedPose3")


@pytest.mark.virtual_time
async def test_find_a_type_that_does_not_exist() -> None:
    async with tool() as session:
        with pytest.raises(UsageError, match=r"did you mean r2p\.msg:Led\?"):
            await find(session, "Ledd")
