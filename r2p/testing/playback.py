"""Recordings that drive tests: the same recording and the same nodes have the same outputs, bit for bit."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Collection, Iterable, Mapping, Sequence
from typing import Any

import msgspec

from r2p import Error, Module, NodeFunction, Sample, name_of
from r2p.clock import clock_of
from r2p.parameters.sources import GivenParameters
from r2p.recording.bag import Bag
from r2p.recording.bag_file import Paths
from r2p.recording.player import Player, PlayOptions
from r2p.sim.clocks import VirtualClock
from r2p.testing.network import Network, node_in
from r2p.units import SECOND

LEAD = 1.0
"""Seconds from the start of the nodes until the recording begins: they find each other, and subscribe."""
LINGER = 0.1
"""Seconds after the last message in which nodes may still answer."""

_PLAYER = "play"
_PROBE = "outputs"
_KEPT = 1 << 24  # messages of each topic
_KEPT_BYTES = 1 << 31


class Playback(msgspec.Struct, frozen=True):
    """What `play` has done, by topic.

    `outputs` are the samples that the nodes published, also before the recording began. `recorded` are those that the
    recording has of the same topics, which were not played; of these only the samples from `start` to `end`. `played`
    counts what was played, and `missed` what of that did not reach every subscriber.
    """

    outputs: dict[str, list[Sample]]
    recorded: dict[str, list[Sample]]
    played: dict[str, int]
    missed: dict[str, int]


async def play(
    file: Paths,
    *nodes: NodeFunction,
    network: Network | None = None,
    module: str = "ROBOT",
    params: GivenParameters = None,
    topics: Collection[str] = (),
    exclude: Collection[str] = (),
    remap: Mapping[str, str] | None = None,
    start: float = 0.0,
    end: float | None = None,
) -> Playback:
    """Play a recording to nodes, and return what they published. Only under virtual time.

        @pytest.mark.virtual_time
        async def test_odometry() -> None:
            playback = await r2p.testing.play("drive.mcap", forward_kinematics)
            assert [each.data for each in playback.outputs["odometry"]] == expected

    The nodes run in a module of this name, with these `params`. Topics that they publish themselves are not played, so
    a whole recording can be played to one of the nodes that were in it. The clock is that of the recording: a message
    that was received at 14:03:05 arrives at that time of `node.now()`, with the stamp that it had. The nodes start one
    second before that.

    On a `network` of the test other modules take part, which are to be open before. `topics` and `exclude` are names
    and patterns of topics to play, and to leave out; `remap` gives them other names. `start` and `end` are in seconds
    after the start of the recording. Without nodes, it plays to the network alone.

    Raises BagError if the file can't be read or has nothing to play, Error without virtual time, NodeCrashed if a node
    crashes, and TypeMismatch if a node has a topic in another type than the recording.
    """
    clock = _virtual_clock()
    network = Network() if network is None else network
    with Bag(file) as bag:
        first = bag.start + round(start * SECOND)
        last = None if end is None else bag.start + round(end * SECOND)
        clock.epoch = first - round(LEAD * SECOND) - clock.elapsed
        async with network.module(module, params=params) as robot, _watching(robot, nodes) as outputs:
            await asyncio.sleep(LEAD / 2)  # until the nodes have advertised what they publish
            own = tuple(outputs)
            options = PlayOptions(
                topics=tuple(topics),
                exclude=(*exclude, *_recorded_names(own, remap or {})),
                remap=remap or {},
                start=first,
                end=last,
            )
            async with network.module(_PLAYER) as source, Player(source, bag, options) as player:
                await asyncio.sleep(max(0, first - clock.now()) / SECOND)
                await player.run()
                await asyncio.sleep(LINGER)
                played = dict(player.played)
                missed = {name: counts.total() for name, counts in player.missed.items()}
            found = {name: list(queue) for name, queue in outputs.items()}
        names = _recorded_names(own, remap or {})
        recorded: dict[str, list[Sample]] = {name: [] for name in own}
        for record in bag.records(names, start=first, end=last):
            recorded[(remap or {}).get(record.topic, record.topic)].append(record.sample)
    return Playback(found, recorded, played, missed)


def _virtual_clock() -> VirtualClock:
    """Return the clock of the running loop. Raises Error without virtual time."""
    clock = clock_of(asyncio.get_running_loop())
    if not isinstance(clock, VirtualClock) or clock.paced:
        raise Error("play() needs virtual time: mark the test with @pytest.mark.virtual_time, or use r2p.sim.run()")
    return clock


@contextlib.asynccontextmanager
async def _watching(robot: Module, nodes: Iterable[NodeFunction]) -> AsyncIterator[dict[str, Sequence[Sample]]]:
    """Start nodes in the module; yield what they publish from their first message on, by topic."""
    space, names = robot.space, {name_of(each) for each in nodes}
    outputs: dict[str, Sequence[Sample]] = {}
    inform = space.changed
    async with node_in(robot, name=_PROBE) as probe:

        def changed(topic: Any) -> None:
            inform(topic)
            if topic.name not in outputs and any(each.node.name in names for each in topic.publishers):
                outputs[topic.name] = ()  # first: to subscribe is a change as well
                kept = probe.subscribe(topic.name, None, queue=_KEPT, queue_bytes=_KEPT_BYTES, lossy=True)
                outputs[topic.name] = kept.queue

        space.changed = changed
        try:
            for each in nodes:
                robot.start(each)
            yield outputs
        finally:
            space.changed = inform


def _recorded_names(names: Iterable[str], remap: Mapping[str, str]) -> list[str]:
    """Return the names that topics have in the recording."""
    renamed = {new: old for old, new in remap.items()}
    return [renamed.get(each, each) for each in names]
