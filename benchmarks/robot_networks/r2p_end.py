"""Nodes of a network by r2p, in one module of one process: `r2p_end PLAN VIA NODE...`, run as a module.

`VIA` is a URL, empty for none, or `can`: then two modules of this process have every other node each, on a simulated
bus of 1 Mbit/s, without topics that are too large for RTCAN.
"""

import asyncio
import logging
import os
import sys
from contextlib import AsyncExitStack
from typing import Annotated

import r2p
from benchmarks.loops import run_on
from benchmarks.robot_networks import measuring
from benchmarks.robot_networks.plans import HEADER, PLANS, NodePlan, Plan, Topic
from r2p.codecs.rtcan import VARIABLE_MAX
from r2p.sim.transport import SimCan, SimTransport


class Stamped(r2p.Message):
    """A message of any size: its counter, when it was sent (ns, monotonic), and bytes."""

    counter: r2p.u32 = 0
    sent: r2p.u64 = 0
    data: Annotated[bytes, r2p.Max(250_000)] = b""


class StampedFrame(r2p.Message):
    """The same, of which the longest fits into a message of RTCAN."""

    counter: r2p.u32 = 0
    sent: r2p.u64 = 0
    data: Annotated[bytes, r2p.Max(VARIABLE_MAX - HEADER)] = b""


Via = str | SimTransport
Kind = type[Stamped] | type[StampedFrame]


async def work(node: r2p.Node, plan: NodePlan, kind: Kind, recorder: measuring.Recorder) -> None:
    """A node: a loop for each topic that it publishes, and callbacks."""
    for name in plan.subscribes:
        _subscribe(node, name, kind, recorder)
    async with asyncio.TaskGroup() as loops:
        for topic in plan.publishes:
            loops.create_task(_publish(node, topic, kind))
        while plan.subscribes:
            await node.spin()


def _subscribe(node: r2p.Node, name: str, kind: Kind, recorder: measuring.Recorder) -> None:
    def receive(message: Stamped | StampedFrame) -> None:
        recorder.message(node.name, name, message.counter, message.sent)

    node.subscribe(name, kind, receive, queue=10)


async def _publish(node: r2p.Node, topic: Topic, kind: Kind) -> None:
    publisher = node.advertise(topic.name, kind)
    data, counter = bytes(topic.size), 0
    async for _ in node.every(topic.period):
        counter += 1
        await publisher.publish(kind(counter, measuring.now(), data))


async def main(plan: Plan, via: str, names: list[str]) -> None:
    nodes = [each for each in plan.nodes if each.name in names]
    ended, loop = asyncio.Event(), asyncio.get_running_loop()
    plan = plan.up_to(VARIABLE_MAX) if via == "can" else plan
    recorder = measuring.Recorder(plan, names)
    parts: list[tuple[str, list[Via], tuple[NodePlan, ...]]]
    async with AsyncExitStack() as stack:
        if via == "can":
            bus = SimCan()
            parts = [(f"M{index}", [bus.transport()], plan.half(index)) for index in (0, 1)]
        else:
            parts = [(f"M{names[0].upper()}"[:15], [via] if via else [], tuple(nodes))]
        for name, links, part in parts:
            module = await stack.enter_async_context(r2p.Module(name, via=links, watchdog=False))
            for each in part:
                module.start(work, each, StampedFrame if via == "can" else Stamped, recorder, name=each.name)
            measuring.say(dict(module.addresses))
        measuring.serve(recorder, lambda: loop.call_soon_threadsafe(ended.set))
        await ended.wait()
        os._exit(0)  # what closing takes is not measured, and processes of others end as suddenly


if __name__ == "__main__":
    logging.disable()
    plan_name, url, *node_names = sys.argv[1:]
    run_on("precise" if url == "can" else "uvloop", main(PLANS[plan_name], url, node_names))
