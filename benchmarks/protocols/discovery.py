"""What discovery takes of the bus where r2p modules have the topics of a set: it is not in the figures of RTCAN."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

import msgspec

import r2p
from benchmarks.protocols.message_sets import MessageSet, named_set
from r2p.codecs import rtcan
from r2p.codecs.can_bits import FRAME_MAX, INTERMISSION
from r2p.msg import Led
from r2p.sim import SimCan, run
from r2p.testing.network import node_in
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.sim.can import FrameRecord

_SETTLED = 10.0  # s after the start, when nothing is new
_WATCHED = 10.0  # s


class DiscoveryShare(msgspec.Struct, frozen=True):
    """Management of modules without syncs: its share of the time, and of the slots that are free for events."""

    bus: float
    free_slots: float


class _ManagementCount:
    """Counts the frames of management and their bits."""

    def __init__(self) -> None:
        self.frames = 0
        self.bits = 0

    def observe(self, record: FrameRecord) -> None:
        identifier = record.frame.id
        of_sync = rtcan.is_sync(identifier) and len(record.frame.data) == FRAME_MAX
        if not of_sync and rtcan.high_byte(rtcan.message_of(identifier)) == rtcan.MANAGEMENT:
            self.frames += 1
            self.bits += record.bits + INTERMISSION


def discovery_share(name: str = "thesis-80") -> DiscoveryShare:
    """Run the nodes of a set as r2p modules, each subscribed to the topics of the one before it.

    Only what modules say of their topics matters, so all of these have one type, and events are not sent.
    """
    results: list[DiscoveryShare] = []

    async def main() -> None:
        results.append(await _measure(named_set(name)))

    run(main, seed=1)
    return results[0]


async def _measure(messages: MessageSet) -> DiscoveryShare:
    can, count = SimCan(seed=1, bitrate=messages.bitrate), _ManagementCount()
    async with AsyncExitStack() as stack:
        nodes = {}
        for name in messages.nodes:
            module = r2p.Module(name, via=can.transport(), watchdog=False)
            nodes[name] = await stack.enter_async_context(node_in(await stack.enter_async_context(module)))
        subscribers = [_connect(messages, nodes, place) for place in range(len(messages.messages))]
        await asyncio.sleep(_SETTLED)
        can.bus.observers.append(count.observe)
        await asyncio.sleep(_WATCHED)
        del subscribers
    duration = _WATCHED * SECOND
    slot = 166_000 * 1_000_000 // messages.bitrate
    reserved = sum(slot / each.period * -(-each.size // FRAME_MAX) for each in messages.messages if not each.sporadic)
    free = duration / slot * (1 - reserved - 1 / 60)
    return DiscoveryShare(round(count.bits * can.bus.bit / duration, 4), round(count.frames / free, 4))


def _connect(messages: MessageSet, nodes: dict[str, r2p.Node], place: int) -> r2p.Subscriber[Led]:
    message, names = messages.messages[place], list(nodes)
    sender = nodes[message.node]
    receiver = nodes[names[names.index(message.node) - 1]]
    if message.sporadic:
        sender.advertise(message.name, Led, r2p.Sporadic(deadline=message.deadline / SECOND))
    else:
        sender.advertise(message.name, Led, r2p.Periodic(message.period / SECOND, fill=Led))
    return receiver.subscribe(message.name, Led, lossy=True, queue=1)
