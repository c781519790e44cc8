"""Answers of which only numbers are read mean the same as those that are decoded, whatever the bytes are."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.errors import DecodeError
from r2p.messages import layout
from r2p.modules.statistics import (
    ForwardedTopic,
    LinkStatistics,
    ModuleStatistics,
    NodeStatistics,
    PublisherStatistics,
    ReasonCount,
    ServiceStatistics,
    SubscriberStatistics,
    TopicOnLink,
)
from r2p.monitoring import counters as module_of_counters
from r2p.monitoring.answers import KnownAnswer
from r2p.monitoring.counters import ModuleCounters
from tests.benchmarks.test_growth import calls

COUNTS = st.one_of(st.integers(0, 3), st.integers(0, (1 << 64) - 1))
ROOM = 1000


def answer(second: int, topics: int = 3, *, prefix: str = "joint", lost: int = 0) -> ModuleStatistics:
    """Return what a module with some topics says; each second, one message more of each."""
    names = [f"{prefix}{number}" for number in range(topics)]
    return ModuleStatistics(
        uptime=float(second),
        cpu=0.25 * second,
        nodes=(NodeStatistics("arm", running=True, restarts=0),),
        publishers=tuple(PublisherStatistics(name, "arm", 3, 10 * second, lost, 0) for name in names),
        subscribers=tuple(SubscriberStatistics(name, "arm", 1, lost, 0, lost, 0, 0) for name in names),
        services=(ServiceStatistics("grip", "arm", 0, 0, second),),
        links=(LinkStatistics("can:", True, 1, 0, second, 0, 0, 0, (ReasonCount("stale", lost),)),),
        topics=tuple(TopicOnLink(name, "can:", lost, math.nan if lost else 0.5) for name in names),
        forwarded=(ForwardedTopic("joint0", "can:", "tcp:", second, lost),),
    )


def state(counters: ModuleCounters) -> dict[str, Any]:
    """Return all figures of a module."""
    names = ("answers", "has_rates", "left_out", "entries", "uptime", "cpu", "nodes", "services", "links", "lost")
    publishers = {
        key: (each.sent, each.missed, each.late, each.rate, each.publisher_class)
        for key, each in counters.publishers.items()
    }
    subscribers = {key: (each.waiting, each.lost, each.total) for key, each in counters.subscribers.items()}
    found = {name: getattr(counters, name) for name in names}
    return found | {"publishers": publishers, "subscribers": subscribers, "laxity": counters.laxity}


class Both:
    """Two counters: one reads answers, the other gets what is decoded of them."""

    def __init__(self) -> None:
        self.read, self.updated = ModuleCounters(), ModuleCounters()
        self.decoded = 0

    def enter(self, part: bytes, room: int = ROOM) -> None:
        """Enter an answer in both, and compare them."""
        try:
            statistics = layout(ModuleStatistics).decode(part)
        except DecodeError:
            with pytest.raises(DecodeError):
                self.read.read("ARM", part, room)
        else:
            self.updated.update("ARM", statistics, room)
            self.read.read("ARM", part, room)
        assert state(self.read) == state(self.updated)

    def silence(self) -> None:
        """Have both note that the module is silent."""
        self.read.silence()
        self.updated.silence()


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sizes of the answers that counters have decoded."""
    sizes: list[int] = []

    class Counted(KnownAnswer):
        def __init__(self, statistics: ModuleStatistics, part: bytes) -> None:
            super().__init__(statistics, part)
            sizes.append(len(part))

    monkeypatch.setattr(module_of_counters, "KnownAnswer", Counted)
    return sizes


def test_answers_with_the_same_names_are_decoded_once(decoded: list[int]) -> None:
    both = Both()
    for second in range(1, 40):
        both.enter(answer(second, lost=second // 10).encode())
    assert len(decoded) == 1
    assert [each.rate for each in both.read.publishers.values()] == [10.0] * 3
    assert both.read.lost == {"joint0": 3 + 3 + 6, "joint1": 3 + 6, "joint2": 3 + 6}
    assert both.read.links["can:"].lost == {"stale": 3}


def test_what_else_changes_is_decoded(decoded: list[int]) -> None:
    """Names of the same length, a node that ends, other links, a class: nothing of it is missed."""
    both = Both()
    both.enter(answer(1).encode())
    ended = (NodeStatistics("arm", running=False, restarts=0),)
    other = PublisherStatistics("joint9", "arm", 3, 7)
    for changed in (
        answer(2, prefix="elbow"),
        answer(3, topics=4),
        msgspec.structs.replace(answer(4), nodes=ended),
        msgspec.structs.replace(answer(5), publishers=(*answer(5).publishers[1:], other)),
        msgspec.structs.replace(answer(6), publishers=tuple(PublisherStatistics("joint0", f"n{i}") for i in range(3))),
        msgspec.structs.replace(answer(7), links=(LinkStatistics("udp:", True, 1),)),
        msgspec.structs.replace(answer(8), services=(ServiceStatistics("drop", "arm"),)),
    ):
        before = len(decoded)
        both.enter(changed.encode())
        assert len(decoded) == before + 1


def test_a_restart_and_silence_begin_anew(decoded: list[int]) -> None:
    both = Both()
    for second in (10, 11, 12, 1, 2):  # a clock that goes back: the module has started again
        both.enter(answer(second).encode())
    assert len(decoded) == 2
    assert both.read.publishers["arm", "joint0"].rate == 10.0
    both.silence()
    assert both.read.publishers["arm", "joint0"].rate is None
    both.enter(answer(3).encode())
    assert both.read.publishers["arm", "joint0"].rate is None
    both.enter(answer(4).encode())
    assert both.read.publishers["arm", "joint0"].rate == 10.0
    both.enter(msgspec.structs.replace(answer(5), uptime=math.nan).encode())
    both.enter(answer(6).encode())


def test_entries_without_room_and_names_that_come_twice_are_decoded(decoded: list[int]) -> None:
    both = Both()
    entries = 3 + 3 + 3 + 4
    for second in range(1, 4):
        both.enter(answer(second).encode(), entries - 1)
    assert decoded == []
    assert both.read.left_out == 1
    twice = PublisherStatistics("joint0", "arm", 3, 5)
    for second in range(4, 7):
        statistics = answer(second)
        both.enter(msgspec.structs.replace(statistics, publishers=(*statistics.publishers, twice)).encode())
    assert decoded == []
    assert both.read.publishers["arm", "joint0"].sent == 65
    both.enter(answer(7).encode())
    both.enter(answer(8).encode(), entries - 1)  # there was room for the one before
    assert both.read.left_out == 1


@st.composite
def numbers(draw: st.DrawFn) -> ModuleStatistics:
    """Return an answer that differs from the others in numbers only."""
    counts = iter(draw(st.lists(COUNTS, min_size=22, max_size=22)))
    changed: dict[str, Any] = {"uptime": draw(st.floats(allow_infinity=True)), "cpu": draw(st.floats())}
    for field in ("publishers", "subscribers", "topics", "forwarded"):
        names = {"publishers": ("sent", "missed"), "subscribers": ("lost", "stale"), "forwarded": ("dropped",)}
        changed[field] = tuple(
            msgspec.structs.replace(each, **{name: next(counts) for name in names.get(field, ("lost",))})
            for each in getattr(answer(1), field)
        )
    return msgspec.structs.replace(answer(1), **changed)


@given(st.lists(numbers(), max_size=5))
def test_any_numbers(answers: list[ModuleStatistics]) -> None:
    both = Both()
    both.enter(answer(1).encode())
    for each in answers:
        both.enter(each.encode())


@given(st.data())
def test_any_damage(data: st.DataObject) -> None:
    both = Both()
    both.enter(answer(1, lost=1).encode())
    for second in range(2, 5):
        part = bytearray(answer(second, lost=1).encode())
        for _ in range(data.draw(st.integers(1, 3))):
            part[data.draw(st.integers(16, len(part) - 1))] = data.draw(st.integers(0, 255))
        both.enter(bytes(part[: data.draw(st.sampled_from([len(part), len(part), len(part) - 1, 10]))]))


def test_what_an_answer_costs_in_calls() -> None:
    """For each publisher its rate and its totals, for each subscriber its counts; decoding makes each entry, too."""
    counters = {topics: ModuleCounters() for topics in (10, 100)}
    costs = {}
    for topics, each in counters.items():
        for second in (1, 2, 3):
            part = answer(second, topics).encode()
            costs[topics, second] = calls(lambda each=each, part=part: each.read("ARM", part, ROOM))  # type: ignore[misc]
    assert (costs[100, 3] - costs[10, 3]) / 90 < 4.0
    assert costs[100, 3] < costs[100, 1] / 3
