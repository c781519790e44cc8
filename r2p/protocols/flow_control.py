"""Flow from end to end: a publisher knows how far each subscriber has come, and does not run ahead of it.

Everything that a session sends on a topic in one class has a serial number. A subscriber's session grants credit: it
tells the last serial that its queues have taken, and its `window` says how many more may be on the way. A subscriber
that grants nothing is one that a publisher waits for, and goes on without when it has waited long enough; its next
credit brings it back. The serials also tell what was lost on the way.
"""

import msgspec

NO_LIMIT = 1 << 62

SHARE = 1024
"""Messages from one credit to the next where no window limits them: more than that are not unknown when a link breaks,
beside what was on the way.
"""

_WRAP = 0xFFFFFFFF
_HALF = 0x80000000


class _Taker(msgspec.Struct):
    """One remote subscriber: what it has taken, when it joined, and whether anything was heard from it since."""

    window: int
    taken: int
    joined: int
    heard: bool = False
    waited_for: bool = True
    leaving: bool = False


class SendWindow:
    """What goes out on one topic in one class, and to whom."""

    def __init__(self) -> None:
        self.serial = 0
        """The last one that was sent; the next is one more."""
        self.limit = NO_LIMIT
        """The last serial that all who are waited for have room for."""
        self.takers: dict[int, _Taker] = {}

    def joined(self, session: int, window: int) -> None:
        """A subscriber, or its new window; 0: it need not be waited for."""
        taker = self.takers.get(session)
        if taker is None:
            self.takers[session] = _Taker(window, self.serial, self.serial)
        elif taker.window != window:  # it need not have granted anything for what went out before
            taker.window = window
            taker.taken = self.serial
        self._update()

    def parted(self, session: int) -> int:
        """Nothing is sent to it any more; says how many messages it may not have got: those that it has not granted
        credit for. One that leaves in order does not want them.
        """
        taker = self.takers.pop(session, None)
        self._update()
        return 0 if taker is None or taker.leaving else max(0, self.serial - taker.taken)

    def leaves(self, session: int, *, leaving: bool) -> None:
        """Whether it has said that it does not subscribe any more; one that grants credit again has come back."""
        taker = self.takers.get(session)
        if taker is not None:
            taker.leaving = leaving

    def credited(self, session: int, serial: int) -> None:
        """It has taken everything up to this serial, of which the wire tells the low 32 bits."""
        taker = self.takers.get(session)
        if taker is None:
            return
        behind = (self.serial - serial) & _WRAP
        if behind < _HALF:  # else it is from before, or nonsense
            taker.taken = max(taker.taken, self.serial - behind)
            taker.heard = taker.waited_for = True
        self._update()

    def give_up(self) -> list[int]:
        """Wait no more for those without room, until their next credit. Says who that is."""
        hung = [number for number, each in self.takers.items() if _is_full(each, self.serial)]
        for number in hung:
            self.takers[number].waited_for = False
        self._update()
        return hung

    def unacknowledged(self) -> list[int]:
        """Subscribers to whom something was sent, and from whom nothing has been heard since they joined."""
        return [number for number, each in self.takers.items() if not each.heard and self.serial > each.joined]

    def _update(self) -> None:
        self.limit = min(
            (each.taken + each.window for each in self.takers.values() if each.window and each.waited_for),
            default=NO_LIMIT,
        )


def _is_full(taker: _Taker, serial: int) -> bool:
    return bool(taker.window) and taker.waited_for and serial >= taker.taken + taker.window


class ReceiveWindow:
    """What comes in from one session on one topic in one class."""

    def __init__(self, window: int) -> None:
        self.window = window
        self.next = -1
        """The serial that is expected; -1: any."""
        self.until_credit = 1
        """Messages that the queues have yet to take before the sender is told; the first one is answered at once."""

    def gap(self, serial: int) -> int:
        """A message has come: how many are missing before it; -1: it came before, or too late."""
        ahead = (serial - self.next) & _WRAP if self.next >= 0 else 0
        if ahead >= _HALF:
            return -1
        self.next = (serial + 1) & _WRAP
        return ahead

    def resized(self, window: int) -> None:
        """The subscribers want another window. The sender counts anew from when it is told, and so do we."""
        self.window = window
        self.until_credit = min(self.until_credit, self._share)

    def interrupted(self) -> None:
        """The sender is gone: should it come back, it knows nothing of us, so its first message is answered."""
        self.until_credit = 1

    def skipped(self, count: int) -> None:
        """So many were lost: the next one that the queues take is told of in good time."""
        self.until_credit = max(1, self.until_credit - count)

    def credited(self) -> None:
        """The sender is told now: so when next?"""
        self.until_credit = self._share

    @property
    def _share(self) -> int:
        """Messages from one credit to the next: so many that the sender need not stop for it."""
        return max(1, self.window // 4) if self.window else SHARE
