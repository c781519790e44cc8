"""A set of messages on a CAN bus, as the analysis takes it. All times are ns, as everywhere in r2p."""

import enum
from itertools import pairwise

import msgspec

from r2p.codecs.can_bits import (
    FRAME_MAX,
    IDENTIFIER_BITS,
    INTERMISSION,
    STANDARD_BITS,
    Frame,
    OtherFrame,
    arbitration_field,
    frame_bits_max,
)
from r2p.codecs.rtcan import PAYLOAD_MAX, fragment_count
from r2p.errors import MessageError
from r2p.units import SECOND


class MessageClass(enum.Enum):
    """How a message uses the bus."""

    PLAIN = "can"
    """A frame of plain CAN: the controller sends the one with the lowest identifier, and again until it is through."""
    HRT = "hrt"
    """Hard real-time on RTCAN: in reserved slots."""
    SRT = "srt"
    """Soft real-time on RTCAN: in free slots, the least laxity first."""
    NRT = "nrt"
    """Non real-time on RTCAN: in free slots, behind all soft real-time messages."""


class Urgency(enum.Enum):
    """How urgent a soft real-time message is on RTCAN, by its deadline."""

    OWN = "own"
    """As its own deadline says."""
    LENT = "lent"
    """Also as the discovery of its node that waits behind it: up to any."""
    EASED = "eased"
    """In its last four milliseconds as with four left, and so when it is overdue: discovery (PROTOCOL.md 6)."""


class BusMessage(msgspec.Struct, frozen=True, kw_only=True):
    """A message that is sent at most once a `period`, within `jitter` of that, and has to be through by `deadline`.

    `size` is in bytes: up to 8, on RTCAN up to 1024 in several frames. `period`, `deadline` and `jitter` are ns;
    `period` None: nobody knows how often it is sent. `deadline` counts from when the message should have been queued
    without jitter (plain CAN), or from when it is published (RTCAN); None: it has none. `bits`: the length of its
    longest frame without intermission, where that is known; None: as many stuff bits as any content can have.
    `urgency` is that of RTCAN's own messages, which `management_load` returns.
    """

    name: str
    size: int
    period: int | None = None
    deadline: int | None = None
    jitter: int = 0
    node: str = ""
    id: int = 0
    extended: bool = False
    message_class: MessageClass = MessageClass.PLAIN
    bits: int | None = None
    urgency: Urgency = Urgency.OWN

    @property
    def frames(self) -> int:
        """The number of its frames."""
        return 1 if self.message_class is MessageClass.PLAIN else fragment_count(self.size)

    @property
    def longest(self) -> int:
        """The bits of its longest frame, from its start to its end, without intermission."""
        if self.bits is not None:
            return self.bits
        extended = self.extended or self.message_class is not MessageClass.PLAIN
        return frame_bits_max(min(self.size, FRAME_MAX), extended=extended)

    @property
    def occupied(self) -> int:
        """The bit times for which it occupies the bus, with the intermission after each frame."""
        return self.frames * (self.longest + INTERMISSION)

    @property
    def rank(self) -> int:
        """The number that decides an arbitration: the lowest wins."""
        return arbitration_field(Frame(self.id, b"") if self.extended else OtherFrame(self.id))

    def load(self, bit: int) -> float:
        """Return the share of the time for which it occupies a bus with this bit time (ns)."""
        return self.occupied * bit / self.period if self.period else 0.0


def check_message(message: BusMessage) -> BusMessage:
    """Return the message. Raises `MessageError` for one that no bus can carry."""
    plain = message.message_class is MessageClass.PLAIN
    longest = FRAME_MAX if plain else PAYLOAD_MAX
    width = IDENTIFIER_BITS if message.extended else STANDARD_BITS
    wrong = None
    if not (0 if plain else 1) <= message.size <= longest:
        wrong = f"{message.size} bytes: a {'frame' if plain else 'message'} has up to {longest}"
    elif plain and (message.id < 0 or message.id >> width):
        wrong = f"the identifier {message.id:#x} has more than {width} bits"
    elif message.period is not None and message.period <= 0:
        wrong = f"a period of {message.period / SECOND:g} s: it must be longer than 0"
    elif message.deadline is not None and message.deadline <= 0:
        wrong = f"a deadline of {message.deadline / SECOND:g} s: it must be longer than 0"
    elif message.jitter < 0:
        wrong = "the jitter is less than 0"
    if wrong:
        raise MessageError(f"{message.name}: {wrong}")
    return message


def by_priority(messages: list[BusMessage]) -> list[BusMessage]:
    """Return plain messages, the one first that wins every arbitration. Raises `MessageError` for equal identifiers."""
    ordered = sorted(messages, key=lambda each: each.rank)
    for first, second in pairwise(ordered):
        if first.rank == second.rank:
            raise MessageError(f"{first.name} and {second.name} have the same identifier {first.id:#x}: change one")
    return ordered


def bit_time(bitrate: int) -> int:
    """Return the length of a bit (ns), rounded up where it is not whole: a bound stays one."""
    return -(-SECOND // bitrate)


def utilisation(messages: list[BusMessage], bit: int) -> float:
    """Return the share of the time for which all messages together occupy the bus."""
    return sum(each.load(bit) for each in messages)
