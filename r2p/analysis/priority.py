"""Worst-case response times of plain CAN, where the identifier is the priority.

The equations are those of Davis, Burns, Bril and Lukkien, "Controller Area Network (CAN) schedulability analysis:
refuted, revisited and revised", Real-Time Systems 35, 2007. A message waits for one longer frame of less priority that
has just started (blocking), for all frames of more priority (interference), and for its own instances before it: so all
instances of the busy period count, not only the first.

A response ends with the last bit of the frame, when receivers have it, not with the intermission after it. The last
frame before it may have ended just now, so also the message of least priority waits for an intermission. This is how
the tables of the literature count.

It is assumed that each node always offers its most urgent frame: no FIFO, and no mailbox whose frame can't be replaced.
"""

import math
from collections.abc import Callable, Iterator, Sequence

import msgspec

from r2p.analysis.messages import BusMessage, by_priority, utilisation
from r2p.codecs.can_bits import INTERMISSION
from r2p.units import SECOND

ERROR_BITS = 29
"""Bits that an error frame takes at most until the next frame starts, without what was sent of the destroyed frame."""

_BUSY_MAX = 1000  # longest periods in a busy period, from where on no bound is found: the bus is as good as overloaded
_FINER = 1 << 12  # steps from 0 to a full bus in the search for the breakdown


class FaultModel(msgspec.Struct, frozen=True):
    """Bit errors, each of which destroys a frame: `count` of them at any time, and one more each `gap` ns (0: none)."""

    count: int = 0
    gap: int = 0

    def within(self, time: int) -> int:
        """Return how many there are at most in so many ns."""
        return self.count + (-(-time // self.gap) if self.gap else 0)


NO_FAULTS = FaultModel()


class ResponseBound(msgspec.Struct, frozen=True):
    """The worst case of a message: it is through by `bound` ns after it should have been queued; None: never for sure.

    `instance`: which one in a busy period is the slowest, counted from 0; `instances`: how many there are in it.
    """

    message: BusMessage
    bound: int | None
    instance: int = 0
    instances: int = 0

    @property
    def misses(self) -> bool:
        """True if the message may be late for its deadline."""
        deadline = self.message.deadline
        return deadline is not None and (self.bound is None or self.bound > deadline)


def response_bounds(messages: Sequence[BusMessage], bit: int, faults: FaultModel = NO_FAULTS) -> list[ResponseBound]:
    """Return the worst case of each message on a bus with this bit time (ns), those of the highest priority first.

    A message without a period blocks others, and interferes with those of less priority for an unknown time: they have
    no bound. Raises `MessageError` if two messages have one identifier.
    """
    return list(_bounds(by_priority(list(messages)), bit, faults))


def _bounds(ordered: list[BusMessage], bit: int, faults: FaultModel) -> Iterator[ResponseBound]:
    return (_PriorityLevel(ordered, index, bit, faults).bound() for index in range(len(ordered)))


class _PriorityLevel:
    """A message with those that it waits for. All times are ns."""

    def __init__(self, ordered: list[BusMessage], index: int, bit: int, faults: FaultModel) -> None:
        self._own = own = ordered[index]
        self._bit = bit
        self._faults = faults
        self._gap = INTERMISSION * bit
        self._transmission = own.longest * bit
        lengths = [each.longest * bit for each in ordered]
        self._blocking = max(lengths[index + 1 :], default=0) + self._gap
        self._error = ERROR_BITS * bit + max(lengths[: index + 1])
        known = [(length, each) for length, each in zip(lengths[: index + 1], ordered, strict=False) if each.period]
        self._bounded = len(known) == index + 1 and utilisation(ordered[: index + 1], bit) < 1
        self._same = [(length + self._gap, each.period or 0, each.jitter) for length, each in known]
        self._limit = _BUSY_MAX * max((period for _, period, _ in self._same), default=0)

    def bound(self) -> ResponseBound:
        """Return the worst case of the message."""
        own, period = self._own, self._own.period
        busy = self._fixed_point(self._blocking, self._busy) if self._bounded else None
        if busy is None or period is None:
            return ResponseBound(own, None)
        instances = -(-(busy + own.jitter) // period)
        worst, slowest, wait = 0, 0, self._blocking
        for instance in range(instances):
            found = self._wait(instance, wait)
            if found is None:
                return ResponseBound(own, None)
            wait = found  # the next instance does not begin earlier
            response = own.jitter + wait - instance * period + self._transmission
            if response > worst:
                worst, slowest = response, instance
        return ResponseBound(own, worst, slowest, instances)

    def _busy(self, time: int) -> int:
        """Return how long the bus is busy with what is queued within a time."""
        demand = self._blocking + self._faults.within(time) * self._error
        for cost, period, jitter in self._same:
            demand += -(-(time + jitter) // period) * cost
        return demand

    def _wait(self, instance: int, start: int) -> int | None:
        """Return when an instance begins to be sent, counted from the start of the busy period."""
        before = self._blocking + instance * (self._transmission + self._gap)
        higher = self._same[:-1]

        def wait(time: int) -> int:
            demand = before + self._faults.within(time + self._transmission) * self._error
            for cost, period, jitter in higher:
                # What is queued within a bit after the start of frame still takes part in the arbitration.
                demand += -(-(time + jitter + self._bit) // period) * cost
            return demand

        return self._fixed_point(max(start, before), wait)

    def _fixed_point(self, start: int, function: Callable[[int], int]) -> int | None:
        time = start
        while (after := function(time)) > time:
            time = after
            if time > self._limit:
                return None
        return time


def fault_probabilities(
    messages: Sequence[BusMessage], name: str, bit: int, rate: float, most: int = 8
) -> list[tuple[int | None, float]]:
    """Return for 0 to `most` faults the bound (ns) of a message, and how likely exactly so many hit its response.

    Faults come at random, `rate` a second (Poisson). This is the recursion of Broster, Burns and Rodríguez-Navas,
    "Probabilistic analysis of CAN with faults", 2002: of all ways in which k faults come within the bound for k, those
    are left out in which the response was over before. Raises KeyError without a message of that name.
    """
    ordered = by_priority(list(messages))
    index = next((index for index, each in enumerate(ordered) if each.name == name), None)
    if index is None:
        raise KeyError(name)
    bounds = [_PriorityLevel(ordered, index, bit, FaultModel(count)).bound().bound for count in range(most + 1)]
    found: list[tuple[int | None, float]] = []
    for count, bound in enumerate(bounds):
        chance = 0.0 if bound is None else _poisson(count, bound * rate / SECOND)
        for earlier, (before, probability) in enumerate(found):
            if bound is not None and before is not None:
                chance -= probability * _poisson(count - earlier, (bound - before) * rate / SECOND)
        found.append((bound, max(0.0, chance)))
    return found


def miss_probability(messages: Sequence[BusMessage], name: str, bit: int, rate: float) -> float:
    """Return how likely one instance of a message is late at most, if `rate` faults a second hit the bus at random."""
    message = next(each for each in messages if each.name == name)
    if message.deadline is None:
        return 0.0
    likely = fault_probabilities(messages, name, bit, rate)
    in_time = sum(chance for bound, chance in likely if bound is not None and bound <= message.deadline)
    return max(0.0, 1.0 - in_time)


def _poisson(count: int, mean: float) -> float:
    return math.exp(-mean) * mean**count / math.factorial(count)


class Breakdown(msgspec.Struct, frozen=True):
    """Where a set of messages breaks down: with all frames `scale` times as long, the first deadline may be missed.

    `utilisation` is the load of the bus then. A scale below 1: it is missed already.
    """

    scale: float
    utilisation: float


def breakdown(messages: Sequence[BusMessage], bit: int, faults: FaultModel = NO_FAULTS) -> Breakdown:
    """Return by how much all frames may become longer (or the bit rate less) until a deadline may be missed.

    Rounded down, to 1/4096 of the scale at which the bus is full.
    """
    if not (load := utilisation(list(messages), bit)):
        return Breakdown(math.inf, 0.0)
    # Times in units of 1/_FINER ns, so that the bit time stays a whole number.
    ordered = [_finer(each) for each in by_priority(list(messages))]
    full = math.ceil(bit * _FINER / load)
    low, high = 0, full
    while high - low > 1 + full // _FINER:
        middle = (low + high) // 2
        late = any(each.misses for each in _bounds(ordered, middle, FaultModel(faults.count, faults.gap * _FINER)))
        low, high = (low, middle) if late else (middle, high)
    return Breakdown(low / (bit * _FINER), load * low / (bit * _FINER))


def _finer(message: BusMessage) -> BusMessage:
    period, deadline = message.period, message.deadline
    return msgspec.structs.replace(
        message,
        period=None if period is None else period * _FINER,
        deadline=None if deadline is None else deadline * _FINER,
        jitter=message.jitter * _FINER,
    )
