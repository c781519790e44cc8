"""A nearly full bus: 20 modules that reserve 50 to 95 % of the slots (thesis 3.3.1 and 4.3.4).

`python -m benchmarks.full_bus` runs, under virtual time, modules whose periodic topics need one slot in each cycle,
and each of which the next module subscribes to. It prints when all slots were granted, when messages of all topics had
arrived, which slots were lost later, and the share of management, the same each time.

Some slots have to stay free: the master refuses topics that would leave too few for what keeps the others. The command
says how many, and why.
"""

import argparse
import asyncio
import functools
import logging
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack

import msgspec

import r2p
from benchmarks.twenty_modules import Traffic
from r2p import sim
from r2p.protocols.rtcan.leases import frames_needed
from r2p.transports.rtcan.link import RtcanLink
from r2p.transports.rtcan.tx import SlottedTopic

MODULES = 20
SLOTS = 60
"""Slots in a cycle, one of which is the sync's."""
PERIOD = 0.00996
"""Seconds: one cycle."""
_POLL = 0.01  # s, of what is looked at
_LIMIT = 60.0  # s for all slots to be granted


class Eight(r2p.Message):
    """A full frame."""

    value: r2p.f64 = 0.0


class FullBus(msgspec.Struct, frozen=True):
    """What happened at one load. Times are in s after power, None: not within a minute."""

    granted: float | None
    """All topics have their slots, but for those that are refused."""
    known: float | None
    """All modules know all topics."""
    flowing: float | None
    """A message of each topic has arrived at its subscriber."""
    refused: str
    """Why topics were refused; empty if none was."""
    lost: int
    """Times that a topic lost its slots, of all topics, in the time watched."""
    missed: int
    """Occurrences that found no slot, or came too late for it."""
    slots: int
    management: float
    """Share of the bus in that time."""


async def measure(percent: int, seconds: float, seed: int, modules: int = MODULES) -> FullBus:
    """Let modules reserve so much of all slots, and watch the bus for a while."""
    can = sim.can_bus("full", seed=seed)
    traffic = Traffic(can)
    count = SLOTS * percent // 100 - 1  # one is the sync's
    time = asyncio.get_running_loop().time
    started, arrived = time(), set[str]()
    async with AsyncExitStack() as stack:
        links: list[RtcanLink] = []
        for number in range(modules):
            module = await stack.enter_async_context(r2p.Module(f"M{number}", via="sim:full", watchdog=False))
            module.start(_node, [f"t{each}" for each in range(count)], number, modules, arrived)
            links += [link for link in module.links if isinstance(link, RtcanLink)]
        topics = {f"t{each}" for each in range(count)}
        granted = await _until(lambda: _granted(links) + len(_refusals(links)) == count, started)
        known = await _until(lambda: _is_known(links, topics), started)
        flowing = await _until(lambda: arrived == topics, started)
        everything = [topic for link in links for topic in link.slots.values()]
        missed = sum(each.missed for each in everything)
        traffic.reset()
        lost = await _count_lost(everything, seconds)
        management = traffic.bits["management"] / seconds / can.bitrate
        missed = sum(each.missed for each in everything) - missed
        refused = "; ".join(sorted(set(_refusals(links).values())))
        return FullBus(granted, known, flowing, refused, lost, missed, count, management)


async def _node(node: r2p.Node, topics: Sequence[str], number: int, modules: int, arrived: set[str]) -> None:
    for each in topics[number::modules]:
        node.advertise(each, Eight, r2p.Periodic(PERIOD, Eight))
    for each in topics[(number + 1) % modules :: modules]:
        node.subscribe(each, Eight, callback=functools.partial(_note, arrived, each))
    while True:
        await node.spin()


def _note(arrived: set[str], topic: str, message: Eight) -> None:
    arrived.add(topic)


def _granted(links: Sequence[RtcanLink]) -> int:
    return sum(bool(topic.period) for link in links for topic in link.slots.values())


def _refusals(links: Sequence[RtcanLink]) -> dict[str, str]:
    """Return why topics have no slots."""
    slots = [each for link in links for each in link.slots.values()]
    return {each.topic.name: each.refusal for each in slots if each.refusal and not each.period}


def _is_known(links: Sequence[RtcanLink], topics: set[str]) -> bool:
    return all(topics <= link.discovery.topics.keys() | link.slots.keys() for link in links)


async def _count_lost(topics: Sequence[SlottedTopic], seconds: float) -> int:
    time = asyncio.get_running_loop().time
    end, had, lost = time() + seconds, [bool(each.period) for each in topics], 0
    while time() < end:
        await asyncio.sleep(_POLL)
        has = [bool(each.period) for each in topics]
        lost += sum(before and not after for before, after in zip(had, has, strict=True))
        had = has
    return lost


async def _until(done: Callable[[], bool], started: float) -> float | None:
    """Wait until something is so; return how long that was after the start (s), None after the limit."""
    time = asyncio.get_running_loop().time
    while not done():
        await asyncio.sleep(_POLL)
        if time() - started > _LIMIT:
            return None
    return time() - started


def main() -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.full_bus", description=__doc__)
    parser.add_argument("--percent", type=int, action="append", help="of all slots; may be repeated")
    parser.add_argument("--seconds", type=float, default=60.0, help="to watch, of virtual time")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable()
    head = ["slots reserved", "granted after s", "topics known after s", "messages of all topics after s"]
    head += ["slots lost", "missed", "management"]
    print(f"| {' | '.join(head)} |\n|{' ---: |' * len(head)}")
    refused: dict[int, str] = {}
    for percent in options.percent or (50, 70, 80, 85, 90, 95):
        each = sim.run(lambda: measure(percent, options.seconds, options.seed), seed=options.seed)  # noqa: B023
        when = ["never" if at is None else f"{at:.2f}" for at in (each.granted, each.known, each.flowing)]
        print(f"| {percent} % | {' | '.join(when)} | {each.lost} | {each.missed} | {each.management:.1%} |", flush=True)
        refused |= {percent: each.refused} if each.refused else {}
    needed = frames_needed(MODULES)
    for percent, reason in refused.items():
        left = (SLOTS - SLOTS * percent // 100) / PERIOD
        print(f"{percent} % would leave {left:.0f} slots a second, and {MODULES} modules need {needed}: {reason}")


if __name__ == "__main__":
    main()
