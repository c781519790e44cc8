"""Subscribers whose token is gone, and whose last credit may still come.

A subscriber that leaves in order sends its last credit before its token goes. They come by different ways through
zenoh and through its threads, so the token's end may be seen first: what such a subscriber has not confirmed is counted
when its last credit has not come in good time.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    import asyncio

LATEST = 1.0
"""Seconds after the end of a token in which a last credit may come: far more than threads and networks take."""


class _Gone(msgspec.Struct, eq=False):
    """So many messages are not confirmed; they are counted when the timer ends."""

    unconfirmed: int
    timer: "asyncio.TimerHandle"


class Farewells:
    """Those of one link, by topic and session. `look` takes in the credits that have come; `count` gets the number of
    messages of a subscriber that has not left in order.
    """

    def __init__(
        self, loop: "asyncio.AbstractEventLoop", look: Callable[[], object], count: Callable[[int], object]
    ) -> None:
        self._loop = loop
        self._look = look
        self._count = count
        self._gone: dict[tuple[str, int], _Gone] = {}

    def expect(self, topic: str, session: int, unconfirmed: int) -> None:
        """The token of a subscriber is gone, and so many messages are not confirmed."""
        key = topic, session
        before = self._gone.pop(key, None)
        if before is not None:  # it came back meanwhile, and is gone again
            before.timer.cancel()
            unconfirmed += before.unconfirmed
        self._gone[key] = _Gone(unconfirmed, self._loop.call_later(LATEST, self._late, key))

    def came(self, topic: str, session: int) -> None:
        """A last credit: the subscriber did not want what is not confirmed."""
        gone = self._gone.pop((topic, session), None)
        if gone is not None:
            gone.timer.cancel()

    def close(self) -> None:
        """Nothing comes any more."""
        self._look()
        gone, self._gone = self._gone, {}
        for each in gone.values():
            each.timer.cancel()
            self._count(each.unconfirmed)

    def _late(self, key: tuple[str, int]) -> None:
        self._look()  # which may be the very credit
        gone = self._gone.pop(key, None)
        if gone is not None:
            self._count(gone.unconfirmed)
