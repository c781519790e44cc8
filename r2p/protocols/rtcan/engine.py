"""RTCAN as one state machine (PROTOCOL.md 6 to 9): frames and time go in, frames, messages and news come out.

It does no I/O and reads no clock; the same code runs on the simulated bus, on SocketCAN and in a unit test. What a
transport has to do to drive it:

1. Make it from `EngineSettings`; `number` must be 64 random bits. Call `start` when the bus works, `stop` when not.
2. Every call takes `now`, the node's monotonic clock in ns, and gives back what to do, in order. After every call, set
   one timer to `next_deadline()` and call `poll` then. In slots, "then" is the start of a slot less
   `transmit_latency`: whoever comes late enough misses it.
3. `Transmit`: put the frame into that mailbox, so that its start of frame is not before `not_before`, and not after
   `not_after`: by then a frame that has not started is aborted. Mailboxes hold one frame and never get a second one.
   `Withdraw`: abort it if it has not started. For each `Transmit` call `confirm` exactly once, with what became of
   the frame and when it was over: SENT when its own frame was seen on the bus; LOST in arbitration, on a one-shot
   controller only; LATE when aborted, or not handed over in time; ERROR when given up after a bus error; UNKNOWN when
   no news came, and it may have been sent. One-shot controllers give every try a fresh laxity. On others the laxity is
   that of the hand-over, until the frame is sent or aborted: say so in `guarantees`.
4. `receive` every frame of others, never the own ones, with the instant (by the same clock) of the reception interrupt,
   that is the end of the frame plus `receive_latency`. Sync frames must not wait behind a long queue. `filters` says
   which frames are needed; it changes with `Ready`, `IdConflict`, and subscriptions.
5. After `Ready`, and not before, `publish`, `manage`, `reserve` and let discovery speak. `topics.HighBytes` picks the
   high byte of a topic; its message id is `message_id(high, engine.id8)` and goes into the SUBSCRIBE_RESPONSE.
   `IdConflict` with `yielded` takes all that back until the next `Ready`, possibly with another id8.
6. Answer each `Due` with `fill`, before the slot.

Without a master, or while it refuses slots, periodic messages go as soft real-time ones with their period as deadline.
"""

from collections import Counter
from collections.abc import Hashable, Sequence

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import MessageError
from r2p.protocols.rtcan.core import Core
from r2p.protocols.rtcan.cycle import Timing
from r2p.protocols.rtcan.events import NEVER, Action, Done, EngineSettings, Fate, Mailbox, Outcome, Profile
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.node_id import Stage
from r2p.protocols.rtcan.plan import PeriodicMessage
from r2p.protocols.rtcan.queue import QueuedMessage

_NOTHING: tuple[Action, ...] = ()
_LISTENING = Stage.LISTENING  # Python 3.11 takes its time to find a member of an enum
_NOT_SYNC = ~(0xFF << 7)


class Engine:
    """One node's RTCAN. Raises ValueError for settings that can't work.

    Instants are ns of the node's monotonic clock. Topics are named by the high byte of their message id.
    """

    def __init__(self, settings: EngineSettings) -> None:
        self._core = Core(settings)
        self._out = self._core.out
        self._sender = self._core.sender
        self._reassembly = self._core.reassembly
        self._identity = self._core.identity
        self._timers = self._core.timers
        self._pacer = self._core.pacer
        self._latency = settings.receive_latency
        self._running = False

    # What is known

    @property
    def id8(self) -> int | None:
        """Our id8; None: not yet, or not any more."""
        return self._identity.id8 if self.ready else None

    @property
    def ready(self) -> bool:
        """Whether messages can be sent."""
        return self._running and self._core.joined

    @property
    def profile(self) -> Profile:
        return self._core.profile

    @property
    def role(self) -> Role:
        return self._core.election.role

    @property
    def master(self) -> int | None:
        """The master's id8."""
        return self._core.network.master

    @property
    def epoch(self) -> int | None:
        """Which run of the network this is; cycles are counted through it."""
        return self._core.network.epoch

    @property
    def timing(self) -> Timing:
        return self._core.timing

    @property
    def counts(self) -> Counter[str]:
        """What went wrong here, by kind."""
        return self._core.counts

    @property
    def losses(self) -> dict[int, Counter[str]]:
        """What was lost on the way here, by id8 of the source and reason."""
        return self._reassembly.losses

    @property
    def silenced(self) -> str | None:
        """Why the node sends nothing: the network has other parameters."""
        return self._core.network.silenced

    @property
    def cycle(self) -> int | None:
        """The counter of the current cycle; without NETWORK only its low 8 bits mean something."""
        return self._core.cycle.counter if self._core.cycle.running else None

    @property
    def mask(self) -> int | None:
        """The reserved slots of the current cycle."""
        return self._core.cycle.mask

    @property
    def waiting(self) -> int:
        """Messages that wait to be sent, and management that waits for silence."""
        return len(self._core.queue) + len(self._pacer)

    @property
    def full(self) -> bool:
        """Whether `publish` would refuse."""
        return self._core.queue.full

    def network_time(self, now: int) -> int | None:
        """The time that all nodes of the network share (ns). None: not known."""
        return self._core.cycle.network_time(now)

    def utc(self, now: int) -> tuple[int, int] | None:
        """UTC by the master, and how far off it may be (both ns). None: not known."""
        time, network = self.network_time(now), self._core.network
        if time is None or network.utc_error == management.NO_UTC:
            return None
        return time + network.utc_offset, network.utc_error * 1000

    def set_utc(self, now: int, utc: int, error: int) -> None:
        """This node knows UTC (ns, and its error in ns): as the master it tells the others."""
        time = self.network_time(now)
        if time is not None and self.role is Role.MASTER:
            self._core.network.utc_offset = utc - time
            self._core.network.utc_error = min(-(-error // 1000), management.NO_UTC - 1)

    def filters(self) -> list[tuple[int, int]]:
        """Which frames are needed: those with `id & mask == identifier` of one of these (identifier, mask)."""
        if not self.ready:
            return [(0, 0)]
        high, low = 0xFF << 15, 0xFF << 7
        fixed = [(0, high), (rtcan.MANAGEMENT << 15, high), (self._identity.id8 << 7, low)]
        topics = [message for message in self._reassembly.messages if message >> 8 > rtcan.MANAGEMENT]
        return fixed + [(message << 7, rtcan.MESSAGE_MASK) for message in topics]

    # The bus

    def start(self, now: int) -> Sequence[Action]:
        """The bus can be used: listen, then join."""
        self._running = True
        self._identity.start(now)
        return self._take()

    def stop(self, now: int) -> Sequence[Action]:
        """The bus can't be used any more, or the node leaves: everything that waits is discarded."""
        self._running = False
        self._identity.stop(now)
        self._core.network.stop(now)
        self._sender.reset()
        self._reassembly.reset()
        return self._take()

    def receive(self, now: int, frame: Frame, stamp: int) -> Sequence[Action]:
        """A frame of another node came in; `stamp` is the instant of its reception interrupt."""
        core, identifier = self._core, frame.id
        if not identifier & _NOT_SYNC and core.is_sync(identifier):
            if len(frame.data) != rtcan.FRAME_MAX:
                self.counts["undecodable"] += 1
            elif self._running and core.profile is not Profile.FIRMWARE:
                core.network.sync(now, frame, stamp)
                core.settle(now)
            return self._take()
        if identifier >> 7 & 0xFF == self._identity.id8:
            core.duplicate_id_seen(now, identifier)
        if self._identity.stage is _LISTENING:
            core.listen(identifier)
        high = identifier >> 15 & 0xFF
        if high > rtcan.MANAGEMENT:
            received = self._reassembly.receive(frame, stamp - self._latency)
            if not self._out:
                return _NOTHING if received is None else (received,)
            if received is not None:
                self._out.append(received)
        elif self._running:
            core.low(now, frame, stamp - self._latency)
        return self._take() if self._out else _NOTHING

    def confirm(self, now: int, mailbox: Mailbox, outcome: Outcome, at: int) -> Sequence[Action]:
        """What became of a frame that was to be transmitted, and when it was over (for SENT: its end)."""
        self._sender.confirm(now, mailbox, outcome, at)
        return self._take() if self._out else _NOTHING

    def next_deadline(self) -> int | None:
        """When to call `poll`; an instant in the past means at once."""
        if not self._running:
            return None
        due = self._sender.due
        if self._timers.due < due:
            due = self._timers.due
        if self._reassembly.open and (given_up := self._reassembly.due) < due:
            due = given_up
        if self._pacer.waiting and (quiet := self._pacer.due) < due:
            due = quiet
        return due if due < NEVER else None

    def poll(self, now: int) -> Sequence[Action]:
        """What the time brings."""
        core = self._core
        if not self._running:
            return _NOTHING
        if self._timers.due <= now:
            for key in self._timers.pop(now):
                core.expired(now, key)
                core.settle(now)
        if self._sender.due <= now:
            self._sender.poll(now)
        if self._reassembly.open:
            self._reassembly.poll(now)
        if self._pacer.waiting:
            core.pace(now)
        return self._take()

    # Messages

    def publish(
        self, now: int, high: int, payload: bytes, *, deadline: int = NEVER, drop: bool = True, handle: Hashable = None
    ) -> Sequence[Action]:
        """Send a message: soft real-time with the instant `deadline`, non real-time without.

        When it is overdue it is dropped, or (not `drop`) sent with laxity 1. `Done` tells what became of it, if there
        is a `handle`. Raises `MessageError` beyond 1..1024 bytes, and for high bytes that are not a topic's.
        """
        _check(high)
        message = QueuedMessage(self._core.message_id(high), payload, deadline, drop and deadline != NEVER, handle)
        if not self.ready:
            rtcan.fragment_count(len(payload))
            self._refuse(now, message, Fate.DISCARDED)
        else:
            self._send(now, message)
        return self._take()

    def manage(self, now: int, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> Sequence[Action]:
        """Send a management message of 32 bytes, within 50 ms, or 1 ms and before all others if `urgent`.

        `Done` tells what became of it, if there is a `handle` and the node may send.
        """
        if self.ready:
            self._core.manage(now, data, urgent=urgent, handle=handle)
        return self._take()

    def subscribe(self, message: int, size: int) -> None:
        """Take the messages with this id, of `size` bytes each. Raises `MessageError` beyond 1..1024."""
        self._reassembly.subscribe(message, size)

    def unsubscribe(self, message: int) -> None:
        """Take no more of them."""
        self._reassembly.unsubscribe(message)

    # Periodic messages

    def reserve(
        self, now: int, high: int, size: int, interval: int, *, lead: int = 0, handle: Hashable = None
    ) -> Sequence[Action]:
        """Send a message of `size` bytes every `interval` ns, in slots of its own if the master grants them.

        `Due` asks for the data, `lead` ns before the slot. Raises `MessageError` for a size that RTCAN can't carry.
        """
        core = self._core
        _check(high)
        fragments = rtcan.fragment_count(size)
        self._end(now, high)
        message = core.message_id(high) if self.ready else 0
        periodic = core.periodics[high] = PeriodicMessage(high, message, size, fragments, interval, lead, handle)
        self._sender.add(periodic)
        if self.ready:
            core.wishes.want(now, periodic)
            core.tick(now, periodic)
        return self._take()

    def fill(self, now: int, high: int, payload: bytes | None) -> Sequence[Action]:
        """The data that `Due` asked for; None: nothing this time. Raises `ValueError` when the size is another one."""
        periodic = self._core.periodics.get(high)
        if periodic is None or not self.ready:
            return self._take()
        if payload is not None and len(payload) != periodic.size:
            raise ValueError(f"{len(payload)} bytes for a periodic message of {periodic.size}")
        if not periodic.ticked:
            self._sender.fill(now, periodic, payload)
        elif payload is not None:
            deadline = now + periodic.interval
            self._send(now, QueuedMessage(periodic.message, payload, deadline, handle=periodic.handle))
        periodic.ticked = False
        return self._take()

    def release(self, now: int, high: int) -> Sequence[Action]:
        """End a periodic message; its slots come free."""
        self._end(now, high)
        return self._take()

    # Inside

    def _take(self) -> Sequence[Action]:
        if not self._out:
            return _NOTHING
        actions = self._out[:]
        self._out.clear()
        return actions

    def _send(self, now: int, message: QueuedMessage) -> None:
        if self._core.queue.put(message):
            self._sender.reschedule(now)
        else:
            self._refuse(now, message, Fate.FULL)

    def _refuse(self, now: int, message: QueuedMessage, fate: Fate) -> None:
        missed = message.deadline != NEVER
        self.counts[fate.value] += 1
        if message.handle is not None:
            self._out.append(Done(message.handle, fate, missed, now))

    def _end(self, now: int, high: int) -> None:
        core = self._core
        periodic = core.periodics.pop(high, None)
        if periodic is None:
            return
        if periodic.payload is not None:
            self._sender.abandon(now, periodic, "slots given back")
        self._sender.remove(periodic)
        core.timers.clear(("tick", high))
        if core.wishes.forget(periodic) and self.ready:
            if self.role is Role.MASTER:
                core.grants.remove(periodic.message)
            else:
                core.say(now, management.Release(periodic.message))


def _check(high: int) -> None:
    if not rtcan.FIRST_TOPIC <= high <= 0xFF:
        raise MessageError(f"high byte {high}: those of topics are {rtcan.FIRST_TOPIC} to 255")
