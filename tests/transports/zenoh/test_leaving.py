"""What a publisher counts when a subscriber on zenoh leaves, or is gone."""

import pytest
import zenoh

from r2p.codecs import liveliness
from r2p.codecs.liveliness import TopicToken
from r2p.codecs.management import ROLE_SUBSCRIBES
from r2p.messages import layout
from r2p.msg import Led
from tests.transports.test_conformance import until
from tests.transports.zenoh.cable import Net, guarded
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
        token = alien.liveliness().declare_token(f"r2p/lab/{liveliness.place(wants)}")
        reader = alien.declare_subscriber("r2p/lab/topic/leds", zenoh.handlers.RingChannel(1))
        await publisher.wait_subscriber()
        for number in range(5):
            await publisher.publish(Led(number))
        token.undeclare()
        reader.undeclare()
        await until(lambda: not publisher.subscribers)
        assert link_of(alice).losses["unknown at disconnect"] == 5
