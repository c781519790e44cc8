"""The last messages of a program, such as those of a `finally` that stops the motor, reach their subscribers."""

import asyncio

import pytest

import r2p
from r2p.codecs import rtcan
from r2p.msg import Led
from r2p.sim.can import CanNode
from tests.transports.rtcan.networks import Lab, lab

pytestmark = pytest.mark.virtual_time

CLASSES = (r2p.NonRealTime(), r2p.Sporadic(deadline=0.5), r2p.Sporadic(deadline=0.005))


async def drive(
    node: r2p.Node, publisher_class: r2p.NonRealTime | r2p.Sporadic, messages: int, ready: asyncio.Event
) -> None:
    publisher = node.advertise("stop", Led, publisher_class)
    await publisher.wait_subscriber()
    ready.set()
    try:
        await asyncio.Event().wait()
    finally:
        for number in range(messages):
            await publisher.publish(Led(led=number))


@pytest.mark.parametrize("publisher_class", CLASSES, ids=repr)
@pytest.mark.parametrize("messages", [1, 20])
async def test_what_the_end_of_a_program_publishes_arrives_before_its_good_bye(
    publisher_class: r2p.NonRealTime | r2p.Sporadic, messages: int
) -> None:
    async with lab("A") as (made, (alice,)):
        subscriber = alice.subscribe("stop", Led, queue=100)
        async with made.module("B"):
            await asyncio.sleep(3.0)
            ready = asyncio.Event()
            made.host("B").start(drive, publisher_class, messages, ready)
            await ready.wait()
            link = made.link("B")
        assert [Led.decode(each.data).led for each in subscriber.queue] == list(range(messages))
        assert link.stats.sent == messages
        assert set(link.losses) <= {"interrupted"}  # A may be saying something when B ends
        assert not made.link("A").losses


async def test_where_the_bus_has_no_room_the_end_is_bounded_and_what_is_lost_is_counted() -> None:
    """A broken node takes the whole bus for itself."""
    async with lab("A") as (made, (alice,)):
        subscriber = alice.subscribe("stop", Led, queue=1000)
        async with made.module("B"):
            ready = asyncio.Event()
            made.host("B").start(drive, r2p.NonRealTime(), 100, ready)
            await ready.wait()
            link = made.link("B")
            babble(made)
            began = asyncio.get_running_loop().time()
        assert asyncio.get_running_loop().time() - began < 2.0
        assert len(subscriber.queue) == link.stats.sent < 100
        assert link.stats.sent + link.losses["link down"] == 100


def babble(made: Lab) -> None:
    """A node that sends without a pause, before all others."""
    node = made.can.bus.attach(CanNode("broken"))
    frame = rtcan.Frame(rtcan.encode_identifier(0, 0x02FF), bytes(8))
    node.on_sent = lambda *_: node.request(frame)
    node.request(frame)


async def test_what_comes_after_the_good_bye_is_counted_for_a_while() -> None:
    async with lab("A") as (made, (alice,)):
        link, subscriber = made.link("A"), alice.subscribe("leds", Led)
        async with made.module("B") as bob:
            await bob.advertise("leds", Led).wait_subscriber()
            await asyncio.sleep(0.1)
            needed = link.engine.filters()[-1]
            message = rtcan.decode_identifier(needed[0]).message_id
        frame = rtcan.Frame(rtcan.encode_identifier(rtcan.NRT, message), Led().encode())
        for seconds, lost in (0.0, 1), (0.5, 2), (5.0, 2), (5.0, 2):
            await asyncio.sleep(seconds)
            link.driver.on_frame(frame, link.driver.now())
            assert link.losses == {"not subscribed": lost}
            assert not subscriber.queue
        assert needed not in link.engine.filters()
