"""Tokens and modules for which there was no room are there when room appears."""

import itertools

import pytest

from r2p.codecs import liveliness
from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.codecs.management import ROLE_PUBLISHES
from r2p.protocols.discovery.events import Event, ModuleChanged, PublisherFound, QueryTokens
from r2p.protocols.liveliness import modules, session
from r2p.protocols.liveliness.session import LivelinessDiscovery

SECOND = 1_000_000_000
MOST = 8
KEYS = [liveliness.encode(ModuleToken(n, f"M{n}", n)) for n in range(1, 30)]


class Network:
    """The tokens that are there, and one module that hears of each once. Time passes in `wait`."""

    def __init__(self) -> None:
        self.now = 0
        self.keys: list[str] = []
        self.looks: list[int] = []
        self.events: list[Event] = []
        self.complete = True
        self.unsaid: set[str] = set()
        """Tokens that are not among the answers of the next query."""
        self.module = LivelinessDiscovery("A", 1000)
        self.module.link_up(0)

    def add(self, *keys: str) -> None:
        for key in keys:
            self.keys.append(key)
            self.events += self.module.appeared(self.now, key)

    def remove(self, *keys: str) -> None:
        for key in keys:
            self.keys.remove(key)
            self.events += self.module.disappeared(self.now, key)

    def wait(self, seconds: float) -> None:
        end = self.now + round(seconds * SECOND)
        while (due := self.module.next_deadline()) is not None and due <= end:
            self.now = max(self.now, due)
            events = self.module.poll(self.now)
            self.events += events
            if QueryTokens() in events:
                self._answer()
        self.now = end

    def _answer(self) -> None:
        self.looks.append(self.now)
        for key in self.keys:
            if key not in self.unsaid:
                self.events += self.module.appeared(self.now, key)
        self.unsaid.clear()
        self.events += self.module.query_ended(self.now, complete=self.complete)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    monkeypatch.setattr(session, "TOKENS_MAX", MOST)
    return Network()


def test_refused_tokens_are_asked_for_once_all_have_room(network: Network) -> None:
    network.add(*KEYS[:10])
    assert network.module.counts == {"too many tokens": 2}
    network.remove(KEYS[0])
    network.wait(60.0)
    assert not network.looks
    network.remove(KEYS[1])
    began = network.now
    network.wait(60.0)
    assert set(network.module.modules) == {f"M{n}" for n in range(3, 11)}
    (looked,) = network.looks
    assert 5 * SECOND <= looked - began <= 10 * SECOND
    network.remove(*KEYS[2:10])
    network.wait(3600.0)
    assert len(network.looks) == 2  # once more, as the first one brought something
    assert network.module.next_deadline() is None


def test_a_refused_publisher_is_heard_when_there_is_room(network: Network) -> None:
    network.module.subscribe(0, "leds", 5)
    network.add(*KEYS[:MOST], liveliness.encode(TopicToken(7, ROLE_PUBLISHES, "leds", 7, size=5)))
    assert not network.module.topics
    network.remove(KEYS[0])
    network.wait(60.0)
    assert [each.source for each in network.events if isinstance(each, PublisherFound)] == [7]


def test_a_lot_of_room_is_enough_for_any_number(network: Network) -> None:
    network.add(*KEYS)
    network.remove(*KEYS[: MOST // 4])
    network.wait(60.0)
    assert len(network.module.modules) == MOST
    assert len(network.looks) == 1


def test_refused_tokens_that_went_need_no_room(network: Network) -> None:
    network.add(*KEYS[: MOST + 2])
    network.remove(KEYS[MOST])
    network.remove(KEYS[0])
    network.wait(60.0)
    assert len(network.looks) == 1
    assert f"M{MOST + 2}" in network.module.modules


def test_nobody_asks_while_there_is_no_room(network: Network) -> None:
    network.add(*KEYS[: MOST + 2])
    network.wait(3600.0)
    assert not network.looks


def test_room_that_is_taken_before_the_look_is_waited_for_again(network: Network) -> None:
    network.add(*KEYS[: MOST + 1])
    network.remove(KEYS[0])
    network.add(KEYS[20])
    network.wait(60.0)
    assert not network.looks
    network.remove(KEYS[20])
    network.wait(60.0)
    assert len(network.looks) == 1


def test_looks_again_and_again_are_further_and_further_apart(network: Network) -> None:
    network.complete = False
    network.add(*KEYS[: MOST + 1])
    network.remove(*KEYS[:2])
    network.wait(7200.0)
    apart = [(later - before) / SECOND for before, later in itertools.pairwise(network.looks)]
    assert all(later >= before for before, later in itertools.pairwise(apart))
    assert apart[0] >= 10.0
    assert 300.0 <= apart[-1] <= 600.0
    network.complete = True
    network.wait(600.0)
    network.remove(*KEYS[2 : MOST + 1])
    network.wait(3600.0)
    before = len(network.looks)
    network.add(*KEYS[: MOST + 1])
    network.remove(KEYS[0])
    network.wait(10.0)
    assert len(network.looks) == before + 1


def test_a_query_that_ends_before_its_last_answers_is_repeated(network: Network) -> None:
    network.add(*KEYS[: MOST + 4])
    network.remove(*KEYS[:5])
    network.unsaid = {KEYS[MOST + 1]}
    network.wait(3600.0)
    assert set(network.module.modules) == {f"M{n}" for n in range(6, MOST + 5)}
    assert len(network.looks) == 3  # the last one brought nothing


def test_tokens_of_which_nobody_told_are_asked_for(network: Network) -> None:
    network.keys += KEYS[:3]
    network.module.missed(network.now, 3)
    network.wait(60.0)
    assert len(network.module.modules) == 3


def test_what_is_refused_before_the_link_is_up_is_asked_for_afterwards(network: Network) -> None:
    network.module.link_down(0)
    network.module.refused(0)
    network.keys += KEYS[:1]
    assert network.module.next_deadline() is None
    network.module.link_up(0)
    network.wait(60.0)
    assert list(network.module.modules) == ["M1"]
    assert network.module.counts == {"too many tokens": 1}


def test_nothing_is_asked_of_a_network_that_is_away(network: Network) -> None:
    network.add(*KEYS[: MOST + 1])
    network.remove(KEYS[0])
    network.module.link_down(network.now)
    assert network.module.next_deadline() is None
    network.wait(3600.0)
    assert not network.looks


def test_what_is_not_reported_while_a_module_joins_is_found_soon(network: Network) -> None:
    """Some reports are missing where many modules join at the same time."""
    network.keys += KEYS[:3]
    network.unsaid = {KEYS[0]}
    network.wait(10.0)
    assert list(network.module.modules) == ["M2", "M3"]
    network.wait(3600.0)
    assert set(network.module.modules) == {"M1", "M2", "M3"}
    assert len(network.looks) == 3  # the last one brought nothing
    network.module.link_down(network.now)
    network.module.link_up(network.now)
    network.wait(10.0)
    assert len(network.looks) == 4


def test_a_token_that_is_refused_twice_in_a_look_does_not_need_room_for_two() -> None:
    count = session.RefusedTokens(1000, 0)
    count.add()
    count.review(0, 1)
    assert count.begin_query(5 * SECOND, 1)
    count.add()  # it came
    count.add()  # and is among the answers
    count.query_ended(complete=True)
    count.review(5 * SECOND, 1)
    assert count.next_deadline() == 15 * SECOND


def test_a_pack_that_does_not_fit_is_not_asked_for_again_and_again() -> None:
    count = session.RefusedTokens(100, 0)
    count.add(7)
    count.review(0, 7)
    assert count.begin_query(count.next_deadline() or 0, 7)
    count.add(7)  # somebody else was faster
    count.query_ended(complete=True)
    count.review(10 * SECOND, 6)
    assert count.next_deadline() is None
    count.review(10 * SECOND, 7)
    assert count.next_deadline() is not None


def test_modules_ask_one_by_one() -> None:
    due = set()
    for number in range(256):
        each = session.RefusedTokens(MOST, number)
        each.add()
        each.review(0, MOST)
        due.add(each.next_deadline())
    assert len(due) == 256


def test_a_module_without_room_is_there_when_another_one_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modules, "TABLE_MAX", 2)
    network = Network()
    network.add(*KEYS[:4], liveliness.encode(TopicToken(3, ROLE_PUBLISHES, "leds", 3, "node")))
    assert list(network.module.modules) == ["M1", "M2"]
    assert network.module.counts == {"modules forgotten": 2}
    network.events.clear()
    network.remove(KEYS[0])
    network.wait(0.0)
    assert list(network.module.modules) == ["M2", "M3"]
    assert [each.info.name for each in network.events if isinstance(each, ModuleChanged)] == ["M3"]
    assert [each.module for each in network.module.endpoints.values()] == ["M3"]
    network.remove(KEYS[3])
    network.remove(KEYS[1])
    network.wait(0.0)
    assert list(network.module.modules) == ["M3"]
    assert not network.looks


def test_modules_without_room_do_not_appear_while_the_network_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modules, "TABLE_MAX", 2)
    network = Network()
    network.add(*KEYS[:6])
    assert not [each for each in network.module.link_down(0) if isinstance(each, ModuleChanged)]
    assert not network.module.modules
    assert network.module.next_deadline() is None
