"""TTCAN, level 1 (ISO 11898-4): time slots after a static matrix, in controllers that support it or in software.

As manuals of such controllers describe it (Bosch TTCAN IP, M_TTCAN): the reference message opens a basic cycle and has
the basic cycle's number; its 3 lowest bits are the priority of the time master. In an exclusive window one message is
sent once: a frame that an error destroys is not sent again, and a transmission starts within the Tx enable window (1 to
16 bit times) or not at all. In merged arbitrating windows frames contend, and are repeated as long as they still end in
the window. Bytes of the reference are after those manuals; that its retransmission updates the marks is left out.

Tuned: the basic cycle is the multiple of the shortest period that needs the least of the bus; columns are as wide as
their longest message; every free gap is an arbitrating window for events, by deadline. In hardware the mark of a window
is exact to a bit time; "in software" the same is done with interrupts, and windows are wider. The limit of 64 triggers
in a controller is not enforced. A second master is there: it sends its own reference when one is overdue.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from benchmarks.protocols.fixed_priority import FIRST_IDENTIFIER, standard
from benchmarks.protocols.message_sets import longest_bits
from benchmarks.protocols.network import ProtocolNetwork
from benchmarks.protocols.ttcan_matrix import CYCLES, SystemMatrix
from r2p.codecs.can_bits import OtherFrame, other_frame_bits
from r2p.sim.can import Latency

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.protocols.outbox import MessageOutbox
    from r2p.codecs.can_bits import AnyFrame
    from r2p.sim.can import CanController, ErrorKind

MASTERS = ("time master", "second time master")
_REFERENCE = 0x8  # its lowest 3 bits are the master's priority
_AHEAD = 30_000  # ns before its mark, a frame is handed to the controller


class Ttcan(ProtocolNetwork):
    """Two time masters, and all nodes of the set."""

    title = "TTCAN"
    paces = True
    one_shot = True
    enable_bits = 4
    guard = 2_000
    """Ns for clocks and the resolution of marks, beside the Tx enable window."""

    def extra_nodes(self) -> list[str]:
        return list(MASTERS)

    def start(self) -> None:
        self.master = MASTERS[0]
        self._enable = self.enable_bits * self.bus.bit
        matrix = self.matrix
        self._exclusive: dict[str, list[MessageOutbox]] = {name: [] for name in self.set.nodes}
        self._contending: dict[str, list[MessageOutbox]] = {name: [] for name in self.set.nodes}
        for rank, message in enumerate(self.set.by_deadline()):
            box = self.add_box(message, standard(FIRST_IDENTIFIER + rank))
            box.closes = -1
            if message.name in matrix.exclusive:
                box.single_shot, box.enable = True, self._enable
                box.track.paced, box.track.period = True, matrix.period(message.name)
                self._exclusive[message.node].append(box)
            else:
                self._contending[message.node].append(box)
                self.release_freely(box)
        for name in self.set.nodes:
            self._follow(name)
        for rank, name in enumerate(MASTERS):
            self._lead(self.controllers[name], rank)

    def latency_of(self, name: str) -> Latency:
        return Latency(0, 0)

    def sync_identifier(self) -> int | None:
        return _REFERENCE

    def configuration(self) -> Mapping[str, object]:
        ranks = {message.name: rank for rank, message in enumerate(self.set.by_deadline())}
        windows = {
            name: [(each.start, each.repeat, each.phase) for each in w] for name, w in self.matrix.exclusive.items()
        }
        return {name: (self.matrix.basic, rank, windows.get(name)) for name, rank in ranks.items()}

    @cached_property
    def matrix(self) -> SystemMatrix:
        """The matrix, which every node knows by design."""
        guard = self.guard + self.enable_bits * self.bus.bit
        return SystemMatrix(self.set, longest_bits(1) * self.bus.bit + guard, guard)

    @property
    def ahead(self) -> int:
        """Ns that the software's own latency has to be compensated for."""
        return self.latency_of("").nominal

    def resolution(self) -> int:
        """Return the unit of network time, in ns: at level 1 a bit time."""
        return self.bus.bit

    # Slaves

    def _follow(self, name: str) -> None:
        controller = self.controllers[name]

        def heard(frame: OtherFrame, stamp: int) -> None:
            if frame.id & ~7 == _REFERENCE:
                begin = stamp - self.ahead - other_frame_bits(frame) * self.bus.bit
                begin = -(-begin // self.resolution()) * self.resolution()
                self._basic_cycle(name, begin, frame.data[0] & CYCLES - 1)

        controller.on_other = heard
        controller.filters = [(_REFERENCE, 0x7FFF_FFF8)]

    def _basic_cycle(self, name: str, begin: int, count: int) -> None:
        """Set up what this node does until the next reference."""
        controller = self.controllers[name]
        for box in self._exclusive[name]:
            for window in self.matrix.exclusive[box.message.name]:
                if window.in_cycle(count):
                    mark = begin + window.start + self.guard // 2
                    at = max(mark - _AHEAD, controller.clock.monotonic())
                    controller.call_at(at, self._fire, box, mark, begin + window.end)
        contending = self._contending[name]
        for start, end in self.matrix.open[count] if contending else ():
            opens, closes = begin + start + self.guard // 2, begin + end - self.guard // 2
            controller.call_at(max(opens - _AHEAD, controller.clock.monotonic()), self._open, contending, opens, closes)

    def _fire(self, box: MessageOutbox, mark: int, end: int) -> None:
        """Send in an exclusive window, a value of this very moment."""
        box.clear()
        box.opens, box.closes = mark, end
        box.put(box.track.release(box.controller.clock.true(mark)))

    def _open(self, boxes: list[MessageOutbox], opens: int, closes: int) -> None:
        for box in boxes:
            box.open(opens, closes)

    # Masters

    def _lead(self, master: CanController, rank: int) -> None:
        """Send references; the second master only if none came, half a reference later than its own would be due."""
        basic, frame = self.matrix.basic, longest_bits(1) * self.bus.bit
        state = {"due": master.clock.monotonic() + 1_000_000, "count": 0, "current": rank == 0, "plan": 0}

        def plan() -> None:
            state["plan"] += 1
            late = 0 if state["current"] else 2 * frame
            master.call_at(state["due"] + late - _AHEAD, send, state["plan"])

        def send(number: int) -> None:
            if number != state["plan"]:
                return
            state["current"] = True
            reference = OtherFrame(_REFERENCE | rank, bytes([state["count"] % CYCLES]))
            late = max(state["due"], master.clock.monotonic())
            master.request(reference, not_before=late)
            state["due"], state["count"] = state["due"] + basic, state["count"] + 1
            plan()

        def heard(reference: OtherFrame, stamp: int) -> None:
            if reference.id & ~7 == _REFERENCE and (reference.id & 7) < rank:
                state["current"] = False
                state["due"] = stamp - self.ahead - other_frame_bits(reference) * self.bus.bit + basic
                state["count"] = reference.data[0] + 1
                plan()

        def again(reference: AnyFrame, _kind: ErrorKind, _stamp: int) -> None:
            """Repeat a reference that an error destroyed, at once: for it alone, automatic retransmission is on."""
            state["due"] = master.clock.monotonic() + basic
            master.request(reference)
            plan()

        master.on_other = heard
        master.on_error = again
        master.filters = [(_REFERENCE, 0x7FFF_FFF8)]
        plan()


class SoftwareTtcan(Ttcan):
    """The same with ordinary controllers: stamps and starts have the latencies of interrupts."""

    title = "TTCAN in software"
    enable_bits = 16
    guard = 5_000

    def latency_of(self, name: str) -> Latency:
        return Latency(self.setup.latency, self.setup.jitter)

    def resolution(self) -> int:
        return 1
