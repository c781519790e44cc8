"""Worst-case response times of events on RTCAN, in the free slots between the reserved ones.

In each free slot every node tries its message of the least laxity, in whole milliseconds, and the least of all wins.
So a message waits in whole slots, and what was sent before it in a slot counts, not how long those frames were.
`docs/how-to/analyze.md` derives the bounds; in short:

- **In any order**: as long as anything waits, each free slot carries a frame. So a message is through when the busy
  period is over, whatever the order.
- **By laxity**: laxity is the time to the deadline in whole milliseconds. While a message of the deadline d waits, only
  messages with deadlines before d + Q win a slot, Q = 1 ms; in its last millisecond, where the laxity is 1 at least,
  before d + 2 Q. Counted are all that can arrive in time with such deadlines, over all instants at which the message
  may arrive in a busy period, as Spuri does for EDF; and before it arrives, those that tie with them.

The order holds if nodes begin to send within one bit of each other; otherwise the bound in any order is the one.
"""

import math
from collections.abc import Container, Iterable, Mapping, Sequence

import msgspec

from r2p.analysis.messages import BusMessage, MessageClass, Urgency
from r2p.analysis.priority import Breakdown, ResponseBound
from r2p.analysis.slots import SlotSupply
from r2p.codecs import management
from r2p.codecs.rtcan import SRT_MAX
from r2p.protocols.rtcan.management import CONTROL_DEADLINE, DEADLINE
from r2p.protocols.rtcan.queue import DISCOVERY
from r2p.units import MILLISECOND, SECOND

_CLAMPED = SRT_MAX * MILLISECOND
"""From this time to the deadline on, all messages have the same laxity."""
_STEPS = 256  # at most, in which the arrivals within a busy period are looked at
_FULL = 256  # steps from an idle to a full bus in the search for the breakdown
_BUSY_MAX = 1000  # longest periods, from where on no bound is found


class EventModel(msgspec.Struct, frozen=True):
    """How nodes send events. `latency`: from a node's decision to the start of its frame at most, with jitter (ns).

    `ordered`: nodes begin to send within one bit of each other, so that the laxity decides. `frame_slots`: the free
    slots that each frame takes: 2 if a node may not know by the next slot that its frame was sent.
    """

    latency: int = 0
    ordered: bool = True
    frame_slots: int = 1


PROMPT = EventModel()
"""Nodes without latency, or with one that is over before the next slot, on clocks that agree."""


def event_bounds(messages: Sequence[BusMessage], supply: SlotSupply, model: EventModel = PROMPT) -> list[ResponseBound]:
    """Return the worst case of all soft and non real-time messages, from publishing to the last bit, in their order.

    Bus errors and lost syncs are not counted. Messages of one topic go one after the other.
    """
    return _Events(messages, supply, model).bounds()


def management_load(control: Mapping[str, float], other: float = 0.0) -> list[BusMessage]:
    """Return the management of nodes as messages of a set, of which all of a second may come at once.

    `control`: by node, the messages a second that keep slots and the network, with a deadline of 10 ms. `other`: those
    of discovery and services of each node, with 50 ms; a control message may have to wait for one of them that has
    started, and is as urgent as those that wait behind it. `control_rates` has the rates of RTCAN itself; `r2p bus
    load` shows what a live bus carries, in frames, of which a message has four.
    """
    size, urgency = (management.SIZE * 2, Urgency.LENT) if other else (management.SIZE, Urgency.OWN)
    found = [
        _burst(f"control of {node}", node, size, CONTROL_DEADLINE, rate, urgency) for node, rate in control.items()
    ]
    if other:
        found += [
            _burst(f"management of {node}", node, management.SIZE, DEADLINE, other, Urgency.EASED) for node in control
        ]
    return found


def control_rates(nodes: Iterable[str], owners: Container[str], master: str = "") -> dict[str, float]:
    """Return how many control messages a second nodes send: claims, and the renewals of those that own slots.

    The master also sends NETWORK, and an answer for each renewal. `master` "": it may be any node, and is one more.
    """
    rates = {node: 1.0 + (node in owners) for node in nodes}
    lead = 1.0 + sum(node in owners for node in rates)
    return rates | {master or "the master": rates.get(master, 0.0) + lead}


def _burst(name: str, node: str, size: int, deadline: int, rate: float, urgency: Urgency) -> BusMessage:
    period = round(SECOND / rate)
    return BusMessage(
        name=name,
        node=node,
        size=size,
        period=period,
        jitter=(math.ceil(rate) - 1) * period,
        deadline=deadline,
        message_class=MessageClass.SRT,
        urgency=urgency,
    )


class _Load(msgspec.Struct, eq=False):
    """What a message takes of the free slots: `slots` at most each `period`.

    `busy`: its bound in any order; `bound`: by laxity, as far as it is found.
    """

    message: BusMessage
    slots: int
    period: int
    jitter: int
    deadline: int
    busy: int | None = None
    bound: int | None = None

    def within(self, time: int) -> int:
        """Return the slots of all instances that arrive within a time."""
        return -(-(time + self.jitter) // self.period) * self.slots if time > 0 else 0


class _Rival(msgspec.Struct, frozen=True):
    """Another message, with the instants at which those of its instances arrive that matter (ns).

    Those from `since` to `until` win against the message. Those from `tied_since` to `tied_until` may win a slot before
    it arrives, or in its last millisecond.
    """

    load: _Load
    since: int
    until: int
    tied_since: int
    tied_until: int


class _Events:
    def __init__(self, messages: Sequence[BusMessage], supply: SlotSupply, model: EventModel) -> None:
        self._supply = supply
        self._latency = model.latency
        self._ordered = model.ordered
        self._bit = supply.timing.bit
        self._quantum = MILLISECOND + model.latency
        self._messages = [each for each in messages if each.message_class in {MessageClass.SRT, MessageClass.NRT}]
        self._loads = [
            _Load(each, each.frames * model.frame_slots, each.period, each.jitter, each.deadline or each.period)
            for each in self._messages
            if each.period
        ]
        self._limit = _BUSY_MAX * max((each.period for each in self._loads), default=0)

    def bounds(self) -> list[ResponseBound]:
        """Return the bound of each message."""
        real_time = self._in_any_order()
        if self._ordered and all(each.busy is not None for each in real_time):
            self._order(real_time)
        return self._found()

    def late(self, messages: int) -> bool:
        """Return whether one of so many messages, the first ones, may be late."""
        real_time = self._in_any_order()
        if not any(each.misses for each in self._found()[:messages]):
            return False
        if not self._ordered or any(each.busy is None for each in real_time):
            return True
        self._order(real_time, [each for each in real_time if each.message in self._messages[:messages]])
        return any(each.misses for each in self._found()[:messages])

    def _found(self) -> list[ResponseBound]:
        known = iter(self._loads)
        return [ResponseBound(each, next(known).bound if each.period else None) for each in self._messages]

    def _in_any_order(self) -> list[_Load]:
        """Set the bounds in any order, and return the real-time messages."""
        real_time = [each for each in self._loads if each.message.message_class is not MessageClass.NRT]
        unknown = {each.message_class for each in self._messages if not each.period}
        every = None if unknown else self._busy_slots(self._loads)
        ahead = self._busy_slots(real_time) if self._ordered and unknown <= {MessageClass.NRT} else every
        for load in self._loads:
            slots = every if load.message.message_class is MessageClass.NRT else ahead
            load.busy = load.bound = None if slots is None else self._end(load, slots)
        return real_time

    def _end(self, load: _Load, slots: int) -> int | None:
        """Return when the last frame of a message ends at the latest, if it is in the `slots`-th free slot.

        Counted from the decision about a slot that began just before.
        """
        wait = self._supply.wait(slots)
        return None if wait is None else wait + self._latency + load.message.longest * self._bit

    def _decided(self, slots: int) -> int:
        """Return until when messages arrive that may win the `slots`-th free slot."""
        return (self._supply.wait(slots) or 0) + self._latency + self._bit

    # In any order

    def _busy_slots(self, loads: list[_Load]) -> int | None:
        """Return how many slots pass until nothing waits."""
        if not self._supply.free:
            return None
        slots = sum(each.within(1) for each in loads)
        while (after := sum(each.within(self._decided(slots)) for each in loads)) > slots:
            slots = after
            if self._decided(slots) > self._limit:
                return None
        return slots

    # By laxity

    def _order(self, loads: list[_Load], watched: Sequence[_Load] = ()) -> None:
        """Find bounds that hold because the others do: the least ones that reproduce themselves.

        They only grow, so stop as soon as one that is `watched` is late. They hold, for take the first message that is
        late for its bound: until then all others were in time for theirs, which is all that its bound supposes. So it
        is in time as well, and there is no first one.
        """
        open_ones = [each for each in loads if each.deadline < _CLAMPED]
        for each in open_ones:
            each.bound = 0
        changed = True
        while changed:
            changed = False
            for each in open_ones:
                found = self._laxity_bound(each, loads) if each.bound != each.busy else each.busy
                if found != each.bound:
                    each.bound, changed = found, True
                    if each in watched and (found is None or found > each.deadline):
                        return

    def _laxity_bound(self, load: _Load, loads: list[_Load]) -> int | None:
        """Return the bound of a message by laxity if that shows that it is in time, else its bound in any order.

        It is the longest response over all arrivals within a busy period, a step of arrivals at once.
        """
        assert load.busy is not None
        step, worst = max(self._supply.timing.slot, load.busy // _STEPS), 0
        for first in range(0, load.busy, step):
            found = self._response(load, self._rivals(load, loads, first, first + step), first, first + step)
            if found is None:
                return load.busy
            worst = max(worst, found)
        return min(worst, load.busy)

    def _response(self, load: _Load, rivals: list[_Rival], first: int, last: int) -> int | None:
        """Return the longest response of a message that arrives between two instants after the start of a busy period.

        None: it can't be shown to be in time.
        """
        own = ((last + load.jitter) // load.period + 1) * load.slots
        tail = self._latency + load.message.longest * self._bit
        last_slots = (self._last(load) + self._latency) // self._supply.timing.slot + 1
        response = 0
        while True:
            decided = last + response - tail + self._latency + self._bit
            hurries = response > load.deadline - self._last(load)  # it may lose ties as well
            slots = own + sum(each.load.within(min(decided, each.until) - each.since) for each in rivals)
            ties = decided if hurries else last
            tied = sum(each.load.within(min(ties, each.tied_until) - each.tied_since) for each in rivals)
            late = min(tied, last_slots) if hurries else 0
            from_start, from_arrival = self._supply.wait(slots + tied), self._supply.wait(slots + late)
            assert from_start is not None
            assert from_arrival is not None
            found = min(from_start - first, from_arrival) + tail
            if found <= response:
                return response
            if found > load.deadline:
                return None
            response = found

    def _last(self, load: _Load) -> int:
        """Return for how long a message has one laxity before its deadline (ns): a millisecond, discovery more."""
        return self._quantum * (DISCOVERY if load.message.urgency is Urgency.EASED else 1)

    def _rivals(self, load: _Load, loads: list[_Load], first: int, last: int) -> list[_Rival]:
        """Return what may win slots against a message that arrives between two instants after a busy period began."""
        early, late = first + load.deadline + self._quantum, last + load.deadline + self._quantum
        found = []
        for each in loads:
            if each is not load:
                longest = -(each.bound or 0)  # what waited longer before the busy period would have been late
                since = 0 if late <= _CLAMPED else max(min(0, _CLAMPED - each.deadline), longest)
                tied_since, until = max(early - each.deadline, longest), late - each.deadline
                tied_until = until + self._last(load)
                if each.message.urgency is Urgency.LENT:  # whenever it arrives, it may win
                    since, until, tied_until = min(since, tied_since), late, tied_since
                found.append(_Rival(each, since, until, tied_since, tied_until))
        return found


def event_breakdown(
    messages: Sequence[BusMessage], control: Sequence[BusMessage], supply: SlotSupply, model: EventModel = PROMPT
) -> Breakdown:
    """Return by how much more often all events may come until a deadline may be missed; `control` stays as it is.

    `utilisation` is the share of the free slots that they take then. Rounded down, to 1/256 of a full bus.
    """
    slot = supply.timing.slot
    used = sum(each.frames * model.frame_slots * slot / each.period for each in messages if each.period)
    if not used or not supply.free:
        return Breakdown(math.inf if supply.free else 0.0, 0.0)
    full = supply.share / used
    low, high = 0, _FULL
    while high - low > 1:
        middle = (low + high) // 2
        faster = [_faster(each, middle * full / _FULL) for each in messages]
        late = _Events([*faster, *control], supply, model).late(len(faster))
        low, high = (low, middle) if late else (middle, high)
    return Breakdown(low * full / _FULL, low / _FULL)


def _faster(message: BusMessage, scale: float) -> BusMessage:
    period = None if message.period is None else max(1, int(message.period / scale))
    return msgspec.structs.replace(message, period=period)
