"""Mailboxes in software: one outstanding frame per class, for drivers that queue frames and confirm them late.

    put -> waits (for its instant, for the driver, for its turn) -> handed over -> confirmed
                               |                                         |
                             LATE                                     UNKNOWN, when no confirmation comes

A frame that waits can be withdrawn; one that was handed over can't, and is never handed over twice. No I/O, no clock.
"""

from collections.abc import Callable

from r2p.codecs.rtcan import Frame
from r2p.protocols.rtcan.events import Mailbox, Outcome, Transmit
from r2p.units import NEVER

RETRY_INTERVAL = 500_000
"""Ns until the next try when the driver's queue is full: no interface reports that it has room again."""


class _WaitingFrame:
    """A frame in a mailbox."""

    def __init__(self, order: Transmit, due: int, latest: int) -> None:
        self.order = order
        self.due = due  # when to hand it over; once it is handed over, when to give up its confirmation
        self.latest = latest  # when it is too late to hand it over
        self.handed_over = False


class TxMailboxes:
    """Three mailboxes in front of a driver's queue.

    `send(frame, mailbox)` hands a frame over, and returns False when there is no room. `confirm(mailbox, outcome, at)`
    is called once for each frame. `latency`: ns from the hand-over to the start of frame. `confirm_timeout`: ns until a
    confirmation is given up. `one_at_a_time`: hand over only one frame at a time, so that an error frame, which names
    no frame, must be about that one.
    """

    def __init__(
        self,
        send: Callable[[Frame, Mailbox], bool],
        confirm: Callable[[Mailbox, Outcome, int], object],
        *,
        latency: int,
        confirm_timeout: int,
        one_at_a_time: bool = False,
    ) -> None:
        self._send = send
        self._confirm = confirm
        self._latency = latency
        self._confirm_timeout = confirm_timeout
        self._one_at_a_time = one_at_a_time
        self._frames: dict[Mailbox, _WaitingFrame] = {}

    @property
    def handed_over(self) -> list[Mailbox]:
        """The mailboxes whose frame was handed over."""
        return [mailbox for mailbox, waiting in self._frames.items() if waiting.handed_over]

    def put(self, now: int, order: Transmit) -> None:
        """Put a frame into an empty mailbox.

        A frame that is too late already is confirmed by `poll`: the engine would answer a confirmation from here with
        the next frame, which is too late as well, and so on without end.
        """
        due = order.not_before - self._latency
        latest = order.not_after - self._latency if order.not_after < NEVER else NEVER
        waiting = self._frames[order.mailbox] = _WaitingFrame(order, due, latest)
        if now <= latest:
            self._offer(now, order.mailbox, waiting)

    def withdraw(self, now: int, mailbox: Mailbox) -> None:
        """Take a frame back, unless it was handed over."""
        waiting = self._frames.get(mailbox)
        if waiting is not None and not waiting.handed_over:
            self._end(mailbox, Outcome.LATE, now)

    def seen(self, identifier: int, data: bytes, at: int, now: int) -> bool:
        """Confirm an own frame that was on the bus. False if it is none of those that were handed over."""
        for mailbox, waiting in self._frames.items():
            frame = waiting.order.frame
            if waiting.handed_over and frame.id == identifier and frame.data == data:
                self._end(mailbox, Outcome.SENT, at)
                self.poll(now)
                return True
        return False

    def failed(self, mailbox: Mailbox, outcome: Outcome, now: int) -> None:
        """Confirm that the frame that was handed over was not sent."""
        if mailbox in self._frames:
            self._end(mailbox, outcome, now)
            self.poll(now)

    def clear(self) -> None:
        """Drop all frames without confirming them: the bus is gone."""
        self._frames.clear()

    def next_deadline(self) -> int | None:
        """When to call `poll`."""
        if not self._frames:
            return None
        blocked = self._one_at_a_time and bool(self.handed_over)
        due = min(self._due(waiting, blocked=blocked) for waiting in self._frames.values())
        return due if due < NEVER else None

    def poll(self, now: int) -> None:
        """Hand over what is due, the most urgent class first; give up what is too late."""
        for mailbox in Mailbox:  # in the order of urgency
            waiting = self._frames.get(mailbox)
            if waiting is None:
                continue
            if waiting.handed_over:
                if waiting.due <= now:
                    self._end(mailbox, Outcome.UNKNOWN, now)
            elif waiting.latest < now:
                self._end(mailbox, Outcome.LATE, now)
            else:
                self._offer(now, mailbox, waiting)

    def _offer(self, now: int, mailbox: Mailbox, waiting: _WaitingFrame) -> None:
        if waiting.due > now or (self._one_at_a_time and self.handed_over):
            return
        if self._send(waiting.order.frame, mailbox):
            waiting.handed_over = True
            waiting.due = now + self._confirm_timeout
        else:
            waiting.due = now + RETRY_INTERVAL

    def _due(self, waiting: _WaitingFrame, *, blocked: bool) -> int:
        if waiting.handed_over:
            return waiting.due
        too_late = waiting.latest + 1  # a frame that waits for its turn behind another one can only become too late
        return too_late if blocked else min(waiting.due, too_late)

    def _end(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        # The mailbox is empty before its listener hears of it, which may put the next frame there at once.
        del self._frames[mailbox]
        self._confirm(mailbox, outcome, at)
