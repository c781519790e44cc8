"""A link of zenoh goes on when the handling of one token, credit, subscriber or look around raises."""

import asyncio
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

import r2p
from r2p.codecs import PublisherClass
from r2p.codecs.attachment import Credit, encode_credit
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.config import ZenohOptions
from r2p.transports.zenoh.link import ZenohLink
from r2p.transports.zenoh.sender import CreditReader, Reachability
from r2p.transports.zenoh.transport import ZenohTransport
from tests.faults import once

pytestmark = [pytest.mark.virtual_time, pytest.mark.internal_errors]


def subscriber(topic: str, **faults: Callable[..., Any]) -> Any:
    """Stands for a topic on its way out, with a subscriber that waits and has not said anything."""
    calls: list[str] = []
    subscriber = SimpleNamespace(
        topic=SimpleNamespace(name=topic), calls=calls, silent_checks=Counter(), get_wait_queue=lambda: True
    )
    subscriber.awaits_credit = False
    subscriber.unacknowledged = lambda: {7}
    for name in ("acknowledge", "refill", "resend_latched"):
        setattr(subscriber, name, lambda *_, name=name, **__: calls.append(name))
    for name, fault in faults.items():
        setattr(subscriber, name, fault)
    return subscriber


class Payload(bytes):
    def to_bytes(self) -> bytes:
        return self


async def test_credits() -> None:
    stats, loop = LinkStats(), asyncio.get_running_loop()
    subscribers = [subscriber("a", acknowledge=once(print)), subscriber("b", refill=once(print)), subscriber("c")]
    by_topic = {each.topic.name: each for each in subscribers}
    sender: Any = SimpleNamespace(loop=loop, link=SimpleNamespace(stats=stats), subscribers=lambda: subscribers)
    sender.subscriber = by_topic.get
    credits_of = CreditReader(sender)
    sent = [Credit(7, PublisherClass.NON_REAL_TIME, 5, each) for each in "abc"]
    waiting = [SimpleNamespace(payload=Payload(encode_credit(each))) for each in sent]
    session: Any = SimpleNamespace(
        subscribe=lambda *_, **__: SimpleNamespace(
            receive=lambda: waiting.pop(0) if waiting else None, wait=lambda: None, close=lambda: None
        )
    )
    credits_of.connect(session, "credit")
    credits_of._on_credit(waiting.pop(0))  # type: ignore[arg-type]
    assert [each.calls for each in subscribers] == [["refill"], ["acknowledge"], ["acknowledge", "refill"]]
    assert stats.lost == {"internal error": 2}
    credits_of.close()


@pytest.mark.parametrize("fault", ["reaches", "admit", "unacknowledged"])
async def test_subscribers(fault: str) -> None:
    calls: list[str] = []
    subscribers = [subscriber("a"), subscriber("b")]
    stats = LinkStats()
    sender: Any = SimpleNamespace(
        loop=asyncio.get_running_loop(),
        link=SimpleNamespace(stats=stats),
        topics={"a", "b"},
        publishers=SimpleNamespace(reaches=lambda _: True),
        admit=lambda topic, *_, **__: calls.append(topic),
        credits=SimpleNamespace(receive=lambda: None),
        subscribers=lambda: subscribers,
        report_unreachable=lambda *_: None,
    )
    place = {"reaches": sender.publishers, "admit": sender, "unacknowledged": subscribers[0]}[fault]
    setattr(place, fault, once(getattr(place, fault)))
    reach = Reachability(sender)
    reach.add("a", 7, 16)
    reach.add("b", 7, 16)
    await asyncio.sleep(1.0)
    assert sorted(calls) == (["b"] if fault == "admit" else ["a", "b"])
    assert len(subscribers[1].calls) >= 3
    assert len(subscribers[0].calls) >= 2
    assert stats.lost == {"internal error": 1}
    reach.close()


async def test_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    async with r2p.Module("PC", via=[], watchdog=False) as module:
        assert module._link_manager is not None
        link = ZenohLink("zenoh:", module._link_manager, connects=False, batching=True)
        link.on_up()
        presence = link.discovery
        for call in ("appeared", "disappeared"):
            monkeypatch.setattr(presence, call, once(getattr(presence, call)))
        for number in (1, 2, 3):
            link._on_token((f"1/{number}/module/PC{number}/{number}/0/0", True))
        assert list(presence.modules) == ["PC2", "PC3"]
        for number in (2, 3):
            link._on_token((f"1/{number}/module/PC{number}/{number}/0/0", False))
        await asyncio.sleep(0.1)
        assert list(presence.modules) == ["PC2"]
        assert link.losses == {"internal error": 2}
        link.close()


async def test_looks_around(monkeypatch: pytest.MonkeyPatch) -> None:
    """What looks for modules on other networks goes on, and so does the link."""

    async def find_networks(*, tools: bool) -> set[str]:
        return {"lab", "field"}

    async with r2p.Module("PC", via=[], watchdog=False) as module:
        hub = module._link_manager
        assert hub is not None
        link = ZenohLink("zenoh:", hub, connects=False, batching=True)
        link.on_up()
        notices: list[str] = []
        monkeypatch.setattr(hub, "link_notice", lambda _link, _kind, text, **_: notices.append(text))
        session: Any = SimpleNamespace(find_networks=once(find_networks))
        await ZenohTransport(ZenohOptions("zenoh:"))._look_for_others(session, link, hub, "lab")
        assert link.losses == {"internal error": 1}
        assert notices[0].startswith("no other module is on the network lab, but there are modules on field")
        link.close()
