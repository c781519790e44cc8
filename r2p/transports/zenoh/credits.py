"""What subscribers grant the publishers of this module, looked at when a publisher has come to the end of it.

Under load the loop's thread seldom lets another one run, and credit that had to come through one would come when the
publisher has stopped for it. So it stays in zenoh's ring until somebody has no room, or for REST seconds.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from r2p.codecs import UnknownType
from r2p.codecs.attachment import decode_credit
from r2p.errors import DecodeError
from r2p.sample import PublisherClass
from r2p.transports.intake import LinkStats

if TYPE_CHECKING:
    import asyncio

    import zenoh

    from r2p.transports.zenoh.outlet import ZenohOutlet
    from r2p.transports.zenoh.session import Session, Tap

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
        outlets: Callable[[], Iterable["ZenohOutlet"]],
        left: Callable[[str, int], object],
    ) -> None:
        self._loop = loop
        self._stats = stats
        self._outlets = outlets
        self._left = left
        self._tap: Tap | None = None
        self._expected = False
        self._rest: asyncio.TimerHandle | None = None

    def connect(self, session: "Session", key: str) -> None:
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

    def _grant(self, payload: "zenoh.ZBytes", outlets: dict[str, "ZenohOutlet"]) -> None:
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
            if outlet.room():
                self._stats.lost.guard(outlet.refill)
        if any(outlet.expects for outlet in outlets):
            self.expect()
        elif not self._expected and self._rest is None:
            self._rest = self._loop.call_later(REST, self._rested)

    def _rested(self) -> None:
        self._rest = None
        self.expect()
