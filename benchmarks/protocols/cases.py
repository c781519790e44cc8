"""One run: a protocol, a set of messages, an error rate, a seed, perhaps a fault; and the figures that come of it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec

from benchmarks.protocols.canopen import CanOpen
from benchmarks.protocols.edf_identifier import EdfIdentifier
from benchmarks.protocols.fixed_priority import Cyphal, DeadlineMonotonic, DroneCan, RateMonotonic
from benchmarks.protocols.ftt_can import FttCan
from benchmarks.protocols.message_sets import SetMessage, named_set
from benchmarks.protocols.network import ProtocolNetwork, ProtocolSetup
from benchmarks.protocols.rtcan_network import RtcanNetwork
from benchmarks.protocols.ttcan import SoftwareTtcan, Ttcan
from r2p.sim import run
from r2p.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Iterable

    from benchmarks.protocols.message_sets import MessageSet
    from benchmarks.protocols.recorder import MessageVerdict

PROTOCOLS: dict[str, type[ProtocolNetwork]] = {
    each.title: each
    for each in (
        RateMonotonic,
        DeadlineMonotonic,
        EdfIdentifier,
        FttCan,
        Ttcan,
        SoftwareTtcan,
        CanOpen,
        Cyphal,
        DroneCan,
        RtcanNetwork,
    )
}
FAULTS = ("urgent babble", "low babble", "lost sync", "lost master")
FAULT_AT = 0.2  # s after the measurement has begun
BABBLE = 0.1  # s
RESPONSES_MIN = 5000
"""From so many responses on, the longest one in 1000 is given: five or more are longer."""
WATCHED = 0.5  # s from the fault on, in which its effects count
BABBLER = "3"
"""The node of the thesis's set that fails; its own messages do not count."""


class StudyCase(msgspec.Struct, frozen=True, kw_only=True):
    """What is run. `messages`: a set's short name; `seed`: of the run, and of random sets; `duration` in s."""

    protocol: str
    messages: str
    bit_error_rate: float = 0.0
    seed: int = 1
    duration: float = 1.0
    fault: str = ""


class CaseFigures(msgspec.Struct, kw_only=True):
    """The figures of one case, or of several with different seeds. Shares of 1; times in us; `load`: of the set.

    `jitter`: the worst of all periodic messages, `jitter_fast`: of those with the shortest period; `silence`: the
    longest time without one of those. `responses` are kept while seeds are put together. `unplaced`: periodic messages
    that did not get the slots or the window that they asked for.
    """

    load: float = 0.0
    sync: float = 0.0
    busy: float = 0.0
    periodic: int = 0
    periodic_missed: int = 0
    jitter: float = 0.0
    jitter_fast: float = 0.0
    sporadic: int = 0
    sporadic_missed: int = 0
    silence: float = 0.0
    unplaced: int = 0
    runs: int = 0
    worst: float = 0.0
    p999: float | None = None
    median: float | None = None
    responses: list[int] = []

    def put_together(self) -> CaseFigures:
        """Compute what needs all responses, and drop these."""
        ordered = sorted(self.responses)
        if ordered:
            self.worst = ordered[-1] / 1000
            self.median = ordered[len(ordered) // 2] / 1000
        if len(ordered) >= RESPONSES_MIN:
            self.p999 = ordered[int(len(ordered) * 0.999)] / 1000
        self.responses = []
        return self


def merge(figures: Iterable[CaseFigures]) -> CaseFigures:
    """Put the figures of several seeds together: sums, worst values, and means of shares."""
    total = CaseFigures()
    for each in figures:
        for name in ("periodic", "periodic_missed", "sporadic", "sporadic_missed", "unplaced", "runs", "responses"):
            setattr(total, name, getattr(total, name) + getattr(each, name))
        for name in ("jitter", "jitter_fast", "silence"):
            setattr(total, name, max(getattr(total, name), getattr(each, name)))
        for name in ("load", "sync", "busy"):
            setattr(total, name, getattr(total, name) + getattr(each, name))
    for name in ("load", "sync", "busy"):
        setattr(total, name, round(getattr(total, name) / total.runs, 6))
    return total.put_together()


def simulate(case: StudyCase) -> CaseFigures:
    """Run one case in virtual time of its own."""
    results: list[CaseFigures] = []

    async def main() -> None:
        results.append(await _measure(case))

    run(main, seed=case.seed)
    return results[0]


async def _measure(case: StudyCase) -> CaseFigures:
    messages = named_set(case.messages, case.seed)
    setup = ProtocolSetup(messages=messages, seed=case.seed, duration=case.duration, bit_error_rate=case.bit_error_rate)
    network = PROTOCOLS[case.protocol](setup)
    network.start()
    await network.ready()
    network.bus.reset_statistics()
    network.sync_bits = 0
    begin = network.bus.timeline.now()
    if case.fault:
        begin = await _fail(network, case.fault)
        left_out = BABBLER if "babble" in case.fault else network.master
    else:
        left_out = None
        await asyncio.sleep(case.duration)
    end = network.bus.timeline.now()
    figures = _figures(network, begin, end, left_out)
    network.close()
    return figures


async def _fail(network: ProtocolNetwork, fault: str) -> int:
    """Let something fail, and wait until its effects have shown; return the instant of the fault."""
    await asyncio.sleep(FAULT_AT)
    begin = network.bus.timeline.now()
    if "babble" in fault:
        kind = "HA" if fault == "urgent babble" else "SC"
        network.babble(BABBLER, f"{kind}{BABBLER}", on=True)
        await asyncio.sleep(BABBLE)
        network.babble(BABBLER, "", on=False)
    elif fault == "lost sync":
        network.bus.disturb_next(1, identifier=network.sync_identifier())
    else:
        network.kill(network.master or "")
    await asyncio.sleep(WATCHED - (BABBLE if "babble" in fault else 0))
    return begin


def _figures(network: ProtocolNetwork, begin: int, end: int, left_out: str | None) -> CaseFigures:
    tracks = {each.name: network.tracks[each.name] for each in network.set.messages if each.node != left_out}
    verdicts = [each.judge(begin, end) for each in tracks.values()]
    periodic = [each for each in verdicts if not each.message.sporadic]
    sporadic = [each for each in verdicts if each.message.sporadic]
    shortest = min(each.message.period for each in periodic)
    fast = [each for each in periodic if each.message.period == shortest]
    elapsed = end - begin
    return CaseFigures(
        load=network.set.load,
        sync=network.sync_bits * network.bus.bit / elapsed,
        busy=network.bus.load(),
        periodic=sum(each.count for each in periodic),
        periodic_missed=sum(each.missed for each in periodic),
        jitter=_most(each.jitter for each in periodic),
        jitter_fast=_most(each.jitter for each in fast),
        sporadic=sum(each.count for each in sporadic),
        sporadic_missed=sum(each.missed for each in sporadic),
        silence=_most(each.silence for each in fast),
        unplaced=_unplaced(network),
        runs=1,
        responses=_responses(sporadic),
    )


def _unplaced(network: ProtocolNetwork) -> int:
    if not network.paces:
        return 0
    return sum(not track.paced for name, track in network.tracks.items() if not track.message.sporadic)


def _responses(sporadic: list[MessageVerdict]) -> list[int]:
    return [response for each in sporadic for response in each.responses]


def _most(values: Iterable[int]) -> float:
    """The largest, in us."""
    return max(values, default=0) / 1000


class AddedMessage(msgspec.Struct, frozen=True):
    """What it takes to add a message while the network runs: others' messages and nodes that get new settings."""

    messages: int
    nodes: int
    milliseconds: float = 0.0
    frames: int = 0


def add_message(protocol: str, name: str) -> AddedMessage:
    """Add a periodic message of 4 bytes, T = 20 ms, D = 8 ms, to a set, and compare the settings."""
    results: list[AddedMessage] = []

    async def main() -> None:
        results.append(await _add(PROTOCOLS[protocol], name))

    run(main, seed=1)
    return results[0]


async def _add(protocol: type[ProtocolNetwork], name: str) -> AddedMessage:
    before = named_set(name)
    node = before.nodes[-1]
    added = SetMessage("added", node, 4, 20 * MILLISECOND, 8 * MILLISECOND)
    after = msgspec.structs.replace(before, messages=(*before.messages, added))
    settings = []
    for messages in (before, after):
        network = protocol(ProtocolSetup(messages=messages))
        settings.append(network.configuration())
        network.close()
    owners = {each.name: each.node for each in before.messages}
    changed = [each for each, value in settings[0].items() if settings[1][each] != value]
    extra = await _online(after) if protocol is RtcanNetwork else (0.0, 0)
    return AddedMessage(len(changed), len({owners[each] for each in changed}), *extra)


async def _online(messages: MessageSet) -> tuple[float, int]:
    """Let a running network of RTCAN grant slots to the new message; return the ms it takes, and management frames."""
    network = RtcanNetwork(ProtocolSetup(messages=messages))
    network.start()
    network.later.add("added")
    await network.ready()
    before = network.management_frames
    begin = network.bus.timeline.now()
    granted = await network.add("added")
    frames = network.management_frames - before
    network.close()
    return (granted - begin) * 1000 / SECOND, frames
