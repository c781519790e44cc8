"""Timers of which the next one is known at no cost: it is asked for after every frame, and seldom changes."""

from collections import Counter
from collections.abc import Hashable, Iterator

from r2p.codecs import management, rtcan
from r2p.codecs.rtcan import Frame
from r2p.errors import DecodeError
from r2p.protocols.rtcan.cycle import Cycle, timing
from r2p.protocols.rtcan.events import NEVER, Action, Done, Due, EngineSettings, Fate, Profile, Ready, Received
from r2p.protocols.rtcan.leases import SlotGrants, SlotRequests
from r2p.protocols.rtcan.management import ManagementHandlers
from r2p.protocols.rtcan.master import Election, Role
from r2p.protocols.rtcan.network import Detector, NetworkMembership, RateLimiter
from r2p.protocols.rtcan.node_id import Identity, Stage
from r2p.protocols.rtcan.plan import PeriodicMessage, SlotPlan
from r2p.protocols.rtcan.queue import LaxityQueue, QueuedMessage
from r2p.protocols.rtcan.reassembly import Reassembly
from r2p.protocols.rtcan.transmitter import Mailboxes, Mode, SlotTransmitter
from r2p.protocols.timers import KeyedTimers


class Timers(KeyedTimers):
    """As `KeyedTimers`, and remembers when the next key runs out."""

    def __init__(self) -> None:
        super().__init__()
        self.due = NEVER
        """When the next key runs out; NEVER if there is none."""

    def set(self, key: Hashable, due: int) -> None:
        super().set(key, due)
        self._look()

    def clear(self, key: Hashable) -> None:
        super().clear(key)
        self._look()

    def pop(self, now: int) -> Iterator[Hashable]:
        for key in super().pop(now):
            self._look()
            yield key

    def _look(self) -> None:
        due = self.next()
        self.due = NEVER if due is None else due


# The parts of an engine put together, and what passes between them: management messages, timers, changes of mode.


_DEADLINE = 50_000_000  # of management, ns
_CONTROL = 10_000_000  # of what keeps the network: slots must not wait for all that discovery has to say
_URGENT = 1_000_000
_DEPTH = 128  # management messages that wait
_PAUSE = 500_000  # ns after a bus error, before the same topic is tried again
_PAUSE_SPREAD = 8_000_000
# Python 3.11 takes its time to find a member of an enum.
_FIRMWARE, _ELECTING, _LISTENING = Profile.FIRMWARE, Role.ELECTING, Stage.LISTENING
_SILENT, _FREE, _SLOTTED = Mode.SILENT, Mode.FREE, Mode.SLOTTED


class Core:
    """All parts of one node. Its owner takes `out` after every call."""

    def __init__(self, settings: EngineSettings) -> None:
        if settings.id8 is not None and not 0 < settings.id8 < 256:
            raise ValueError(f"id8 {settings.id8}: it is a byte, and not 0")
        self.settings = settings
        self.counts: Counter[str] = Counter()
        self.out: list[Action] = []
        self.periodics: dict[int, PeriodicMessage] = {}
        self.joined = False
        """Whether messages may be sent: the node has an id8, and knows how the network works."""
        self._management_ends = False  # the next frame of firmware's management is the last one of a message
        self.timing = timing(settings.slots, settings.cycle, settings.bit_rate)
        self.timers = Timers()
        self.reassembly = Reassembly()
        self.detector = Detector(settings.profile)
        self.queue = LaxityQueue(settings.capacity, _DEPTH)
        self.cycle = Cycle(self.timing, settings.receive_latency)
        self.agenda = SlotPlan(self.timing)
        self.election = Election(settings.priority, 3 * self.timing.cycle, self.timers)
        self.grants = SlotGrants(self.cycle, self.timers)
        self._assemble(settings)

    def _assemble(self, settings: EngineSettings) -> None:
        """The parts that work with others."""
        counts, out, timers, cycle = self.counts, self.out, self.timers, self.cycle
        self.identity = Identity(
            settings.id8, settings.number, settings.listen, timers, out, counts, self._announce, self._stage_changed
        )
        self.pacer = RateLimiter(self.identity.draw, counts)
        self.post = Mailboxes(self.queue, out, counts, self._pause)
        latency, coarse = settings.transmit_latency, settings.coarse
        self.sender = SlotTransmitter(
            cycle, self.queue, self.agenda, self.post, out, counts, self._turn, latency=latency, coarse=coarse
        )
        self.wishes = SlotRequests(
            cycle,
            self.agenda,
            timers,
            self.periodics,
            out,
            self._ask,
            self._slots_lost,
            enabled=settings.reserves,
        )
        parts = self.identity, self.election, self.grants, self.wishes
        self.network = NetworkMembership(cycle, self.sender, *parts, timers, out, counts, self.say, settings.priority)
        self.answers = ManagementHandlers(*parts, self.network, self.periodics, self.say, self.tick)

    @property
    def profile(self) -> Profile:
        return self.detector.profile

    def message_id(self, high: int) -> int:
        return rtcan.message_id(high, self.identity.id8)

    def settle(self, now: int) -> None:
        """Use the bus as the state of things allows."""
        electing, held = self.election.role is _ELECTING, self.queue.only is not None
        self.queue.only = self.message_id(rtcan.MANAGEMENT) if electing else None
        if self.identity.stage is _LISTENING or self.network.silenced is not None:
            mode = _SILENT
        elif not self.cycle.running:
            mode = _FREE
        else:
            mode = _SLOTTED if self.network.verified else _SILENT
        self.sender.enter(now, mode)
        if not self.joined and self.identity.stage is Stage.OWNING and self.network.settled:
            self._join(now)
        if held and not electing:
            self.sender.reschedule(now)

    def discard(self, now: int) -> None:
        """Give up everything that waits to be sent."""
        handles = self.pacer.clear() + [message.handle for message in self.post.discard()]
        self.out += [Done(each, Fate.DISCARDED, missed=True, at=now) for each in handles if each is not None]
        for periodic in self.periodics.values():
            self.wishes.lapse(now, periodic, "the node may not send")
            self.timers.clear(("tick", periodic.high))

    # Management

    def say(self, now: int, message: management.Management) -> None:
        """Send a management message of our own."""
        data = management.encode(message)
        if self.profile is _FIRMWARE:
            self.manage(now, data)
        else:
            self._queue_management(now, self.message_id(rtcan.MANAGEMENT), data, None, _CONTROL)

    def manage(self, now: int, data: bytes, *, urgent: bool = False, handle: Hashable = None) -> None:
        """Send a management message; before the others, if it is urgent."""
        if self.profile is not _FIRMWARE:
            within = _URGENT if urgent else _DEADLINE
            self._queue_management(now, self.message_id(rtcan.MANAGEMENT), data, handle, within)
            return
        dropped = self.pacer.put(data, urgent=urgent, handle=handle)
        self.post.report(dropped, Fate.FULL, missed=False, at=now)

    def pace(self, now: int) -> None:
        """Among firmware: send management if it is quiet."""
        due = self.pacer.pop(now)
        if due is not None:
            self._queue_management(now, rtcan.FIRMWARE_MANAGEMENT, *due, _DEADLINE)

    def is_sync(self, identifier: int) -> bool:
        """Whether a frame is a sync that has the identifier of one.

        When firmware has no time left it sends laxity 0: then the last frame of its management has the identifier of
        the sync of cycle 0, and in a network of firmware a topic may have that of another one.
        """
        message = identifier >> 7
        if self.detector.profile is _FIRMWARE:
            return message != rtcan.FIRMWARE_MANAGEMENT and not self.reassembly.subscribed(message)
        return not (self._management_ends and message == rtcan.FIRMWARE_MANAGEMENT)

    def listen(self, identifier: int) -> None:
        """What any frame tells while we only listen."""
        message = identifier >> 7 & 0xFFFF
        if rtcan.high_byte(message) == rtcan.SYNC:
            self.detector.firmware_heard()
        if message != rtcan.FIRMWARE_MANAGEMENT:
            self.identity.seen(rtcan.id8_of(message))

    def duplicate_id_seen(self, now: int, identifier: int) -> None:
        """A frame with our id8 that is not ours."""
        if identifier >> 7 & 0xFFFF != rtcan.FIRMWARE_MANAGEMENT:
            self.identity.duplicate_id_seen(now)
            self.settle(now)

    def low(self, now: int, frame: Frame, stamp: int) -> None:
        """A frame of management, or in a network of firmware one of a topic whose high byte is as low as that."""
        message = frame.id >> 7 & 0xFFFF
        high = message >> 8
        firmware = self.detector.profile is _FIRMWARE
        if high <= rtcan.MANAGEMENT:
            self.pacer.traffic(now)
        if high == rtcan.SYNC and not firmware:
            self.counts["management of firmware"] += 1
            self._management_ends = message == rtcan.FIRMWARE_MANAGEMENT and frame.id & rtcan.LEFT_MASK == 1
        ours = message == rtcan.FIRMWARE_MANAGEMENT if firmware else high == rtcan.MANAGEMENT
        if ours:
            self.reassembly.subscribe(message, management.SIZE)
        received = self.reassembly.receive(frame, stamp)
        if received is not None and ours:
            self.hear(now, received)
        elif received is not None:
            self.out.append(received)

    def hear(self, now: int, received: Received) -> None:
        """A management message came in: ours to handle, or discovery's."""
        if management.type_of(received.payload) not in management.RTCAN_TYPES:
            self.out.append(received)
            return
        try:
            message = management.decode(received.payload)
        except DecodeError:
            self.counts["undecodable"] += 1
            return
        if self.answers.take(now, message, received.source):
            self.settle(now)

    # Timers

    def expired(self, now: int, key: Hashable) -> None:
        """A timer ran out."""
        match key:
            case "listened":
                self.detector.decide(synced=self.cycle.running)
                self.identity.listened(now)
            case "claim":
                self.identity.repeat(now)
            case "election":
                self.network.decide(now)
            case "network":
                self.network.tell(now)
            case "renew":
                self.wishes.renew(now)
            case "silence":
                self.network.unsilence(now)
            case ("granted", int(message)):
                self.grants.remove(message)
            case (str(kind), int(high)) if high in self.periodics:
                self._periodic_timer(now, kind, self.periodics[high])

    def tick(self, now: int, periodic: PeriodicMessage) -> None:
        """Without slots the node's own clock says when a periodic message is due."""
        if not periodic.active and self.joined and ("tick", periodic.high) not in self.timers:
            self.timers.set(("tick", periodic.high), now)

    def _periodic_timer(self, now: int, kind: str, periodic: PeriodicMessage) -> None:
        if kind == "ask":
            self.wishes.request(now, periodic)
        elif kind == "lease":
            self.wishes.suspend(now, periodic, "the master does not answer")
            self.wishes.want(now, periodic)
            self.tick(now, periodic)
        elif not periodic.active or self.cycle.counter < periodic.from_cycle:
            at = now if periodic.tick is None else now - (now - periodic.tick) % periodic.interval
            periodic.tick = at + periodic.interval
            periodic.ticked = True
            self.timers.set(("tick", periodic.high), periodic.tick)
            self.out.append(Due(periodic.high, at, False))

    # What the parts need of each other

    def _turn(self, now: int) -> None:
        self.network.turn(now)
        self.settle(now)

    def _slots_lost(self, now: int, periodic: PeriodicMessage) -> None:
        self.sender.abandon(now, periodic, "slots lost")

    def _pause(self) -> int:
        return _PAUSE + self.identity.draw(_PAUSE_SPREAD)

    def _announce(self, now: int) -> None:
        flags = self.identity.flags | (management.CLAIM_ELECTING if self.network.master is None else 0)
        self.say(now, management.Claim(self.identity.id8, self.identity.number, self.settings.priority, flags))

    def _stage_changed(self, now: int) -> None:
        stage = self.identity.stage
        if stage is _LISTENING:
            self.joined = False
            self.detector.start()
            self.discard(now)
            self.network.resign(now)
        elif stage is Stage.OWNING:
            for periodic in self.periodics.values():
                periodic.message = self.message_id(periodic.high)
            if self.profile is not _FIRMWARE:
                self.network.owned(now)
        self.settle(now)

    def _join(self, now: int) -> None:
        """Whose network it is has been found out: messages may be sent."""
        self.joined = True
        self.out.append(Ready(self.identity.id8, self.profile))
        for periodic in self.periodics.values():
            self.wishes.want(now, periodic)
            self.tick(now, periodic)

    def _queue_management(self, now: int, message: int, data: bytes, handle: Hashable, within: int) -> None:
        outgoing = QueuedMessage(message, data, now + within, drop=False, handle=handle)
        if self.queue.put(outgoing, urgent=within < _DEADLINE, management=True):
            self.sender.reschedule(now)
        else:
            self.counts["management dropped"] += 1
            self.post.report(handle, Fate.FULL, missed=False, at=now)

    def _ask(self, now: int, wanted: management.Reserve | management.Renew) -> None:
        self.answers.ask(now, wanted)
