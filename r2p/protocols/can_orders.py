"""The orders to a CAN controller, and its answers: the interface of CAN ports and protocols.

They are separate, as a port (`r2p.transports.can`) does not know RTCAN, nor RTCAN's engine ports.
"""

import enum

import msgspec

from r2p.codecs.can_bits import Frame
from r2p.units import NEVER


class Mailbox(enum.IntEnum):
    """The controller's transmit buffers. Each holds one frame; HRT goes before SRT before NRT."""

    HRT = 0  # sync and hard real-time
    SRT = 1  # soft real-time and management
    NRT = 2


class Outcome(enum.Enum):
    """The outcome of an order to transmit a frame."""

    SENT = "sent"
    LOST = "arbitration lost"  # one-shot controllers only
    ERROR = "bus error"  # destroyed, not acknowledged, or given up in bus-off
    LATE = "not started"  # withdrawn, or not started by `not_after`: it was never on the bus
    UNKNOWN = "unknown"  # the port can't say; never sent again, as a second copy would look like a new message


class Transmit(msgspec.Struct, frozen=True, gc=False):
    """Put this frame into the mailbox, which is empty. Its start of frame must lie between the two instants (ns of the
    port's clock). The port answers each one with an `Outcome`.
    """

    frame: Frame
    mailbox: Mailbox
    not_before: int
    not_after: int = NEVER


class Withdraw(msgspec.Struct, frozen=True, gc=False):
    """Take the frame back if it has not started; it is confirmed as every frame."""

    mailbox: Mailbox
