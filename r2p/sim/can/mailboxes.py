"""What a controller has to send: its mailboxes, and which of their frames it tries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

from r2p.sim.can.node import NEVER

if TYPE_CHECKING:
    from collections.abc import Callable

    from r2p.codecs.rtcan import Frame
    from r2p.sim.can.controller import CanController

BABBLE: Final = -1
"""The mailbox of a node that has gone mad."""


class Request(msgspec.Struct, eq=False):
    """A frame in a mailbox of the controller `owner`.

    `ready`: from when on the controller tries it; `last`: until when it may start; `held`: until when it is on the
    wire. `guarded`: it will be aborted at `last`, unless it is on the wire.
    """

    owner: CanController
    frame: Frame
    mailbox: int
    ready: int
    last: int
    held: int = 0
    guarded: bool = False


class Mailboxes:
    """One frame in each. `guard` is told of those that may have to be aborted at their last instant."""

    def __init__(self, guard: Callable[[Request], None]) -> None:
        self.requests: dict[int, Request] = {}
        """By mailbox."""
        self.not_before = 0
        """No start of frame here earlier than this."""
        self._guard = guard

    def choose(self, start: int, end: int) -> Request | None:
        """The frame that this controller tries when a start of frame comes at `start`; `end` is one bit later.

        Of those ready by then the one with the lowest identifier, else the first that gets ready before `end`.
        """
        chosen = None
        if start < self.not_before:
            start = self.not_before
        for request in self.requests.values():
            begins = request.ready
            if begins < start:
                begins = start
            if begins > request.last:
                continue
            if begins < end or (begins == end and chosen is not None and request.frame.id < chosen.frame.id):
                chosen, end = request, begins
        return chosen

    def first(self, free: int) -> int:
        """When this controller wants to start a frame, given when the bus is free. NEVER: not at all."""
        earliest = NEVER
        if free < self.not_before:
            free = self.not_before
        for request in self.requests.values():
            begins = request.ready
            if begins < free:
                begins = free
            if begins > request.last:
                self._guard(request)
            elif begins < earliest:
                earliest = begins
        return earliest

    def passed(self, chosen: Request | None) -> None:
        """A frame has started, and of these at most this one takes part: watch the others' last instants."""
        for request in self.requests.values():
            if request.last < NEVER and request is not chosen:
                self._guard(request)

    def clear(self) -> list[Frame]:
        """Empty all; these were the frames."""
        frames = [request.frame for mailbox, request in self.requests.items() if mailbox != BABBLE]
        self.requests.clear()
        return frames

    def remove(self, request: Request) -> bool:
        """Empty its mailbox. False if it is no longer there; a babbling node never ends."""
        mailbox = request.mailbox
        if mailbox == BABBLE or self.requests.get(mailbox) is not request:
            return False
        del self.requests[mailbox]
        return True
