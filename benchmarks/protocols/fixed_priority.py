"""Fixed priorities: plain CAN with rate- or deadline-monotonic identifiers, and the priorities of Cyphal and DroneCAN.

Every node always offers its highest frame, as the response-time analysis assumes (Davis, Burns, Bril, Lukkien, "CAN
schedulability analysis: refuted, revisited and revised", Real-Time Systems 35, 2007): there is a mailbox for each
message. Nothing is synchronised: nodes release messages by their own clocks.

Simplified: messages of more than 8 bytes on plain CAN are cut into frames of one identifier, and what numbers these is
not charged. Cyphal's and DroneCAN's nodes are static: nobody allocates node ids.
"""

from __future__ import annotations

import math
import random
from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from benchmarks.protocols.message_sets import SetMessage
from benchmarks.protocols.network import ProtocolNetwork
from benchmarks.protocols.recorder import MessageTrack
from r2p.codecs.can_bits import FRAME_MAX, Frame, OtherFrame
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from benchmarks.protocols.outbox import MessageOutbox
    from benchmarks.protocols.recorder import MessageInstance
    from r2p.codecs.can_bits import AnyFrame

FIRST_IDENTIFIER = 0x10
"""Of messages; syncs have lower ones."""
_PAYLOAD = FRAME_MAX - 1  # beside the tail byte
_CRC = 2


class PlainCan(ProtocolNetwork):
    """11-bit identifiers in the order of some rule, without gaps."""

    def start(self) -> None:
        for place, message in enumerate(self.order()):
            identifier = FIRST_IDENTIFIER + place
            self.release_freely(self.add_box(message, standard(identifier)))

    def configuration(self) -> Mapping[str, object]:
        return {message.name: place for place, message in enumerate(self.order())}

    @abstractmethod
    def order(self) -> Sequence[SetMessage]:
        """Return the messages, the highest priority first."""


class RateMonotonic(PlainCan):
    """The shortest period first."""

    title = "plain CAN, RM"

    def order(self) -> Sequence[SetMessage]:
        return self.set.by_rate()


class DeadlineMonotonic(PlainCan):
    """The shortest deadline first."""

    title = "plain CAN, DM"

    def order(self) -> Sequence[SetMessage]:
        return self.set.by_deadline()


def standard(identifier: int) -> Callable[[MessageInstance, bytes], OtherFrame]:
    """Return what makes frames with this 11-bit identifier."""
    return lambda _instance, payload: OtherFrame(identifier, payload)


class PriorityLevels(ProtocolNetwork):
    """29-bit identifiers: a few levels of priority, by deadline, and within one of them the number of the subject.

    A frame has 7 bytes of payload and a tail byte; a transfer of several frames has 2 more bytes, a CRC. Each node
    sends a heartbeat of 7 bytes a second. Subject numbers have nothing to do with deadlines: they are drawn.
    """

    levels: ClassVar[Sequence[int]]
    priority_shift: ClassVar[int]
    subject_max: ClassVar[int]
    heartbeat: ClassVar[tuple[int, int]]
    """Its level and its subject."""

    def start(self) -> None:
        levels, subjects = self._levels(), self._subjects()
        names = {node: number for number, node in enumerate(self.set.nodes, start=1)}
        for message in self.set.messages:
            level, number = levels[message.name], names[message.node]
            extra = _CRC if message.size > _PAYLOAD else 0
            self.release_freely(self._box(message, self._identifier(level, subjects[message.name], number), extra))
        for node, number in names.items():
            beat = SetMessage(f"heartbeat of {node}", node, _PAYLOAD, SECOND, SECOND)
            self.tracks[beat.name] = MessageTrack(beat, SECOND)
            box = self._box(beat, self._identifier(*self.heartbeat, number))
            box.service = True
            self.release_freely(box)

    def configuration(self) -> Mapping[str, object]:
        return self._levels()

    def _levels(self) -> dict[str, int]:
        """Levels by deadline on a logarithmic scale, from 1 ms to 128 ms: a new message moves no other one."""
        last = len(self.levels) - 1
        places = {each.name: math.ceil(math.log2(each.deadline / MILLISECOND) * last / 7) for each in self.set.messages}
        return {name: self.levels[min(max(place, 0), last)] for name, place in places.items()}

    def _subjects(self) -> dict[str, int]:
        numbers = random.Random(f"{self.setup.seed}/subjects")
        drawn = numbers.sample(range(1, self.subject_max), len(self.set.messages))
        return {message.name: number for message, number in zip(self.set.messages, drawn, strict=True)}

    def _identifier(self, level: int, subject: int, node: int) -> int:
        return level << self.priority_shift | subject << 8 | node

    def _box(self, message: SetMessage, identifier: int, extra: int = 0) -> MessageOutbox:
        def make(_instance: MessageInstance, payload: bytes) -> AnyFrame:
            return Frame(identifier, payload)

        return self.add_box(message, make, payload_max=_PAYLOAD, overhead=1, extra=extra)


class Cyphal(PriorityLevels):
    """Cyphal/CAN: 3 bits of priority. The highest, "exceptional", is left free, as its specification advises."""

    title = "Cyphal"
    levels = range(1, 8)
    priority_shift = 26
    subject_max = 6144
    heartbeat = (4, 7509)


class DroneCan(PriorityLevels):
    """DroneCAN: 5 bits of priority, and a subject of 16 bits. The highest level is left free here, too."""

    title = "DroneCAN"
    levels = range(1, 32)
    priority_shift = 24
    subject_max = 1 << 15
    heartbeat = (16, 341)
