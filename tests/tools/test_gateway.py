"""`r2p gateway` without processes: its output, its counters as messages, and its options."""

from __future__ import annotations

import asyncio
import io
import json
from typing import TYPE_CHECKING

import pytest
import typer

import r2p
from r2p.bridge import BridgeOptions, GatewayStatistics, PortStatistics, RouteStatistics
from r2p.bridge.options import PREFIX_ON, Policy
from r2p.msg import GatewayStatus, Led
from r2p.testing.network import node_in
from r2p.tools import gateway
from r2p.tools.gateway import LiveTable, RateCounter, crop, serve, table
from r2p.tools.options import class_choice, topic_pairs
from r2p.tools.output import Output
from r2p.tools.session import Settings, UsageError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SECOND = 1_000_000_000
PORTS = [
    PortStatistics("rtcan:can0", "forwarding", 1, {}),
    PortStatistics("zenoh:", "alone", 0, {"converging": 3}),
]


def routes(forwarded: int) -> list[RouteStatistics]:
    return [
        RouteStatistics("encoder", "rtcan:can0", "zenoh:", forwarded, {"late": 2}),
        RouteStatistics("encoder", "zenoh:", "rtcan:can0", 0, {}),
    ]


def test_the_table() -> None:
    rates = RateCounter()
    rates.rows(GatewayStatistics(PORTS, routes(100)), 1 * SECOND)
    rows = rates.rows(GatewayStatistics(PORTS, routes(300)), 3 * SECOND)
    assert table(rows).splitlines() == [
        "LINK        STATE                     DROPPED",
        "rtcan:can0  forwarding (1 more here)",
        "zenoh:      forwarding, alone         3 converging",
        "",
        "TOPIC    FROM   TO     RATE     FORWARDED  DROPPED",
        "encoder  rtcan  zenoh  100.0/s  300        2 late",
    ]


def test_two_links_of_a_kind_have_their_names_in_the_table() -> None:
    ports = [PortStatistics(link, "forwarding", 0, {}) for link in ("tcp:a:23", "tcp:b:23", "zenoh:tcp/c:7447")]
    there = [
        RouteStatistics("encoder", "tcp:a:23", "zenoh:tcp/c:7447", 5, {}),
        RouteStatistics("leds", "zenoh:tcp/c:7447", "tcp:b:23", 5, {}),
        RouteStatistics("leds", "zenoh:tcp/c:7447", "tcp:gone:23", 5, {}),
    ]
    text = table(RateCounter().rows(GatewayStatistics(ports, there), SECOND))
    routes = [line.split()[:3] for line in text.partition("TOPIC")[2].splitlines()[1:]]
    assert routes == [["encoder", "tcp:a:23", "zenoh"], ["leds", "zenoh", "tcp:b:23"], ["leds", "zenoh", "tcp:gone:23"]]


def test_a_route_that_is_made_anew_counts_anew() -> None:
    rates = RateCounter()
    rates.rows(GatewayStatistics(PORTS, routes(100)), 1 * SECOND)
    rows = rates.rows(GatewayStatistics(PORTS, routes(20)), 2 * SECOND)
    assert [row.rate for row in rows if row.topic] == [20.0]


def test_the_table_fits_on_the_terminal() -> None:
    text = "".join(f"{number} {'x' * 20}\n" for number in range(10))
    assert crop(text, 80, 12) == text
    assert crop(text, 10, 11).splitlines() == [*(f"{n} xxxxxxxx" for n in range(8)), "... and 2 "]
    assert crop(text, 80, 1) == "... and 10 more lines\n"


@pytest.mark.virtual_time
async def test_the_table_stays_in_its_place_until_something_is_logged() -> None:
    stream = io.StringIO()
    output = Output("yaml", stream)
    output.format = "text"
    screen = LiveTable(output)
    rows = RateCounter().rows(GatewayStatistics(PORTS, []), SECOND)
    await screen.draw(rows)
    await screen.draw(rows)
    assert stream.getvalue().count("\x1b[4F\x1b[J") == 1
    gateway.logger.warning("something happened")
    await screen.draw(rows)
    assert stream.getvalue().count("\x1b[") == 2
    screen.close()


@pytest.mark.virtual_time
async def test_the_counters_are_on_a_topic_and_in_a_pipe() -> None:
    stream = io.StringIO()
    serving = asyncio.create_task(
        serve("GW", Settings(["memory:a", "memory:b"]), BridgeOptions(), Output("json", stream))
    )
    async with (
        r2p.Module("A", via="memory:a") as one,
        node_in(one) as a,
        r2p.Module("B", via="memory:b") as other,
        node_in(other) as b,
    ):
        leds, status = a.advertise("leds", Led), b.subscribe("gateway", GatewayStatus, queue=100)
        b.subscribe("leds", Led)
        await leds.wait_subscriber()
        for number in range(10):
            await leds.publish(Led(led=number))
        await asyncio.sleep(2)
        heard = {(each.source, each.target, each.topic): each async for each in drained(status)}
        assert heard["memory:a", "memory:b", "leds"].forwarded == 10
        assert heard["memory:a", "", ""].state == "alone"
    serving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await serving
    printed = [json.loads(line) for line in stream.getvalue().splitlines()]
    last = [each for each in printed if each["topic"] == "leds"][-1]
    assert last["forwarded"] == 10


async def drained(status: r2p.Subscriber[GatewayStatus]) -> AsyncIterator[GatewayStatus]:
    for _ in range(len(status.queue)):
        yield await status.fetch()


def test_links_that_are_meant_by_rules_and_options() -> None:
    links = ["rtcan", "rtcan:can0", "rtcan:*", "zenoh", "zenoh:", "tcp:robot", "tcp:robot:2323", "tcp", "tcp:10.*", "*"]
    assert gateway._links(links, "--read-only", VIA) == tuple(links)
    assert gateway._links(["tcp:10.0.0.5:*"], "--read-only", ["tcp-listen:0"])
    assert gateway._rules(["cmd_*@zenoh>rtcan", "log"], "--allow", VIA)
    assert gateway._prefix("robot1/") == "robot1/"
    assert gateway._prefix("") == ""


VIA = ["rtcan:can0,priority=1", "zenoh:?network=lab", "tcp:robot", "tcp-listen:0"]


def test_mistakes_are_told() -> None:
    with pytest.raises(UsageError, match="--deny 'leds@': write TOPIC"):
        gateway._rules(["leds@"], "--deny", VIA)
    with pytest.raises(
        UsageError, match="--allow: 'can0' matches none of the links rtcan:can0, zenoh:, tcp:robot, tcp-listen:0"
    ):
        gateway._rules(["leds@can0"], "--allow", VIA)
    with pytest.raises(UsageError, match="--read-only: 'serial' matches none"):
        gateway._links(["zenoh", "serial"], "--read-only", VIA)
    for prefix in ("robot1", "rob ot/", "a/b/", "a_name_that_is_too_long/"):
        with pytest.raises(UsageError, match=r"--prefix: .* robot1/"):
            gateway._prefix(prefix)
        with pytest.raises(r2p.Error, match="is not a valid prefix"):
            Policy(BridgeOptions(prefix=prefix))
    with pytest.raises(UsageError, match="--rate-limit leds: write it as TOPIC=HZ"):
        list(topic_pairs(["leds"], "--rate-limit", "TOPIC=HZ"))
    with pytest.raises(UsageError, match="--rate-limit: no topic can match 'leds@tcp'"):
        list(topic_pairs(["leds@tcp=5"], "--rate-limit", "TOPIC=HZ"))
    with pytest.raises(typer.BadParameter, match="periodic:10ms"):
        class_choice("often")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (BridgeOptions(prefix="robot1/"), "--prefix robot1/ is for links to zenoh and ROS, and there is none"),
        (BridgeOptions(prefix_on=("memory:lab",)), "--prefix-on memory:lab needs a --prefix"),
        (BridgeOptions(reserve=("imu",)), "--reserve is for slots on RTCAN, and there is no such link"),
        (BridgeOptions(classes={"imu": class_choice("nrt")}), "--class is for debug lines, and there is none"),
    ],
)
def test_options_without_effect(options: BridgeOptions, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        gateway._check_effect(options, ["memory:robot", "memory:lab"])
    here = ["memory:lab", "tcp:robot", "sim:bus", "zenoh:"]
    if options.prefix_on == PREFIX_ON:
        gateway._check_effect(options, here)
