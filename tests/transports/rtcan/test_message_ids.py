"""Who sent a management message, where the id of its frame does not say that; and who sent data."""

from r2p.codecs import management
from r2p.codecs.management import (
    CLASS_NRT,
    ROLE_PUBLISHES,
    UNANSWERED,
    Advertise,
    Alive,
    Endpoint,
    Hello,
    SubscribeRequest,
    SubscribeResponse,
)
from r2p.protocols.discovery.events import ModuleInfo
from r2p.protocols.discovery.session import Discovery
from r2p.runtime.sample import Source
from r2p.transports.buffered_link import SenderLookup
from r2p.transports.rtcan.message_ids import FIRMWARE, R2P, address_of


def test_what_r2p_says_among_firmware_is_marked() -> None:
    request = management.encode(SubscribeRequest("leds", 5, 16, UNANSWERED))
    response = management.encode(SubscribeResponse("leds", 5, 1, management.rtcan_params(0x1828)))
    for data in (request, response, management.encode(Advertise("leds", 5))):
        assert address_of(data, {}) == FIRMWARE
        marked = management.mark(data)
        assert address_of(marked, {}) == R2P
        assert management.unmark(marked) == data
        assert management.unmark(data) == data
    assert management.rtcan_message_id(management.decode(management.mark(response)).params) == 0x1828  # type: ignore[union-attr]


def test_modules_are_known_by_what_they_said_before() -> None:
    alive = management.encode(Alive("PC1"))
    r2p, firmware = ModuleInfo("PC1", instance=1), ModuleInfo("PC1")
    assert address_of(alive, {}) == FIRMWARE
    assert address_of(alive, {"PC1": firmware}) == FIRMWARE
    assert address_of(alive, {"PC1": r2p}) == R2P
    assert address_of(management.encode(Hello("PC1", 1)), {}) == R2P
    assert management.mark(alive) == alive
    assert management.unmark(alive) == alive


def hear(discovery: Discovery, message: management.Management, source: int) -> None:
    discovery.receive(0, management.encode(message), source)


def test_the_source_of_data_follows_from_the_id8() -> None:
    discovery = Discovery("ME", 1)
    discovery.link_up(0)
    senders = SenderLookup(discovery, "bus", shared=(FIRMWARE, R2P))
    assert senders.source("leds", 0x21) == Source("", "", "bus")
    hear(discovery, Hello("A", 2), 0x21)
    hear(discovery, Hello("B", 3), 0x22)
    assert senders.source("leds", 0x21) == Source("A", "", "bus")
    hear(discovery, Endpoint(ROLE_PUBLISHES, 2, "blink", "leds", CLASS_NRT), 0x21)
    hear(discovery, Endpoint(ROLE_PUBLISHES, 3, "other", "leds", CLASS_NRT), 0x22)
    assert senders.source("leds", 0x21) == Source("A", "blink", "bus")
    assert senders.source("leds", 0x22) == Source("B", "other", "bus")
    hear(discovery, Endpoint(ROLE_PUBLISHES, 2, "second", "leds", CLASS_NRT), 0x21)
    assert senders.source("leds", 0x21) == Source("A", "", "bus")
    hear(discovery, Hello("A", 2), 0x23)  # it has another id8 now
    assert senders.source("leds", 0x23) == Source("A", "", "bus")


def test_of_firmware_the_only_module_that_it_can_be() -> None:
    discovery = Discovery("ME", 1)
    discovery.link_up(0)
    senders = SenderLookup(discovery, "bus", shared=(FIRMWARE, R2P))
    hear(discovery, Alive("IMU1"), FIRMWARE)
    assert senders.source("leds", 0x28) == Source("IMU1", "", "bus")
    hear(discovery, Alive("IMU2"), FIRMWARE)
    assert senders.source("leds", 0x28) == Source("", "", "bus")
