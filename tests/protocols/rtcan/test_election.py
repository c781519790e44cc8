"""Who takes over, and when."""

from r2p.protocols.rtcan.cycle import timing
from r2p.protocols.rtcan.events import EngineContext, EngineSettings
from r2p.protocols.rtcan.master import FRESH, Election, Role

MS = 1_000_000
WINDOW = 3 * timing().cycle


class Candidate:
    def __init__(self, id8: int, priority: int) -> None:
        self.id8 = id8
        context = EngineContext(EngineSettings(number=1, priority=priority))
        self.timers = context.timers
        self.election = Election(context)

    def takes_over_at(self) -> int | None:
        """When it becomes the master, if nothing happens."""
        while (at := self.timers.next()) is not None:
            list(self.timers.pop(at))
            if self.election.decide(at, self.id8):
                return at
        return None


def test_the_highest_priority_then_the_highest_id8_takes_over_first() -> None:
    candidates = [Candidate(10, 5), Candidate(12, 5), Candidate(200, 4), Candidate(11, 7)]
    for each in candidates:
        each.election.begin(0, forget=True)
        for other in candidates:
            if other is not each:
                each.election.on_claim(1 * MS, other.id8, 7 if other.id8 == 11 else 4 if other.id8 == 200 else 5)
    at = {each.id8: each.takes_over_at() for each in candidates}
    assert at == {11: WINDOW, 12: 2 * WINDOW, 10: 3 * WINDOW, 200: 4 * WINDOW}


def test_priority_0_never_takes_over() -> None:
    never = Candidate(10, 0)
    never.election.begin(0, forget=True)
    assert never.takes_over_at() is None
    assert never.election.role is Role.NONE
    lowest = Candidate(9, 1)
    lowest.election.begin(0, forget=True)
    lowest.election.on_claim(0, 10, 0)
    assert lowest.takes_over_at() == WINDOW


def test_those_of_long_ago_do_not_count() -> None:
    candidate = Candidate(10, 5)
    candidate.election.on_claim(0, 11, 9)
    candidate.election.begin(FRESH, forget=False)
    assert candidate.takes_over_at() == FRESH + WINDOW
    candidate.election.on_claim(FRESH, 11, 9)
    candidate.election.begin(FRESH + 1, forget=True)
    assert candidate.takes_over_at() == FRESH + 1 + WINDOW


def test_a_master_ends_it() -> None:
    candidate = Candidate(10, 5)
    candidate.election.begin(0, forget=True)
    candidate.election.end(Role.SLAVE)
    assert candidate.takes_over_at() is None
    assert candidate.election.role is Role.SLAVE


def test_of_two_masters_the_higher_stays() -> None:
    election = Candidate(10, 5).election
    assert election.beats(10, 4, 200)
    assert election.beats(10, 5, 9)
    assert not election.beats(10, 5, 11)
    assert not election.beats(10, 6, 1)
