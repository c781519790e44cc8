"""How much of a deadline is left, with clocks that differ, drift, and are set."""

import random

import pytest

from r2p.protocols.time_left import TimeLeft, TimesLeft

SECOND = 1_000_000_000
MS = 1_000_000
SPAN = 20 * MS


def arrive(known: TimeLeft, published: int, delay: int, offset: int = 0) -> int:
    """A message that is published at `published`, by a clock that is ahead by `offset`."""
    stamp = published + offset
    return known.left(published + delay, stamp, stamp + SPAN)


@pytest.mark.parametrize("offset", [0, SECOND, -SECOND, -(10**18), 10**18])
def test_the_difference_of_the_clocks_makes_no_difference(offset: int) -> None:
    known = TimeLeft()
    assert [arrive(known, n * 100 * MS, 3 * MS, offset) for n in range(20)] == [SPAN] * 20


def test_what_was_held_up_has_less_time() -> None:
    """A link stalls for 100 ms, and all that was published meanwhile comes at once."""
    known = TimeLeft()
    assert arrive(known, 0, 3 * MS, SECOND) == SPAN
    held_up = [arrive(known, SECOND + n * 10 * MS, 103 * MS - n * 10 * MS, SECOND) for n in range(11)]
    assert held_up == pytest.approx([SPAN - 100 * MS + n * 10 * MS for n in range(11)], abs=SECOND // 1000)
    assert arrive(known, 2 * SECOND, 3 * MS, SECOND) == SPAN


def test_it_is_never_more_than_the_publisher_gave() -> None:
    known, numbers = TimeLeft(), random.Random(1)
    lefts = [arrive(known, n * 10 * MS, numbers.randrange(50) * MS, -SECOND) for n in range(1000)]
    assert max(lefts) == SPAN
    assert min(lefts) < 0


def test_clocks_that_drift() -> None:
    """Of a publisher that sends seldom, too."""
    known = TimeLeft()
    for n in range(1000):
        assert arrive(known, n * 60 * SECOND, 3 * MS, -n * 60 * SECOND // 5000) == SPAN


def test_a_clock_that_is_set_forward() -> None:
    known = TimeLeft()
    assert {arrive(known, n * 10 * MS, 3 * MS, SECOND * (n > 50)) for n in range(100)} == {SPAN}


def test_a_clock_that_is_set_back_makes_messages_late_for_five_seconds() -> None:
    """And no more, though it runs at half speed until it is right."""
    known = TimeLeft()
    arrive(known, 0, 3 * MS)
    left = [arrive(known, n * 100 * MS, 3 * MS, -n * 50 * MS) for n in range(1, 600)]
    assert [n for n, each in enumerate(left) if each <= 0] == list(range(51))


@pytest.mark.parametrize("span", [0, -SECOND])
def test_a_deadline_that_is_over_when_it_is_stamped(span: int) -> None:
    known = TimeLeft()
    assert [known.left(n, n, n + span) for n in range(3)] == [span] * 3


def test_publishers_are_told_apart_and_bounded() -> None:
    times = TimesLeft()
    assert times.of("a") is times.of("a") is not times.of("b")
    for n in range(3000):
        times.of(n)
    assert len(times._known) <= TimesLeft.PUBLISHERS_MAX
