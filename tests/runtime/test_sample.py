"""Messages that come again."""

from __future__ import annotations

from r2p.runtime.sample import DuplicateFilter, LastReceived, Sample, Source


def sample(sequence: int, stamp: int, module: str = "A") -> Sample:
    return Sample(b"", Source(module, "n", "memory:a"), stamp, sequence=sequence)


def test_what_was_seen_before() -> None:
    seen = DuplicateFilter()
    assert seen.accept(sample(1, 100))
    assert not seen.accept(sample(1, 100))
    assert seen.accept(sample(1, 100, "B"))
    assert seen.accept(sample(1, 200))  # a publisher that started again
    for number in range(2, 500):
        assert seen.accept(sample(number, 100 * number))
    assert not seen.accept(sample(499, 49900))


def test_many_messages_of_one_instant_are_all_new() -> None:
    seen = DuplicateFilter()
    assert all(seen.accept(sample(number, 100)) for number in range(1, 200))
    assert not seen.accept(sample(199, 100))


def test_a_publisher_whose_clock_went_back_passes_a_gateway() -> None:
    seen = DuplicateFilter()
    assert all(seen.accept(sample(number, 1_000_000 + number)) for number in range(1, 100))
    assert all(seen.accept(sample(number, 50 + number)) for number in range(1, 100))


def test_what_is_not_newer_than_the_last_message() -> None:
    last = LastReceived()
    assert last.accept(2, 200)
    assert not last.accept(2, 200)
    assert not last.accept(1, 100)
    assert last.accept(1, 300)  # counted anew
    assert last.accept(2, 250)  # the clock went back
    assert last.accept(0, 0)  # without a number
