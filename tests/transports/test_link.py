"""What all links share: they go on when the handling of one thing raises."""

import asyncio

import pytest

import r2p
from r2p.msg import Led
from r2p.protocols.discovery.events import Event, ModuleChanged, ModuleGone
from r2p.testing.network import Network, node_in
from r2p.transports.link import Link
from r2p.transports.memory import Datagram, MemoryLink
from tests.faults import once

pytestmark = [pytest.mark.virtual_time, pytest.mark.internal_errors]


def link_of(module: r2p.Module) -> Link:
    (link,) = module.links
    assert isinstance(link, Link)
    return link


async def test_the_discovery_alarm_goes_on(r2p_network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    async with r2p.Module("A", via=r2p_network.transport()) as a, node_in(a) as node:
        link = link_of(a)
        monkeypatch.setattr(link.discovery, "poll", once(link.discovery.poll))
        await asyncio.sleep(5.0)
        assert link.losses == {"internal error": 1}
        publisher = node.advertise("leds", Led)
        async with r2p.Module("B", via=r2p_network.transport()) as b, node_in(b) as other:
            other.subscribe("leds", Led)
            await publisher.wait_subscriber()
        await asyncio.sleep(1.0)
        assert [each.name for each in a.network.modules()] == ["A"]


async def test_an_alarm_whose_work_always_raises_does_not_take_all_the_time(
    r2p_network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with r2p.Module("A", via=r2p_network.transport()) as a:
        link = link_of(a)
        monkeypatch.setattr(link.discovery, "poll", lambda _now: 1 // 0)
        await asyncio.sleep(5.0)
        assert 10 < link.losses["internal error"] <= 50


async def test_news_that_raise_do_not_stop_the_news_behind_them(
    r2p_network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with r2p.Module("A", via=r2p_network.transport()) as a:
        link, seen = link_of(a), list[Event]()
        monkeypatch.setattr(link._hub, "discovered", once(lambda _link, event: seen.append(event)))
        info = r2p.ModuleInfo("X", 0, 0)
        link._apply([ModuleChanged(info), ModuleGone(info)])
        assert (seen, link.losses) == ([ModuleGone(info)], {"internal error": 1})


async def test_the_memory_network_goes_on(r2p_network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    async with (
        r2p.Module("A", via=r2p_network.transport()) as a,
        r2p.Module("B", via=r2p_network.transport()) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led, queue=9)
        await publisher.wait_subscriber()
        link = link_of(b)
        assert isinstance(link, MemoryLink)

        def is_second(_topic: str, arrival: Datagram) -> bool:
            return arrival.sequence == 2

        monkeypatch.setattr(link, "sample", once(link.sample, is_second))
        for number in range(4):
            await publisher.publish(Led(number))
        await asyncio.sleep(0.1)
        assert [sample.sequence for sample in subscriber._sink.queue] == [1, 3, 4]
        assert link.losses == {"internal error": 1}


async def test_a_message_that_raises_when_there_is_room_for_it_does_not_stop_the_others(
    r2p_network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with (
        r2p.Module("A", via=r2p_network.transport()) as a,
        r2p.Module("B", via=r2p_network.transport()) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        publishers = [alice.advertise(f"leds{number}", Led) for number in range(3)]
        subscribers = [bob.subscribe(f"leds{number}", Led) for number in range(3)]
        for publisher in publishers:
            await publisher.wait_subscriber()
        link = link_of(a)
        assert isinstance(link, MemoryLink)
        monkeypatch.setattr(link.network, "_in_flight", 2000)  # it is full
        async with asyncio.TaskGroup() as tasks:
            for publisher in publishers:
                tasks.create_task(publisher.publish(Led()))
            await asyncio.sleep(0)
            monkeypatch.setattr(link, "write", once(link.write))
            monkeypatch.setattr(link.network, "_in_flight", 0)
            link.made_room()
        await asyncio.sleep(0.1)
        assert [len(each.queue) for each in subscribers] == [0, 1, 1]
        assert [each.missed for each in publishers] == [1, 0, 0]
        assert link.losses == {"internal error": 1}


async def test_an_announcement_that_raises_stops_neither_the_program_nor_other_links(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, other = Network(), Network()
    async with (
        r2p.Module("A", via=[one.transport(), other.transport()]) as a,
        r2p.Module("B", via=other.transport()) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        first, second = a.links
        monkeypatch.setattr(first.discovery, "advertise", once(first.discovery.advertise))
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led(1))
        assert await subscriber.fetch(timeout=1.0) == Led(1)
        assert (first.losses["internal error"], second.losses["internal error"]) == (1, 0)
