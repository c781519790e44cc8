"""Which tokens are believed, and when."""

import asyncio
from collections import Counter

import pytest

from r2p.transports.zenoh.link import KEYS_PER_TURN, TokenDebouncer

pytestmark = [pytest.mark.anyio, pytest.mark.virtual_time]


class Believer:
    """Keeps what is believed."""

    def __init__(self, *, up: bool = True, most: int = 100) -> None:
        self.there: set[str] = set()
        self.settled: Counter[str] = Counter()
        self.refused = 0
        self.tokens = TokenDebouncer(asyncio.get_running_loop(), self._believed, self._count, most)
        if up:
            self.tokens.on_up()

    def _believed(self, key: str, there: bool) -> None:
        (self.there.add if there else self.there.discard)(key)
        self.settled[key] += 1

    def _count(self) -> None:
        self.refused += 1


async def turns() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


async def test_an_answer_that_is_older_than_the_end_of_its_token_is_not_believed() -> None:
    believer = Believer()
    for key in ("before", "during", "again"):
        believer.tokens.on_change(key, True)
    believer.tokens.on_change("before", False)
    believer.tokens.begin_query(believer.there)
    for key in ("during", "again"):
        believer.tokens.on_change(key, False)
    await asyncio.sleep(1.0)
    believer.tokens.on_change("again", True)
    for key in ("before", "during", "again", "refused"):
        believer.tokens.on_answer(key)
    assert believer.tokens.end_query()
    await asyncio.sleep(1.0)
    assert believer.there == {"again", "refused"}


async def test_answers_are_of_no_use_once_the_link_was_down() -> None:
    believer = Believer()
    believer.tokens.begin_query(believer.there)
    believer.tokens.on_down()
    believer.tokens.on_up()
    believer.tokens.on_answer("old")
    assert not believer.tokens.end_query()
    assert not believer.there


async def test_answers_without_a_token_that_is_there_are_incomplete() -> None:
    believer = Believer()
    for key in ("stays", "goes"):
        believer.tokens.on_change(key, True)
    believer.tokens.begin_query(believer.there)
    believer.tokens.on_change("goes", False)
    believer.tokens.on_answer("new")
    assert not believer.tokens.end_query()
    assert "new" in believer.there
    believer.tokens.begin_query(believer.there)
    for key in ("new", "stays"):
        believer.tokens.on_answer(key)
    assert believer.tokens.end_query()


async def test_no_answer_at_all_is_incomplete() -> None:
    believer = Believer()
    believer.tokens.begin_query(())
    assert not believer.tokens.end_query()


async def test_answers_are_of_no_use_where_too_many_tokens_go_meanwhile() -> None:
    believer = Believer(most=4)
    believer.tokens.begin_query(believer.there)
    for number in range(5):
        believer.tokens.on_change(f"{number}", False)
    believer.tokens.on_answer("0")
    assert not believer.tokens.end_query()
    assert not believer.there


async def test_what_has_no_room_before_the_link_is_up_is_counted() -> None:
    believer = Believer(up=False, most=2)
    for key in ("a", "b", "b", "c", "d"):
        believer.tokens.on_change(key, True)
    believer.tokens.on_up()
    assert (believer.there, believer.refused) == ({"a", "b"}, 2)


async def test_many_tokens_from_before_the_link_was_up_are_believed_in_turns() -> None:
    """Those that end before their turn were never there, and those that are told again count once."""
    believer = Believer(up=False)
    keys = [f"{number}" for number in range(50)]
    for key in keys:
        believer.tokens.on_change(key, True)
    believer.tokens.on_up()
    assert believer.there == set(keys[:KEYS_PER_TURN])
    believer.tokens.on_change(keys[40], False)
    believer.tokens.on_change(keys[41], True)
    believer.tokens.on_change("new", True)
    await turns()
    assert believer.there == {*keys, "new"} - {keys[40]}
    assert believer.settled[keys[41]] == 1


async def test_tokens_whose_turn_has_not_come_wait_while_the_link_is_down_again() -> None:
    believer = Believer(up=False)
    for number in range(50):
        believer.tokens.on_change(f"{number}", True)
    believer.tokens.on_up()
    believer.tokens.on_down()
    believer.tokens.on_change("49", False)
    await turns()
    assert len(believer.there) == KEYS_PER_TURN
    believer.tokens.on_up()
    await turns()
    assert believer.there == {f"{number}" for number in range(49)}
