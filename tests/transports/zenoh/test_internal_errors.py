"""A link of zenoh goes on when the handling of one token, credit, subscriber or look around raises."""

import asyncio
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

import r2p
from r2p.codecs.attachment import Credit, encode_credit
from r2p.transports.stats import LinkStats
from r2p.transports.zenoh.config import ZenohOptions
from r2p.transports.zenoh.credit import Credits, Reachability
from r2p.transports.zenoh.link import ZenohLink
from r2p.transports.zenoh.transport import ZenohTransport
from tests.faults import once

pytestmark = [pytest.mark.virtual_time, pytest.mark.internal_errors]


def outlet(topic: str, **faults: Callable[..., Any]) -> Any:
    """Stands for a topic on its way out, with a subscriber that waits and has not said anything."""
    calls: list[str] = []
    outlet = SimpleNamespace(topic=SimpleNamespace(name=topic), calls=calls, tries=Counter(), wait_queue=lambda: True)
    outlet.expects = False
    outlet.unacknowledged = lambda: {7}
    for name in ("credited", "refill", "resend_latched"):
        setattr(outlet, name, lambda *_, name=name, **__: calls.append(name))
    for name, fault in faults.items():
        setattr(outlet, name, fault)
    return outlet


class Payload(bytes):
    def to_bytes(self) -> bytes:
        return self


async def test_credits() -> None:
    stats = LinkStats()
    outlets = [outlet("a", credited=once(print)), outlet("b", refill=once(print)), outlet("c")]
    credits_of = Credits(asyncio.get_running_loop(), stats, lambda: outlets, lambda *_: None)
    waiting = [SimpleNamespace(payload=Payload(encode_credit(Credit(7, 1, 5, each)))) for each in "abc"]
    session: Any = SimpleNamespace(
        subscribe=lambda *_: SimpleNamespace(
            take=lambda: waiting.pop(0) if waiting else None, wait=lambda: None, close=lambda: None
        )
    )
    credits_of.connect(session, "credit")
    credits_of._arrived(waiting.pop(0))  # type: ignore[arg-type]
    assert [each.calls for each in outlets] == [["refill"], ["credited"], ["credited", "refill"]]
    assert stats.lost == {"internal error": 2}
    credits_of.close()


@pytest.mark.parametrize("fault", ["reach", "let_in", "unacknowledged"])
async def test_subscribers(fault: str) -> None:
    calls: list[str] = []
    outlets = [outlet("a"), outlet("b")]
    link: Any = SimpleNamespace(
        stats=LinkStats(),
        knows=lambda _: True,
        senders=SimpleNamespace(reach=lambda _: True),
        let_in=lambda topic, *_, **__: calls.append(topic),
        credits=SimpleNamespace(look=lambda: None),
        zenoh_outlets=lambda: outlets,
        tell_unheard=lambda *_: None,
    )
    place = {"reach": link.senders, "let_in": link, "unacknowledged": outlets[0]}[fault]
    setattr(place, fault, once(getattr(place, fault)))
    reach = Reachability(link, asyncio.get_running_loop())
    reach.came("a", 7, 16)
    reach.came("b", 7, 16)
    await asyncio.sleep(1.0)
    assert sorted(calls) == (["b"] if fault == "let_in" else ["a", "b"])
    assert len(outlets[1].calls) >= 3
    assert len(outlets[0].calls) >= 2
    assert link.stats.lost == {"internal error": 1}
    reach.close()


async def test_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    async with r2p.Module("PC", via=[], watchdog=False) as module:
        assert module._hub is not None
        link = ZenohLink("zenoh:", module._hub, connects=False, batching=True)
        link.on_up()
        presence = link.discovery
        for call in ("appeared", "disappeared"):
            monkeypatch.setattr(presence, call, once(getattr(presence, call)))
        for number in (1, 2, 3):
            link._token_changed((f"1/{number}/module/PC{number}/{number}/0/0", True))
        assert list(presence.modules) == ["PC2", "PC3"]
        for number in (2, 3):
            link._token_changed((f"1/{number}/module/PC{number}/{number}/0/0", False))
        await asyncio.sleep(0.1)
        assert list(presence.modules) == ["PC2"]
        assert link.losses == {"internal error": 2}
        link.close()


async def test_looks_around(monkeypatch: pytest.MonkeyPatch) -> None:
    """What looks for modules on other networks goes on, and so does the link."""

    async def networks(*, tools: bool) -> set[str]:
        return {"lab", "field"}

    async with r2p.Module("PC", via=[], watchdog=False) as module:
        hub = module._hub
        assert hub is not None
        link = ZenohLink("zenoh:", hub, connects=False, batching=True)
        link.on_up()
        notices: list[str] = []
        monkeypatch.setattr(hub, "link_notice", lambda _link, _kind, text, **_: notices.append(text))
        session: Any = SimpleNamespace(networks=once(networks))
        await ZenohTransport(ZenohOptions("zenoh:"))._look_around(session, link, hub, "lab")
        assert link.losses == {"internal error": 1}
        assert notices[0].startswith("nobody else is on the network lab, but there are modules on field")
        link.close()
