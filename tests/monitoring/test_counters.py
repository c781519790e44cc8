"""Rates and sums of what modules count, whatever they say."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.modules.statistics import (
    ForwardedTopic,
    LinkStatistics,
    ModuleStatistics,
    NodeStatistics,
    PublisherStatistics,
    ReasonCount,
    SubscriberStatistics,
    TopicOnLink,
)
from r2p.monitoring.counters import ModuleCounters, local_names, network_name
from r2p.monitoring.rates import CounterRate

U64 = st.integers(0, (1 << 64) - 1)
NAMES = st.sampled_from(["", "a", "joint", "robot1/joint", "\x1b[2J", "x" * 200, "ä"])


@st.composite
def statistics(draw: st.DrawFn) -> ModuleStatistics:
    def name() -> str:
        return draw(NAMES)

    def count() -> int:
        return draw(U64)

    return ModuleStatistics(
        uptime=draw(st.floats()),
        cpu=draw(st.floats()),
        nodes=(NodeStatistics(name(), running=True, restarts=3),) * draw(st.integers(0, 2)),
        publishers=tuple(PublisherStatistics(name(), name(), 9, count(), count(), count()) for _ in range(3)),
        subscribers=tuple(SubscriberStatistics(name(), name(), 1, count(), count(), count()) for _ in range(3)),
        links=(
            LinkStatistics(name(), True, 1, 2, count(), count(), count(), count(), (ReasonCount(name(), count()),)),
        ),
        topics=(TopicOnLink(name(), name(), count(), draw(st.floats(width=32))),) * 2,
        forwarded=(ForwardedTopic(name(), name(), name(), count(), count()),) * 3,
    )


@given(st.lists(statistics(), max_size=5), st.integers(0, 20))
def test_any_answers_have_finite_figures_that_json_can_have(answers: list[ModuleStatistics], room: int) -> None:
    counters = ModuleCounters()
    for answer in answers:
        counters.update("M", answer, room)
        counters.silence() if room == 3 else None
        rates = [each.rate for each in counters.publishers.values()] + [each.sent for each in counters.links.values()]
        assert all(rate is None or math.isfinite(rate) for rate in (*rates, counters.cpu, counters.uptime))
        rows = [list(counters.publishers.values()), list(counters.links.values()), counters.lost, counters.laxity]
        assert msgspec.json.decode(msgspec.json.encode(rows))
        assert all(name.isprintable() for name in (*counters.nodes, *counters.links))
        assert counters.entries <= room
        assert counters.entries + counters.left_out == len(answer.nodes) + 3 + 3 + 1 + 2 + 3


def test_a_steady_rate_gets_more_exact_and_a_change_is_seen_at_once() -> None:
    rate = CounterRate(0.0, 0)
    count = 0.0
    for second in range(1, 31):
        count += 100.4016
        rate.add(second, int(count))
    assert rate.rate == pytest.approx(100.4016, abs=0.11)
    assert rate.add(31.0, int(count) + 20) == 20.0
    assert rate.add(32.0, int(count) + 20) == 0.0


def test_a_slow_counter_that_stops_has_the_rate_0_when_two_messages_are_overdue() -> None:
    rate = CounterRate(0.0, 0)
    for second in range(1, 30):
        rate.add(second, second // 2)
    assert rate.rate == pytest.approx(0.5, abs=0.1)
    rates = [rate.add(30.0 + second, 14) for second in range(8)]
    assert rates[-1] == 0.0


def test_a_counter_that_went_back_was_opened_anew() -> None:
    rate = CounterRate(5.0, 1000)
    assert rate.add(6.0, 1100) == 100.0
    assert rate.add(7.0, 60) == 60.0


def test_names_of_a_module_behind_a_prefix() -> None:
    assert list(local_names("robot1/ARM", "robot1/joint")) == ["joint", "robot1/joint"]
    assert "joint" in local_names("r1_ARM", "r1_joint")
    assert list(local_names("ARM", "joint")) == ["joint"]
    assert network_name("robot1/ARM", "joint", {}) == "robot1/joint"
    assert network_name("r1_ARM", "joint", {"r1_joint": 0}) == "r1_joint"
    assert network_name("r1_ARM", "joint", {"joint": 0, "r1_joint": 0}) == "joint"
