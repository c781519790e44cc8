"""How many messages the last bytes of a connection were."""

import tracemalloc

import pytest

from r2p.transports.line import UnconfirmedBytes


def given(pieces: int, messages: int = 2, size: int = 10) -> UnconfirmedBytes:
    """So many pieces of `size` bytes, each of so many messages."""
    handed = UnconfirmedBytes()
    for number in range(pieces):
        handed.add(size, number * messages)
    return handed


@pytest.mark.parametrize(("last", "messages"), [(0, 0), (1, 2), (10, 2), (11, 4), (100, 20), (999, 20)])
def test_pieces_count_as_a_whole(last: int, messages: int) -> None:
    assert given(10).messages_in(last, 20) == messages


def test_nothing_was_given() -> None:
    assert UnconfirmedBytes().messages_in(5, 7) == 0


def test_what_is_long_ago_is_less_exact_but_never_less() -> None:
    count = 100_000
    handed = given(count)
    for pieces in (1, 50):
        assert handed.messages_in(10 * pieces, 2 * count) == 2 * pieces
    for pieces in (100, 5000, 50_000, count):
        assert 2 * pieces <= handed.messages_in(10 * pieces, 2 * count) <= 2 * pieces + 1000


def test_what_no_socket_holds_is_not_remembered() -> None:
    handed = given(10_000, size=4096)
    assert 2 * 2048 <= handed.messages_in(10_000 * 4096, 20_000) <= 2 * 4096


def test_what_is_remembered_of_a_connection_is_small() -> None:
    """A server has hundreds of them, and each may have carried any number of bytes."""
    tracemalloc.start()
    try:
        handed = given(10_000, size=4096)
        remembered, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert handed.messages_in(1, 20_000) == 2
    assert remembered < 40_000
