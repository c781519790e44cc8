"""RTCAN as one state machine (PROTOCOL.md 6 to 9): frames and time go in; frames, messages and events come out.

It does no I/O and reads no clock; the same code runs on the simulated bus, on SocketCAN and in unit tests. To drive it,
a transport does this:

1. Make it from `EngineSettings`; `number` must be 64 random bits. Call `start` when the bus works, `stop` when not.
2. Every call takes `now`, the node's monotonic clock in ns, and returns the actions to carry out, in order. After every
   call, set one timer to `next_deadline()` and call `poll` then. In slots, "then" is the start of a slot less
   `transmit_latency`: a call that is late enough misses the slot.
3. `Transmit`: put the frame into that mailbox, so that its start of frame is not before `not_before`, and not after
   `not_after`: by then a frame that has not started is aborted. Mailboxes hold one frame and never get a second one.
   `Withdraw`: abort it if it has not started. For each `Transmit` call `confirm` exactly once, with its outcome and its
   end: SENT when its own frame was seen on the bus; LOST in arbitration, on a one-shot controller only; LATE when
   aborted, or not handed over in time; ERROR when given up after a bus error; UNKNOWN when there was no confirmation,
   and it may have been sent. One-shot controllers give every try a fresh laxity. On others the laxity is that of the
   hand-over, until the frame is sent or aborted: say so in `guarantees`.
4. `receive` every frame of others, never the own ones, with the instant (by the same clock) of the reception interrupt,
   that is the end of the frame plus `receive_latency`. Sync frames must not wait behind a long queue. `filters` says
   which frames are needed; it changes with `Ready`, `IdConflict`, and subscriptions.
5. After `Ready`, and not before, `publish`, `manage`, `reserve`, and start discovery. `TopicIdAllocator` picks the
   high byte of a topic; its message id is `message_id(high, engine.id8)` and goes into the SUBSCRIBE_RESPONSE.
   `IdConflict` with `yielded` takes all that back until the next `Ready`, possibly with another id8.
6. Answer each `Due` with `fill`, before the slot.

Until the master grants slots, and while it refuses them, `Due` comes by the node's own clock (not `slotted`), and data
then go as a soft real-time message with the period as deadline. After `SlotsLost` there may be no `Due` until the next
`SlotsGranted`. An owner with a clock of its own, as links have, fills None when not `slotted`, and calls `publish`.
"""

from collections.abc import Hashable, Sequence

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import HIGH_MAX, HIGH_SHIFT, ID8_MAX, MANAGEMENT, MESSAGE_MAX, MESSAGE_SHIFT, NOT_SYNC, Frame
from r2p.errors import DecodeError, MessageError
from r2p.protocols.can_orders import Mailbox, Outcome
from r2p.protocols.rtcan.events import Action, Done, EngineContext, EngineSettings, Fate, Profile, Ready, Received
from r2p.protocols.rtcan.leases import PeriodicMessage, SlotGrants, SlotRequests
from r2p.protocols.rtcan.management import ManagementHandlers, ManagementSender
from r2p.protocols.rtcan.master import Role
from r2p.protocols.rtcan.network import Detector, NetworkMembership
from r2p.protocols.rtcan.node_id import NodeId, Stage
from r2p.protocols.rtcan.queue import QueuedMessage
from r2p.protocols.rtcan.reassembly import Reassembly
from r2p.protocols.rtcan.transmitter import Mode, SlotTransmitter
from r2p.units import NEVER, SECOND

_NOTHING: tuple[Action, ...] = ()
# Python 3.11 is slow to find a member of an enum.
_FIRMWARE, _RTCAN, _ELECTING, _LISTENING = Profile.FIRMWARE, Profile.RTCAN, Role.ELECTING, Stage.LISTENING
_SILENT, _FREE, _SLOTTED = Mode


class Engine:
    """One node's RTCAN. Raises ValueError for settings that can't work.

    Instants are ns of the node's monotonic clock. Topics are named by the high byte of their message id.
    """

    def __init__(self, settings: EngineSettings) -> None:
        if settings.id8 is not None and not 0 < settings.id8 <= ID8_MAX:
            raise ValueError(f"id8 {settings.id8}: use 1 to 255")
        self.settings = settings
        context = EngineContext(settings)
        self.timing = context.timing
        self.cycle = context.cycle
        self.counts = context.counts
        """Counts of what went wrong here, by kind."""
        self.reassembly = Reassembly()
        self.detector = Detector(settings.profile)
        self.node_id = NodeId(context, self._send_claim, self._on_stage)
        self.transmitter = SlotTransmitter(context, self._next_cycle)
        self.periodics = self.transmitter.plan.periodics
        """The periodic messages of this node by high byte."""
        self.management = ManagementSender(context, self.node_id, self.detector, self.transmitter)
        self.grants = SlotGrants(context)
        self.requests = SlotRequests(context, self.transmitter.plan, self._ask, self.transmitter.abandon)
        self.network = NetworkMembership(
            context, self.transmitter, self.node_id, self.grants, self.requests, self.management.send
        )
        self.election = self.network.election
        self._handlers = ManagementHandlers(self.network, self.grants, self.requests, self.management.send)
        self._context = context
        self._actions = context.actions
        self._timers = context.timers
        self._limiter = self.management.limiter
        self._latency = settings.receive_latency
        self._running = False
        self._joined = False  # the node has an id8, and knows how the network works: messages may be sent
        self._management_ends = False  # the next frame of firmware's management is the last one of a message

    # State

    @property
    def id8(self) -> int | None:
        """The id8 of this node; None while it has none."""
        return self.node_id.id8 if self.ready else None

    @property
    def ready(self) -> bool:
        """Return whether messages can be sent."""
        return self._running and self._joined

    @property
    def profile(self) -> Profile:
        """The network's profile, as far as it is known."""
        return self.detector.profile

    @property
    def waiting(self) -> int:
        """The number of waiting messages, and of management messages that wait for silence."""
        return self.transmitter.queue.size + len(self._limiter.waiting)

    @property
    def management_waiting(self) -> int:
        """The number of waiting management messages."""
        return self.transmitter.queue.count(rtcan.message_id(rtcan.MANAGEMENT, self.id8 or 0))

    def network_time(self, now: int) -> int | None:
        """Return the time that all nodes of the network share (ns); None while unknown."""
        return self.cycle.network_time(now)

    def utc(self, now: int) -> tuple[int, int] | None:
        """Return UTC by the master, and its possible error (both ns); None while unknown."""
        time, network = self.network_time(now), self.network
        if time is None or network.utc_error == management.NO_UTC:
            return None
        return time + network.utc_offset, network.utc_error * 1000

    def set_utc(self, now: int, utc: int, error: int) -> None:
        """Set UTC and its error (both ns), which this node distributes while it is the master."""
        time = self.network_time(now)
        if time is not None and self.election.role is Role.MASTER:
            self.network.utc_offset = utc - time
            self.network.utc_error = min(-(-error // 1000), management.NO_UTC - 1)

    def set_discovery_rate(self, rate: float) -> None:
        """Set how many messages of discovery a second this node may send before others that are overdue."""
        self.transmitter.queue.starved_apart = round(SECOND / rate)

    def report_syncs(self, wanted: bool) -> None:
        """Return a `SyncSeen` for each sync from now on, or no longer."""
        self._context.report_syncs = wanted

    def filters(self) -> list[tuple[int, int]]:
        """Return the frames to receive: those with `id & mask == identifier` for one of these (identifier, mask)."""
        if not self.ready:
            return [(0, 0)]
        fixed = [rtcan.high_filter(rtcan.SYNC), rtcan.high_filter(MANAGEMENT), rtcan.id8_filter(self.node_id.id8)]
        topics = [each for each in self.reassembly.messages if rtcan.high_byte(each) > MANAGEMENT]
        return fixed + [rtcan.message_filter(each) for each in topics]

    # The bus and time

    def start(self, now: int) -> Sequence[Action]:
        """Listen, then join: the bus can be used."""
        self._running = True
        self.node_id.start(now)
        return self._drain()

    def stop(self, now: int) -> Sequence[Action]:
        """Stop, as the bus can no longer be used, or the node leaves. Waiting messages are discarded."""
        self._running = False
        self.node_id.stop(now)  # first: messages are discarded, and a master steps down, before the cycle stops
        self.network.stop(now)
        self.transmitter.reset()
        self.reassembly.reset()
        return self._drain()

    def receive(self, now: int, frame: Frame, stamp: int) -> Sequence[Action]:
        """Receive a frame of another node; `stamp` is the instant of its reception interrupt."""
        identifier = frame.id
        # The codec's functions are inlined: most frames of a busy bus are for others, and only need these lines.
        if not identifier & NOT_SYNC and self._is_sync(identifier):
            self._on_sync(now, frame, stamp)
            return self._drain()
        if identifier >> MESSAGE_SHIFT & ID8_MAX == self.node_id.id8:
            self._on_own_id8(now, identifier)
        if self.node_id.stage is _LISTENING:
            self._learn(identifier)
        high = identifier >> HIGH_SHIFT & HIGH_MAX
        if high > MANAGEMENT:
            received = self.reassembly.receive(frame, stamp - self._latency)
            if not self._actions:
                return _NOTHING if received is None else (received,)
            if received is not None:
                self._actions.append(received)
        elif self._running:
            self._on_low(now, frame, high, stamp - self._latency)
        return self._drain() if self._actions else _NOTHING

    def confirm(self, now: int, mailbox: Mailbox, outcome: Outcome, at: int) -> Sequence[Action]:
        """Note the outcome of a frame to transmit, and its time (for SENT: the end of the frame)."""
        self.transmitter.confirm(now, mailbox, outcome, at)
        return self._drain() if self._actions else _NOTHING

    def next_deadline(self) -> int | None:
        """Return when to call `poll`; an instant in the past means at once."""
        if not self._running:
            return None
        # No `min` over all parts: this is called after each frame.
        due = self.transmitter.due
        if self._timers.due < due:
            due = self._timers.due
        if self.reassembly.open and (given_up := self.reassembly.due) < due:
            due = given_up
        if self._limiter.waiting and (quiet := self._limiter.due) < due:
            due = quiet
        return due if due < NEVER else None

    def poll(self, now: int) -> Sequence[Action]:
        """Carry out due work."""
        if not self._running:
            return _NOTHING
        # Timers go first: a lease that is over must not send in the slot that begins now.
        if self._timers.due <= now:
            for key in self._timers.pop(now):
                self._expired(now, key)
                self._update_mode(now)
        if self.transmitter.due <= now:
            self.transmitter.poll(now)
        if self.reassembly.open:
            self.reassembly.poll(now)
        if self._limiter.waiting:
            self.management.poll(now)
        return self._drain()

    # Messages

    def publish(
        self, now: int, high: int, payload: bytes, *, deadline: int = NEVER, drop: bool = True, handle: Hashable = None
    ) -> Sequence[Action]:
        """Send a message: soft real-time with the instant `deadline`, non real-time without.

        An overdue message is dropped, or (not `drop`) sent with laxity 1. `Done` reports its fate, if there is a
        `handle`. Raises `MessageError` beyond 1..1024 bytes, and for high bytes that are not a topic's.
        """
        _check_topic(high)
        message = QueuedMessage(self._message_id(high), payload, deadline, drop and deadline != NEVER, handle)
        if not self.ready:
            rtcan.fragment_count(len(payload))  # raises for what could never be sent
            self._reject(now, message, Fate.DISCARDED)
        else:
            self._enqueue(now, message)
        return self._drain()

    def manage(self, now: int, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> Sequence[Action]:
        """Send a management message of 32 bytes, within 50 ms, or 1 ms and before all others if `urgent`.

        `Done` reports its fate, if there is a `handle` and the node may send.
        """
        if self.ready:
            self.management.send_bytes(now, data, urgent=urgent, handle=handle)
        return self._drain()

    def subscribe(self, message: int, size: int, *, varies: bool = False) -> None:
        """Receive the messages with this id, of `size` bytes each. Raises `MessageError` beyond 1..1024.

        If their length `varies`, they have a header (`rtcan.encode_variable`), and `size` is a bound without it: 0 says
        that all are empty.
        """
        self.reassembly.subscribe(message, size, varies=varies)

    def unsubscribe(self, message: int) -> None:
        """Stop receiving messages with this id."""
        self.reassembly.unsubscribe(message)

    # Periodic messages

    def reserve(
        self,
        now: int,
        high: int,
        size: int,
        interval: int,
        *,
        lead: int = 0,
        varies: bool = False,
        handle: Hashable = None,
    ) -> Sequence[Action]:
        """Send a message of `size` bytes every `interval` ns, in slots of its own if the master grants them.

        If its length `varies`, it has at most so many, header included, and slots for all of them. `Due` asks for the
        data, `lead` ns before the slot. Raises `MessageError` for a size that RTCAN can't carry.
        """
        _check_topic(high)
        fragments = rtcan.fragment_count(size)
        self._end_periodic(now, high)
        message = self._message_id(high) if self.ready else 0
        periodic = self.periodics[high] = PeriodicMessage(
            high, message, size, fragments, interval, lead, handle, varies
        )
        if self.ready:
            self.requests.start(now, periodic)
        return self._drain()

    def fill(self, now: int, high: int, payload: bytes | None) -> Sequence[Action]:
        """Give the data for a `Due`; None: nothing this time. Raises `ValueError` for data of another size."""
        periodic = self.periodics.get(high)
        if periodic is None or not self.ready:
            return self._drain()
        if payload is not None and not periodic.takes(len(payload)):
            raise ValueError(f"{len(payload)} bytes for a periodic message of {periodic.size}")
        if not periodic.ticked:
            self.transmitter.fill(now, periodic, payload)
        elif payload is not None:
            deadline = now + periodic.interval
            self._enqueue(now, QueuedMessage(periodic.message, payload, deadline, handle=periodic.handle))
        periodic.ticked = False
        return self._drain()

    def release(self, now: int, high: int) -> Sequence[Action]:
        """End a periodic message, and free its slots."""
        self._end_periodic(now, high)
        return self._drain()

    # May the node send?

    def _update_mode(self, now: int) -> None:
        """Decide whether and how the node may send, by its id8, its network and the cycle.

        Three gates are set here: the transmitter's mode; `queue.only`, which holds all but management back during an
        election; and `_joined`, without which `ready` is False and `publish`, `manage`, `reserve` and `fill` send
        nothing.
        Called after each sync, timer, change of the id8, and management message of the bus.
        """
        # During an election only management may go, so that the first sync meets a quiet bus.
        electing, held = self.election.role is _ELECTING, self.transmitter.queue.only is not None
        self.transmitter.queue.only = self._message_id(MANAGEMENT) if electing else None
        if self.node_id.stage is _LISTENING or self.network.mismatch is not None:
            mode = _SILENT
        elif not self.cycle.running:
            mode = _FREE
        else:
            mode = _SLOTTED if self.network.verified else _SILENT
        self.transmitter.set_mode(now, mode)
        if not self._joined and self.node_id.stage is Stage.OWNING and self.network.decided:
            self._join(now)
        if held and not electing:
            self.transmitter.reschedule(now)  # the mode may be the same, and other messages may go now

    def _join(self, now: int) -> None:
        self._joined = True
        self._actions.append(Ready(self.node_id.id8, self.profile))
        for periodic in self.periodics.values():
            self.requests.start(now, periodic)

    def _on_stage(self, now: int) -> None:
        """Adapt to the new stage of the id8: lost, claimed or owned."""
        stage = self.node_id.stage
        if stage is _LISTENING:
            self._joined = False
            self.detector.start()
            self._discard(now)
            self.network.on_id_lost(now)
        elif stage is Stage.OWNING:
            for periodic in self.periodics.values():
                periodic.message = self._message_id(periodic.high)
            if self.profile is not _FIRMWARE:  # which has neither master nor slots
                self.network.on_id_owned(now)
        self._update_mode(now)

    def _discard(self, now: int) -> None:
        """Give up all waiting messages."""
        handles = self._limiter.clear() + [message.handle for message in self.transmitter.mailboxes.discard()]
        self._actions += [Done(each, Fate.DISCARDED, missed=True, at=now) for each in handles if each is not None]
        self.requests.revoke_all(now, "the node may not send")
        for high in self.periodics:
            self._timers.clear(("tick", high))

    def _send_claim(self, now: int) -> None:
        electing = management.CLAIM_ELECTING if self.network.master is None else 0
        id8, number, flags = self.node_id.id8, self.node_id.number, self.node_id.flags | electing
        self.management.send(now, management.Claim(id8, number, self.settings.priority, flags))

    # Frames

    def _is_sync(self, identifier: int) -> bool:
        """Return whether a frame with the identifier of a sync is one.

        Firmware sends overdue messages with laxity 0: then the last frame of its management has the identifier of the
        sync of cycle 0, and in a network of firmware a topic may have that of another sync.
        """
        message = rtcan.message_of(identifier)
        if self.profile is _FIRMWARE:
            return message != rtcan.FIRMWARE_MANAGEMENT and not self.reassembly.subscribed(message)
        return not (self._management_ends and message == rtcan.FIRMWARE_MANAGEMENT)

    def _on_sync(self, now: int, frame: Frame, stamp: int) -> None:
        if len(frame.data) != rtcan.FRAME_MAX:
            self.counts["undecodable"] += 1
        elif self._running and self.profile is not _FIRMWARE:
            self.network.on_sync(now, frame, stamp)
            self._update_mode(now)

    def _on_own_id8(self, now: int, identifier: int) -> None:
        """Handle a frame of another node that has this node's id8."""
        if rtcan.message_of(identifier) != rtcan.FIRMWARE_MANAGEMENT:
            self.node_id.duplicate_id_seen(now)
            self._update_mode(now)

    def _learn(self, identifier: int) -> None:
        """Learn, while the node listens, from any frame which id8 is taken, and whether there is firmware."""
        message = rtcan.message_of(identifier)
        if rtcan.high_byte(message) == rtcan.SYNC:
            self.detector.firmware_seen()
        if message != rtcan.FIRMWARE_MANAGEMENT:
            self.node_id.mark_taken(rtcan.id8_of(message))

    def _on_low(self, now: int, frame: Frame, high: int, stamp: int) -> None:
        """Handle a frame of management, or among firmware one of a topic whose high byte is as low as that."""
        message, profile = frame.id >> MESSAGE_SHIFT & MESSAGE_MAX, self.detector.profile
        firmware = profile is _FIRMWARE
        if profile is not _RTCAN:  # there nothing waits for silence
            self._limiter.on_traffic(now)
        if high == rtcan.SYNC and not firmware:
            self.counts["management of firmware"] += 1
            # The last frame, of which 0 are left, will look like a sync if its laxity is 0 as well.
            self._management_ends = message == rtcan.FIRMWARE_MANAGEMENT and frame.id & rtcan.LEFT_MASK == 1
        ours = message == rtcan.FIRMWARE_MANAGEMENT if firmware else high == MANAGEMENT
        if ours:  # of each sender by itself: they interleave, and none is known before
            self.reassembly.subscribe(message, management.SIZE, packed=not firmware)
        received = self.reassembly.receive(frame, stamp)
        if received is not None and ours:
            self._on_management(now, received)
        elif received is not None:
            self._actions.append(received)

    def _on_management(self, now: int, received: Received) -> None:
        """Handle a management message of the RTCAN bus itself; discovery's leave the engine."""
        if management.type_of(received.payload) not in management.RTCAN_TYPES:
            self._actions.append(received)
            return
        try:
            message = management.decode(received.payload)
        except DecodeError:
            self.counts["undecodable"] += 1
            return
        self._handlers.handle(now, message, received.source)
        self._update_mode(now)

    # Timers and periodic messages

    def _expired(self, now: int, key: Hashable) -> None:
        match key:
            case "listened":
                self.detector.decide(synced=self.cycle.running)
                self.node_id.on_listened(now)
            case "claim":
                self.node_id.on_claim_timer(now)
            case "election":
                self.network.decide_election(now)
            case "network":
                self.network.send_network(now)
            case "renew":
                self.requests.renew(now)
            case "silence":
                self.network.forget_mismatch(now)
            case ("granted", int(message)):
                self.grants.remove(message)
            case (str(kind), int(high)) if high in self.periodics:
                self.requests.on_timer(now, kind, self.periodics[high])

    def _end_periodic(self, now: int, high: int) -> None:
        periodic = self.periodics.pop(high, None)
        if periodic is None:
            return
        if periodic.payload is not None:
            self.transmitter.abandon(now, periodic, "slots given back")
        self.transmitter.forget(periodic)
        if self.requests.forget(periodic) and self.ready:
            if self.election.role is Role.MASTER:
                self.grants.remove(periodic.message)
            else:
                self.management.send(now, management.Release(periodic.message))

    def _ask(self, now: int, wanted: management.Reserve | management.Renew) -> None:
        self._handlers.ask(now, wanted)

    def _next_cycle(self, now: int) -> None:
        self.network.next_cycle(now)
        self._update_mode(now)

    # Messages out, actions out

    def _message_id(self, high: int) -> int:
        return rtcan.message_id(high, self.node_id.id8)

    def _enqueue(self, now: int, message: QueuedMessage) -> None:
        if self.transmitter.queue.put(message):
            self.transmitter.reschedule(now)
        else:
            self._reject(now, message, Fate.FULL)

    def _reject(self, now: int, message: QueuedMessage, fate: Fate) -> None:
        self.counts[fate.value] += 1
        if message.handle is not None:  # not `report`: a message that was never queued does not count as missed
            self._actions.append(Done(message.handle, fate, message.deadline != NEVER, now))

    def _drain(self) -> Sequence[Action]:
        if not self._actions:
            return _NOTHING
        actions = self._actions[:]  # the parts keep the list itself
        self._actions.clear()
        return actions


def _check_topic(high: int) -> None:
    if not rtcan.FIRST_TOPIC <= high <= HIGH_MAX:
        raise MessageError(f"high byte {high}: topics have {rtcan.FIRST_TOPIC} to {HIGH_MAX}")
