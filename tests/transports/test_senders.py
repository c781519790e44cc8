"""Who is named as the source of what comes in."""

from r2p.codecs import management as m
from r2p.protocols.discovery.session import Discovery
from r2p.runtime.sample import Source
from r2p.transports.senders import SenderLookup
from tests.protocols.discovery.wire import PC2, PEER, S, hear, run


def publisher(node: str, *, gone: bool = False) -> m.Endpoint:
    return m.Endpoint(m.ROLE_PUBLISHES | (m.ROLE_GONE if gone else 0), PEER, node, "leds", m.CLASS_NRT)


def test_a_publisher_that_is_replaced_by_another() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources = SenderLookup(discovery, "lab")
    assert sources.source("leds") == Source("", "", "lab")
    hear(discovery, S, PC2, publisher("blink"))
    assert sources.source("leds") == Source("PC2", "blink", "lab")
    hear(discovery, S, publisher("blink", gone=True), publisher("wink"))
    assert sources.source("leds") == Source("PC2", "wink", "lab")
    hear(discovery, S, publisher("blink"))
    assert sources.source("leds") == Source("PC2", "", "lab"), "one of two"
    for now in range(4 * S, 24 * S, 4 * S):
        assert sources.source("leds") == Source("PC2", "", "lab")
        hear(discovery, now, PC2, publisher("blink"))
        run(discovery, now, now + 4 * S)
    assert sources.source("leds") == Source("PC2", "blink", "lab"), "the other one was not repeated"


def test_what_is_only_repeated_is_not_worked_out_again() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources = SenderLookup(discovery, "lab")
    hear(discovery, S, PC2, publisher("blink"))
    found = sources.source("leds")
    hear(discovery, 2 * S, PC2, m.Alive("PC2"), publisher("blink"))
    assert sources.source("leds") is found


def test_firmware_is_known_where_it_is_alone() -> None:
    discovery = Discovery("PC1", 1)
    discovery.link_up(0)
    sources = SenderLookup(discovery, "lab")
    hear(discovery, S, m.Alive("IMU1"))
    assert sources.source("leds") == Source("IMU1", "", "lab")
    hear(discovery, S, m.Alive("IMU2"))
    assert sources.source("leds") == Source("", "", "lab")
    discovery.link_down(2 * S)
    assert sources.source("leds") == Source("", "", "lab")
