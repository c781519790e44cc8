"""The values of one message that wait at their node, and the mailbox of the controller that offers the oldest."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from benchmarks.protocols.message_sets import longest_bits
from benchmarks.protocols.recorder import MessageInstance
from r2p.codecs.can_bits import FRAME_MAX
from r2p.units import NEVER

if TYPE_CHECKING:
    from collections.abc import Callable

    from benchmarks.protocols.network import ProtocolNetwork
    from benchmarks.protocols.recorder import MessageTrack
    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can import CanController, FrameRecord

_QUEUED_MAX = 128
"""Values of one message that wait at most."""


class MessageOutbox:
    """A queue in front of one mailbox. `make(instance, payload)` makes the frame of a value.

    `drop`: a value whose deadline has passed before its first frame starts is given up. `opens`, `closes`: the instants
    by the node's clock between which frames may be on the bus, however many stuff bits they have; `enable`: ns after
    `opens` in which the first one has to start; `single_shot`: one that fails is not sent again.
    """

    def __init__(
        self,
        network: ProtocolNetwork,
        track: MessageTrack,
        controller: CanController,
        mailbox: int,
        make: Callable[[MessageInstance, bytes], AnyFrame],
        *,
        payload_max: int = FRAME_MAX,
        overhead: int = 0,
        extra: int = 0,
    ) -> None:
        """A frame has `payload_max` bytes of payload at most; the protocol adds `overhead` bytes to each frame, and
        `extra` bytes to the message.
        """
        self.track = track
        self.message = track.message
        self.queue: deque[MessageInstance] = deque()
        self.controller = controller
        self.opens = 0
        self.closes = NEVER
        self.enable = NEVER
        self.single_shot = False
        self.replaces = False
        self.service = False
        """True if the message is the protocol's own."""
        self._network = network
        self._mailbox = mailbox
        self._make = make
        size = self.message.size + extra
        self._sizes = [min(payload_max, size - done) + overhead for done in range(0, size, payload_max)]
        self._sent = 0  # frames of the oldest value that are through
        self._offered: AnyFrame | None = None

    def put(self, instance: MessageInstance) -> None:
        """Send this value. If values `replace` each other, the one that waits is given up."""
        if self.replaces and self.queue and not self._sent and self.withdraw():
            self.queue.popleft()
        if len(self.queue) < _QUEUED_MAX:
            self.queue.append(instance)
            self.offer()

    def open(self, opens: int, closes: int) -> None:
        """Let frames start between these instants only."""
        self.opens, self.closes = opens, closes
        self.offer()

    def withdraw(self) -> bool:
        """Take the frame out of its mailbox. False: it is on the wire."""
        if self._offered is not None:
            if not self.controller.abort(self._mailbox):
                return False
            self._offered = None
        return True

    def clear(self) -> None:
        """Give up what waits, unless it is on the wire."""
        if self.withdraw():
            self.queue.clear()
            self._sent = 0

    def offer(self) -> None:
        """Put the next frame into the mailbox, if it may be sent."""
        if self._offered is not None:
            return
        now = self.controller.clock.monotonic()
        soon = now + 1  # a frame that came back too late did so up to a nanosecond before the instant itself
        while self.queue and not self._sent and self._expires(self.queue[0]) <= soon:
            self.queue.popleft()
        if not self.queue:
            return
        instance, size = self.queue[0], self._sizes[self._sent]
        last = self.closes
        if last < NEVER:
            last -= longest_bits(size) * self._network.bus.bit
        if not self._sent:
            last = min(last, self.opens + self.enable, self._expires(instance))
        if soon >= last:
            return
        frame = self._make(instance, self._network.payload(size))
        opens = self.opens if self.opens > now else None
        if self.controller.request(frame, self._mailbox, not_before=opens, not_after=None if last >= NEVER else last):
            self._offered = frame
            self._network.route(frame, self)

    def example(self) -> AnyFrame:
        """Return a frame as this message has them, released now."""
        return self._make(MessageInstance(self._network.bus.timeline.now()), bytes(self._sizes[0]))

    def _expires(self, instance: MessageInstance) -> int:
        if not self._network.setup.drop:
            return NEVER
        return self.controller.clock.local(instance.released + self.message.deadline)

    # What happens to the frame

    def observed(self, record: FrameRecord) -> None:
        """Note that the frame was on the bus."""
        instance = self.queue[0]
        if not self._sent:
            instance.start = record.start
        if self._sent + 1 == len(self._sizes):
            instance.end = record.end

    def sent(self) -> None:
        """Go on with the next frame."""
        self._offered = None
        self._sent += 1
        if self._sent == len(self._sizes):
            self.queue.popleft()
            self._sent = 0
        self.offer()

    def returned(self) -> None:
        """Try again: the frame is back, as it was too late, lost the arbitration or was destroyed."""
        self._offered = None
        if self.single_shot:
            self.queue.clear()
            self._sent = 0
        else:
            self.offer()
