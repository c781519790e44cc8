"""How much of the time that a publisher gives its messages is left when they arrive, whatever its clock shows.

The clocks of two computers are not compared: they may differ by seconds. A message's delay, the instant of its arrival
less its stamp, is the difference of the clocks and the time on the way. The least delay of a publisher's messages is
that of those that nothing held up; so what is above it is how long a message was held up, by a stalled network, or by a
gateway that was stopped. What every message takes alike can't be told from the difference of the clocks, and is not
counted.
"""

_SECOND = 1_000_000_000
_DRIFT = 2_000  # two clocks drift apart by less than a part in so many
_BELIEVED = 5 * _SECOND  # ns for which all of a publisher's messages can be late: no link holds them up for longer
_DOUBTED = 60 * _SECOND


class TimeLeft:
    """What is known of one publisher's messages; all times in ns.

    Where all are late for longer than a link can hold them up, the publisher's clock was set back. Such a clock may run
    slowly until it is right (r2p.clock), so for a minute it does not say what is late.
    """

    __slots__ = ("_at", "_doubted_until", "_late_since", "_least")

    def __init__(self) -> None:
        self._least: int | None = None
        self._at = 0
        self._late_since: int | None = None
        self._doubted_until: int | None = None

    def left(self, now: int, stamp: int, deadline: int) -> int:
        """What is left at `now` (monotonic, this computer) until `deadline`, at most all of the time after `stamp`
        (both UTC, the publisher's clock); 0 or less: it is too late.
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
        elif now - self._late_since > _BELIEVED:
            least, held_up = delay, 0
            self._doubted_until, self._late_since = now + _DOUBTED, None
        self._least, self._at = least, now
        return span - held_up


class TimesLeft:
    """Those of many publishers, by any key; of MOST at a time."""

    MOST = 1024

    def __init__(self) -> None:
        self._known: dict[object, TimeLeft] = {}

    def of(self, publisher: object) -> TimeLeft:
        """That of one publisher."""
        known = self._known.get(publisher)
        if known is None:
            if len(self._known) >= self.MOST:
                self._known.clear()
            known = self._known[publisher] = TimeLeft()
        return known
