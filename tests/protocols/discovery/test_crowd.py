"""Many modules on one link: what they repeat, by count; and that losses and modules of before stay harmless."""

import math
import random
from collections import Counter
from itertools import pairwise

import pytest

from r2p.codecs import management as m
from r2p.protocols.discovery.directory import LEASE, topic_lease
from r2p.protocols.discovery.events import (
    Event,
    ModuleInfo,
    PublisherFound,
    PublisherGone,
    Send,
    SubscriberJoined,
    SubscribersGone,
)
from r2p.protocols.discovery.schedule import Item, ItemKind, Schedule
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import MS, S, hear, run, sent


class Crowd:
    """Discoveries on one link without delay. Each publishes so many topics, and subscribes to the first of the next."""

    def __init__(self, modules: int, *, topics: int = 3, loss: float = 0.0) -> None:
        self.now = 0
        self.heard: Counter[str] = Counter()
        """Messages, by the number of modules that handled them."""
        self.said: Counter[type] = Counter()
        self.attached = [set[str]() for _ in range(modules)]
        self.opened = [set[str]() for _ in range(modules)]
        self.modules = [Discovery(f"M{n}", n + 1) for n in range(modules)]
        self._loss = loss
        self._random = random.Random(modules)
        for n, module in enumerate(self.modules):
            for topic in range(topics):
                module.advertise(0, f"m{n}t{topic}", 8)
            module.subscribe(0, f"m{(n + 1) % modules}t0", 8)
            self._act(n, module.link_up(0))

    def run(self, seconds: float) -> None:
        end = self.now + round(seconds * S)
        while True:
            due, n = min((each.next_deadline() or end, n) for n, each in enumerate(self.modules))
            if due >= end:
                break
            self.now = max(self.now, due)
            self._act(n, self.modules[n].poll(self.now))
        self.now = end

    def is_connected(self) -> bool:
        count = len(self.modules)
        return all(self.attached[n] == {f"m{n}t0"} for n in range(count)) and all(
            self.opened[n] == {f"m{(n + 1) % count}t0"} for n in range(count)
        )

    def _act(self, n: int, events: list[Event]) -> None:
        for event in events:
            match event:
                case Send(data):
                    self.said[type(m.decode(data))] += 1
                    for other, module in enumerate(self.modules):
                        if other != n and self._random.random() >= self._loss:
                            self.heard["all"] += 1
                            self._act(other, module.receive(self.now, data, n))
                case SubscriberJoined(topic):
                    self.attached[n].add(topic)
                case SubscribersGone(topic):
                    self.attached[n].discard(topic)
                case PublisherFound(topic):
                    self.opened[n].add(topic)
                case PublisherGone(topic):
                    self.opened[n].discard(topic)
                case _:
                    pass


def idle_rate(modules: int) -> float:
    """Messages a second of all modules together, when there is nothing new."""
    crowd = Crowd(modules)
    crowd.run(10)
    assert crowd.is_connected()
    crowd.said.clear()
    crowd.run(60)
    assert crowd.is_connected()
    return crowd.said.total() / 60


def test_what_is_said_grows_with_those_who_talk() -> None:
    few, many = idle_rate(6), idle_rate(24)
    assert math.log(many / few) / math.log(24 / 6) < 1.05
    assert many / 24 < 2, "messages of one module, with HELLO and ALIVE"


def test_a_start_costs_each_module_a_few_repetitions() -> None:
    said = {}
    for modules in (6, 24):
        crowd = Crowd(modules)
        crowd.run(6)
        said[modules] = crowd.said.total()
    assert math.log(said[24] / said[6]) / math.log(24 / 6) < 1.2


@pytest.mark.parametrize("modules", [0, 5, 50, 130, 1000])
@pytest.mark.parametrize("lossless", [False, True])
def test_topics_are_repeated_before_others_forget_them(modules: int, lossless: bool) -> None:
    schedule = Schedule(rate=1e6, burst=32, quiet=0)
    schedule.set_lossless(lossless=lossless)
    for topic in range(3):
        schedule.add(Item(ItemKind.PUBLISHER, (f"t{topic}",)))
    schedule.start(0)
    schedule.set_crowd(modules)
    wire = m.WIRE_CROWD if modules else 0
    rounds = 2 if lossless else 3
    lease = topic_lease(ModuleInfo("M", instance=1, lease=max(LEASE, rounds * schedule.round_time), wire=wire))
    said: dict[Item, list[int]] = {}
    while (now := max(schedule.due(), 0)) < 3 * lease:
        item = schedule.pop(now)
        if item is not None:
            said.setdefault(item, []).append(now)
            schedule.sent(now, 1)
    topics = [times for item, times in said.items() if item.kind is ItemKind.PUBLISHER]
    assert len(topics) == 3
    assert max(later - at for times in topics for at, later in pairwise(times)) < lease


@pytest.mark.parametrize("loss", [0.1, 0.4])
def test_losses_are_made_good(loss: float) -> None:
    crowd = Crowd(8, loss=loss)
    crowd.run(60)
    assert crowd.is_connected()


def test_a_subscription_outlasts_its_lease_while_its_module_is_there_and_no_longer() -> None:
    crowd = Crowd(6)
    crowd.run(40)
    assert crowd.is_connected()
    gone = crowd.modules.pop(5)
    assert gone.next_deadline() is not None
    crowd.run(LEASE / S + 0.1)
    assert not crowd.attached[0]
    assert not crowd.opened[4]


def test_where_nothing_is_lost_one_other_module_is_enough() -> None:
    discovery = Discovery("PC1", 99)
    discovery.set_lossless(0)
    discovery.advertise(0, "leds", 5)
    discovery.link_up(0)
    hear(discovery, 0, m.Hello("M1", 1, lease_ms=60_000, wire=m.WIRE_VERSION), m.Alive("M1", 0))
    run(discovery, 0, 10 * S)
    assert 1 <= offers(discovery, 10 * S, 52 * S) <= 2
    hear(discovery, 52 * S, m.Alive("FW", 0))  # firmware behind a gateway needs its answers again and again
    assert offers(discovery, 52 * S, 57 * S) >= 3


def test_where_nothing_is_lost_a_subscription_ends_with_its_module_only() -> None:
    """However many modules come, and however late it is repeated for that; a gateway's demand ends the same way."""
    discovery = Discovery("PC1", 99)
    discovery.set_lossless(0, addresses=True)
    demand = discovery.demand()
    discovery.advertise(0, "leds", 5)
    discovery.link_up(0)
    hear(discovery, 0, m.Hello("M1", 1, wire=m.WIRE_VERSION), m.SubscribeRequest("leds", 5, 5), source=1)
    gone: list[int] = []

    def pass_time(start: int, end: int, *, alive: bool = True) -> bool:
        for second in range(start, end):
            gone.extend(
                at for at, each in run(discovery, second * S, second * S + S) if each == SubscribersGone("leds")
            )
            if alive:
                hear(discovery, second * S + S, m.Hello("M1", 1, wire=m.WIRE_VERSION), source=1)
        return demand.is_subscribed("leds") and not gone

    assert pass_time(0, 300)
    discovery.set_lossless(300 * S, lossless=False)
    assert not pass_time(300, 400)
    assert len(gone) == 1
    discovery.set_lossless(400 * S, addresses=True)
    hear(discovery, 400 * S, m.SubscribeRequest("leds", 5, 5), source=1)
    gone.clear()
    assert pass_time(400, 500)
    assert not pass_time(500, 506, alive=False)
    assert len(gone) == 1


def test_what_no_module_knew_leaves_nothing_behind() -> None:
    """Neither while the link is down, nor beside firmware alone, which has no message for the end."""
    discovery = Discovery("PC1", 99)
    discovery.set_lossless(0)
    discovery.link_up(0)
    for number in range(20):
        if number == 10:
            discovery.link_down(S)
        discovery.subscribe(S, f"t{number}", 5)
        discovery.add_endpoint(S, "node", f"t{number}", m.ROLE_SUBSCRIBES)
        discovery.unsubscribe(S, f"t{number}")
        discovery.remove_endpoint(S, "node", f"t{number}", m.ROLE_SUBSCRIBES)
    assert not discovery._announcer._ended


def test_an_endpoint_that_came_before_its_module_stays_where_nothing_is_lost() -> None:
    """The HELLO of before was lost, as there were faults."""
    discovery = Discovery("PC1", 99)
    discovery.set_lossless(0, addresses=True)
    discovery.link_up(0)
    hear(discovery, 0, m.Endpoint(m.ROLE_PUBLISHES, 1, "drive", "leds", 1), source=1)
    for second in range(1, 20):
        hear(discovery, second * S, m.Hello("M1", 1, wire=m.WIRE_VERSION), source=1)
        run(discovery, second * S, second * S + S)
    assert len(discovery.endpoints) == 1


def test_a_hello_comes_first_when_nothing_is_lost_any_more() -> None:
    discovery = crowded()
    run(discovery, 0, 10 * S)
    said = sent(discovery.set_lossless(10 * S, addresses=True))
    assert isinstance(said[0], m.Hello)
    assert any(isinstance(each, m.Advertise) for each in said)


def told(modules: int, *, each: int = S // 10) -> tuple[Discovery, list[tuple[int, m.Management]]]:
    """One that others join, one by one, on a network where each newcomer is answered alone; and what it says to all."""
    discovery = Discovery("PC1", 99)
    discovery.set_lossless(0, addresses=True)
    discovery.advertise(0, "leds", 5)
    discovery.add_endpoint(0, "blink", "leds", m.ROLE_PUBLISHES)
    said = [(0, message) for message in sent(discovery.link_up(0))]
    for n in range(modules):
        hello = m.Hello(f"M{n}", n + 1, m.HELLO_QUERY, wire=m.WIRE_VERSION)
        events = hear(discovery, n * each, hello, m.Alive(f"M{n}", 0), source=n)
        said += [(n * each, message) for message in sent(events)]
        said += says(discovery, n * each, (n + 1) * each)
    return discovery, said


def says(discovery: Discovery, start: int, end: int) -> list[tuple[int, m.Management]]:
    return [(now, message) for now, event in run(discovery, start, end) for message in sent([event])]


def test_while_many_modules_start_each_says_everything_once() -> None:
    _, said = told(100, each=20 * MS)
    kinds = Counter(type(message) for _, message in said)
    assert kinds == {m.Hello: 1, m.Alive: 1, m.TypeInfo: 1, m.Advertise: 1, m.Endpoint: 1}


def test_a_module_may_be_silent_for_two_rounds_of_as_many_modules_as_there_are_now() -> None:
    """Its last HELLO says 5 s, as it was one of the first."""
    discovery, _ = told(100)
    run(discovery, 10 * S, 29 * S)
    assert len(discovery.modules) == 100
    run(discovery, 29 * S, 45 * S)
    assert not discovery.modules
    discovery, _ = told(3)
    run(discovery, S, 4 * S)
    assert len(discovery.modules) == 3
    run(discovery, 4 * S, 6 * S)
    assert not discovery.modules


def test_a_module_is_heard_in_time_when_the_others_have_gone() -> None:
    """They forget it after the two rounds of a few modules, and so it does not wait for the end of its long one."""
    discovery, _ = told(100)
    run(discovery, 10 * S, 12 * S)
    for n in range(90):
        hear(discovery, 12 * S, m.Hello(f"M{n}", n + 1, m.HELLO_LEAVING, wire=m.WIRE_VERSION), source=n)
    said = says(discovery, 12 * S, 14 * S)
    assert {type(message) for _, message in said} >= {m.Alive}
    assert said[0][0] == 12 * S


def test_a_module_is_heard_within_a_round_when_messages_begin_to_be_lost() -> None:
    discovery, _ = told(100)
    discovery.set_lossless(10 * S, lossless=False)
    heard = [now for now, message in says(discovery, 10 * S, 25 * S) if isinstance(message, m.Alive)]
    assert max(later - at for at, later in pairwise([10 * S, *heard])) <= 9 * S / 2


def crowded(*, wire: int = m.WIRE_VERSION) -> Discovery:
    """One that knows five others on its link, and repeats a topic."""
    discovery = Discovery("PC1", 99)
    discovery.advertise(0, "leds", 5)
    discovery.link_up(0)
    for n in range(5):
        others = m.WIRE_VERSION if n else wire
        hear(discovery, 0, m.Hello(f"M{n}", n + 1, lease_ms=60_000, wire=others), m.Alive(f"M{n}", 0), source=n)
    return discovery


def offers(discovery: Discovery, start: int, end: int) -> int:
    return sum(isinstance(each, m.Advertise) for each in sent([event for _, event in run(discovery, start, end)]))


def requests(discovery: Discovery, start: int, end: int) -> int:
    said = sent([event for _, event in run(discovery, start, end)])
    return sum(isinstance(each, m.SubscribeRequest) for each in said)


def test_topics_are_repeated_slowly_only_if_all_know_that() -> None:
    settled = crowded()
    run(settled, 0, 10 * S)
    assert 4 <= offers(settled, 10 * S, 50 * S) <= 7
    before = crowded(wire=2)
    run(before, 0, 10 * S)
    assert offers(before, 10 * S, 50 * S) >= 26
    run(settled, 50 * S, 51 * S)
    hear(settled, 51 * S, m.Alive("FW", 0), source=20)  # firmware
    assert offers(settled, 51 * S, 56 * S) >= 3


def test_a_request_is_repeated_until_it_is_answered() -> None:
    discovery = crowded()
    discovery.subscribe(0, "pwm", 8)
    run(discovery, 0, 2 * S)
    assert requests(discovery, 2 * S, 12 * S) <= 2
    hear(discovery, 12 * S, m.Advertise("pwm", 8), source=1)
    assert requests(discovery, 12 * S, 22 * S) >= 5
    hear(discovery, 22 * S, m.SubscribeResponse("pwm", 8, 5), source=1)
    run(discovery, 22 * S, 26 * S)
    assert requests(discovery, 26 * S, 36 * S) <= 2


def test_a_restarted_module_keeps_no_subscription_that_it_does_not_want() -> None:
    discovery = crowded()
    joined = hear(discovery, S, m.SubscribeRequest("leds", 5, 5, m.UNANSWERED), source=1)
    assert any(isinstance(event, SubscriberJoined) for event in joined)
    hear(discovery, 2 * S, m.Hello("M1", 77, lease_ms=60_000, wire=m.WIRE_VERSION), source=1)
    events = [event for _, event in run(discovery, 2 * S, 2 * S + LEASE + MS)]
    assert SubscribersGone("leds") in events
