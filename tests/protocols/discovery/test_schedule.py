"""The parts of the schedule by themselves."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management as m
from r2p.protocols.discovery.schedule import Item, ItemKind, Schedule, TokenBucket
from r2p.protocols.discovery.session import Discovery
from tests.protocols.discovery.wire import MS, S, run, sent


@given(
    st.floats(0.5, 10_000),
    st.integers(2, 50),
    st.lists(st.tuples(st.integers(0, S), st.integers(1, 2)), max_size=60),
)
def test_a_bucket_never_lets_more_pass(rate: float, burst: int, requests: list[tuple[int, int]]) -> None:
    bucket = TokenBucket(rate, burst)
    now, passed = 0, list[int]()
    for wait, count in requests:
        now += wait
        if bucket.ready_at(count) <= now:
            bucket.spend(now, count)
            passed += [now] * count
    for first, start in enumerate(passed):
        for last in range(first, len(passed)):
            assert last - first + 1 <= burst + (passed[last] - start) / bucket.gap


def test_a_bucket_of_another_rate_owes_what_it_did() -> None:
    bucket = TokenBucket(10, 4)
    bucket.spend(0, 4)
    slower = bucket.changed(5, 4)
    assert bucket.ready_at(1) == 100 * MS
    assert slower.ready_at(4) == 400 * MS
    assert slower.ready_at(1) <= 0 < slower.changed(20, 2).ready_at(1)


class TestSchedule:
    def test_a_ring_of_what_is_left(self) -> None:
        schedule = Schedule(1000, 100, 0)
        items = [Item(ItemKind.PUBLISHER, (f"t{n}",)) for n in range(4)]
        for item in items:
            schedule.add(item)
        schedule.drop(items[1])
        schedule.start(0)
        said = []
        for now in range(0, 10 * S, 10 * MS):
            while (each := schedule.pop(now)) is not None:
                said.append(each.key)
                schedule.sent(now, 1)
            if now == 5 * S:
                schedule.drop(items[0])
        names = [key[0] for key in said if key]
        assert names[:6] == ["t0", "t2", "t3"] * 2
        assert set(names[-6:]) == {"t2", "t3"}

    def test_nothing_goes_while_it_is_held(self) -> None:
        schedule = Schedule(1000, 100, 0)
        schedule.start(0)
        schedule.hold(70 * MS)
        assert schedule.due() == 70 * MS
        assert schedule.pop(70 * MS - 1) is None
        assert schedule.pop(70 * MS) is not None

    def test_a_thousand_new_items_keep_no_presence_back_for_longer_than_a_lease(self) -> None:
        schedule = Schedule(100, 10, 0)
        schedule.start(0)
        for number in range(1000):
            schedule.add(Item(ItemKind.PUBLISHER, (f"t{number}",)))
        presences, others = [0], 0
        for now in range(0, 12 * S, 10 * MS):
            while (each := schedule.pop(now)) is not None:
                schedule.sent(now, 1)
                if each.kind is ItemKind.PRESENCE:
                    presences.append(now)
                others += each.kind is ItemKind.PUBLISHER
        assert max(later - earlier for earlier, later in pairwise(presences)) <= 3.5 * S
        assert others >= 1000

    def with_endpoints(self, count: int) -> tuple[Schedule, list[Item]]:
        """They have been said for 10 s: seldom by now."""
        schedule = Schedule(1000, 100, 0)
        schedule.start(0)
        items = [Item(ItemKind.ENDPOINT, ("n", f"t{n}", 1)) for n in range(count)]
        for each in items:
            schedule.add(each)
        self.said(schedule, 0, 10 * S)
        return schedule, items

    def said(self, schedule: Schedule, start: int, end: int) -> list[tuple[int, Item]]:
        """What comes up, and when."""
        times: list[tuple[int, Item]] = []
        for now in range(start, end, MS):
            while (each := schedule.pop(now)) is not None:
                times.append((now, each))
                schedule.sent(now, 1)
        return times

    def test_what_only_describes_is_repeated_once_soon_and_then_seldom(self) -> None:
        schedule = Schedule(1000, 100, 0)
        schedule.start(0)
        endpoint, publisher = Item(ItemKind.ENDPOINT, ("n", "t", 1)), Item(ItemKind.PUBLISHER, ("t",))
        schedule.add(publisher)
        schedule.add(endpoint)
        said = self.said(schedule, 0, 40 * S)
        first, second, *rest = [now for now, item in said if item == endpoint]
        assert first == 0
        assert second <= 1.5 * S
        gaps = [later - earlier for earlier, later in pairwise([second, *rest])]
        assert min(gaps) >= 3 * S
        assert max(gaps) <= 6.1 * S
        published = [now for now, item in said if item == publisher]
        assert max(later - earlier for earlier, later in pairwise(published)) <= 1.5 * S

    def test_of_much_that_only_describes_each_has_its_turn_in_four_rounds(self) -> None:
        schedule = Schedule(1000, 100, 0)
        for n in range(40):
            schedule.add(Item(ItemKind.ENDPOINT, ("n", f"t{n}", 1)))
        for n in range(7):
            schedule.add(Item(ItemKind.PUBLISHER, (f"t{n}",)))
        schedule.start(0)
        said = self.said(schedule, 0, 40 * S)
        late = [(now, item) for now, item in said if now > 10 * S]
        for item in {item for _, item in late}:
            times = [now for now, each in late if each == item]
            rounds = 4 if item.kind is ItemKind.ENDPOINT else 1
            assert max(b - a for a, b in pairwise(times)) == pytest.approx(rounds * 1.5 * S, rel=0.1)

    def test_for_a_newcomer_what_only_describes_is_said_at_once_and_once_more_soon(self) -> None:
        schedule, endpoints = self.with_endpoints(20)
        schedule.repeat(10 * S)
        said = self.said(schedule, 10 * S, 20 * S)
        for each in endpoints:
            first, second, third, *_ = [now for now, item in said if item == each]
            assert first == 10 * S
            assert second <= first + 2 * S
            assert 1.5 * S <= third - second <= 7.5 * S

    def test_what_is_said_seldom_can_be_dropped_and_the_rest_goes_on(self) -> None:
        schedule, items = self.with_endpoints(3)
        schedule.drop(items[1])
        later = {item for _, item in self.said(schedule, 10 * S, 20 * S)}
        assert later == {items[0], items[2], Item(ItemKind.PRESENCE, once=True)}
        schedule.drop(items[0])
        schedule.drop(items[2])
        assert {item for _, item in self.said(schedule, 20 * S, 30 * S)} == {Item(ItemKind.PRESENCE, once=True)}

    def test_what_is_said_once_is_forgotten_when_the_link_goes_down(self) -> None:
        schedule = Schedule(1, 2, 0)
        schedule.start(0)
        schedule.add(Item(ItemKind.PUBLISHER, ("t",)))
        schedule.add(Item(ItemKind.UNSUBSCRIBE, ("t",), once=True))
        schedule.stop()
        schedule.start(0)
        kinds = []
        for now in range(0, 5 * S, S):
            while (item := schedule.pop(now)) is not None:
                kinds.append(item.kind)
                schedule.sent(now, 1)
        assert kinds[:2] == [ItemKind.QUERY, ItemKind.PUBLISHER]
        assert ItemKind.UNSUBSCRIBE not in kinds

    def test_what_comes_and_goes_while_the_link_is_down_leaves_nothing_behind(self) -> None:
        discovery = Discovery("PC1", 1)
        for n in range(1000):
            discovery.advertise(n, f"t{n}", 5)
            discovery.withdraw(n, f"t{n}")
        discovery.advertise(1000, "t", 5)
        assert len(discovery._schedule._fresh) == 1
        assert len(discovery._schedule._ring) == 0

    def test_what_waits_to_be_said_once_is_said_once(self) -> None:
        discovery = Discovery("PC1", 1, rate=1, burst=2)
        discovery.link_up(0)
        for n in range(1000):
            discovery.report_conflict(n, "IMU1", 1, 2)
            discovery.set_flags(n, n % 2)
        kinds = [type(message) for _, event in run(discovery, 1000, 100 * S) for message in sent([event])]
        assert kinds.count(m.Conflict) == 1
        assert len(discovery._schedule._fresh) == 0

    def test_a_new_type_of_what_was_announced_goes_first(self) -> None:
        schedule = Schedule(1000, 100, 0)
        items = [Item(ItemKind.PUBLISHER, (f"t{n}",)) for n in range(4)]
        for item in items:
            schedule.add(item)
        while (schedule.pop(0)) is not None:
            schedule.sent(0, 1)
        schedule.add(items[2])
        assert schedule.pop(S) == items[2]
        assert schedule._count == len(items)

    def test_presence_leaves_room_on_a_slow_line(self) -> None:
        schedule = Schedule(1, 2, 0)
        schedule.add(Item(ItemKind.PUBLISHER, ("t",)))
        schedule.start(0)
        kinds = []
        for now in range(0, 60 * S, S):
            schedule.repeat(now)
            while (item := schedule.pop(now)) is not None:
                kinds.append(item.kind)
                schedule.sent(now, 2 if item.kind in {ItemKind.PRESENCE, ItemKind.QUERY} else 1)
        assert kinds.count(ItemKind.PUBLISHER) > kinds.count(ItemKind.PRESENCE) > 5
