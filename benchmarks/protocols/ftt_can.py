"""FTT-CAN: elementary cycles, each opened by a trigger message of the master that says who sends in it.

Almeida, Pedreiras, Fonseca, "The FTT-CAN protocol: why and how" (IEEE Trans. Industrial Electronics 49(6), 2002) and
section 4.2.4 of the thesis: the trigger opens the cycle; first comes the asynchronous window, in which events contend
by their identifiers, at its end the synchronous window, whose messages the trigger names and which contend there. An
asynchronous frame starts only if its longest form ends before the synchronous window. The layout of the trigger and the
scheduler are after general descriptions: one flag for each message, and rate-monotonic with balanced offsets.

Tuned: the cycle is the shortest period of the set; the trigger is as short as its flags allow; nodes know all lengths,
so it does not carry the length of the window. Synchronous messages that do not fit go into the asynchronous window.
Simplified: nodes decode the trigger in `TURNAROUND`, and a frame that an error destroyed is sent again within its
window. No second master: replicas are described elsewhere.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from benchmarks.protocols.fixed_priority import FIRST_IDENTIFIER, standard
from benchmarks.protocols.message_sets import frames_ns, least_busy, longest_bits
from benchmarks.protocols.network import ProtocolNetwork
from r2p.codecs.can_bits import FRAME_MAX, OtherFrame, other_frame_bits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from benchmarks.protocols.message_sets import SetMessage
    from benchmarks.protocols.outbox import MessageOutbox
    from r2p.sim.can import CanController

TRIGGER = 1
_FLAGS_MAX = 64
TURNAROUND = 20_000
"""Ns from the end of the trigger until a node has read it; papers of 2002 have more, with 8-bit controllers."""
GUARD = 20_000
"""Ns for the jitter of both ends of a window: twice the three latencies that make it, and the clocks."""


class FttCan(ProtocolNetwork):
    """A master of its own, and all nodes of the set."""

    title = "FTT-CAN"
    paces = True

    def extra_nodes(self) -> list[str]:
        return ["FTT master"]

    def start(self) -> None:
        self.master = "FTT master"
        self.cycle = self.elementary_cycle()
        self.flagged = self.placed()
        self._flags = {name: number for number, name in enumerate(self.flagged)}
        self._lengths = [self._length(self.tracks[name].message) for name in self.flagged]
        for rank, message in enumerate(self.set.by_deadline()):
            box = self.add_box(message, standard(FIRST_IDENTIFIER + rank))
            box.closes = -1
            if message.name in self.flagged:
                box.replaces = True
                box.track.paced, box.track.period = True, self.flagged[message.name][0] * self.cycle
            else:
                self.release_freely(box)
        for name in self.set.nodes:
            self._follow(name)
        self._lead(self.controllers[self.master])

    def sync_identifier(self) -> int | None:
        return TRIGGER

    def configuration(self) -> Mapping[str, object]:
        # A node knows its own identifier and flag; periods and offsets are the master's business.
        ranks = {message.name: rank for rank, message in enumerate(self.set.by_deadline())}
        return dict(ranks)

    def elementary_cycle(self) -> int:
        """Return the shortest period of the set."""
        return min(each.period for each in self.set.messages if not each.sporadic)

    def placed(self) -> dict[str, tuple[int, int]]:
        """Return period and offset, in cycles, of the synchronous messages; the least busy cycles first."""
        cycle = self.elementary_cycle()
        room = cycle - self._trigger_ns() - TURNAROUND - 2 * GUARD - self._longest_event()
        busy = [0] * 240
        places: dict[str, tuple[int, int]] = {}
        for message in self.set.by_rate():
            every = max(1, message.period // cycle) if not message.sporadic else 0
            if not every or len(places) == _FLAGS_MAX:
                continue
            offset = least_busy(busy, every)
            length = self._length(message)
            if max(busy[offset::every]) + length > room:
                continue
            for each in range(offset, 240, every):
                busy[each] += length
            places[message.name] = every, offset
        return places

    def _length(self, message: SetMessage) -> int:
        return frames_ns(message.size, self.set.bitrate)

    def _trigger_ns(self) -> int:
        periodic = sum(not each.sporadic for each in self.set.messages)
        return longest_bits(-(-min(periodic, _FLAGS_MAX) // 8)) * self.bus.bit

    def _longest_event(self) -> int:
        """Return the longest frame of an event: one has to fit in each cycle."""
        sizes = [min(each.size, FRAME_MAX) for each in self.set.messages if each.sporadic]
        return longest_bits(max(sizes, default=FRAME_MAX)) * self.bus.bit

    # Slaves

    def _follow(self, name: str) -> None:
        controller = self.controllers[name]
        boxes = self.boxes[name]

        def heard(frame: OtherFrame, stamp: int) -> None:
            if frame.id != TRIGGER:
                return
            end = stamp - self.setup.latency
            begin = end - other_frame_bits(frame) * self.bus.bit
            flags = int.from_bytes(frame.data, "little")
            window = sum(length for number, length in enumerate(self._lengths) if flags >> number & 1)
            closes = begin + self.cycle - GUARD // 2
            opens = closes - window - GUARD // 2  # the first frame may be late by the jitter
            for box in boxes:
                self._open(box, flags, (max(end + TURNAROUND, stamp), opens, closes))

        controller.on_other = heard
        controller.filters = [(TRIGGER, 0x7FFF_FFFF)]

    def _open(self, box: MessageOutbox, flags: int, window: tuple[int, int, int]) -> None:
        """`window`: when the asynchronous window begins, when the synchronous one begins, and when that ends."""
        begins, opens, closes = window
        number = self._flags.get(box.message.name)
        if number is None:
            box.open(begins, opens - GUARD // 2)
        elif flags >> number & 1:
            box.clear()  # what an error has kept from the last window
            box.opens, box.closes = opens, closes
            box.put(box.track.release(box.controller.clock.true(opens)))

    # The master

    def _lead(self, master: CanController) -> None:
        due, count = master.clock.monotonic() + 1_000_000, 0

        def send() -> None:
            nonlocal due, count
            flags = sum(1 << self._flags[name] for name in self._scheduled(count))
            size = -(-len(self.flagged) // 8)
            master.request(OtherFrame(TRIGGER, flags.to_bytes(size, "little")), not_before=due)
            due, count = due + self.cycle, count + 1
            master.call_at(due - 50_000, send)

        master.call_at(due - 50_000, send)

    def _scheduled(self, count: int) -> list[str]:
        """Return the messages of this cycle."""
        return [name for name, (every, offset) in self.flagged.items() if count % every == offset]
