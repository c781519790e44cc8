"""What the modules on a link have said: what gateways know of who publishes what."""

from __future__ import annotations

from r2p.codecs import management as m
from r2p.protocols.discovery.events import Send
from r2p.protocols.discovery.negotiation import GRACE
from r2p.protocols.discovery.session import Discovery

SECOND = 1_000_000_000


def made() -> Discovery:
    discovery = Discovery("GW", 1)
    discovery.demand()
    discovery.link_up(0)
    return discovery


def hear(discovery: Discovery, now: float, *messages: m.Management, source: str = "a") -> None:
    for message in messages:
        discovery.receive(round(now * SECOND), m.encode(message), source)


def test_firmware_wants_and_offers_for_good() -> None:
    discovery = made()
    hear(discovery, 0, m.Advertise("leds", 5), m.SubscribeRequest("cmd", 12, 5))
    demand = discovery.demand()
    assert demand.pop_changed() == {"leds", "cmd"}
    discovery.poll(1000 * SECOND)
    assert (demand.is_published("leds"), demand.is_subscribed("cmd"), demand.is_subscribed("leds")) == (
        True,
        True,
        False,
    )
    discovery.link_down(1000 * SECOND)
    assert demand.is_subscribed("cmd")


def test_r2p_modules_want_for_a_lease() -> None:
    discovery = made()
    hear(discovery, 0, m.Hello("PC1", 7), m.SubscribeRequest("leds", 5, 1))
    demand = discovery.demand()
    hear(discovery, 3, m.SubscribeRequest("leds", 5, 1))
    discovery.poll(7 * SECOND)
    assert demand.is_subscribed("leds")
    discovery.poll(9 * SECOND)
    assert not demand.is_subscribed("leds")


def test_a_request_before_the_first_hello_becomes_a_lease() -> None:
    discovery = made()
    hear(discovery, 0, m.SubscribeRequest("leds", 5, 1), m.Hello("PC1", 7))
    discovery.poll(6 * SECOND)
    assert not discovery.demand().is_subscribed("leds")


def test_unsubscribe_and_good_bye() -> None:
    discovery = made()
    demand = discovery.demand()
    hear(discovery, 0, m.Hello("PC1", 7), m.SubscribeRequest("leds", 5, 1), m.Advertise("cmd", 12))
    hear(discovery, 1, m.Unsubscribe("leds", 7))
    assert not demand.is_subscribed("leds")
    hear(discovery, 1, m.Hello("PC1", 7, m.HELLO_LEAVING))
    assert not demand.is_published("cmd")


def test_two_who_share_a_line_do_not_speak_for_each_other() -> None:
    discovery = made()
    hear(discovery, 0, m.Hello("PC1", 7), m.Hello("PC2", 8), m.SubscribeRequest("leds", 5, 1))
    hear(discovery, 1, m.Unsubscribe("leds", 7), m.Hello("PC1", 7, m.HELLO_LEAVING))
    assert discovery.demand().is_subscribed("leds")


def test_who_has_asked_before_joins_at_once() -> None:
    discovery = made()
    hear(discovery, 0, m.SubscribeRequest("leds", 5, 1))
    events = discovery.advertise(SECOND, "leds", 5)
    assert m.encode(m.SubscribeResponse("leds", 5, 1)) in [event.data for event in events if isinstance(event, Send)]
    assert "SubscriberJoined" in {type(event).__name__ for event in discovery.poll(SECOND + GRACE)}


def test_relayed_messages_take_their_turn() -> None:
    discovery = Discovery("GW", 1, rate=10.0, burst=2)
    discovery.link_up(0)
    for number in range(5):
        discovery.relay(0, m.Alive(f"M{number}"))
        discovery.relay(0, m.Alive(f"M{number}"))
    said = []
    now = 0
    while now < 3 * SECOND:
        now = max(now, discovery.next_deadline() or now) + 1
        for event in discovery.poll(now):
            message = m.decode(event.data)  # type: ignore[union-attr]
            if isinstance(message, m.Alive) and message.module != "GW":
                said.append(message.module)
    assert said == [f"M{number}" for number in range(5)]
