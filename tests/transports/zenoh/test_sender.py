"""Subscribers on a network: credit, and final credits that come after the end of a token, or not at all.

In virtual time.
"""

import asyncio
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import pytest

from r2p.protocols.discovery.events import TopicType
from r2p.protocols.flow_control import SendWindow
from r2p.runtime.queues import WakeScheduler
from r2p.runtime.sample import PublisherClass, Sample, Source
from r2p.runtime.topic import Topic
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.sender import FINAL_CREDIT_S, FinalCredits, ZenohSubscriber
from tests.faults import once

pytestmark = pytest.mark.virtual_time


class Bench:
    """Final credits, what they count, and a credit that is found by looking."""

    def __init__(self) -> None:
        self.counted: list[int] = []
        self.found: tuple[str, int] | None = None
        sender: Any = SimpleNamespace(
            loop=asyncio.get_running_loop(),
            credits=SimpleNamespace(receive=self._look),
            count_unknown=self.counted.append,
        )
        self.final_credits = FinalCredits(sender)

    def _look(self) -> None:
        if self.found is not None:
            self.final_credits.receive(*self.found)


async def test_a_last_credit_that_comes_late_leaves_nothing_unknown() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    bench.final_credits.expect("leds", 2, 7)
    await asyncio.sleep(FINAL_CREDIT_S / 2)
    bench.final_credits.receive("leds", 1)
    bench.final_credits.receive("leds", 3)  # nothing is expected of it
    bench.final_credits.receive("speed", 2)
    await asyncio.sleep(FINAL_CREDIT_S)
    assert bench.counted == [7]


async def test_one_that_is_found_at_the_end_is_in_time() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    bench.found = "leds", 1
    await asyncio.sleep(2 * FINAL_CREDIT_S)
    assert bench.counted == []


async def test_one_that_came_back_and_is_gone_again_is_counted_once() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    await asyncio.sleep(FINAL_CREDIT_S / 2)
    bench.final_credits.expect("leds", 1, 7)
    await asyncio.sleep(0.9 * FINAL_CREDIT_S)
    assert bench.counted == []
    await asyncio.sleep(FINAL_CREDIT_S)
    assert bench.counted == [12]


async def test_a_link_that_is_closed_waits_for_nothing() -> None:
    bench = Bench()
    bench.final_credits.expect("leds", 1, 5)
    bench.final_credits.expect("leds", 2, 7)
    bench.found = "leds", 1
    bench.final_credits.close()
    assert bench.counted == [7]
    await asyncio.sleep(2 * FINAL_CREDIT_S)
    assert bench.counted == [7]


def subscriber_of(topic: Topic) -> ZenohSubscriber:
    """A topic on its way out by a link without a network."""
    link = SimpleNamespace(name="zenoh", up=True, stats=LinkStats())
    windows = defaultdict[object, SendWindow](SendWindow)
    sender: Any = SimpleNamespace(
        link=link,
        batcher=SimpleNamespace(add=lambda stream: None),
        credits=SimpleNamespace(receive=lambda: None, wait=lambda: None),
        publishers=SimpleNamespace(window=lambda topic, publisher_class: windows[publisher_class]),
        types={topic.name: TopicType(4)},
    )
    return ZenohSubscriber(sender, topic)


async def test_credit_counts_again_after_latched_values_that_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    topic = Topic("leds", WakeScheduler(asyncio.get_running_loop()))
    subscriber = subscriber_of(topic)
    subscriber.add_session(1, 1)
    window = subscriber._streams[PublisherClass.NON_REAL_TIME].window
    window.serial = window.limit  # there is no credit left
    monkeypatch.setattr(topic, "resend_latched", once(topic.resend_latched))
    with pytest.raises(RuntimeError):
        subscriber.resend_latched()  # which `Reachability` guards
    assert not subscriber.offer(Sample(b"", Source(), 0))


async def test_a_session_that_joins_again_is_checked_as_often_as_a_new_one() -> None:
    subscriber = subscriber_of(Topic("leds", WakeScheduler(asyncio.get_running_loop())))
    subscriber.add_session(1, 0)
    subscriber.add_session(2, 0)  # it keeps the topic open
    subscriber.silent_checks[1] = 9
    subscriber.remove_session(1)
    subscriber.add_session(1, 0)
    assert subscriber.silent_checks[1] == 0
