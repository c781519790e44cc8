"""Earliest deadline first in the identifier: a mixed traffic scheduler after the general description of MTS.

Zuberi and Shin ("Non-preemptive scheduling of messages on controller area network for real-time control applications",
RTAS 1995) put the deadline of urgent periodic messages into the identifier, in regions of time relative to the start of
an epoch, and give the others fixed priorities. Nodes rewrite the identifiers of waiting frames at the end of each
epoch. The paper could not be read in full: the widths of the fields and the split are chosen here.

Here: urgent are periodic messages with deadlines up to ten times the shortest, up to 31 of them so that 11 bits
suffice: 1 bit for the class, 5 for the region, 5 for the message. The rest has 11-bit identifiers by deadline. A master
starts each epoch of 16 regions with an empty frame, as the paper needs a common start and does not say how to have it.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from benchmarks.protocols.fixed_priority import standard
from benchmarks.protocols.network import ProtocolNetwork
from r2p.codecs.can_bits import OtherFrame, other_frame_bits, wire_identifier

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.protocols.message_sets import SetMessage
    from benchmarks.protocols.outbox import MessageOutbox
    from benchmarks.protocols.recorder import MessageInstance
    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can import CanController

SYNC = OtherFrame(0)
REGIONS = 16
"""In an epoch; a deadline may lie as far in the next one."""
_REGION_MAX = 31
_URGENT_MAX = 31
_OTHERS = 1 << 10
_SPAN = 10


class EdfIdentifier(ProtocolNetwork):
    """A node's clock only has to count regions, so all nodes take the receptions of the sync for the start."""

    title = "EDF in the identifier"

    def extra_nodes(self) -> list[str]:
        return ["time master"]

    def start(self) -> None:
        self.master = "time master"
        urgent, others = self.split()
        self.region = max(each.deadline for each in urgent) // REGIONS if urgent else 1_000_000
        self.epochs: dict[str, int] = {}
        for number, message in enumerate(urgent, start=1):
            self._urgent_box(message, number)
        for place, message in enumerate(others):
            identifier = _OTHERS + place
            self.release_freely(self.add_box(message, standard(identifier)))
        for name in self.set.nodes:
            self._follow(name, self.controllers[name])
        self._lead(self.controllers[self.master])

    def sync_identifier(self) -> int | None:
        return wire_identifier(SYNC)

    def configuration(self) -> Mapping[str, object]:
        urgent, others = self.split()
        fixed: dict[str, object] = {message.name: ("fixed", place) for place, message in enumerate(others)}
        return fixed | {message.name: "urgent" for message in urgent}

    def split(self) -> tuple[list[SetMessage], list[SetMessage]]:
        """Return the urgent messages and the others, each in the order of deadlines."""
        ordered = self.set.by_deadline()
        periodic = [each for each in ordered if not each.sporadic]
        limit = _SPAN * periodic[0].deadline if periodic else 0
        urgent = [each for each in periodic if each.deadline <= limit][:_URGENT_MAX]
        names = {each.name for each in urgent}
        return urgent, [each for each in ordered if each.name not in names]

    def _urgent_box(self, message: SetMessage, number: int) -> None:
        controller = self.controllers[message.node]

        def make(instance: MessageInstance, payload: bytes) -> AnyFrame:
            deadline = controller.clock.local(instance.released) + message.deadline
            region = (deadline - self.epochs.get(message.node, 0)) // self.region
            return OtherFrame(min(max(region, 0), _REGION_MAX) << 5 | number, payload)

        self.release_freely(self.add_box(message, make))

    def _follow(self, name: str, controller: CanController) -> None:
        """Start an epoch at each sync, or one epoch after the last one: then waiting frames get new identifiers."""
        length = REGIONS * self.region

        def begin(start: int) -> None:
            self.epochs[name] = start
            for box in self._urgent(name):
                if box.withdraw():
                    box.offer()
            pending[0] += 1
            controller.call_at(start + length + length // 4, without, pending[0])

        def without(number: int) -> None:
            if number == pending[0]:
                begin(self.epochs[name] + length)

        def heard(frame: OtherFrame, stamp: int) -> None:
            if frame.id == SYNC.id:
                begin(stamp - self.setup.latency - other_frame_bits(SYNC) * self.bus.bit)

        pending = [0]
        controller.on_other = heard
        controller.filters = [(wire_identifier(SYNC), 0x7FFF_FFFF)]

    def _urgent(self, name: str) -> list[MessageOutbox]:
        return [box for box in self.boxes[name] if isinstance(self.configured[box.message.name], str)]

    @cached_property
    def configured(self) -> Mapping[str, object]:
        """The configuration, made once."""
        return self.configuration()

    def _lead(self, master: CanController) -> None:
        due = master.clock.monotonic() + 1_000_000

        def send() -> None:
            nonlocal due
            master.request(SYNC, not_before=due)
            due += REGIONS * self.region
            master.call_at(due - self.region // 4, send)

        master.call_at(due - 100_000, send)
