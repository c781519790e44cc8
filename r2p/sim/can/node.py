"""The settings of a node on the bus, the states of its controller, and what is recorded of each frame."""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

import msgspec

from r2p.codecs.rtcan import Frame  # noqa: TC001 - msgspec looks up the types of fields

if TYPE_CHECKING:
    import random
    from collections.abc import Callable


class ControllerState(Enum):
    """The error state of a controller (ISO 11898), or that it has no power."""

    ACTIVE = "error active"
    PASSIVE = "error passive"  # a counter over 127: its error flags destroy no frame, and it waits longer to send
    BUS_OFF = "bus off"  # the transmit counter over 255: it neither sends nor receives
    DOWN = "down"  # no power


class ErrorKind(Enum):
    """Why a frame was not transmitted."""

    ACK = "no acknowledge"  # no other node is on the bus
    BIT = "bit error"  # the bus had another level than the sender: noise, or a second sender
    STUFF = "stuff error"  # the sender lost power in the middle of the frame
    BUS_OFF = "bus off"  # the sender's controller went to bus-off while the frame waited in its mailbox


class Latency(msgspec.Struct, frozen=True):
    """A delay of `nominal` ns, plus or minus up to `jitter` ns, uniformly distributed; `jitter` <= `nominal`."""

    nominal: int = 0
    jitter: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.jitter <= self.nominal:
            raise ValueError(
                f"the jitter ({self.jitter} ns) must be between 0 and the nominal delay ({self.nominal} ns)"
            )

    def sampler(self, numbers: random.Random) -> Callable[[], int]:
        """A function that returns one random delay after the other, in ns."""
        if not self.jitter:
            return lambda: self.nominal
        shortest, span, draw = self.nominal - self.jitter, 2 * self.jitter + 1, numbers.random
        return lambda: shortest + int(draw() * span)


class CanNode(msgspec.Struct, frozen=True):
    """The settings of one node.

    - `one_shot`: a frame that loses arbitration or is destroyed is given up and reported. Otherwise it is sent again.
    - `mailboxes`: how many frames the controller holds; it sends the one with the lowest identifier first.
    - `offset` (ns) and `drift_ppm`: how the node's clock differs from true time, which is that of the loop.
    - `transmit`: from the request until the controller is ready to send. `receive`: from the end of a frame (or the
      lost arbitration, or the error) until the node's software is called; it stamps the frame at that moment.
    - `loss`: the share of received frames that the node's software loses. `noise`: the share of received frames in
      which only this node sees a bit error; while it is error active, it then destroys the frame for all.
    - `recovery`: a controller in bus-off recovers by itself, after 128 times 11 recessive bits.
    """

    name: str
    one_shot: bool = False
    mailboxes: int = 3
    offset: int = 0
    drift_ppm: float = 0.0
    transmit: Latency = Latency()
    receive: Latency = Latency()
    loss: float = 0.0
    noise: float = 0.0
    recovery: bool = True


class FrameRecord(msgspec.Struct, frozen=True, gc=False):
    """What happened on the wire: one frame, or one attempt that ended with an error frame.

    `start` and `end` are true time, in ns: start of frame, and end of the frame or of the error frame; `bits` lie
    between them. With several senders, they sent the same bits or collided.
    """

    start: int
    end: int
    frame: Frame
    senders: tuple[str, ...]
    bits: int
    error: ErrorKind | None
