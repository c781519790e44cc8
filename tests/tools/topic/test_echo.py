"""`r2p topic echo`."""

from __future__ import annotations

import asyncio
import json
from typing import Annotated, Any

import pytest

import r2p
from r2p.codecs.management import ROLE_PUBLISHES, TypeInfo
from r2p.msg import GatewayStatus, Header, LaserScan, Led, StampedPose3, Velocity3
from r2p.tools.session import TimedOut, UsageError
from r2p.tools.topic.echo import QUEUE, echo
from r2p.tools.topic.rates import hz
from tests.tools.rig import Firmware, keep_types, printed, robot, tool


class Private(r2p.Message):
    """A type that the tool does not know by its fingerprint."""

    secret: r2p.u16 = 0


class Five(r2p.Message):
    """Another type with as many bytes as Led."""

    five: Annotated[str, r2p.Len(5)] = ""


async def leds(node: r2p.Node) -> None:
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.1):
        await publisher.publish(Led(led=publisher.sent, value=1))


async def poses(node: r2p.Node) -> None:
    publisher = node.advertise("poses", StampedPose3)
    async for _ in node.every(0.25):
        await publisher.publish(StampedPose3(r2p.Timestamp(5, 6), x=0.1))


async def scans(node: r2p.Node) -> None:
    publisher = node.advertise("scan", LaserScan)
    async for _ in node.every(0.25):
        await publisher.publish(LaserScan(Header(7), ranges=r2p.Array([0.5] * 20)))


async def secrets(node: r2p.Node) -> None:
    publisher = node.advertise("secrets", Private)
    async for _ in node.every(0.1):
        await publisher.publish(Private(secret=0x1234))


@pytest.mark.virtual_time
async def test_it_prints_messages_by_the_type_that_the_peer_tells(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        await echo(session, ["/leds"], count=3)
    first, *_ = records = printed(capsys)
    assert records == [{"led": first["led"] + n, "value": 1} for n in range(3)]


@pytest.mark.virtual_time
async def test_yaml(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(poses), tool() as session:
        await echo(session, ["poses"], once=True, format="yaml")
    assert capsys.readouterr().out == "timestamp:\n  sec: 5\n  nsec: 6\nx: 0.1\ny: 0.0\nw: 0.0\n---\n"


@pytest.mark.virtual_time
async def test_long_arrays(capsys: pytest.CaptureFixture[str]) -> None:
    """Whole for programs, shortened for people, one cell of a table; a field is found in each message anew."""
    shown = [[0.5] * 8 + ["and 12 more"], [0.5] * 20]
    async with robot(scans), tool() as session:
        await echo(session, ["scan"], once=True)
        await echo(session, ["scan"], once=True, format="yaml", field=["ranges"])
        await echo(session, ["scan"], once=True, format="yaml", field=["ranges"], full=True)
        await echo(session, ["scan"], once=True, format="csv", field=["ranges", "header.seq"])
        await echo(session, ["scan"], once=True, field=["ranges[19]", "ranges[20]", "header"], filter="len(ranges) > 2")
    first, *yaml, head, row, last = capsys.readouterr().out.splitlines()
    assert json.loads(first)["ranges"] == [0.5] * 20
    assert yaml == [line for each in shown for line in (f"ranges: {each}".replace("'", ""), "---")]
    assert (head, row) == ("ranges,header.seq", f'"{[0.5] * 20}",7')
    header = {"seq": 7, "stamp": {"sec": 0, "nsec": 0}, "frame_id": ""}
    assert json.loads(last) == {"ranges[19]": 0.5, "ranges[20]": None, "header": header}


@pytest.mark.virtual_time
async def test_meta_tells_where_and_when(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        await echo(session, ["leds"], once=True, meta=True)
        now = session.node.now()
    (record,) = printed(capsys)
    meta = record.pop("_")
    assert now - 1_000_000_000 < meta.pop("stamp") <= now
    assert meta == {"topic": "leds", "stamp_from": "sender", "source": "BOT/leds", "sequence": record["led"] + 1}


@pytest.mark.virtual_time
async def test_several_topics_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds, poses), tool() as session:
        await echo(session, ["leds", "poses", "leds"], count=6)
    topics = [record["_"]["topic"] for record in printed(capsys)]
    assert topics.count("poses") in {1, 2}
    assert topics.count("leds") == 6 - topics.count("poses")


@pytest.mark.virtual_time
async def test_fields(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(poses), tool() as session:
        await echo(session, ["poses"], once=True, field=["timestamp.nsec", "x"])
        assert printed(capsys) == [{"timestamp.nsec": 6, "x": 0.1}]
        await echo(session, ["poses"], count=2, field=["x", "timestamp"], format="csv")
        assert capsys.readouterr().out == "x,timestamp.sec,timestamp.nsec\n0.1,5,6\n0.1,5,6\n"


@pytest.mark.virtual_time
async def test_an_unknown_field_is_a_mistake() -> None:
    async with robot(poses), tool() as session:
        with pytest.raises(ExceptionGroup) as caught:
            await echo(session, ["poses"], field=["z"])
    assert caught.group_contains(
        UsageError, match="there is no field z; the fields are timestamp.sec, timestamp.nsec, x, y, w$"
    )
    async with robot(poses), tool() as session:
        with pytest.raises(ExceptionGroup) as caught:
            await echo(session, ["poses"], field=["x,y"])
    assert caught.group_contains(UsageError, match="there is no field x,y; .* x, y, w, one --field for each$")


@pytest.mark.virtual_time
async def test_a_field_that_only_some_topics_have(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds, poses), tool() as session:
        await echo(session, ["leds", "poses"], count=6, field=["x"], format="csv")
        captured = capsys.readouterr()
        header, *rows = captured.out.splitlines()
        assert (header, set(rows)) == ("topic,x", {"leds,", "poses,0.1"})
        assert captured.err.count("leds has no field x: left out there") == 1
        await echo(session, ["leds", "poses"], count=6, field=["x", "led"])
        fields = [set(record) - {"_"} for record in printed(capsys)]
        assert all(each in fields for each in ({"x"}, {"led"}))
        with pytest.raises(ExceptionGroup) as caught:
            await echo(session, ["leds", "poses"], field=["x", "z"])
    problem = r"no topic has a field z; of (leds: there is no field z; the fields are led|poses: there is)"
    assert caught.group_contains(UsageError, match=problem)


@pytest.mark.virtual_time
async def test_csv_of_several_topics_has_a_column_for_the_topic(capsys: pytest.CaptureFixture[str]) -> None:
    async def gateway(node: r2p.Node) -> None:
        publisher = node.advertise("gateway", GatewayStatus, latch=True)
        await publisher.publish(GatewayStatus(topic="odometry"))
        await asyncio.Event().wait()

    async with robot(leds, poses, secrets, gateway), tool() as session:
        await echo(session, ["leds", "poses", "secrets"], count=9, format="csv")
        header, *rows = capsys.readouterr().out.splitlines()
        assert header == "topic,led,value,timestamp.sec,timestamp.nsec,x,y,w,secret"
        assert rows.count("poses,,,5,6,0.1,0.0,0.0,") in {1, 2}
        assert rows.count(f"secrets,,,,,,,,{0x1234}") in {3, 4}

        await echo(session, ["gateway", "leds"], once=True, format="csv")
        header, row = capsys.readouterr().out.splitlines()
        values = dict(zip(header.split(","), row.split(","), strict=True))
        assert (values["topic"], values["topic_"]) == ("gateway", "odometry")


@pytest.mark.virtual_time
async def test_csv_says_what_has_no_column(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot() as module, tool() as session:
        asyncio.get_running_loop().call_later(10, module.start, leds)
        await echo(session, ["leds", "poses"], count=2, format="csv")
    captured = capsys.readouterr()
    assert captured.out == "topic,data\nleds,\nleds,\n"
    assert captured.err.count("the CSV has no column for led, value: these are left out") == 1


@pytest.mark.virtual_time
async def test_a_type_whose_code_is_elsewhere_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(secrets), tool() as session:
        await echo(session, ["secrets"], once=True)
    assert printed(capsys) == [{"secret": 0x1234}]


@pytest.mark.virtual_time
async def test_an_unknown_type_is_printed_in_hex_and_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(secrets) as module, tool() as session:
        keep_types(module)
        await echo(session, ["secrets"], count=2)
    captured = capsys.readouterr()
    assert captured.out == '{"data": "3412"}\n' * 2
    assert captured.err.count("the type of secrets is unknown") == 1
    assert "r2p_msgs/PWM" in captured.err  # has two bytes, too


@pytest.mark.virtual_time
@pytest.mark.parametrize("by", ["option", "r2p.toml"])
async def test_a_type_can_be_stated(by: str, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"{__name__}:Private"
    types = {"secrets": name} if by == "r2p.toml" else None
    async with robot(secrets), tool(types=types) as session:
        await echo(session, ["secrets"], once=True, type=name if by == "option" else None)
    assert printed(capsys) == [{"secret": 0x1234}]


@pytest.mark.virtual_time
async def test_a_stated_type_that_is_not_the_publishers_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        with pytest.raises(ExceptionGroup) as caught:
            await echo(session, ["leds"], type="r2p.msg:Velocity3", timeout=2)
        assert caught.group_contains(
            r2p.Error,
            match=r"leds carries r2p_msgs/Led \(5 bytes\), not r2p_msgs/Velocity3 .* --type r2p_msgs/Led$",
        )
    async with robot(leds), tool() as session:
        with pytest.raises(ExceptionGroup) as caught:
            await echo(session, ["leds"], type=f"{__name__}:Five")
        assert caught.group_contains(r2p.Error, match=r"leds carries r2p_msgs/Led \(5 bytes\), not tests/Five")
    assert capsys.readouterr() == ("", "")


@pytest.mark.virtual_time
async def test_a_stated_type_that_does_not_fit_firmware_is_an_error() -> None:
    async with tool() as session:
        asyncio.get_running_loop().call_later(0.1, Firmware().advertise, "leds", 5)
        with pytest.raises(ExceptionGroup) as caught:
            await echo(session, ["leds"], type="Velocity3")
    assert caught.group_contains(
        r2p.Error, match="messages of 5 bytes, but r2p_msgs/Velocity3 has 12: .*; types of 5 bytes: r2p_msgs/Led$"
    )


@pytest.mark.virtual_time
async def test_a_publisher_of_another_type_does_not_matter_beside_one_that_fits() -> None:
    async def other(node: r2p.Node) -> None:
        node.advertise("leds", Velocity3)
        await asyncio.Event().wait()

    async with robot(leds), robot(other, name="OTHER"), tool() as session:
        await echo(session, ["leds"], type="Led", count=50)


@pytest.mark.virtual_time
async def test_a_filter(capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "r2p.echo")
    async with robot(leds), tool() as session:
        await echo(session, ["leds"], filter="led % 3 == 0 and value == 1", count=2)
    first, second = (record["led"] for record in printed(capsys))
    assert (first % 3, second - first) == (0, 3)
    (told,) = caplog.messages
    passed, of, rest = told.removeprefix("leds: ").split(" ", 2)
    assert (passed, of, rest.split(" ", 1)[1]) == ("2", "of", "messages passed the filter")
    assert 4 <= int(rest.split(" ", 1)[0]) <= 6


@pytest.mark.virtual_time
async def test_a_filter_that_nothing_passes(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(leds), tool() as session:
        with pytest.raises(TimedOut, match="no message passed the filter on leds for 5 s"):
            await echo(session, ["leds"], filter="value > 1", timeout=5)
    assert capsys.readouterr().err == "r2p: messages of leds arrive, but none has passed the filter yet\n"


@pytest.mark.virtual_time
async def test_a_filter_that_does_not_fit_the_type() -> None:
    async with robot(leds, secrets) as module, tool() as session:
        keep_types(module)
        with pytest.raises(UsageError, match=r"Led has no field led_; did you mean led\?"):
            await echo(session, ["leds"], type="Led", filter="led_ > 1")
        for topic, text in (("leds", "Led has no field x; the fields are led, value"), ("secrets", "give --type")):
            with pytest.raises(ExceptionGroup) as caught:
                await echo(session, [topic], filter="x > 1")
            assert caught.group_contains(UsageError, match=text)


@pytest.mark.virtual_time
async def test_types_in_the_file_are_known_by_fingerprint_on_any_topic(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(secrets), tool(types={"other": f"{__name__}:Private"}) as session:
        await echo(session, ["secrets"], once=True)
    assert printed(capsys) == [{"secret": 0x1234}]


@pytest.mark.virtual_time
async def test_firmware_tells_no_type(capsys: pytest.CaptureFixture[str]) -> None:
    async with tool() as session:
        imu = Firmware()
        loop = asyncio.get_running_loop()
        loop.call_later(0.1, imu.advertise, "leds", 5)
        loop.call_later(0.2, imu.publish, "leds", Led(led=3, value=1).encode())
        await echo(session, ["leds"], once=True)
        loop.call_later(0.2, imu.publish, "leds", Led(led=3, value=1).encode())
        await echo(session, ["leds"], once=True, type="Led")
    assert printed(capsys) == [{"data": "0300000001"}, {"led": 3, "value": 1}]


@pytest.mark.virtual_time
async def test_messages_wait_for_a_type_that_is_announced_late(capsys: pytest.CaptureFixture[str]) -> None:
    typed, led = r2p.layout(Led), Led(led=3, value=1).encode()
    async with robot(), tool() as session:
        late = Firmware()  # which says nothing of itself, as modules behind a busy gateway
        loop = asyncio.get_running_loop()
        loop.call_later(1.0, late.advertise, "leds", 5)
        for n in range(3):
            loop.call_later(1.5 + n / 10, late.publish, "leds", led)
        loop.call_later(2.0, late.send, TypeInfo(ROLE_PUBLISHES, "leds", typed.fingerprint, typed.size))
        loop.call_later(2.0, late.advertise, "leds", 5)
        await echo(session, ["leds"], count=3)
    captured = capsys.readouterr()
    assert captured.out == '{"led": 3, "value": 1}\n' * 3
    assert "unknown" not in captured.err


@pytest.mark.virtual_time
async def test_it_waits_for_a_topic_that_nobody_knows_and_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot() as module, tool() as session:
        asyncio.get_running_loop().call_later(30, module.start, leds)
        await echo(session, ["leds"], once=True)
        assert asyncio.get_running_loop().time() > 30
    captured = capsys.readouterr()
    assert captured.err == "r2p: waiting for a publisher of leds on memory:lab\n"
    assert captured.out == '{"led": 0, "value": 1}\n'


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("topic", "hint"),
    [
        ("ledz", "r2p: ledz has no publisher; did you mean leds?\n"),
        ("/robot1/leds", "r2p: robot1/leds has no publisher; did you mean leds?\n"),
        ("odometry", ""),
    ],
)
async def test_topics_with_names_much_like_it_are_named_once(
    topic: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    async with robot(leds), tool() as session:
        with pytest.raises(TimedOut):
            await echo(session, [topic], timeout=20)
    assert capsys.readouterr().err == f"r2p: waiting for a publisher of {topic.lstrip('/')} on memory:lab\n{hint}"


@pytest.mark.virtual_time
@pytest.mark.parametrize("command", [echo, hz])
async def test_a_short_time_out_names_topics_with_names_much_like_it(command: Any) -> None:
    async with robot(leds), tool() as session:
        topics = ["ledz"] if command is echo else "ledz"
        with pytest.raises(TimedOut, match=r"^nothing received on ledz for 1\.5 s; did you mean leds\?$"):
            await command(session, topics, timeout=1.5)


@pytest.mark.virtual_time
async def test_silence_is_a_time_out(capsys: pytest.CaptureFixture[str]) -> None:
    async def three(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led, latch=True)
        for _ in range(3):
            await publisher.wait_subscriber()
            await asyncio.sleep(0.9)
            await publisher.publish(Led())
        await asyncio.Event().wait()

    async with robot(three), tool() as session:
        start = asyncio.get_running_loop().time()
        with pytest.raises(TimedOut, match="nothing received on leds for 1 s"):
            await echo(session, ["leds"], timeout=1)
        assert asyncio.get_running_loop().time() - start == pytest.approx(3.7, abs=0.1)
    assert len(printed(capsys)) == 3


@pytest.mark.virtual_time
async def test_a_publisher_that_comes_back_with_another_type(capsys: pytest.CaptureFixture[str]) -> None:
    async def later(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Velocity3)
        await publisher.wait_subscriber()
        await publisher.publish(Velocity3(x=1.5))

    async def changes(module: r2p.Module) -> None:
        async def first(node: r2p.Node) -> None:
            publisher = node.advertise("leds", Led)
            await publisher.wait_subscriber()
            await publisher.publish(Led(led=1))

        module.start(first)
        await module.wait()
        await asyncio.sleep(10)
        module.start(later)

    async with robot() as module, tool() as session, asyncio.TaskGroup() as tasks:
        tasks.create_task(changes(module))
        await echo(session, ["leds"], count=2)
    assert printed(capsys) == [{"led": 1, "value": 0}, {"x": 1.5, "y": 0.0, "w": 0.0}]


@pytest.mark.virtual_time
async def test_what_the_tool_itself_loses_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    async def burst(node: r2p.Node) -> None:
        publisher = node.advertise("leds", Led)
        await publisher.wait_subscriber()
        for _ in range(QUEUE + 10):
            publisher.publish_nowait(Led())

    async with tool() as session:
        session.module.start(burst)
        await echo(session, ["leds"], count=QUEUE)
    captured = capsys.readouterr()
    assert "10 messages of leds lost: the output was too slow" in captured.err
    assert len(captured.out.splitlines()) == QUEUE
