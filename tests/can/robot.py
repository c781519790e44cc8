"""A module on a CAN bus, to run several of: `python -m tests.can.robot NAME URL OTHERS...`.

It publishes numbered messages of each class, and subscribes those of the others. It prints `enough` when it has enough
of each topic, goes on until its input ends, and prints as JSON what it received.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
from typing import Annotated, Any

import r2p
from r2p.modules.runner import run_main

ENOUGH = 4
"""Messages of each topic."""
PERIOD = 0.4
"""Seconds between hard real-time messages."""
PAUSE = 0.3
"""Seconds between the others."""
DEADLINE = 60.0
"""Seconds that messages may wait: these tests are about loss, not about time."""


class Number(r2p.Message):
    number: r2p.u32 = 0


class Bulk(r2p.Message):
    """25 fragments, all of which have the number."""

    number: r2p.u32 = 0
    copies: Annotated[tuple[r2p.u32, ...], r2p.Len(49)] = (0,) * 49


class Received:
    """Counts what came in of one topic."""

    def __init__(self) -> None:
        self.count = 0
        self.missing = 0
        self.wrong = 0
        self._last: int | None = None

    def count_message(self, number: int) -> None:
        if self._last is not None:
            self.missing += max(0, number - self._last - 1)
            self.wrong += number <= self._last
        self._last = number
        self.count += 1

    def report(self) -> dict[str, int]:
        return {"count": self.count, "missing": self.missing, "wrong": self.wrong}


class Robot:
    def __init__(self, name: str, others: list[str]) -> None:
        self.received = {f"{kind}_{other}": Received() for other in others for kind in ("hrt", "srt", "nrt")}
        self.enough = asyncio.Event()
        self.publishers: list[r2p.Publisher[Any] | r2p.SporadicPublisher[Any] | r2p.PeriodicPublisher[Any]] = []
        self._name = name

    async def talk(self, node: r2p.Node) -> None:
        ticks = itertools.count()
        periodic = r2p.Periodic(period=PERIOD, fill=lambda: Number(number=next(ticks)))
        hrt = node.advertise(f"hrt_{self._name}", Number, periodic)
        srt = node.advertise(f"srt_{self._name}", Number, r2p.Sporadic(deadline=DEADLINE))
        nrt = node.advertise(f"nrt_{self._name}", Bulk, r2p.NonRealTime(stall=DEADLINE))
        self.publishers = [hrt, srt, nrt]
        for number in itertools.count():
            await srt.publish(Number(number=number))
            await nrt.publish(Bulk(number=number, copies=(number,) * 49))
            await asyncio.sleep(PAUSE)

    async def listen(self, node: r2p.Node, topic: str, message_type: type[Number | Bulk]) -> None:
        async for message in node.subscribe(topic, message_type, queue=1000):
            if isinstance(message, Bulk):
                assert message.copies == (message.number,) * 49
            self.received[topic].count_message(message.number)
            if all(received.count >= ENOUGH for received in self.received.values()):
                self.enough.set()

    def report(self) -> dict[str, Any]:
        return {
            "received": {topic: received.report() for topic, received in self.received.items()},
            "said": {each.topic: {"missed": each.missed, "guarantees": each.guarantees} for each in self.publishers},
        }


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def main(name: str, url: str, *others: str) -> None:
    robot = Robot(name, list(others))
    async with r2p.Module(name, via=url, watchdog=False) as module:
        module.start(robot.talk)
        for topic in robot.received:
            module.start(robot.listen, topic, Bulk if topic.startswith("nrt") else Number, name=topic)
        await robot.enough.wait()
        say("enough")
        await asyncio.to_thread(sys.stdin.read)
        (link,) = module.links
        say(json.dumps(robot.report() | {"lost": link.losses, "faults": link.stats.faults}))
        await module.stop()


if __name__ == "__main__":
    run_main(lambda: main(*sys.argv[1:]))
