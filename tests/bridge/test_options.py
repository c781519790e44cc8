"""What the options of a gateway let through, and what they change in messages on their way."""

from __future__ import annotations

import pytest

import r2p
from r2p.bridge import BridgeOptions
from r2p.bridge.options import ClassOf, Policy, RelayedPeriodic, is_link, parse_rule
from r2p.runtime.sample import PublisherClass, Sample, Source

SECOND = 1_000_000_000


def sample(stamp: int = SECOND, publisher_class: PublisherClass = PublisherClass.NON_REAL_TIME) -> Sample:
    return Sample(b"12345", Source("A", "n", "tcp:x"), stamp, publisher_class=publisher_class)


@pytest.mark.parametrize("text", ["", "@", "leds@", "leds@a>", "@a", "leds>zenoh", "a//c", "my topic"])
def test_rules_without_sense(text: str) -> None:
    with pytest.raises(r2p.Error, match="write TOPIC, TOPIC@FROM"):
        parse_rule(text)


def test_links_are_meant_by_name_kind_or_pattern() -> None:
    assert all(is_link("tcp:10.0.0.5:23", each) for each in ("tcp", "tcp:10.0.0.5:23", "tcp:10.*", "*"))
    assert not any(is_link("tcp:10.0.0.5:23", each) for each in ("tcp-listen", "tcp:", "zenoh", ""))


def test_loader_topics_come_in_from_ip_links_only_with_permission() -> None:
    strict, open_ = Policy(BridgeOptions()), Policy(BridgeOptions(allow_control=True))
    for link in ("tcp:10.0.0.5:23", "zenoh:"):
        assert not strict.allows("BOOT_IMU1", link, "rtcan:can0")
        assert strict.allows("BOOT_IMU1", "rtcan:can0", link)
        assert open_.allows("BOOT_IMU1", link, "rtcan:can0")
        assert not strict.order_denied(link, "rtcan:can0", harmless=True)
        assert strict.order_denied(link, "rtcan:can0", harmless=False)
    assert strict.allows("BOOT_IMU1", "serial:/dev/ttyUSB0", "rtcan:can0")


def test_links_of_one_kind_are_treated_alike() -> None:
    policy = Policy(BridgeOptions(deny=("*@tcp-listen*>tcp-listen*",), allow=("cmd_*@zenoh>rtcan", "log")))
    clients = [f"tcp-listen:0#{number}" for number in range(3)]
    assert len({policy.kind(each) for each in clients}) == 1
    assert len({policy.kind(each) for each in (clients[0], "zenoh:", "rtcan:can0", "serial:/dev/ttyUSB0")}) == 4


def test_what_a_debug_line_brings_gets_the_class_that_it_can_not_say() -> None:
    klass = ClassOf(PublisherClass.SPORADIC, 0.02)
    policy = Policy(BridgeOptions(classes={"enc*": klass}))
    assert policy.class_of("encoder", "tcp:10.0.0.5:23") == klass
    assert policy.class_of("leds", "tcp:10.0.0.5:23") is None
    assert policy.class_of("encoder", "zenoh:") is None
    shaper = policy.shaper("encoder", "tcp:10.0.0.5:23", soften=False)
    assert shaper is not None
    shaped = shaper.shape(sample(), 0, 0)
    assert shaped is not None
    assert (shaped.publisher_class, shaped.deadline) == (PublisherClass.SPORADIC, SECOND + SECOND // 50)
    assert not shaped.drop_late  # nobody who published it has said so


def test_periodic_messages_are_due_within_their_period() -> None:
    shaper = Policy(BridgeOptions()).shaper("encoder", "tcp:x", soften=True)
    assert shaper is not None
    periodic = [sample(n * SECOND // 100, PublisherClass.PERIODIC) for n in range(1, 5)]
    last = [shaper.shape(each, 0, 0) for each in periodic][-1]
    assert last is not None
    assert (last.publisher_class, last.deadline - last.stamp) == (PublisherClass.SPORADIC, SECOND // 100)
    plain = sample()
    assert shaper.shape(plain, 0, 0) is plain


def test_nothing_to_change() -> None:
    assert Policy(BridgeOptions()).shaper("encoder", "tcp:x", soften=False) is None


def test_slots_are_filled_with_the_latest_message_of_the_size_that_they_have() -> None:
    link, relayed = object(), RelayedPeriodic(5, 0.01)
    first, second = sample(), sample(2 * SECOND)
    assert not relayed.offer(first)  # there are no slots yet
    assert relayed.use_slot_clock(link, 0.008)
    assert not relayed.use_slot_clock(object(), 0.01)
    assert relayed.offer(first)
    assert relayed.offer(second)
    assert not relayed.offer(Sample(b"1234", Source("A", "n", "tcp:x"), SECOND))
    assert (relayed.tick(0, 0, 0), relayed.tick(0, 0, 0), relayed.missed, relayed.period) == (second, None, 1, 0.008)
    relayed.use_own_clock(link)
    assert not relayed.offer(first)
