"""What subscribers grant the publishers of this module, looked at when a publisher has come to the end of it.

Under load the loop's thread seldom lets another one run, and credit that had to come through one would come when the
publisher has stopped for it. So it stays in zenoh's ring until somebody has no room, or for REST seconds.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import msgspec

from r2p.codecs import UnknownType
from r2p.codecs.attachment import decode_credit
from r2p.errors import DecodeError
from r2p.runtime.sample import PublisherClass
from r2p.transports.stats import LinkStats

if TYPE_CHECKING:
    import asyncio

    import zenoh

    from r2p.transports.zenoh.link import ZenohLink
    from r2p.transports.zenoh.publish import ZenohSubscriber
    from r2p.transports.zenoh.session import SubscriptionReader, ZenohSession

REST = 0.02
"""Seconds for which nobody is woken by credit that nobody waits for."""

_MOST = 1024
"""Credits that come in that time at most."""

_LONGEST = 256  # bytes


class Credits:
    """The credit of all topics of one link. `outlets` gives those that are there; `left(topic, session)` is called for
    each last credit, whether or not there is an outlet.
    """

    def __init__(
        self,
        loop: "asyncio.AbstractEventLoop",
        stats: LinkStats,
        outlets: Callable[[], Iterable["ZenohSubscriber"]],
        left: Callable[[str, int], object],
    ) -> None:
        self._loop = loop
        self._stats = stats
        self._outlets = outlets
        self._left = left
        self._tap: SubscriptionReader | None = None
        self._expected = False
        self._rest: asyncio.TimerHandle | None = None

    def connect(self, session: "ZenohSession", key: str) -> None:
        """There is a session now."""
        self._tap = session.subscribe(key, _MOST, self._arrived)
        self._expected = True

    def look(self) -> None:
        """Take what has come; those who waited for it go on when the work that is being done now is over."""
        if self._tap is not None:
            first = self._tap.take()
            if first is not None:
                self._take(first)
                self._loop.call_soon(self._serve)

    def expect(self) -> None:
        """Somebody waits for credit: wake him when some comes."""
        if self._tap is not None and not self._expected:
            self._expected = True
            self._tap.wait()

    def close(self) -> None:
        tap, self._tap = self._tap, None
        if tap is not None:
            tap.close()
        if self._rest is not None:
            self._rest.cancel()

    def _arrived(self, first: "zenoh.Sample | None") -> None:
        self._expected = False
        self._take(first)
        self._serve()

    def _take(self, sample: "zenoh.Sample | None") -> None:
        outlets = {each.topic.name: each for each in self._outlets()}
        while sample is not None and self._tap is not None:
            self._stats.lost.guard(self._grant, sample.payload, outlets)
            sample = self._tap.take()

    def _grant(self, payload: "zenoh.ZBytes", outlets: dict[str, "ZenohSubscriber"]) -> None:
        try:
            credit = decode_credit(payload.to_bytes() if len(payload) <= _LONGEST else b"")
            publisher_class = PublisherClass(credit.publisher_class)
        except UnknownType:
            self._stats.lost["unknown type"] += 1
        except (DecodeError, ValueError):
            self._stats.lost["undecodable"] += 1
        else:
            outlet = outlets.get(credit.topic)
            if outlet is not None:
                outlet.credited(credit.session, publisher_class, credit.serial, leaving=credit.leaving)
            if credit.leaving:
                self._left(credit.topic, credit.session)

    def _serve(self) -> None:
        """Those who wait."""
        if self._tap is None:
            return
        outlets = list(self._outlets())
        for outlet in outlets:
            if outlet.wait_queue():
                self._stats.lost.guard(outlet.refill)
        if any(outlet.expects for outlet in outlets):
            self.expect()
        elif not self._expected and self._rest is None:
            self._rest = self._loop.call_later(REST, self._rested)

    def _rested(self) -> None:
        self._rest = None
        self.expect()


# Whether messages reach the subscribers that tokens tell of: looked at before they are let in, and after.


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


class Reachability:
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

    def _check_outlet(self, outlet: "ZenohSubscriber") -> None:
        for session in outlet.unacknowledged():
            outlet.tries[session] += 1
            if outlet.tries[session] <= _REPEATS:
                outlet.resend_latched()
            elif outlet.tries[session] == _REPEATS + 1:
                self._link.tell_unheard(outlet.topic.name, session)


# Subscribers whose token is gone, and whose last credit may still come.


LATEST = 1.0
"""Seconds after the end of a token in which a last credit may come: far more than threads and networks take."""


class _Gone(msgspec.Struct, eq=False):
    """So many messages are not confirmed; they are counted when the timer ends."""

    unconfirmed: int
    timer: "asyncio.TimerHandle"


class FinalCredits:
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
