"""Gateways of zenoh: what comes in by one network or line must not stop what passes to the others."""

import asyncio

import pytest

import r2p
from r2p.codecs import PublisherClass, attachment, management
from r2p.codecs.attachment import Header, Origin
from r2p.msg import Led
from r2p.testing.network import node_in
from r2p.transports.zenoh.publish import _reaches
from tests.transports.conversation import Script, line, manage
from tests.transports.test_conformance import until
from tests.transports.zenoh.cable import Net, guarded, module, plain_session

pytestmark = pytest.mark.anyio

STRANGER = "1/abcd"  # version and session of its tokens
BAD_NAMES = ["a#b", "a*b", "a//b", "$*"]


@guarded
async def test_values_that_other_links_can_not_carry_stop_nothing() -> None:
    """Sizes in tokens, names and roles on a line, and messages too long for it."""
    net, script = Net(), Script()
    async with r2p.Module("GW", via=[net.listen, script], bridge=True, watchdog=False) as gateway:

        def goes_on(topic: str) -> bool:
            return topic in gateway.space.topics and bool(gateway.space.topics[topic].remote_subscribers)

        with plain_session(net) as session:
            live, topics = session.liveliness(), f"r2p/{net.name}/topic"
            keys = [f"{STRANGER}/sub/evil{number}/abcd/x/0/99999999/-/16/0" for number in range(20)]
            keys += [f"{STRANGER}/pub/boom/abcd/x/1/0/-/0/0"]
            tokens = [live.declare_token(f"r2p/{net.name}/live/{key}") for key in keys]
            script.hear(b"".join(manage(management.Hello(name, 77)) for name in BAD_NAMES if len(name) < 8))
            script.hear(b"".join(manage(management.Endpoint(1, 77, "n", name, 1)) for name in BAD_NAMES))
            script.hear(manage(management.Endpoint(3, 77, "n", "t", 1)) + manage(management.Hello("FINE", 78)))
            script.hear(manage(management.Advertise("leds", 5)) + manage(management.SubscribeRequest("boom", 0, 5)))
            async with module("FAR", net.join) as far, node_in(far) as node:
                subscriber = node.subscribe("leds", Led)
                await until(lambda: goes_on("leds"))
                script.hear(manage(management.SubscribeResponse("leds", 5)) + line("leds", Led(7).encode()))
                assert await subscriber.fetch(timeout=5.0) == Led(7)
                await until(lambda: {"FINE", "FAR", "GW"} <= {each.name for each in far.network.modules()})
            publisher = session.declare_publisher(f"{topics}/boom")
            await until(lambda: _reaches(publisher) and goes_on("boom"))
            for serial, size in enumerate((5, 300, 5), 1):
                origin = Origin(PublisherClass.NON_REAL_TIME, 0xABCD, 0xABCD, bytes(8), "X", "x")
                header = Header(origin, serial, serial, serial)
                publisher.put(bytes(size), attachment=attachment.encode(header))
            await until(lambda: len(script.topics("boom")) == 2)
            link = gateway.links[0]
            assert (link.losses["undecodable"], link.losses["internal error"]) == (20, 0)
            assert link.losses["name not carried"] >= len(BAD_NAMES)
            assert gateway.links[1].losses["unknown type"] == 1
            for token in tokens:
                token.undeclare()


@guarded
async def test_two_networks_of_one_router() -> None:
    """Both links are called alike, by the endpoint."""
    router, one, other = Net("none"), Net("one"), Net("other")
    one.port = other.port = router.port
    async with (
        module("ROUTER", router.listen),
        r2p.Module("GW", via=[one.join, other.join], bridge=True, watchdog=False) as gateway,
        module("A", one.join) as a,
        module("B", other.join) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        there, back = alice.advertise("there", Led), bob.advertise("back", Led)
        arrived_there, arrived_back = bob.subscribe("there", Led), alice.subscribe("back", Led)
        await asyncio.gather(there.wait_subscriber(), back.wait_subscriber())
        async with asyncio.timeout(10.0):
            while not (arrived_there.queue and arrived_back.queue):  # the first ones while the gateway converges
                there.publish_nowait(Led(1))
                back.publish_nowait(Led(2))
                await asyncio.sleep(0.05)
        assert gateway.links[1].name == f"{gateway.links[0].name}#2"
        assert (await arrived_there.fetch(), await arrived_back.fetch()) == (Led(1), Led(2))
