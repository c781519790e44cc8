"""CANopen (CiA 301): a producer sends SYNC, and nodes answer it with process data objects (PDOs).

As CANopenNode implements it: SYNC has identifier 0x80 and a counter of one byte (object 1019h) every communication
cycle (1006h). A synchronous PDO of transmission type n is sent at every n-th SYNC; one that still waits at the next
SYNC is dropped (synchronous window, 1007h, of a whole cycle). Events are PDOs of type 255.

Tuned: the cycle is the shortest period of the set; the identifiers of PDOs are not the predefined ones but in order of
deadlines, which CiA 301 allows; the counter's start value (SYNC start value) spreads the PDOs of long periods over
the cycles. Simplified: no NMT, heartbeats or SDOs are sent, and no second producer of SYNC takes over: that is not part
of CiA 301.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.protocols.fixed_priority import standard
from benchmarks.protocols.message_sets import frames_ns, least_busy
from benchmarks.protocols.network import ProtocolNetwork
from r2p.codecs.can_bits import OtherFrame, wire_identifier

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.protocols.outbox import MessageOutbox
    from r2p.sim.can import CanController

SYNC = 0x80
_FIRST_PDO = 0x181
_TYPE_MAX = 240


class CanOpen(ProtocolNetwork):
    """A SYNC producer of its own, and all nodes of the set."""

    title = "CANopen"
    paces = True

    def extra_nodes(self) -> list[str]:
        return ["SYNC producer"]

    def start(self) -> None:
        self.master = "SYNC producer"
        self.cycle = self.shortest()
        places = self.placed()
        self._synchronous: dict[str, list[tuple[MessageOutbox, int, int]]] = {name: [] for name in self.set.nodes}
        for rank, message in enumerate(self.set.by_deadline()):
            box = self.add_box(message, standard(_FIRST_PDO + rank))
            if message.sporadic:
                self.release_freely(box)
                continue
            kind, start = places[message.name]
            box.replaces = True
            box.track.paced, box.track.period = True, kind * self.cycle
            self._synchronous[message.node].append((box, kind, start))
        for name in self.set.nodes:
            self._follow(name)
        self._produce(self.controllers[self.master])

    def sync_identifier(self) -> int | None:
        return SYNC

    def configuration(self) -> Mapping[str, object]:
        ranks = {message.name: rank for rank, message in enumerate(self.set.by_deadline())}
        return {name: (rank, self.placed().get(name)) for name, rank in ranks.items()}

    def shortest(self) -> int:
        """Return the shortest period of the set, which is the cycle."""
        return min(each.period for each in self.set.messages if not each.sporadic)

    def placed(self) -> dict[str, tuple[int, int]]:
        """Return transmission type and start value of each periodic message; the least busy cycles first."""
        busy = [0] * _TYPE_MAX
        places = {}
        for message in self.set.by_rate():
            if message.sporadic:
                continue
            kind = max(1, min(_TYPE_MAX, message.period // self.shortest()))
            start = least_busy(busy, kind)
            for each in range(start, _TYPE_MAX, kind):
                busy[each] += frames_ns(message.size, self.set.bitrate)
            places[message.name] = kind, start
        return places

    def _follow(self, name: str) -> None:
        controller = self.controllers[name]
        objects = self._synchronous[name]

        def heard(frame: OtherFrame, _stamp: int) -> None:
            if frame.id != SYNC:
                return
            now = self.bus.timeline.now()
            counted[0] = frame.data[0] if counted[0] < 0 else counted[0] + 1  # start values count once, then SYNCs
            for box, kind, start in objects:
                if counted[0] % kind == start:
                    box.put(box.track.release(now))

        counted = [-1]
        controller.on_other = heard
        controller.filters = [(wire_identifier(OtherFrame(SYNC)), 0x7FFF_FFFF)]

    def _produce(self, producer: CanController) -> None:
        due, counter = producer.clock.monotonic() + 1_000_000, 0

        def send() -> None:
            nonlocal due, counter
            producer.request(OtherFrame(SYNC, bytes([counter])), not_before=due)
            counter = (counter + 1) % _TYPE_MAX
            due += self.cycle
            producer.call_at(due - 50_000, send)

        producer.call_at(due - 50_000, send)
