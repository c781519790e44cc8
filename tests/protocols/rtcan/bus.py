"""A CAN bus for engines, small enough to be read: true to the bit in time and arbitration, without any real clock.

Frames that are requested within one bit time of the start of frame contend, the others wait. What is reported to a
node, and when, is what its controller would.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from r2p.codecs import can_bits
from r2p.codecs.can_bits import INTERMISSION
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit, Withdraw
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Due, EngineSettings, Ready, Received
from r2p.units import NEVER

if TYPE_CHECKING:
    from r2p.codecs.rtcan import Frame

MS = 1_000_000
SECOND = 1_000_000_000
_ERROR_FRAME = 20  # bits
T = TypeVar("T")


class Node:
    """An engine with its controller and its clock, which is `offset` ns ahead of the bus and gains `ppm`.

    Its computer hands a frame over `late` ns after its time.
    """

    def __init__(self, bus: "Bus", settings: EngineSettings, *, offset: int, ppm: int, one_shot: bool) -> None:
        self.engine = Engine(settings)
        self.alive = True
        self.one_shot = one_shot
        self.boxes: dict[Mailbox, tuple[int, Transmit]] = {}
        self.actions: list[tuple[int, Action]] = []
        self.fill: Callable[[Due], bytes | None] = lambda due: None
        self.on_ready: Callable[[], Sequence[Action]] = lambda: ()
        self.deaf: Callable[[Frame], bool] = lambda frame: False
        self.late: Callable[[Frame], int] = lambda frame: 0
        self.bus = bus
        self._offset = offset
        self._ppm = ppm

    def local(self, true: int) -> int:
        return true + true * self._ppm // 1_000_000 + self._offset

    def true(self, local: int) -> int:
        true = (local - self._offset) * 1_000_000 // (1_000_000 + self._ppm)
        while self.local(true) < local:
            true += 1
        return true

    @property
    def now(self) -> int:
        return self.local(self.bus.now)

    def of(self, kind: type[T]) -> list[T]:
        return [action for _, action in self.actions if isinstance(action, kind)]

    def received(self, high: int) -> list[bytes]:
        return [each.payload for each in self.of(Received) if each.high == high]

    def act(self, actions: Sequence[Action]) -> None:
        for action in actions:
            self.actions.append((self.bus.now, action))
            match action:
                case Transmit(frame, mailbox, not_before):
                    assert mailbox not in self.boxes, "the mailbox is full"
                    ready = max(self.bus.now, self.true(not_before)) + self.late(frame)
                    self.boxes[mailbox] = (ready, action)
                case Withdraw(mailbox):
                    if mailbox in self.boxes and not self.bus.is_sending(self, mailbox):
                        self.bus.report(self, mailbox, Outcome.LATE)
                case Due(high):
                    self.act(self.engine.fill(self.now, high, self.fill(action)))
                case Ready():
                    self.act(self.on_ready())
                case _:
                    pass


class Bus:
    """Runs engines. `sent` lists what was on the bus: start of frame, frame, node; `collisions` counts the others."""

    def __init__(self, bit: int = 1000) -> None:
        self.now = 0
        self.nodes: list[Node] = []
        self.sent: list[tuple[int, Frame, Node]] = []
        self.collisions = 0
        self._bit = bit
        self._idle = 0
        self._sending: tuple[int, list[tuple[Node, Mailbox, Frame]], bool] | None = None

    def add(self, *, offset: int = 0, ppm: int = 0, one_shot: bool = True, **settings: Any) -> Node:
        settings.setdefault("number", 0x1234_5678_9ABC_DEF1 * (len(self.nodes) + 1) & (1 << 64) - 1)
        node = Node(self, EngineSettings(**settings), offset=offset, ppm=ppm, one_shot=one_shot)
        self.nodes.append(node)
        return node

    def start(self, *nodes: Node) -> None:
        for node in nodes or self.nodes:
            node.act(node.engine.start(node.now))

    def kill(self, node: Node) -> None:
        """No power any more."""
        node.alive = False
        node.boxes.clear()

    def run(self, duration: int) -> None:
        """Let `duration` ns pass."""
        end = self.now + duration
        while True:
            due = self._next()
            if due > end:
                self.now = end
                return
            self.now = max(self.now, due)
            self._step()

    def run_until(self, condition: Callable[[], bool], limit: int = 10 * SECOND) -> None:
        """Let time pass until it holds."""
        end = self.now + limit
        while not condition():
            due = self._next()
            assert due <= end, "it did not happen"
            self.now = max(self.now, due)
            self._step()

    def is_sending(self, node: Node, mailbox: Mailbox) -> bool:
        """Whether this frame is on the bus right now."""
        return self._sending is not None and any(each[:2] == (node, mailbox) for each in self._sending[1])

    def report(self, node: Node, mailbox: Mailbox, outcome: Outcome) -> None:
        del node.boxes[mailbox]
        node.act(node.engine.confirm(node.now, mailbox, outcome, node.now))

    @property
    def _live(self) -> list[Node]:
        return [node for node in self.nodes if node.alive]

    def _next(self) -> int:
        due = [node.true(at) for node in self._live if (at := node.engine.next_deadline()) is not None]
        if self._sending is not None:
            due.append(self._sending[0])
        for node in self._live:
            for mailbox, (ready, transmit) in node.boxes.items():
                if self._sending is None:
                    due.append(max(ready, self._idle))
                if transmit.not_after < NEVER and not self.is_sending(node, mailbox):
                    due.append(node.true(transmit.not_after) + 1)
        return min(due, default=NEVER)

    def _step(self) -> None:
        if self._sending is not None and self._sending[0] <= self.now:
            self._end()
            return
        for node in self._live:
            at = node.engine.next_deadline()
            if at is not None and node.true(at) <= self.now:
                node.act(node.engine.poll(node.now))
                return
        for node in self._live:
            for mailbox, (_, transmit) in list(node.boxes.items()):
                if node.local(self.now) > transmit.not_after and not self.is_sending(node, mailbox):
                    self.report(node, mailbox, Outcome.LATE)
                    return
        if self._sending is None and self.now >= self._idle:
            self._arbitrate()

    def _arbitrate(self) -> None:
        contending = [
            (transmit.frame.id, node, mailbox, transmit.frame)
            for node in self._live
            for mailbox, (ready, transmit) in node.boxes.items()
            if ready <= self.now + self._bit
        ]
        if not contending:
            return
        lowest = min(identifier for identifier, *_ in contending)
        winners = [(node, mailbox, frame) for identifier, node, mailbox, frame in contending if identifier == lowest]
        frame = winners[0][2]
        good = len({each[2].data for each in winners}) == 1 and len(self._live) > 1
        bits = can_bits.frame_bits(frame.id, frame.data) if good else 60 + _ERROR_FRAME
        self._sending = self.now + bits * self._bit, winners, good
        if good:
            self.sent.append((self.now, frame, winners[0][0]))
        else:
            self.collisions += 1
        for identifier, node, mailbox, _ in contending:
            if identifier != lowest and node.one_shot and (node, mailbox) not in [each[:2] for each in winners]:
                self.report(node, mailbox, Outcome.LOST)

    def _end(self) -> None:
        assert self._sending is not None
        _, winners, good = self._sending
        self._sending = None
        self._idle = self.now + INTERMISSION * self._bit
        for node, mailbox, _ in winners:
            if node.alive and mailbox in node.boxes:
                if good:
                    self.report(node, mailbox, Outcome.SENT)
                elif node.one_shot:
                    self.report(node, mailbox, Outcome.ERROR)
        if good:
            frame, senders = winners[0][2], [node for node, *_ in winners]
            for node in self._live:
                if node not in senders and not node.deaf(frame):
                    node.act(node.engine.receive(node.now, frame, node.now))
