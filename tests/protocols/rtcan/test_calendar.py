"""Which slots belong to whom: admission, phases, removal, masks."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs.management import RefuseReason
from r2p.protocols.rtcan.calendar import PERIOD_MAX, Calendar, PeriodRule, Refusal, Reservation, occupied

HARMONIC = PeriodRule.HARMONIC


def collide(a: Reservation, b: Reservation) -> bool:
    """Whether two reservations ever own the same slot, whatever their periods are."""
    step = math.gcd(a.period, b.period)
    distance = (b.phase - a.phase) % step
    return distance < a.fragments or step - distance < b.fragments


def admitted(calendar: Calendar, message: int, period: int, fragments: int = 1) -> Reservation:
    outcome = calendar.admit(message, period, fragments)
    assert isinstance(outcome, Reservation)
    return outcome


def refused(calendar: Calendar, message: int, period: int, fragments: int = 1) -> Refusal:
    outcome = calendar.admit(message, period, fragments)
    assert isinstance(outcome, Refusal)
    return outcome


def test_the_schedule_of_the_thesis() -> None:
    """Three nodes, each with messages every 6, 30 and 60 slots: 39 of 59 slots (thesis 4.4.1, figure 4.12)."""
    calendar = Calendar(60, HARMONIC)
    phases = [admitted(calendar, period << 8 | node, period).phase for period in (6, 30, 60) for node in (1, 2, 3)]
    assert phases == [1, 2, 3, 4, 5, 6, 10, 11, 12]
    assert (calendar.mask(0) >> 1).bit_count() == 39
    assert calendar.mask(7) == calendar.mask(0) == 0x038E38FF_8E38FFFF  # as written down in the original's hrt.c
    ours = Calendar(60)
    for period in (60, 60, 60, 30, 30, 30, 6, 6, 6):  # the least phases would take all six residues of 6
        admitted(ours, len(ours), period)
    assert (ours.mask(0) >> 1).bit_count() == 39


def test_the_least_phase_from_1_on() -> None:
    calendar = Calendar(10, HARMONIC)
    assert [admitted(calendar, message, 10).phase for message in range(9)] == [*range(1, 10)]
    refusal = refused(calendar, 9, 10)
    assert refusal.reason == RefuseReason.FULL
    assert refusal.text == "no slot is free every 10 slots"
    assert calendar.remove(3)
    assert not calendar.remove(3)
    assert admitted(calendar, 9, 10).phase == 4


def test_the_phase_that_leaves_most() -> None:
    calendar = Calendar(60)
    periods = [30, *[60] * 7]  # with the sync, they are ten slots of a cycle
    assert [admitted(calendar, message, period).phase % 6 for message, period in enumerate(periods)] == [0] * 8
    assert sorted(admitted(calendar, message, 6).phase for message in range(11, 16)) == [1, 2, 3, 4, 5]


def test_topics_of_a_control_loop_are_next_to_each_other() -> None:
    """While all periods are harmonic, and rounded: what asks next comes next on the bus."""
    calendar = Calendar(60)
    phases = []
    for message, period in enumerate((60, 30, 65, 60)):
        outcome = calendar.admit(message, period, round_down=True)
        assert isinstance(outcome, Reservation)
        phases.append(outcome.phase)
    assert phases == [1, 2, 3, 4]
    admitted(calendar, 9, 90)
    spread = calendar.admit(10, 6, round_down=True)
    assert isinstance(spread, Reservation)


def test_fragments_take_slots_in_a_row() -> None:
    calendar = Calendar(12, HARMONIC)
    assert admitted(calendar, 1, 12, 3).phase == 1
    assert admitted(calendar, 2, 6, 2).phase == 4  # 4, 5 and 10, 11: not 1..3, nor 6 = 0
    assert admitted(calendar, 3, 12, 3).phase == 6
    assert refused(calendar, 4, 12, 2).reason == RefuseReason.FULL
    assert admitted(calendar, 4, 12).phase == 9


def test_periods_with_common_factors() -> None:
    """Thesis 4.3.4: periods must not be relatively prime; nothing says that one divides the other."""
    calendar = Calendar(60)
    for message, period in enumerate((8, 18, 48, 90), 1):
        reservation = admitted(calendar, message, period)
        assert reservation.period == period
        assert reservation.phase % math.gcd(period, 60)
    assert refused(calendar, 9, 35).text == (
        "a period of 35 slots meets the 8 of message 0x0001 at each phase: their greatest common factor is 1"
    )
    assert refused(Calendar(60), 9, 7).text == (
        "a period of 7 slots meets the 60 of a cycle at each phase: their greatest common factor is 1"
    )
    assert refused(Calendar(60), 9, 9, 3).reason == RefuseReason.FACTOR  # three and the sync in three residues


def test_the_mask_of_each_cycle_where_periods_do_not_divide_it() -> None:
    """A period of 90 slots comes two times in three cycles, and the counter goes on beyond what the sync has of it."""
    calendar = Calendar(60)
    phase = admitted(calendar, 1, 90).phase
    for cycle in (0, 1, 2, 255, 256, 257, 1 << 40):
        mask = sum(1 << slot for slot in range(60) if (cycle * 60 + slot - phase) % 90 == 0)
        assert calendar.mask(cycle) == mask | 1
    assert [(calendar.mask(cycle) >> 1).bit_count() for cycle in range(6)] == [1, 1, 0] * 2 or phase >= 30


@pytest.mark.parametrize(
    ("period", "fragments", "reason", "text"),
    [
        (7, 1, RefuseReason.PERIOD, "a period of 7 slots neither divides the 60 of a cycle nor is a multiple"),
        (90, 1, RefuseReason.PERIOD, "a period of 90 slots neither divides the 60"),
        (20, 1, RefuseReason.OTHER, "a period of 20 slots neither divides the 12 of message 0x0102 nor is a multiple"),
        (0, 1, RefuseReason.LENGTH, "this message needs one of 2 to 65536"),
        (1, 1, RefuseReason.LENGTH, "a period of 1 slots"),
        (6, 6, RefuseReason.LENGTH, "a period of 6 slots"),
        (6, 0, RefuseReason.LENGTH, ""),
        (PERIOD_MAX + 60, 1, RefuseReason.LENGTH, ""),
        (12, 11, RefuseReason.FULL, "no 11 slots in a row are free every 12 slots"),
    ],
)
def test_refusals_say_why(period: int, fragments: int, reason: RefuseReason, text: str) -> None:
    calendar = Calendar(60, HARMONIC)
    admitted(calendar, 0x0102, 12)
    refusal = refused(calendar, 0x0103, period, fragments)
    assert refusal.reason == reason
    assert text in refusal.text
    assert [each.message for each in calendar] == [0x0102]


def test_a_period_is_rounded_down_to_what_is_possible() -> None:
    calendar = Calendar(60)
    periods = []
    for message, period in enumerate((31, 61, 200, 7)):
        outcome = calendar.admit(message, period, round_down=True)
        assert isinstance(outcome, Reservation)
        periods.append(outcome.period)
    assert periods == [30, 60, 180, 6]
    outcome = calendar.admit(9, 120, round_down=True)
    assert isinstance(outcome, Reservation)
    assert outcome.period == 120
    harmonic = Calendar(60, HARMONIC)
    admitted(harmonic, 1, 180)
    outcome = harmonic.admit(9, 120, round_down=True)  # 120 does not go with 180
    assert isinstance(outcome, Reservation)
    assert outcome.period == 60


def test_rounding_down_goes_on_where_nothing_is_free() -> None:
    calendar = Calendar(4)
    for message in range(3):  # each residue that the sync leaves, each second cycle
        assert calendar.readmit(Reservation(message, 8, 1 + message)) == calendar.get(message)
    assert refused(calendar, 9, 12).reason == RefuseReason.FULL
    outcome = calendar.admit(9, 12, round_down=True)
    assert isinstance(outcome, Reservation)
    assert (outcome.period, outcome.phase) == (8, 5)
    for message in range(3):
        calendar.admit(20 + message, 8)
    outcome = calendar.admit(99, 100, round_down=True)
    assert isinstance(outcome, Refusal)
    assert (outcome.reason, outcome.period) == (RefuseReason.FULL, 100)


def test_asking_again_changes_nothing_and_asking_for_something_else_gives_the_old_slots_back() -> None:
    calendar = Calendar(10, HARMONIC)
    first = admitted(calendar, 1, 10)
    admitted(calendar, 2, 10)
    assert calendar.admit(1, 10) == first
    assert calendar.admit(1, 13, round_down=True) == first
    assert admitted(calendar, 1, 5, 2) == Reservation(1, 5, 3, 2)
    assert calendar.get(1) == Reservation(1, 5, 3, 2)
    assert refused(calendar, 1, 3).reason == RefuseReason.PERIOD
    assert calendar.get(1) is None


def test_what_another_master_granted() -> None:
    calendar = Calendar(10)
    granted = Reservation(1, 10, 4, 2)
    assert calendar.readmit(granted) == granted
    assert calendar.readmit(granted) == granted
    assert calendar.mask(3) == 0b110001
    for other in (
        Reservation(2, 10, 0xFFFFFFFF),
        Reservation(2, 10, 5),
        Reservation(2, 5, 0),
        Reservation(2, 20, 14),
        Reservation(2, 10, 9, 2),
    ):
        taken = calendar.readmit(other)
        assert isinstance(taken, Refusal)
        assert taken.reason == RefuseReason.TAKEN
        assert taken.text == "its slots were given to another message"
    assert len(calendar) == 1
    assert calendar.readmit(Reservation(1, 20, 14, 2)) == Reservation(1, 20, 14, 2)
    assert [calendar.mask(cycle) for cycle in range(3)] == [1, 0b110001, 1]


def test_periods_of_several_cycles() -> None:
    calendar = Calendar(4, HARMONIC)
    assert [admitted(calendar, message, 12).phase for message in range(9)] == [1, 2, 3, 5, 6, 7, 9, 10, 11]
    assert refused(calendar, 9, 4).reason == RefuseReason.FULL
    for message in (0, 3, 6):
        calendar.remove(message)
    assert admitted(calendar, 9, 4).phase == 1


@pytest.mark.parametrize("slots", [1, 65])
def test_cycles_have_2_to_64_slots(slots: int) -> None:
    with pytest.raises(ValueError, match="2 to 64"):
        Calendar(slots)
    assert admitted(Calendar(64), 1, 64, 63).phase == 1


requests = st.lists(
    st.one_of(
        st.tuples(st.integers(0, 30), st.integers(0, 250), st.integers(1, 9), st.booleans()),  # request
        st.tuples(st.integers(0, 30), st.integers(1, 4), st.integers(1, 3), st.none()),  # a multiple of the cycle
        st.integers(0, 30),  # removal
        st.builds(Reservation, st.integers(0, 30), st.integers(0, 130), st.integers(0, 130), st.integers(0, 9)),
    ),
    max_size=60,
)


def apply(calendar: Calendar, change: object) -> None:
    """Change the calendar. Its answer is about the very period that was asked for, unless a shorter one will do."""
    match change:
        case int(message):
            calendar.remove(message)
        case (int(message), int(factor), int(fragments), None):
            period = factor * calendar.slots
            assert calendar.admit(message, period, fragments).period == period
        case (int(message), int(period), int(fragments), bool(round_down)):
            answer = calendar.admit(message, period, fragments, round_down=round_down)
            assert answer.period == period or (round_down and answer.period < period)
        case Reservation():
            calendar.readmit(change)
        case _:
            raise AssertionError(change)


@given(st.integers(2, 64), requests, st.sampled_from(PeriodRule))
def test_no_slot_ever_has_two_owners(slots: int, changes: list[object], rule: PeriodRule) -> None:
    calendar = Calendar(slots, rule)
    for change in changes:
        apply(calendar, change)
        all_of_them = [*calendar, Reservation(-1, slots, 0)]
        assert not any(collide(a, b) for i, a in enumerate(all_of_them) for b in all_of_them[:i])
    all_of_them = [*calendar, Reservation(-1, slots, 0)]
    round_trip = min(math.lcm(*(each.period for each in all_of_them)) // slots, 50)
    for cycle in range(max(1, round_trip)):
        owners = [0] * slots
        for each in all_of_them:  # counted one by one, with nothing but the definition
            for number in range(cycle * slots, (cycle + 1) * slots):
                owners[number % slots] += (number - each.phase) % each.period < each.fragments
        assert max(owners) <= 1
        assert calendar.mask(cycle) == sum(count << slot for slot, count in enumerate(owners))


@given(
    st.integers(1, 40), st.integers(0, 40), st.integers(1, 5), st.integers(1, 40), st.integers(0, 40), st.integers(1, 5)
)
def test_collide_is_what_it_says(p: int, f: int, k: int, q: int, g: int, n: int) -> None:
    def owns(number: int, period: int, phase: int, fragments: int) -> bool:
        return (number - phase) % period < fragments

    both = any(owns(number, p, f, k) and owns(number, q, g, n) for number in range(math.lcm(p, q)))
    assert collide(Reservation(1, p, f, k), Reservation(2, q, g, n)) == both


@given(st.integers(2, 64), st.data())
def test_nothing_is_refused_that_would_fit_at_some_phase(slots: int, data: st.DataObject) -> None:
    calendar = Calendar(slots)
    factors = [period for period in range(2, 2 * slots + 1) if math.gcd(slots, period) > 1]
    for message in range(data.draw(st.integers(0, 12))):
        period = data.draw(st.sampled_from(factors))
        outcome = calendar.admit(message, period, data.draw(st.integers(1, min(3, period - 1))))
        if isinstance(outcome, Refusal):
            others = [*calendar, Reservation(-1, slots, 0)]
            for phase in range(period):
                candidate = Reservation(99, period, phase, outcome.fragments)
                assert any(collide(candidate, other) for other in others)


def test_the_slots_of_one_cycle() -> None:
    assert occupied(Reservation(1, 6, 4, 2), 60, 12) == 0b110000110000
    assert occupied(Reservation(1, 24, 16, 2), 12, 12) == 0b110000
    assert occupied(Reservation(1, 24, 16, 2), 24, 12) == 0
    assert Reservation(1, 24, 16).first_from(17) == 40
    assert Reservation(1, 24, 16).first_from(16) == 16
