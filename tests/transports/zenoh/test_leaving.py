"""What a publisher counts when a subscriber on zenoh leaves, or is gone."""

from collections import Counter
from contextlib import AsyncExitStack

import pytest
import zenoh

from r2p.codecs import PublisherClass, liveliness
from r2p.codecs.attachment import Credit, encode_credit
from r2p.codecs.liveliness import TopicToken
from r2p.codecs.management import ROLE_SUBSCRIBES
from r2p.messages import layout
from r2p.msg import Led
from r2p.testing.network import node_in
from tests.transports.test_conformance import until
from tests.transports.zenoh.cable import Net, guarded, module
from tests.transports.zenoh.test_link import alien_on, link_of, nodes

pytestmark = pytest.mark.anyio


@guarded
async def test_a_subscriber_that_leaves_in_order_leaves_nothing_unknown() -> None:
    async with nodes(Net(), "A", "B") as (alice, bob):
        publisher = alice.advertise("leds", Led)
        async with bob.subscribe("leds", Led, queue=100) as subscriber:
            await publisher.wait_subscriber()
            for number in range(50):
                await publisher.publish(Led(number))
            assert [(await subscriber.fetch()).led for _ in range(50)] == list(range(50))
        await until(lambda: not publisher.subscribers)
        assert link_of(alice).losses["unknown at disconnect"] == 0


@guarded
async def test_what_a_subscriber_that_is_gone_has_not_confirmed_is_unknown() -> None:
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        publisher = alice.advertise("leds", Led)
        wants = liveliness.encode(TopicToken(7, ROLE_SUBSCRIBES, "leds", 7, "node", size=layout(Led).size, window=64))
        token = alien.liveliness().declare_token(f"r2p/lab/{liveliness.token_key(wants)}")
        reader = alien.declare_subscriber("r2p/lab/topic/leds", zenoh.handlers.RingChannel(1))
        await publisher.wait_subscriber()
        for number in range(5):
            await publisher.publish(Led(number))
        token.undeclare()
        reader.undeclare()
        await until(lambda: not publisher.subscribers)
        assert link_of(alice).losses["unknown at disconnect"] == 0  # a last credit may still come
        await until(lambda: link_of(alice).losses["unknown at disconnect"] == 5)


@guarded
@pytest.mark.parametrize("late", [False, True])
async def test_a_last_credit_is_for_all_classes_and_may_come_after_the_end_of_the_token(late: bool) -> None:
    net = Net()
    async with nodes(net, "A") as (alice,), alien_on(net) as alien:
        publisher, link = alice.advertise("leds", Led), link_of(alice)
        wants = liveliness.encode(TopicToken(7, ROLE_SUBSCRIBES, "leds", 7, "node", size=layout(Led).size, window=64))
        token = alien.liveliness().declare_token(f"r2p/lab/{liveliness.token_key(wants)}")
        reader = alien.declare_subscriber("r2p/lab/topic/leds", zenoh.handlers.RingChannel(1))
        await publisher.wait_subscriber()
        for number in range(5):
            await publisher.publish(Led(number))
        last = encode_credit(Credit(7, PublisherClass.SPORADIC, 0, "leds", leaving=True))
        if not late:
            alien.put(f"r2p/lab/credit/{link.instance:x}", last)
        token.undeclare()
        reader.undeclare()
        await until(lambda: not publisher.subscribers)
        if late:
            assert link.sender.final_credits._departed
            alien.put(f"r2p/lab/credit/{link.instance:x}", last)
        await until(lambda: not link.sender.final_credits._departed)
    assert link.losses["unknown at disconnect"] == 0


@guarded
@pytest.mark.parametrize("first", ["publisher", "subscriber", "publisher's module", "subscriber's module"])
async def test_whichever_side_ends_first_in_order_nothing_is_unknown(first: str) -> None:
    net, here, there = Net(), AsyncExitStack(), AsyncExitStack()
    async with here, there:
        alice = await here.enter_async_context(node_in(await here.enter_async_context(module("A", net.listen))))
        bob = await there.enter_async_context(node_in(await there.enter_async_context(module("B", net.join))))
        links = link_of(alice), link_of(bob)
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led, queue=100)
        await publisher.wait_subscriber()
        for number in range(50):
            await publisher.publish(Led(number))
        await until(lambda: len(subscriber.queue) == 50)  # the first of which has been granted credit for
        match first:
            case "publisher":
                publisher.close()
            case "subscriber":
                subscriber.close()
            case "publisher's module":
                await here.aclose()
            case "subscriber's module":
                await there.aclose()
                await until(lambda: not publisher.subscribers)
    assert not sum((link.losses for link in links), Counter())
