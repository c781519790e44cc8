"""Which tokens are believed, and when."""

import asyncio

import pytest

from r2p.transports.zenoh import link as tokens
from r2p.transports.zenoh.link import TokenDebouncer

pytestmark = [pytest.mark.anyio, pytest.mark.virtual_time]


class Believer:
    """Keeps what is believed."""

    def __init__(self, *, up: bool = True) -> None:
        self.there: set[str] = set()
        self.refused = 0
        self.tokens = TokenDebouncer(asyncio.get_running_loop(), self._believed, self._count)
        if up:
            self.tokens.on_up()

    def _believed(self, key: str, there: bool) -> None:
        (self.there.add if there else self.there.discard)(key)

    def _count(self) -> None:
        self.refused += 1


async def test_an_answer_that_is_older_than_the_end_of_its_token_is_not_believed() -> None:
    believer = Believer()
    for key in ("before", "during", "again"):
        believer.tokens.on_change(key, True)
    believer.tokens.on_change("before", False)
    believer.tokens.begin_query()
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
    believer.tokens.begin_query()
    believer.tokens.on_down()
    believer.tokens.on_up()
    believer.tokens.on_answer("old")
    assert not believer.tokens.end_query()
    assert not believer.there


async def test_answers_are_of_no_use_where_too_many_tokens_go_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tokens, "TOKENS_MAX", 4)
    believer = Believer()
    believer.tokens.begin_query()
    for number in range(5):
        believer.tokens.on_change(f"{number}", False)
    believer.tokens.on_answer("0")
    assert not believer.tokens.end_query()
    assert not believer.there


async def test_what_has_no_room_before_the_link_is_up_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tokens, "TOKENS_MAX", 2)
    believer = Believer(up=False)
    for key in ("a", "b", "b", "c", "d"):
        believer.tokens.on_change(key, True)
    believer.tokens.on_up()
    assert (believer.there, believer.refused) == ({"a", "b"}, 2)
