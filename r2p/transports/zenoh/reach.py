"""Whether messages reach the subscribers that tokens tell of: looked at before they are let in, and after.

A token may come before the subscription that it tells of, and zenoh says nothing of a message that a router refuses. So
a subscriber is let in when zenoh knows of a way to it; and one that has said nothing of what was sent to it is sent the
latched value again, until somebody has to be told.
"""

from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    import asyncio

    from r2p.transports.zenoh.link import ZenohLink
    from r2p.transports.zenoh.outlet import ZenohOutlet

_NEXT = 0.002
"""Seconds between two looks whether messages reach a new subscriber; longer each time."""

_TRIES = 50
"""Looks, together 2.5 s, after which somebody has to be told."""

_CHECK = 0.25
"""Seconds between two looks whether what was sent is heard."""

_REPEATS = 6


class _Guest(msgspec.Struct, eq=False):
    """A subscriber that is there, but not known to be within reach."""

    window: int
    waited: int = 0
    leaving: bool = False


class Reach:
    """The subscribers of one link, by topic and session."""

    def __init__(self, link: "ZenohLink", loop: "asyncio.AbstractEventLoop") -> None:
        self._link = link
        self._loop = loop
        self._guests: dict[tuple[str, int], _Guest] = {}
        self._checking: asyncio.TimerHandle | None = None

    def came(self, topic: str, session: int, window: int) -> None:
        """A subscriber is new: let it in as soon as messages reach it."""
        guest = self._guests[topic, session] = _Guest(window)
        self._look(topic, session, guest)

    def leaves(self, topic: str, session: int) -> None:
        """It has sent its last credit, but its token is still there: should it be let in, it is known to be leaving."""
        guest = self._guests.get((topic, session))
        if guest is not None:
            guest.leaving = True

    def left(self, topic: str, session: int) -> None:
        self._guests.pop((topic, session), None)

    def close(self) -> None:
        """Look no more."""
        self._guests.clear()
        if self._checking is not None:
            self._checking.cancel()

    def _look(self, topic: str, session: int, guest: _Guest) -> None:
        if self._guests.get((topic, session)) is not guest or not self._link.knows(topic):
            return
        if not self._reaches(topic):
            guest.waited += 1
            if guest.waited == _TRIES:
                self._link.tell_unheard(topic, session)
            self._loop.call_later(_NEXT * min(guest.waited, 100), self._look, topic, session, guest)
            return
        del self._guests[topic, session]
        self._link.stats.lost.guard(self._link.let_in, topic, session, guest.window, leaving=guest.leaving)
        if self._checking is None:
            self._checking = self._loop.call_later(_CHECK, self._check)

    def _reaches(self, topic: str) -> bool:
        try:
            return self._link.senders.reach(topic)
        except Exception as error:  # noqa: BLE001 - counted and logged; it is looked at again
            self._link.stats.lost.internal_error(error)
            return False

    def _check(self) -> None:
        self._checking = None
        self._link.credits.look()
        outlets = list(self._link.zenoh_outlets())
        for outlet in outlets:
            self._link.stats.lost.guard(self._check_outlet, outlet)
        if outlets:
            self._checking = self._loop.call_later(_CHECK, self._check)

    def _check_outlet(self, outlet: "ZenohOutlet") -> None:
        for session in outlet.unheard():
            outlet.tries[session] += 1
            if outlet.tries[session] <= _REPEATS:
                outlet.welcome()
            elif outlet.tries[session] == _REPEATS + 1:
                self._link.tell_unheard(outlet.topic.name, session)
