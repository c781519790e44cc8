"""The values that pass between an RTCAN engine and its owner, besides frames: settings in, actions out. All are frozen.
The parts of an engine put their actions into the `EngineContext` that they share.

An action is an order to the CAN port (`Transmit`, `Withdraw`), a message, or an event of the node and its network.
Instants are ns of the node's own monotonic clock. A message id is 16 bits: high byte the topic, low byte the id8.
"""

import enum
from collections import Counter
from collections.abc import Hashable

import msgspec

from r2p.codecs import rtcan
from r2p.codecs.can_bits import start_of_frame
from r2p.codecs.rtcan import MESSAGE_MAX, MESSAGE_SHIFT, Frame
from r2p.protocols.can_orders import Mailbox, Transmit, Withdraw
from r2p.protocols.rtcan.calendar import PeriodRule
from r2p.protocols.rtcan.cycle import Cycle, timing
from r2p.protocols.timers import KeyedTimers
from r2p.units import LONG_AGO, SECOND

_FOREIGN = 10  # syncs; of two masters that meet, the lesser one sends up to three
_REPORT_APART = 10 * SECOND  # between two `ForeignSyncs`


class Profile(enum.Enum):
    """The ways in which a network's modules use the bus (PROTOCOL.md 9)."""

    AUTO = "auto"
    RTCAN = "rtcan"
    FIRMWARE = "firmware-2014"  # no sync; management of all modules on one message id


class EngineSettings(msgspec.Struct, frozen=True, kw_only=True):
    """One node on one bus. Times in ns.

    - `number`: 64 random bits. `id8`: 1..255, None: claim a free one. `priority`: in the election, 0: never the master.
    - `slots`, `cycle` (nominal), `bit_rate` must be the same in the whole network.
    - `listen`: the time before anything is sent. `receive_latency`: from the end of a frame to its stamp.
      `transmit_latency`: from the hand-over of a frame to its start. `coarse`: the port can't hit a slot; so a frame
      may start anywhere in a run of free slots.
    - `periods`: as the master, which periods go together.
    - `reserves`: ask for slots for periodic messages. `capacity`: messages in the queue.
    """

    number: int
    id8: int | None = None
    priority: int = 0
    profile: Profile = Profile.AUTO
    slots: int = 60
    cycle: int = 10_000_000
    bit_rate: int = 1_000_000
    listen: int = 1_200_000_000
    receive_latency: int = 0
    transmit_latency: int = 0
    coarse: bool = False
    periods: PeriodRule = PeriodRule.COMMON_FACTORS
    reserves: bool = True
    capacity: int = 256


# Messages


class Fate(enum.Enum):
    """The fate of a message."""

    SENT = "sent"
    UNKNOWN = "unknown"  # sent, but not every frame was confirmed
    OVERDUE = "overdue"  # dropped: its deadline passed before its first frame
    FULL = "no room"  # rejected: the queue is full
    FAILED = "bus errors"  # given up
    DISCARDED = "discarded"  # the node may not send, or stopped
    REPLACED = "newer data in a slot"  # its topic got slots while it waited
    ABANDONED = "slot missed"  # a frame of a hard real-time message missed its slot


class Received(msgspec.Struct, frozen=True, gc=False):
    """A complete message. `identifier` is its first frame's, `stamp` the end of that frame.

    `header` was in front of the payload, if the length of the topic's messages varies.
    """

    identifier: int
    payload: bytes
    stamp: int
    header: bytes = b""

    @property
    def message(self) -> int:
        return self.identifier >> MESSAGE_SHIFT & MESSAGE_MAX  # inlined: it is asked for each message

    @property
    def high(self) -> int:
        """The message id: the topic at that module."""
        return rtcan.high_byte(self.message)

    @property
    def source(self) -> int:
        """The sender's id8; 0 for management of firmware of 2014, which has none."""
        return rtcan.id8_of(self.message)

    @property
    def laxity(self) -> int:
        return rtcan.laxity_of(self.identifier)

    @property
    def mailbox(self) -> Mailbox:
        """The sender's mailbox, which is the message's class."""
        laxity = self.laxity
        return Mailbox.HRT if laxity == rtcan.HRT else Mailbox.NRT if laxity == rtcan.NRT else Mailbox.SRT

    def started(self, bit: int) -> int:
        """Return the start of the first frame, exact to the stuff bits; `bit` is the bit time (ns). Takes 5 us."""
        first = (self.header + self.payload)[: rtcan.FRAME_MAX]
        return start_of_frame(Frame(self.identifier, first), self.stamp, bit)


class Done(msgspec.Struct, frozen=True, gc=False):
    """A published message was sent, or given up. `missed`: not (surely) on the bus by its deadline."""

    handle: Hashable
    fate: Fate
    missed: bool
    at: int


class Due(msgspec.Struct, frozen=True, gc=False):
    """Time for the data of a periodic message: call `Engine.fill`. `at` is its slot's start, or the tick's instant."""

    high: int
    at: int
    slotted: bool


# Events of the node and its network


class Ready(msgspec.Struct, frozen=True):
    """The node has an id8 and may send; message ids with a former id8 are void."""

    id8: int
    profile: Profile


class IdConflict(msgspec.Struct, frozen=True):
    """Another node uses this node's id8. `yielded`: this node gives it up, and sends nothing until the next `Ready`."""

    id8: int
    yielded: bool


class NewMaster(msgspec.Struct, frozen=True):
    """A node is the master from now on. `id8` None: firmware, or not known yet."""

    id8: int | None
    epoch: int
    own: bool


class LostSync(msgspec.Struct, frozen=True):
    """The cycle is lost: periodic messages go as soft real-time ones."""

    reason: str


class ParameterMismatch(msgspec.Struct, frozen=True):
    """The network's parameters differ from this node's: nothing is sent."""

    reason: str


class ParametersMatch(msgspec.Struct, frozen=True):
    """The network's parameters are this node's after all."""


class ForeignSyncs(msgspec.Struct, frozen=True):
    """Another node sends syncs, beside the master's or in their place: a broken one, which nothing identifies."""

    reason: str


class SyncSeen(msgspec.Struct, frozen=True):
    """The sync of cycle `counter` was received, or was sent by this node. Only while `EngineContext.report_syncs`.

    `start` is the beginning of the cycle, `end` the end of the frame, both by the node's clock; `length` the frame's
    exact length, the same for all nodes (ns). `end` 0: this node is the master, and no other node has seen its sync.
    """

    counter: int
    start: int
    end: int
    length: int


class SlotsGranted(msgspec.Struct, frozen=True):
    """A periodic message owns slots. `period`, `phase` in slots; `interval` is the true period in ns."""

    high: int
    period: int
    phase: int
    interval: int


class SlotsRefused(msgspec.Struct, frozen=True):
    """The master has no slots for a periodic message; it goes as a soft real-time one. The request is repeated."""

    high: int
    reason: str


class SlotsLost(msgspec.Struct, frozen=True):
    """A periodic message lost its slots, and goes as a soft real-time one."""

    high: int
    reason: str


PortAction = Transmit | Withdraw
NetworkEvent = Ready | IdConflict | NewMaster | LostSync | ParameterMismatch | ParametersMatch | ForeignSyncs | SyncSeen
SlotEvent = SlotsGranted | SlotsRefused | SlotsLost
Action = PortAction | Received | Done | Due | NetworkEvent | SlotEvent


# Inside an engine


class SyncCheck:
    """Reports syncs of another node, from so many within a second on as two masters that meet never send."""

    def __init__(self, actions: "list[Action]") -> None:
        self._actions = actions
        self._since = self._reported_at = LONG_AGO
        self._foreign = 0

    def on_foreign(self, now: int) -> None:
        """Note a sync off the grid, of another count, or of another node while this one is the master."""
        if now >= self._since + SECOND:
            self._since, self._foreign = now, 0
        self._foreign += 1
        if self._foreign == _FOREIGN:
            self._report(now, f"{_FOREIGN} within a second are not the master's")

    def on_unreserved(self, now: int, syncs: int) -> None:
        """Note that so many syncs in a row lack slots of this node, which it had."""
        self._report(now, f"{syncs} in a row lack slots of this module, which now counts them as lost")

    def _report(self, now: int, reason: str) -> None:
        if now >= self._reported_at + _REPORT_APART:
            self._reported_at = now
            self._actions.append(ForeignSyncs(reason))


class EngineContext:
    """State shared by the parts of one engine. Raises ValueError for slots that are too short."""

    def __init__(self, settings: EngineSettings) -> None:
        self.settings = settings
        self.timing = timing(settings.slots, settings.cycle, settings.bit_rate)
        self.cycle = Cycle(self.timing, settings.receive_latency)
        self.timers = KeyedTimers()
        self.actions: list[Action] = []
        """Actions for the owner of the engine, in order."""
        self.counts: Counter[str] = Counter()
        self.sync_check = SyncCheck(self.actions)
        self.report_syncs = False
        """True while the owner wants a `SyncSeen` for each sync."""
        self._draws = 0

    def draw(self, below: int) -> int:
        """Return a random number below this one. All derive from `settings.number`, so that a run can be repeated."""
        self._draws += 1
        return _mix(self.settings.number + self._draws) % below

    def report_sync(self, frame: Frame, end: int) -> None:
        """Report this cycle's sync, on the bus until `end` (0: it was not), before anything else that it causes."""
        cycle = self.cycle
        length = end - start_of_frame(frame, end, self.timing.bit)
        self.actions.insert(0, SyncSeen(cycle.counter, cycle.reference, end, length))

    def report(self, handle: Hashable, fate: Fate, *, missed: bool, at: int) -> None:
        """Report a message that was sent or given up, if it has a handle; count a missed one."""
        if missed:
            self.counts["missed"] += 1
        if handle is not None:
            self.actions.append(Done(handle, fate, missed, at))


def _mix(number: int) -> int:
    """Splitmix64: numbers that look random, from consecutive ones."""
    number = (number * 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    number = ((number ^ number >> 30) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    number = ((number ^ number >> 27) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return number ^ number >> 31
