"""One outstanding frame per class, for interfaces that have no mailboxes of their own: drivers queue, and tell late.

    transmit -> waits (for its instant, for room, for its turn) -> handed over -> confirmed
                                                  |                    |
                                                 LATE              UNKNOWN, when no news come

A frame that waits can be withdrawn; one that was handed over can't. It is never handed over twice. No I/O, no clock.
"""

from collections.abc import Callable

from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.events import NEVER, Mailbox, Outcome, Transmit

AGAIN = 500_000
"""Ns until the next try when the driver's queue is full: no interface says when it has room."""


class _Waiting:
    """A frame in a mailbox."""

    def __init__(self, order: Transmit, due: int, latest: int) -> None:
        self.order = order
        self.due = due  # when to hand it over, or to look for its confirmation
        self.latest = latest  # when it is too late to hand it over
        self.handed = False


class TxSlots:
    """Three mailboxes in front of a queue.

    `send(frame, mailbox)` hands a frame over, and says False when there is no room; `confirm(mailbox, outcome, at)` is
    called once a frame. `latency`: ns from the hand-over to the start of frame; `patience`: ns until a confirmation is
    given up; `singly`: only one frame at a time is handed over, so that news without a name must be about that one.
    """

    def __init__(
        self,
        send: Callable[[Frame, Mailbox], bool],
        confirm: Callable[[Mailbox, Outcome, int], object],
        *,
        latency: int,
        patience: int,
        singly: bool = False,
    ) -> None:
        self._send = send
        self._confirm = confirm
        self._latency = latency
        self._patience = patience
        self._singly = singly
        self._boxes: dict[Mailbox, _Waiting] = {}

    @property
    def handed(self) -> list[Mailbox]:
        """The mailboxes whose frame was handed over."""
        return [mailbox for mailbox, waiting in self._boxes.items() if waiting.handed]

    def put(self, now: int, order: Transmit) -> None:
        """A frame for an empty mailbox. That it is too late is told by `poll`: who heard it now would try again now."""
        due = order.not_before - self._latency
        latest = order.not_after - self._latency if order.not_after < NEVER else NEVER
        waiting = self._boxes[order.mailbox] = _Waiting(order, due, latest)
        if now <= latest:
            self._offer(now, order.mailbox, waiting)

    def withdraw(self, now: int, mailbox: Mailbox) -> None:
        """Nobody wants it any more."""
        waiting = self._boxes.get(mailbox)
        if waiting is not None and not waiting.handed:
            self._end(mailbox, Outcome.LATE, now)

    def seen(self, identifier: int, data: bytes, at: int, now: int) -> bool:
        """An own frame was on the bus. False: it is none of those that were handed over."""
        for mailbox, waiting in self._boxes.items():
            frame = waiting.order.frame
            if waiting.handed and frame.id == identifier and frame.data == data:
                self._end(mailbox, Outcome.SENT, at)
                self.poll(now)
                return True
        return False

    def failed(self, mailbox: Mailbox, outcome: Outcome, now: int) -> None:
        """The frame that was handed over did not make it."""
        if mailbox in self._boxes:
            self._end(mailbox, outcome, now)
            self.poll(now)

    def clear(self) -> None:
        """The bus is gone: so are all frames, without a word."""
        self._boxes.clear()

    def next_deadline(self) -> int | None:
        """When to call `poll`."""
        if not self._boxes:
            return None
        blocked = self._singly and bool(self.handed)
        due = min(self._due(waiting, blocked=blocked) for waiting in self._boxes.values())
        return due if due < NEVER else None

    def poll(self, now: int) -> None:
        """Hand over what is due, the most urgent class first; give up what is too late."""
        for mailbox in Mailbox:
            waiting = self._boxes.get(mailbox)
            if waiting is None:
                continue
            if waiting.handed:
                if waiting.due <= now:
                    self._end(mailbox, Outcome.UNKNOWN, now)
            elif waiting.latest < now:
                self._end(mailbox, Outcome.LATE, now)
            else:
                self._offer(now, mailbox, waiting)

    def _offer(self, now: int, mailbox: Mailbox, waiting: _Waiting) -> None:
        if waiting.due > now or (self._singly and self.handed):
            return
        if self._send(waiting.order.frame, mailbox):
            waiting.handed = True
            waiting.due = now + self._patience
        else:
            waiting.due = now + AGAIN

    def _due(self, waiting: _Waiting, *, blocked: bool) -> int:
        if waiting.handed:
            return waiting.due
        too_late = waiting.latest + 1
        return too_late if blocked else min(waiting.due, too_late)

    def _end(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        del self._boxes[mailbox]
        self._confirm(mailbox, outcome, at)
