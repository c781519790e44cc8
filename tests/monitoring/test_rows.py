"""The rows of topics, and that nothing is made of what has not changed."""

from typing import Any

import pytest

from r2p.messages import layout
from r2p.modules.graph import Endpoint, TopicView
from r2p.modules.statistics import ModuleStatistics, PublisherStatistics, SubscriberStatistics
from r2p.monitoring.counters import ModuleCounters
from r2p.monitoring.polling import until_next
from r2p.monitoring.rows import FigureSources, TopicRow, TypeNames
from r2p.msg import Led
from r2p.runtime.sample import PublisherClass
from tests.benchmarks.test_growth import calls


class Types:
    """Knows one type."""

    def by_fingerprint(self, fingerprint: bytes) -> type[Led] | None:
        """Return it."""
        return Led if fingerprint == layout(Led).fingerprint else None


class Buses:
    """No bus."""

    def __init__(self) -> None:
        self.frames: dict[str, float] = {}


class Rig:
    """A topic that ARM publishes, and HAND has subscribed to."""

    def __init__(self) -> None:
        self.time = 0
        types: Any = Types()
        self.counters = {"ARM": ModuleCounters(), "HAND": ModuleCounters()}
        self.sources = FigureSources(Buses(), types, self.counters)  # type: ignore[arg-type]
        self.answer(0, 0)
        led = layout(Led)
        ends = Endpoint("ARM", "a", PublisherClass.PERIODIC, "tcp:"), Endpoint("HAND", "h", None, "tcp:")
        self.view = TopicView("led", led.size, led.fingerprint, None, [ends[0]], [ends[1]], ["tcp:"], ["tcp:"], 1.0)
        self.row = TopicRow(self.view, self.sources, TypeNames(types), None, is_of_service=False)

    def answer(self, sent: int, lost: int) -> None:
        """Enter the answers of both modules, a second later."""
        self.time += 1
        arm = ModuleStatistics(uptime=float(self.time), publishers=(PublisherStatistics("led", "a", 3, sent),))
        hand = ModuleStatistics(uptime=float(self.time), subscribers=(SubscriberStatistics("led", "h", 0, lost),))
        self.counters["ARM"].update("ARM", arm, 100)
        self.counters["HAND"].update("HAND", hand, 100)
        self.sources.sum_up({"led": None})  # type: ignore[dict-item]


def test_a_row_has_what_has_changed_and_shares_what_has_not() -> None:
    rig = Rig()
    first = rig.row.update()
    assert (first.type, first.rate, first.lost_on_way) == ("r2p_msgs/Led", None, 0)
    rig.answer(5, 0)
    second = rig.row.update()
    assert (second.rate, second.rate_source, second.bandwidth) == (5.0, "counters", 25.0)
    assert [each.sent for each in first.publishers] == [0]  # what was given away stays
    assert [each.sent for each in second.publishers] == [5]
    assert second.subscribers is first.subscribers
    rig.answer(10, 2)
    third = rig.row.update()
    assert (third.lost_on_way, third.subscribers[0].lost) == (2, {"queue full": 2})
    assert (second.lost_on_way, second.subscribers[0].lost) == (0, {})
    rig.counters["ARM"].silence()
    assert (rig.row.update().rate, rig.row.update().publishers[0].rate) == (None, None)


def test_a_row_of_which_nothing_has_changed_is_the_same_and_costs_one_call() -> None:
    rig = Rig()
    for _ in range(2):
        rig.answer(0, 0)
        rig.row.update()
    before = rig.row.row
    rig.answer(0, 0)
    rig.view.age = 2.0  # which is shown in steps of 10 s
    assert calls(rig.row.update) == 1
    assert rig.row.row is before
    rig.view.age = 12.0
    assert rig.row.update().age == 10.0


def test_a_row_that_is_made_anew_stays_the_object_that_it_was() -> None:
    rig = Rig()
    before = rig.row.update()
    again = TopicRow(rig.view, rig.sources, TypeNames(rig.sources.types), before, is_of_service=False)
    assert again.update() is before


@pytest.mark.parametrize(
    ("now", "period", "rest"), [(0.0, 1.0, 1.0), (7.25, 1.0, 0.75), (7.75, 1.0, 1.25), (3.0, 2.0, 1.0)]
)
def test_questions_meet_at_multiples_of_the_period(now: float, period: float, rest: float) -> None:
    assert until_next(now, period) == rest
