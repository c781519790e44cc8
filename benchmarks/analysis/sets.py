"""Random message sets with their arrivals, and what the simulated bus makes of them, beside the bounds."""

import random

import msgspec

from benchmarks.analysis.simulated import arrivals, plain_responses, rtcan_responses
from r2p.analysis import (
    BusMessage,
    EventModel,
    FaultModel,
    MessageClass,
    ResponseBound,
    control_rates,
    event_bounds,
    management_load,
    response_bounds,
    slot_supply,
)
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.units import MILLISECOND

_PERIODS = (2, 3, 5, 7, 10, 16, 20)  # ms
_DEADLINES = (2, 3, 5, 10, 20, 35, 50, 70)  # ms
_FIRST = 5 * MILLISECOND  # by then all that have jitter may have been due
_HRT_PERIODS = (5, 6, 10, 12, 30, 60, 120)  # slots


class Compared(msgspec.Struct, frozen=True):
    """A message: its bound (ns), the slowest response that was simulated, and how many were."""

    message: BusMessage
    bound: int | None
    slowest: int
    count: int


def plain_set(numbers: random.Random, count: int) -> list[BusMessage]:
    """Return messages of either kind of identifier, in no order of periods."""
    found = []
    for index in range(count):
        extended = numbers.random() < 0.5
        found.append(
            BusMessage(
                name=f"m{index}",
                id=index << 18 | numbers.getrandbits(18) if extended else numbers.randrange(64) << 5 | index,
                extended=extended,
                size=numbers.randint(0, 8),
                period=numbers.choice(_PERIODS) * MILLISECOND + numbers.randint(0, 1000),
                jitter=numbers.choice((0, 0, numbers.randint(0, 3 * MILLISECOND))),
            )
        )
    return found


def compare_plain(numbers: random.Random, *, count: int, bit: int, duration: int) -> list[Compared]:
    """Simulate plain CAN with random content, and with bit errors now and then; the first arrivals are close together.

    Each random set begins with a frame of low priority that has just started.
    """
    messages = plain_set(numbers, count)
    start = numbers.choice((bit, 1, 0, numbers.randint(0, 2 * MILLISECOND)))
    plan = {each.name: arrivals(each, numbers, duration, offset=_FIRST + start - each.jitter) for each in messages}
    blocker = max(messages, key=lambda each: each.rank)
    if numbers.random() < 0.7:
        plan[blocker.name] = arrivals(blocker, numbers, duration, offset=_FIRST - blocker.jitter)
    data = {each.name: numbers.choice((bytes(each.size), numbers.randbytes(each.size))) for each in messages}
    errors = numbers.choice((0, 0, 0, 1, 2))
    simulated = plain_responses(messages, bit, plan, data, errors)
    bounds = response_bounds(messages, bit, FaultModel(errors))
    return [_compared(each, simulated[each.message.name]) for each in bounds]


def _compared(found: ResponseBound, responses: list[int]) -> Compared:
    return Compared(found.message, found.bound, max(responses, default=0), len(responses))


class RtcanSet(msgspec.Struct):
    """A network: `messages`, of which the HRT ones ask for slots in this order."""

    timing: Timing
    messages: list[BusMessage]


def rtcan_set(numbers: random.Random, load: float) -> RtcanSet:
    """Return a network whose events take about this share of the slots that are free."""
    slots = numbers.choice((20, 60, 60))
    grid = timing(slots, slots * 167_000)
    messages = [
        BusMessage(
            name=f"h{index}",
            node=f"n{numbers.randrange(3)}",
            size=numbers.choice((8, 8, 16)),
            period=period * grid.slot,
            message_class=MessageClass.HRT,
        )
        for index, period in enumerate(sorted(numbers.sample(_HRT_PERIODS, numbers.randint(0, 3))))
    ]
    left = load * (1 - sum(2 * grid.slot / (each.period or 1) for each in messages))
    while left > 0 and len(messages) < 30:
        deadline = numbers.choice(_DEADLINES) * MILLISECOND + numbers.choice((0, numbers.randint(0, MILLISECOND)))
        event = BusMessage(
            name=f"e{len(messages)}",
            node=f"n{numbers.randrange(4)}",
            size=numbers.choice((1, 8, 8, 8, 16, 30)),
            period=round(deadline * numbers.choice((0.5, 1, 1, 2))),
            deadline=deadline,
            jitter=numbers.choice((0, 0, numbers.randint(0, 2 * MILLISECOND))),
            message_class=MessageClass.SRT,
        )
        left -= event.frames * grid.slot / (event.period or 1)
        messages.append(event)
    return RtcanSet(grid, messages)


def compare_rtcan(numbers: random.Random, *, load: float, duration: int, discovery: int = 0) -> list[Compared]:
    """Simulate a network of real engines; events arrive together, or in bursts, and non real-time messages beside.

    `discovery`: messages that each node sends as well, at any time or all at once.
    """
    network = rtcan_set(numbers, load)
    events = [each for each in network.messages if each.message_class is MessageClass.SRT]
    spread = numbers.choice((0, 0, MILLISECOND, 20 * MILLISECOND))
    start = numbers.randint(0, network.timing.cycle)
    plan = {each.name: arrivals(each, numbers, duration, offset=start + numbers.randint(0, spread)) for each in events}
    idle = BusMessage(name="background", node="n3", size=30, period=2 * MILLISECOND, message_class=MessageClass.NRT)
    plan[idle.name] = arrivals(idle, numbers, duration // 4, offset=start)
    nodes = sorted({each.node for each in [*network.messages, idle]})
    width = numbers.choice((0, duration)) if discovery else 0
    found = {node: [start + numbers.randint(0, width) for _ in range(discovery)] for node in nodes}
    run = rtcan_responses([*network.messages, idle], network.timing, plan, duration + 400 * MILLISECOND, found)
    supply = slot_supply(network.timing, run.reservations)
    # NRT messages without a period: nobody says how many there are.
    owners = {each.node for each in network.messages if each.message_class is MessageClass.HRT}
    management = management_load(control_rates(nodes, owners, run.master), discovery)
    known = [*events, *management, msgspec.structs.replace(idle, period=None)]
    bounds = event_bounds(known, supply, EventModel())
    return [_compared(each, run.responses[each.message.name]) for each in bounds if each.message in events]
