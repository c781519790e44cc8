"""Work out the time left until a message's deadline on arrival, whatever the publisher's clock shows.

The clocks of two computers are not compared: they may differ by seconds. A message's delay, the instant of its arrival
less its stamp, is the difference of the clocks plus the time on the way. The least delay of a publisher's messages is
that of undisturbed messages; anything above it is time that a message was held up, by a stalled network or by a stopped
gateway. A delay common to all messages can't be distinguished from the difference of the clocks, and is not counted.
"""

from r2p.units import SECOND

_DRIFT = 2_000  # two clocks drift apart by less than 1/2000
_LATE_MAX = 5 * SECOND  # ns for which all of a publisher's messages can be late: no link holds them up for longer
_DOUBT = 60 * SECOND  # ns in which a clock that was set back may run slowly until it is right


class TimeLeft:
    """The least delay of one publisher's messages; all times in ns.

    If all are late for longer than a link can hold them up, the publisher's clock was set back. Such a clock may run
    slowly until it is right (r2p.clock), so for a minute no message of it counts as late.
    """

    __slots__ = ("_at", "_doubted_until", "_late_since", "_least")

    def __init__(self) -> None:
        self._least: int | None = None
        self._at = 0
        self._late_since: int | None = None
        self._doubted_until: int | None = None

    def left(self, now: int, stamp: int, deadline: int) -> int:
        """Return the time left at `now` (monotonic, this computer) until `deadline`, at most all of the time after
        `stamp` (both UTC, the publisher's clock); 0 or less: it is too late.
        """
        span, delay = deadline - stamp, now - stamp
        least = delay if self._least is None else min(delay, self._least + (now - self._at) // _DRIFT)
        held_up = delay - least
        if self._doubted_until is not None and now < self._doubted_until:
            least, held_up = delay, 0
        elif held_up < span or span <= 0:
            self._late_since = None
        elif self._late_since is None:
            self._late_since = now
        elif now - self._late_since > _LATE_MAX:
            least, held_up = delay, 0
            self._doubted_until, self._late_since = now + _DOUBT, None
        self._least, self._at = least, now
        return span - held_up


class TimesLeft:
    """The `TimeLeft` of many publishers, by any key; of at most PUBLISHERS_MAX at a time."""

    PUBLISHERS_MAX = 1024

    def __init__(self) -> None:
        self._known: dict[object, TimeLeft] = {}

    def of(self, publisher: object) -> TimeLeft:
        """Return the `TimeLeft` of one publisher."""
        known = self._known.get(publisher)
        if known is None:
            if len(self._known) >= self.PUBLISHERS_MAX:
                self._known.clear()  # the least delay is found again within a few messages
            known = self._known[publisher] = TimeLeft()
        return known
