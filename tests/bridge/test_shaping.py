"""What a gateway changes in messages on their way."""

from __future__ import annotations

from r2p.bridge import BridgeOptions
from r2p.bridge.options import ClassOf, Policy
from r2p.bridge.shaping import RelayedPeriodic, Shaper
from r2p.runtime.sample import PublisherClass, Sample, Source

SECOND = 1_000_000_000


def sample(stamp: int = SECOND, publisher_class: PublisherClass = PublisherClass.NON_REAL_TIME) -> Sample:
    return Sample(b"12345", Source("A", "n", "tcp:x"), stamp, publisher_class=publisher_class)


def test_what_a_debug_line_brings_gets_the_class_that_it_can_not_say() -> None:
    klass = ClassOf(PublisherClass.SPORADIC, 0.02)
    policy = Policy(BridgeOptions(classes={"enc*": klass}))
    assert policy.class_of("encoder", "tcp:10.0.0.5:23") == klass
    assert policy.class_of("leds", "tcp:10.0.0.5:23") is None
    assert policy.class_of("encoder", "zenoh:") is None
    shaper = Shaper.of(rate=None, klass=klass, soften=False)
    assert shaper is not None
    shaped = shaper.shape(sample(), 0, 0)
    assert shaped is not None
    assert (shaped.publisher_class, shaped.deadline) == (PublisherClass.SPORADIC, SECOND + SECOND // 50)
    assert not shaped.drop_late  # nobody who published it has said so


def test_periodic_messages_are_due_within_their_period() -> None:
    shaper = Shaper.of(rate=None, klass=None, soften=True)
    assert shaper is not None
    periodic = [sample(n * SECOND // 100, PublisherClass.PERIODIC) for n in range(1, 5)]
    last = [shaper.shape(each, 0, 0) for each in periodic][-1]
    assert last is not None
    assert (last.publisher_class, last.deadline - last.stamp) == (PublisherClass.SPORADIC, SECOND // 100)
    plain = sample()
    assert shaper.shape(plain, 0, 0) is plain


def test_nothing_to_change() -> None:
    assert Shaper.of(rate=None, klass=None, soften=False) is None


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
